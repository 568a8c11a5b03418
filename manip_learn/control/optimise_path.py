"""The null-space motion that is best over a whole horizon, never worse than the greedy law."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.manipulability_batch import manipulability_batch
from manip_learn.control.command import Controller
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent, NullSpacePolicy
from manip_learn.control.rollout import Rollout
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import FreeDirection, Task
from manip_learn.control.way import farthest_off, places_of
from manip_learn.errors import ConfigurationError, FeatureError, MissingExtraError
from manip_learn.linalg import finite
from manip_learn.robot.batch.postures import unwound
from manip_learn.robot.robot import Robot

SLOWNESS = 1.0  # cost of a knot at which the task stands still, in units of log mu: a factor e of manipulability
SMOOTHNESS = 1e-3  # cost of a change of velocity by 1 rad/s from one knot to the next, in units of log mu
STEP = 1e-6  # [rad or m] of forward differences


@final
class JointBounds(NamedTuple):
    """Bounds of the joints, shape (nv,) each; infinite where there is none.

    Attributes:
        lower: Lowest positions [rad or m].
        upper: Highest positions [rad or m].
        velocity: Highest speeds [rad/s or m/s].
        acceleration: Highest accelerations [rad/s2 or m/s2].
    """

    lower: Float[np.ndarray, " nv"]
    upper: Float[np.ndarray, " nv"]
    velocity: Float[np.ndarray, " nv"]
    acceleration: Float[np.ndarray, " nv"]


@final
class PathProblem:
    """Knots q_1 .. q_K at distances h in time from a fixed q_0, and the speed sigma_k of the task between them.

        minimise    -1/K sum_k log sqrt(mu(q_k)^2 + floor^2)  +  SLOWNESS/K sum_k (1 - sigma_k)  +  smoothness
        subject to  A(m_k) (q_k - q_{k-1}) = h sigma_k b(m_k, t_k),   m_k = (q_{k-1} + q_k) / 2,   0 <= sigma_k <= 1
                    position, velocity and acceleration limits

    The midpoint rule holds equation (1), A u = b, to second order in h for features of every kind, with coordinates or
    without. sigma_k is below 1 only where the limits leave no other way. The integral of the manipulability is the
    criterion of Nakamura, "Advanced Robotics: Redundancy and Optimization", 1991; its logarithm is free of the units of
    the constraint, and the floor keeps it finite at singularities.

    Args:
        constraint: A(q).
        task: b(q, t).
        start: q_0, joint positions.
        h: Time between knots [s].
        knots: K.
        bounds: Limits of the joints.
        floor: Manipulability below which the logarithm flattens out.
    """

    def __init__(
        self,
        constraint: Constraint,
        task: Task,
        start: Float[np.ndarray, " nv"],
        h: float,
        knots: int,
        bounds: JointBounds,
        floor: float,
    ):
        self.constraint, self.task, self.start = constraint, task, start
        self.h, self.knots, self.bounds, self.floor = h, knots, bounds, floor
        self.n, self.s = start.shape[0], constraint.n_constraints
        self.size = knots * (self.n + 1)
        # rows that bound nothing would cost the solver as much as those that do
        self._accelerates = bool(np.all(np.isfinite(bounds.acceleration)))
        self._known: tuple[bytes, tuple[np.ndarray, ...]] = (b"", ())
        # changes of velocity from knot to knot, in a row of postures without the fixed first one
        steps = np.eye(knots) - np.eye(knots, k=-1)
        changes = steps[1:] - steps[:-1]
        self._moves = np.kron(steps, np.eye(self.n))
        self._changes = np.kron(changes, np.eye(self.n))
        self._smoothing = SMOOTHNESS / (knots * h * h)

    def packed(self, q: Float[np.ndarray, "K nv"]) -> Float[np.ndarray, " size"]:
        """The variables from postures, with the task at its full speed."""
        return np.concatenate([q.reshape(-1), np.ones(self.knots)])

    def postures(self, x: Float[np.ndarray, " size"]) -> Float[np.ndarray, "knots nv"]:
        """q_0 .. q_K."""
        return np.vstack([self.start, x[: self.knots * self.n].reshape(self.knots, self.n)])

    def variable_bounds(self) -> tuple[Float[np.ndarray, " size"], Float[np.ndarray, " size"]]:
        """Lowest and highest values of the variables; a start outside the position limits may stay there."""
        K, b = self.knots, self.bounds
        low, high = np.minimum(b.lower, self.start), np.maximum(b.upper, self.start)
        return np.concatenate([np.tile(low, K), np.zeros(K)]), np.concatenate([np.tile(high, K), np.ones(K)])

    def constraint_bounds(self) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
        """Lowest and highest values of `constraints`."""
        K, h, b = self.knots, self.h, self.bounds
        speed, change = np.tile(h * b.velocity, K), np.tile(h * h * b.acceleration, K - 1)
        high = np.concatenate([np.zeros(K * self.s), speed, change if self._accelerates else change[:0]])
        return -high, high

    def objective(self, x: Float[np.ndarray, " size"]) -> float:
        """What is minimised."""
        q, scale = self.postures(x), x[self.knots * self.n :]
        mu = manipulability_batch(self.constraint, q[1:]).mu
        change = np.diff(q, 2, axis=0)
        log_mu = 0.5 * np.log(mu**2 + self.floor**2)
        return float(-np.mean(log_mu) + SLOWNESS * np.mean(1.0 - scale) + 0.5 * self._smoothing * np.sum(change**2))

    def gradient(self, x: Float[np.ndarray, " size"]) -> Float[np.ndarray, " size"]:
        """Gradient of `objective`."""
        q = self.postures(x)
        out = -self._log_gradient(q[1:]).reshape(-1) / self.knots
        out += self._smoothing * self._changes.T @ np.diff(q, 2, axis=0).reshape(-1)
        return np.concatenate([out, np.full(self.knots, -SLOWNESS / self.knots)])

    def _log_gradient(self, q: Float[np.ndarray, "m nv"]) -> Float[np.ndarray, "m nv"]:
        """Gradient of log sqrt(mu^2 + floor^2) = mu grad mu / (mu^2 + floor^2), 0 at a singularity."""
        batch = manipulability_batch(self.constraint, q)
        mu = batch.mu
        return (mu / (mu**2 + self.floor**2))[:, None] * batch.gradient

    def constraints(self, x: Float[np.ndarray, " size"]) -> Float[np.ndarray, " rows"]:
        """The task between the knots, displacements from knot to knot, and their changes."""
        q, scale = self.postures(x), x[self.knots * self.n :]
        middle, step = 0.5 * (q[1:] + q[:-1]), np.diff(q, axis=0)
        A = self.constraint.selection @ self.constraint.features.batch(middle)
        b = self._velocities(middle)
        task = np.einsum("kij,kj->ki", A, step) - self.h * scale[:, None] * b
        parts = [task.reshape(-1), step.reshape(-1)]
        if self._accelerates:
            parts.append(np.diff(step, axis=0).reshape(-1))
        return np.concatenate(parts)

    def jacobian(self, x: Float[np.ndarray, " size"]) -> Float[np.ndarray, "rows size"]:
        """Jacobian of `constraints`."""
        q, scale, h = self.postures(x), x[self.knots * self.n :], self.h
        A, dA, b, db = self._derivatives(x)
        bend = 0.5 * (np.einsum("kijl,kj->kil", dA, np.diff(q, axis=0)) - h * scale[:, None, None] * db)
        return self._jacobian_of(A + bend, bend - A, -h * b)

    def _jacobian_of(self, right: np.ndarray, left: np.ndarray, speed: np.ndarray) -> Float[np.ndarray, "rows size"]:
        """From the blocks along the knot after each step, the one before it, and the speed of the task."""
        K, n, k = self.knots, self.n, np.arange(self.knots)
        task = np.zeros((K, self.s, K + 1, n))  # the first posture is no variable
        task[k, :, k + 1], task[k, :, k] = right, left
        speeds = np.zeros((K, self.s, K))
        speeds[k, :, k] = speed
        rows = [task[:, :, 1:].reshape(K * self.s, K * n), self._moves, *([self._changes] if self._accelerates else [])]
        out = np.zeros((sum(map(len, rows)), self.size))
        out[:, : K * n] = np.concatenate(rows)
        out[: K * self.s, K * n :] = speeds.reshape(K * self.s, K)
        return out

    def hessian(
        self, x: Float[np.ndarray, " size"], weight: float, multipliers: Float[np.ndarray, " rows"]
    ) -> Float[np.ndarray, "size size"]:
        """weight * d2 objective + sum multipliers * d2 constraints, the upper triangle.

        The objective's by differences of its exact gradient; of the constraints the terms in dA/dq, without those in
        the second derivatives of A and b, which the step of time makes small.
        """
        q, K = self.postures(x), self.knots
        _, dA, _, db = self._derivatives(x)
        lam = multipliers[: K * self.s].reshape(K, self.s)
        M = np.einsum("ki,kijl->kjl", lam, dA)
        own = 0.5 * (M + M.transpose(0, 2, 1))
        blocks = -weight / K * self._log_hessian(q[1:]) + own
        blocks[:-1] -= own[1:]
        cross = -0.5 * self.h * np.einsum("ki,kil->kl", lam, db)
        return self._hessian_of(blocks, 0.5 * (M.transpose(0, 2, 1) - M)[1:], cross, weight * self._smoothing)

    def _hessian_of(
        self, blocks: np.ndarray, neighbours: np.ndarray, cross: np.ndarray, smooth: float
    ) -> Float[np.ndarray, "size size"]:
        """From the blocks of each knot, of each and the next, and of a step's two knots with the speed of the task."""
        K, n, k = self.knots, self.n, np.arange(self.knots)
        postures, speeds = np.zeros((K, n, K, n)), np.zeros((K + 1, n, K))
        postures[k, :, k] = blocks
        postures[k[:-1], :, k[1:]] = neighbours
        speeds[k, :, k] = cross
        speeds[k + 1, :, k] = cross
        out = np.zeros((self.size, self.size))
        out[: K * n, : K * n] = postures.reshape(K * n, K * n) + smooth * self._changes.T @ self._changes
        out[: K * n, K * n :] = speeds[1:].reshape(K * n, K)
        return np.triu(out)

    def patterns(self) -> tuple[Bool[np.ndarray, "rows size"], Bool[np.ndarray, "size size"]]:
        """Which entries of the Jacobian and of the Hessian can be other than zero."""
        K, n = self.knots, self.n
        block = np.ones((K, self.s, n))
        hessian = self._hessian_of(np.ones((K, n, n)), np.ones((K - 1, n, n)), np.ones((K, n)), 1e-3)
        return self._jacobian_of(block, block, block[:, :, 0]) != 0.0, hessian != 0.0

    def _derivatives(self, x: np.ndarray) -> tuple[np.ndarray, ...]:
        """A (K, s, nv), dA/dq, b (K, s) and db/dq at the midpoints; the solver asks for both matrices at one place."""
        key = x.tobytes()
        if self._known[0] == key:
            return self._known[1]
        q, Lambda = self.postures(x), self.constraint.selection
        middle = 0.5 * (q[1:] + q[:-1])
        Phi, dPhi = self.constraint.features.batch_with_derivative(middle)
        b = self._velocities(middle)
        db = np.empty((self.knots, self.s, self.n))
        for j in range(self.n):
            moved = middle.copy()
            moved[:, j] += STEP
            db[:, :, j] = (self._velocities(moved) - b) / STEP
        dA = np.einsum("sp,kpjl->ksjl", Lambda, dPhi, optimize=True)
        self._known = key, (Lambda @ Phi, dA, b, db)
        return self._known[1]

    def _velocities(self, q: np.ndarray) -> np.ndarray:
        times = (np.arange(self.knots) + 0.5) * self.h
        return np.array([self.task.velocity(self.constraint, x, t) for x, t in zip(q, times.tolist(), strict=True)])

    def _log_hessian(self, q: np.ndarray) -> np.ndarray:
        K, n = q.shape
        moved = np.repeat(q, n, axis=0) + np.tile(STEP * np.eye(n), (K, 1))
        gradients = self._log_gradient(np.vstack([q, moved]))
        H = (gradients[K:].reshape(K, n, n) - gradients[:K, None]) / STEP
        return 0.5 * (H + H.transpose(0, 2, 1))


@cache
def _evaluations() -> Any:
    """The class of functions of NumPy vectors that CasADi can call; made late, since CasADi is slow to load."""
    import casadi

    class Evaluation(casadi.Callback):
        def __init__(self, name: str, inputs: dict[str, Any], outputs: dict[str, Any], function: Callable[..., list]):
            casadi.Callback.__init__(self)
            self._names_in, self._names_out = tuple(inputs), tuple(outputs)
            self._in, self._out, self._function = tuple(inputs.values()), tuple(outputs.values()), function
            self.construct(name, {})

        def get_n_in(self) -> int:
            return len(self._in)

        def get_n_out(self) -> int:
            return len(self._out)

        def get_name_in(self, i: int) -> str:
            return self._names_in[i]

        def get_name_out(self, i: int) -> str:
            return self._names_out[i]

        def get_sparsity_in(self, i: int):
            return self._in[i]

        def get_sparsity_out(self, i: int):
            return self._out[i]

        def eval(self, arg):
            return self._function(*[np.asarray(a.nonzeros()) for a in arg])

    return Evaluation


def solve(
    problem: PathProblem, start: Float[np.ndarray, " size"], iterations: int, tolerance: float
) -> tuple[Float[np.ndarray, " size"], bool]:
    """Where IPOPT stops near a start, a local minimum as a rule, and whether its conditions of optimality hold there.

    Args:
        problem: Objective, constraints and their derivatives.
        start: First values of the variables; they need not be feasible.
        iterations: Most iterations.
        tolerance: Of the optimality conditions.
    """
    import casadi

    low, high = problem.constraint_bounds()
    size, rows, p = problem.size, low.shape[0], problem
    dense, function = casadi.Sparsity.dense, _evaluations()
    x, g, one, none = dense(size, 1), dense(rows, 1), dense(1, 1), dense(0, 1)

    def sparse(pattern: np.ndarray) -> tuple[Any, Callable[[np.ndarray], Any]]:
        columns, places = np.nonzero(pattern.T)  # CasADi's order, by columns
        sparsity = casadi.Sparsity.triplet(len(pattern), size, places.tolist(), columns.tolist())
        return sparsity, lambda matrix: casadi.DM(sparsity, matrix[places, columns])

    (J, jacobian), (H, hessian) = map(sparse, p.patterns())
    here, there = {"x": x, "p": none}, {"f": one, "g": g}
    weighted, upper = {**here, "lam_f": one, "lam_g": g}, {"triu_hess_gamma_x_x": H}
    options = {
        "grad_f": function("nlp_grad_f", here, {"f": one, "grad_f_x": x}, lambda v, _: [p.objective(v), p.gradient(v)]),
        "jac_g": function(
            "nlp_jac_g", here, {"g": g, "jac_g_x": J}, lambda v, _: [p.constraints(v), jacobian(p.jacobian(v))]
        ),
        "hess_lag": function("nlp_hess_l", weighted, upper, lambda v, _, f, m: [hessian(p.hessian(v, float(f[0]), m))]),
        "print_time": False,
        "no_nlp_grad": True,
        "ipopt": {"print_level": 0, "sb": "yes", "max_iter": iterations, "tol": tolerance, "mu_strategy": "adaptive"},
    }
    oracle = function("nlp", here, there, lambda v, _: [p.objective(v), p.constraints(v)])
    solver = casadi.nlpsol("path", "ipopt", oracle, options)
    lowest, highest = p.variable_bounds()
    answer = solver(x0=start, lbx=lowest, ubx=highest, lbg=low, ubg=high)
    return np.asarray(answer["x"]).reshape(-1), bool(solver.stats()["success"])


def check_joints_add_up(robot: Robot, what: str) -> None:
    """Refuse robots whose joint positions do not add up.

    Args:
        robot: The robot.
        what: What is done for other joints, in words.

    Raises:
        FeatureError: A floating or planar joint, or one of several coordinates; names the first.
    """
    unsuited = next((b for b in robot.blocks if b.kind in ("floating", "planar", "other")), None)
    if unsuited is not None:
        raise FeatureError(
            f"joint {unsuited.name!r} is {unsuited.kind}: {what} for revolute, continuous and prismatic joints only; "
            "load the robot with a fixed base"
        )


@final
class PathPolicy(NullSpacePolicy):
    """pi = dq*/dt + gain (q*(t) - q), q* a cubic spline through knots, at rest before the first and behind the last.

    Args:
        time: Times of the knots, rising [s].
        knots: Joint positions [rad or m], one row per knot.
        gain: Rate at which differences from the path are made up [1/s].
        robot: Whose joints they are; None for a system whose state is a plain vector.
    """

    def __init__(
        self, time: Float[np.ndarray, " K"], knots: Float[np.ndarray, "K nv"], gain: float, robot: Robot | None = None
    ):
        self.time = np.array(time, dtype=np.float64)
        self.knots = np.array(knots, dtype=np.float64)
        self.gain = float(gain)
        self._robot = robot
        self._spline = CubicSpline(self.time, self.knots, bc_type="natural")
        self._rate = self._spline.derivative()

    def __call__(self, q: ArrayLike, t: float = 0.0) -> Float[np.ndarray, " nv"]:
        """Velocity along the path and towards it [rad/s or m/s].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        first, end = float(self.time[0]), float(self.time[-1])
        goal = self._spline(min(max(t, first), end))
        posture = np.asarray(q, dtype=np.float64)
        error = goal - posture if self._robot is None else self._robot.difference(posture, goal)
        return self.gain * error + (self._rate(t) if first <= t < end else 0.0)

    def __repr__(self) -> str:
        return f"PathPolicy({len(self.time)} knots over {self.time[-1] - self.time[0]:g} s, gain={self.gain:g})"


Law = Callable[[NullSpacePolicy], Controller]
FLOOR_RATIO = 1e-2  # mu below this part of its median over random postures counts as singular
SPARE_SPEED = 0.98  # part of the velocity limit that the knots use: a spline overshoots its knots
TASK_SLACK, TASK_FLOOR = 1.01, 1e-6  # a path may leave this much more of the task undone than the greedy law
TASK_STRAY = 1e-3  # [m or rad] and on a way at no time by more: half of what a hand may be off what holds it
TOLERANCE = 1e-3  # of the conditions of optimality, in units of log mu
MOST_ITERATIONS = 60
SAMPLES = 200  # random postures: their median of mu is known within a tenth


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
    posture, start, random, bounds = _system(constraint, q0, acceleration_limit, rng or np.random.default_rng(0))
    floor = FLOOR_RATIO * max(float(np.median(manipulability_batch(rows, random).mu)), np.finfo(np.float64).tiny)

    def run(policy: NullSpacePolicy) -> _Candidate:
        rollout = simulate(constraint.robot, controller_of(policy), posture, duration, dt)
        mu = manipulability_batch(rows, rollout.q).mu
        return _Candidate(rollout, float(np.mean(0.5 * np.log(mu**2 + floor**2))))

    greedy = run(ManipulabilityAscent(rows, gain))
    problem = PathProblem(rows, task, start, duration / knots, knots, bounds, floor)
    pull = 4.0 / duration
    tried = [run(JointAttractor(goal, pull, constraint.robot)) for goal in random[:guesses]]
    best_guess = max([c for c in tried if _serves(c, greedy, task)], key=lambda c: c.score, default=None)
    found = [run(policy) for policy in _optimised(problem, [greedy] + ([best_guess] if best_guess else []))]
    acceptable = [c for c in [*found, *tried] if _serves(c, greedy, task)]
    return max([greedy, *acceptable], key=lambda c: c.score).rollout


@final
class _Candidate(NamedTuple):
    """A rollout and its mean over time of log sqrt(mu^2 + floor^2)."""

    rollout: Rollout
    score: float


def _optimised(problem: PathProblem, starts: list[_Candidate]) -> list[PathPolicy]:
    """Policies along the optima found from some rollouts; none where the solver left the feasible set."""
    policies, robot = [], problem.constraint.robot
    time = np.arange(problem.knots + 1) * problem.h
    for candidate in starts:
        rollout = candidate.rollout
        positions = rollout.q if robot is None else unwound(robot, rollout.q)
        at_knots = np.array([np.interp(time[1:], rollout.time, column) for column in positions.T]).T
        x, _ = solve(problem, problem.packed(at_knots), MOST_ITERATIONS, TOLERANCE)
        q = problem.postures(x)
        if np.all(np.isfinite(q)):
            policies.append(PathPolicy(time, q, 1.0 / problem.h, robot))
    return policies


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


def _system(
    constraint: Constraint, q0: ArrayLike, acceleration: ArrayLike | None, rng: np.random.Generator
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " nv"], Float[np.ndarray, "m nv"], JointBounds]:
    """The start, its joint positions, random ones, and bounds: of a robot, or of a system whose state is a vector."""
    robot, nv = constraint.robot, constraint.nv
    infinite = np.full(nv, np.inf)
    a = infinite if acceleration is None else np.broadcast_to(np.asarray(acceleration, dtype=np.float64), (nv,))
    if not np.all(a > 0.0):
        raise ConfigurationError(f"acceleration limits must be positive, got {a.tolist()}")
    if robot is not None:
        start = robot.checked_posture(q0)
        random = np.array([robot.positions(robot.random_configuration(rng)) for _ in range(SAMPLES)])
        bounds = JointBounds(robot.position_lower, robot.position_upper, SPARE_SPEED * robot.velocity_limit, a)
        return start, robot.positions(start), random, bounds
    if (start := finite(q0, nv)) is None:
        raise ConfigurationError(f"the start must be {nv} finite numbers, got {q0!r}")
    random = start + rng.uniform(-np.pi, np.pi, (SAMPLES, nv))
    return start, start, random, JointBounds(-infinite, infinite, infinite, a)


def _check(constraint: Constraint, knots: int, duration: float, dt: float) -> None:
    if find_spec("casadi") is None:
        raise MissingExtraError("optimising a path", "path")
    if not (np.isfinite(duration) and np.isfinite(dt) and 0.0 < dt <= duration):
        raise ConfigurationError(f"duration and dt must be positive numbers of seconds, got {duration!r} and {dt!r}")
    if not 3 <= knots <= round(duration / dt):
        raise ConfigurationError(f"knots must be between 3 and the {round(duration / dt)} steps, got {knots}")
    if constraint.robot is not None:
        check_joints_add_up(constraint.robot, "paths are optimised")
