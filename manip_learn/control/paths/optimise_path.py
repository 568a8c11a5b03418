"""The null-space motion that is best over a whole horizon, never worse than the greedy law."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.manipulability_batch import manipulability_batch
from manip_learn.control.command import Controller
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.paths.path_problem import JointBounds, PathPolicy, PathProblem, check_joints_add_up
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent, NullSpacePolicy
from manip_learn.control.rollout import Rollout
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import FreeDirection, Task
from manip_learn.control.way import farthest_off, places_of
from manip_learn.errors import ConfigurationError, MissingExtraError
from manip_learn.robot.batch.postures import unwound

Law = Callable[[NullSpacePolicy], Controller]
FLOOR_RATIO = 1e-2  # mu below this part of its median over random postures counts as singular
SPARE_SPEED = 0.98  # part of the velocity limit that the knots use: a spline overshoots its knots
TASK_SLACK, TASK_FLOOR = 1.01, 1e-6  # a path may leave this much more of the task undone than the greedy law
TASK_STRAY = 1e-3  # [m or rad] and on a way at no time by more: half of what a hand may be off what holds it
TOLERANCE = 1e-3  # of the conditions of optimality, in units of log mu
MOST_ITERATIONS = 60
SAMPLES = 200


def optimise_path(
    constraint: Constraint,
    task: Task,
    q0: ArrayLike,
    duration: float = 4.0,
    dt: float = 0.01,
    *,
    knots: int = 40,
    gain: float = 3.0,
    acceleration_limit: ArrayLike | None = None,
    guesses: int = 4,
    law: Law | None = None,
    rng: np.random.Generator | None = None,
) -> Rollout:
    """Null-space motion that maximises the mean of log mu over a horizon, along the task's own motion.

    The greedy law climbs the manipulability from instant to instant, and can be trapped where it must first become
    smaller, or by a joint limit. Here postures at `knots` instants are optimised together (see `PathProblem`; IPOPT
    through CasADi, the extra `path`), from the greedy law's own motion and from the best of a few motions to random
    postures. The controller then follows them in the null space of the task: every sample obeys the task and the limits
    as those of any other rollout do.

    Args:
        constraint: A(q); its features may be of any kind.
        task: b(q, t).
        q0: Start posture.
        duration: Horizon [s].
        dt: Step of the rollout [s].
        knots: Number of instants.
        gain: Of the greedy law, `ManipulabilityAscent`.
        acceleration_limit: Of each joint between knots [rad/s2 or m/s2]; None for none.
        guesses: Number of motions to random postures that are tried; 0 starts from the greedy law only.
        law: Null-space policy -> controller; by default a `ResolvedRateController` with its default settings.
        rng: Random numbers of the guesses; `np.random.default_rng(0)` by default.

    Returns:
        The rollout with the highest mean of log mu (bounded near singularities) out of the greedy one and those found,
        if its distance to the task's goal, both mean and final, is at most 1 % above the greedy one's, and, on a
        way, if the hand is at no time farther from what holds it by more than a millimetre or a milliradian.

    Raises:
        MissingExtraError: CasADi is not installed.
        ConfigurationError: A start that does not fit, knots fewer than 3 or more than the steps, limits not positive.
        FeatureError: Joints whose positions do not add up (planar and floating bases).
    """
    _check(constraint, knots, duration, dt)
    rows = task.rows(constraint)
    controller_of = law or (lambda policy: ResolvedRateController(constraint, task, policy, dt=dt))
    posture = _posture(constraint, q0)
    start = _positions(constraint, posture)
    rng = rng or np.random.default_rng(0)
    random = _random_postures(constraint, start, rng)
    floor = FLOOR_RATIO * max(float(np.median(manipulability_batch(rows, random).mu)), np.finfo(np.float64).tiny)

    def run(policy: NullSpacePolicy) -> _Candidate:
        rollout = simulate(constraint.robot, controller_of(policy), posture, duration, dt)
        return _Candidate(rollout, _score(rows, rollout, floor))

    greedy = run(ManipulabilityAscent(rows, gain))
    bounds = _bounds(constraint, start.shape[0], acceleration_limit)
    problem = PathProblem(rows, task, start, duration / knots, knots, bounds, floor)
    pull = 4.0 / duration
    tried = [run(JointAttractor(goal, pull, constraint.robot)) for goal in random[:guesses]]
    best_guess = max([c for c in tried if _serves(c, greedy, task)], key=lambda c: c.score, default=None)
    found = [run(policy) for policy in _optimised(problem, [greedy] + ([best_guess] if best_guess else []))]
    acceptable = [c for c in [*found, *tried] if _serves(c, greedy, task)]
    return max([greedy, *acceptable], key=lambda c: c.score).rollout


@final
class _Candidate(NamedTuple):
    """A rollout and its mean of bounded log mu."""

    rollout: Rollout
    score: float


def _optimised(problem: PathProblem, starts: list[_Candidate]) -> list[PathPolicy]:
    """Policies along the optima found from some rollouts; none where the solver left the feasible set."""
    from manip_learn.control.paths.interior_point import solve

    policies, robot = [], problem.constraint.robot
    time = np.arange(problem.knots + 1) * problem.h
    for candidate in starts:
        rollout = candidate.rollout
        positions = rollout.q if robot is None else unwound(robot, rollout.q)
        at_knots = np.array([np.interp(time[1:], rollout.time, column) for column in positions.T]).T
        solution = solve(problem, problem.packed(at_knots), MOST_ITERATIONS, TOLERANCE)
        q = problem.postures(solution.x)
        if np.all(np.isfinite(q)):
            policies.append(PathPolicy(time, q, 1.0 / problem.h, robot))
    return policies


def _score(constraint: Constraint, rollout: Rollout, floor: float) -> float:
    """Mean over time of log sqrt(mu^2 + floor^2)."""
    mu = manipulability_batch(constraint, rollout.q).mu
    return float(np.mean(0.5 * np.log(mu**2 + floor**2)))


def _serves(candidate: _Candidate, greedy: _Candidate, task: Task) -> bool:
    """Whether a candidate comes as close to its goal as the greedy law does: on average and in the end, and, on a
    way, no farther from what holds the hand.
    """
    ours, theirs = candidate.rollout.task_error, greedy.rollout.task_error
    if np.any(np.isnan(theirs)):
        return True
    allowed = TASK_SLACK * np.array([np.mean(theirs), theirs[-1]]) + TASK_FLOOR
    strays = _strays(task, candidate.rollout) > _strays(task, greedy.rollout) + TASK_STRAY
    return bool(np.mean(ours) <= allowed[0] and ours[-1] <= allowed[1] and not strays)


def _strays(task: Task, rollout: Rollout) -> float:
    """Largest distance of the hand from what holds it on a way [m or rad]; 0 for other tasks."""
    return farthest_off(task, rollout, places_of(task, rollout)) if isinstance(task, FreeDirection) else 0.0


def _posture(constraint: Constraint, q0: ArrayLike) -> Float[np.ndarray, " n"]:
    if constraint.robot is not None:
        return constraint.robot.checked_posture(q0)
    vector = np.array(q0, dtype=np.float64)
    if vector.shape != (constraint.nv,) or not np.all(np.isfinite(vector)):
        raise ConfigurationError(f"the start must be {constraint.nv} finite numbers, got {vector.tolist()}")
    return vector


def _positions(constraint: Constraint, q: Float[np.ndarray, " n"]) -> Float[np.ndarray, " nv"]:
    return q if constraint.robot is None else constraint.robot.positions(q)


def _random_postures(constraint: Constraint, start: np.ndarray, rng: np.random.Generator) -> Float[np.ndarray, "m nv"]:
    robot = constraint.robot
    if robot is None:
        return start + rng.uniform(-np.pi, np.pi, (SAMPLES, start.shape[0]))
    return np.array([robot.positions(robot.random_configuration(rng)) for _ in range(SAMPLES)])


def _bounds(constraint: Constraint, n: int, acceleration: ArrayLike | None) -> JointBounds:
    infinite = np.full(n, np.inf)
    a = infinite if acceleration is None else np.broadcast_to(np.asarray(acceleration, dtype=np.float64), (n,))
    if not np.all(a > 0.0):
        raise ConfigurationError(f"acceleration limits must be positive, got {a.tolist()}")
    robot = constraint.robot
    if robot is None:
        return JointBounds(-infinite, infinite, infinite, a)
    return JointBounds(robot.position_lower, robot.position_upper, SPARE_SPEED * robot.velocity_limit, a)


def _check(constraint: Constraint, knots: int, duration: float, dt: float) -> None:
    if find_spec("casadi") is None:
        raise MissingExtraError("optimising a path", "path")
    if not (np.isfinite(duration) and np.isfinite(dt) and 0.0 < dt <= duration):
        raise ConfigurationError(f"duration and dt must be positive numbers of seconds, got {duration!r} and {dt!r}")
    if not 3 <= knots <= round(duration / dt):
        raise ConfigurationError(f"knots must be between 3 and the {round(duration / dt)} steps, got {knots}")
    if constraint.robot is not None:
        check_joints_add_up(constraint.robot, "paths are optimised")
