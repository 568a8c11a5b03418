"""From any start: the posture in which to take hold, how to get there, and the way, so that all of it can be done."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.manipulability import manipulability_batch
from manip_learn.constraint.skill import Take
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.follow_motion import ARRIVED
from manip_learn.control.keeping_clear import CLEARANCE
from manip_learn.control.law_sequence import JointMotion, LawSequence, every_joint
from manip_learn.control.limits import Limits, check_inside
from manip_learn.control.policies import NullSpacePolicy
from manip_learn.control.rollout import Rollout
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks.driven_motion import way_in_words
from manip_learn.control.tasks.motion import FreeDirection
from manip_learn.control.way import WayDone, joint_at_limit, simulate_way
from manip_learn.errors import ConfigurationError, FeatureError, MissingExtraError, NoPlanError, TargetError, an
from manip_learn.planning.clearance import Clearance, Surroundings
from manip_learn.planning.following import ENOUGH, Followed, carried, followed, joined, nearest_turn
from manip_learn.planning.joint_path import joint_path
from manip_learn.planning.scene import Scene
from manip_learn.planning.search import TIE, Marches, marches_of, relaxed
from manip_learn.planning.stations import (
    FEWEST,
    MOST,
    PERIOD,
    Margins,
    Postures,
    Stations,
    margins_of,
    node_margins,
)
from manip_learn.recordings.load import Progress
from manip_learn.robot.batch.postures import unwound
from manip_learn.robot.collision import SelfCollision
from manip_learn.robot.robot import Robot

_CANDIDATES = 384  # seeds: with 2,000 the best margin of a drawer rises by less than 0.01 (benchmarks/planned_ways.py)
LEAST_CANDIDATES = 8  # three stations, three kinds of pull, and the start
FOLLOWING = 5.0  # [1/s] pull back to the planned postures, half as hard as the task's own feedback
APPROACH_SHARE = 0.25  # of the velocity limits, on the way to the posture of hold: beside people, as ISO 10218-1
AGAIN = 4  # times the seeds before a plan is refused
_TRIED = 8  # choices that are simulated, best margin first
VAIN = 3  # searches for an approach that find none, half a second each: then straight ones only
OTHERS = 4  # choices of which a refusal looks how far they come
SPARE = 1.1  # times the time that the fastest joint needs: its speed also takes deviations back
LESS = 0.9  # of a way that did not come true is tried next
LEAST_SHARE = 0.01  # of the whole way: less is no part of it
LOOKED = 20  # of marches in whose way something is, for what would help
LOOKED_AT = 6  # every such posture of a recording is looked at beside what stands around
_SEEN = 60  # postures of an approach of which a plan says how near they come to what stands around
Around = Scene | Literal["assumed"] | None


@final
@dataclass(frozen=True, eq=False, repr=False)
class Plan:
    """A posture in which to take hold, the approach to it, and the way with its null-space motion.

    Attributes:
        robot: The robot.
        q_grasp: Joint positions in which the hand takes hold [rad or m].
        approach: From the start to that posture, as simulated.
        way: The motion itself, as simulated, from the time when the hand has taken hold.
        margin: Least share of its own limits that the way leaves, at most 1: of the joints' ranges, of their speeds,
            of what the weakest direction could do (`manip_learn.planning.stations` has the formula).
        margins: The same in parts, with where and which joint.
        outcome: What became of the way: how far, how straight, how fast.
        controller: Runs the plan, in `simulate` and in a `ServoLoop`, from the start.
        candidates: Number of postures at the first station that were compared.
        notes: What was not looked at, in sentences.
        around: What approach and way keep clear of.
        take: The recording that it follows; None of a plan that was searched.
    """

    robot: Robot
    q_grasp: Float[np.ndarray, " nv"]
    approach: Rollout
    way: Rollout
    margin: float
    margins: Margins
    outcome: WayDone
    controller: LawSequence
    candidates: int
    notes: tuple[str, ...] = ()
    around: Surroundings = Surroundings()
    take: Take | None = None

    @property
    def rollout(self) -> Rollout:
        """Approach and way, one after the other; its phases are the approach, the hold and the way."""
        return self.approach.followed_by(self.way)

    def save(self, path: str | Path) -> Path:
        """Write approach and way as one file; formats and errors as for `Rollout.save`."""
        return self.rollout.save(path)

    @property
    def sentence(self) -> str:
        """What is planned, in words."""
        far = float(np.max(np.abs(self.approach.q[-1] - self.approach.q[0]), initial=0.0))
        moved = "take hold as it stands" if far < ARRIVED else f"take hold after {self.approach.time[-1]:.1f} s"
        return (
            f"{moved}, then {way_in_words(self.outcome.done, self.outcome.unit)} in {self.outcome.seconds:.3g} s; "
            f"margin {self.margin:.0%}: {self.margins.limited_by(self.outcome.unit)}"
        )

    def __repr__(self) -> str:
        return f"Plan({self.sentence})"

    def to_dict(self) -> dict[str, Any]:
        """The JSON answer: lengths in m, angles in rad, of the way in degrees."""
        return {
            "margin": self.margin,
            "limited_by": self.margins.limited_by(self.outcome.unit),
            "least_singular_value": self.margins.singular_value,
            "hold": self.q_grasp.tolist(),
            "approach_seconds": float(self.approach.time[-1]),
            "candidates": self.candidates,
            "notes": list(self.notes),
            "clear_of": list(self.around.names),
        }


def plan(
    constraint: Constraint,
    motion: FreeDirection,
    start: ArrayLike,
    seed: int = 0,
    *,
    candidates: int = _CANDIDATES,
    limits: Limits | None = None,
    collision: SelfCollision | bool = True,
    scene: Around = "assumed",
    dt: float = 0.01,
    progress: Progress | None = None,
) -> Plan:
    """The posture in which to take hold so that the whole way can be done, and the motion from the start through it.

    Whether a drawer opens is decided before the pull begins: by the posture in which the handle is taken. The hand's
    place is that of the motion (see `motion`); the posture is chosen among hundreds by the least margin over the whole
    way, in units of its own limits (`manip_learn.planning.stations` has the formula); of margins within a
    hundredth of each other the larger manipulability of the rows held and driven decides. The best is simulated, and
    taken if the whole way is done within 2 mm of what holds the hand; else the next one. An arm that does as well from
    where it stands takes hold there. Approach and way keep clear of the arm's own links and of the scene by 5 mm.

    Args:
        constraint: What holds the hand.
        motion: The way along it, as `motion` makes it.
        start: Posture before the motion.
        seed: Of the random postures: the same seed gives the same plan.
        candidates: Number of postures from which the search begins.
        limits: Of the joints; the robot's own by default.
        collision: The pairs of links that must not touch; True for those of the robot's shapes, False for none.
        scene: What stands around; None for nothing. By default a floor under the base is assumed, below all that the
            recordings show and that the arm is in at the start.
        dt: Step of the simulation [s].
        progress: As for `simulate`.

    Raises:
        NoPlanError: The way cannot be done from any posture that was tried; says how much of it can, what stops it,
            and what would help.
        TargetError: A start outside the limits or in collision, a way longer than what was shown, a grasp that does
            not fit.
        MissingExtraError: Something is in the way of the straight approach, and RoboPlan is not installed.
        ConfigurationError: A start of another size, a joint without velocity limit, a number that is none.
        FeatureError: Rows that are not those of a frame, or a robot with a floating or planar base.

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("sawyer")
        >>> drawer = ml.Constraint([[0, 1, 0], [0, 0, 1]], ml.FrameJacobian(robot, "right_gripper_tip"))
        >>> plan = ml.plan(drawer, ml.motion(drawer, distance=-0.2), [0.0, -1.0, 0.0, 1.7, 0.0, 0.8, 0.0], seed=0)
        >>> bool(plan.outcome.is_done), plan.way.q.shape[1]
        (True, 7)
    """
    if candidates < LEAST_CANDIDATES:
        raise ConfigurationError(f"a plan needs {LEAST_CANDIDATES} candidates or more, got {candidates!r}")
    problem = _Problem(constraint, motion, start, seed, limits, collision, scene, dt)
    problem.check()
    return _searched(problem, candidates, progress or (lambda _title, _share: None))


def plan_as_shown(
    constraint: Constraint,
    motion: FreeDirection,
    start: ArrayLike,
    takes: Sequence[Take],
    seed: int,
    *,
    limits: Limits,
    scene: Around,
    dt: float,
    progress: Progress,
) -> Plan:
    """The plan that follows one of the recordings; that of `plan`, whose arguments and errors these are, where none can
    be followed or none is given.
    """
    problem = _Problem(constraint, motion, start, seed, limits, True, scene, dt, takes)
    problem.check()
    found = problem.as_it_stands(None) if takes else None
    if takes and (found is None or found.margin < ENOUGH):
        shown = problem.follow(progress)
        found = found if shown is None or (found is not None and found.margin > shown.margin) else shown
    if found is not None:
        return found
    found = _searched(problem, _CANDIDATES, progress)
    said = "no recording could be followed: the posture was searched"
    return replace(found, notes=(*found.notes, said)) if takes else found


def _searched(problem: _Problem, candidates: int, said: Progress) -> Plan:
    said("comparing postures", 0.1)
    marches = problem.marches(candidates)
    if problem.slow_down(marches):
        marches = problem.marches(candidates)
    found = problem.best(marches, said)
    if found is None:
        said("comparing more postures", 0.5)
        marches = problem.marches(AGAIN * candidates)
        found = problem.best(marches, said)
    found = problem.as_it_stands(found) or found
    if found is None and problem.missing is not None:
        raise problem.missing
    if found is None:
        said("looking for what would help", 0.6)
        raise problem.refusal(marches, candidates)
    said("planned", 1.0)
    return found


def moved_to(
    goal: Float[np.ndarray, " nv"],
    start: Float[np.ndarray, " nq"],
    limits: Limits,
    clear: Clearance,
    seed: int,
    dt: float,
) -> tuple[ResolvedRateController, Rollout] | None:
    """The motion of the joints from one posture to another, and its law; None where something is in the way.

    Args:
        goal: Joint positions.
        start: A configuration.
        limits: Of the joints.
        clear: What is clear.
        seed: Of the path around what is in the way.
        dt: Step of the simulation [s].

    Raises:
        MissingExtraError: Something is in the way of the straight motion, and RoboPlan is not installed.
    """
    robot = limits.robot
    path = joint_path(robot, robot.positions(start), goal, limits, clear, seed)
    return None if path is None else _through(path, start, limits, dt)


def moved_as_shown(
    knots: Postures | None, start: Float[np.ndarray, " nq"], limits: Limits, clear: Clearance, dt: float
) -> tuple[ResolvedRateController, Rollout] | None:
    """The smooth motion of the joints through knots, and its law; None where these are not within limits and clear."""
    if knots is None or np.any((knots < limits.lower) | (knots > limits.upper)) or not clear.of_way(knots):
        return None
    return _through(knots, start, limits, dt, through=True)


def _through(
    knots: ArrayLike, start: Float[np.ndarray, " nq"], limits: Limits, dt: float, *, through: bool = False
) -> tuple[ResolvedRateController, Rollout] | None:
    """The motion of the joints through knots, and its law, see `JointMotion`; None where it does not arrive."""
    robot = limits.robot
    task = JointMotion(limits, knots, APPROACH_SHARE, through=through)
    law = ResolvedRateController(every_joint(robot), task, limits=limits, dt=dt)
    rollout = simulate(robot, law, start, task.duration + 1.0, dt)
    arrived = np.flatnonzero((rollout.task_error < ARRIVED) & (rollout.time >= task.duration))
    return (law, rollout.until(float(rollout.time[arrived[0]]))) if len(arrived) else None


@final
class PathPolicy(NullSpacePolicy):
    """pi = dq*/dt + gain (q*(t) - q), q* a cubic spline through knots, at rest before the first and behind the last.

    Args:
        time: Times of the knots, rising [s].
        knots: Joint positions [rad or m], one row per knot.
        gain: Rate at which differences from the path are made up [1/s].
        robot: Whose joints they are.
        moving: shape (nv,), joints that follow the path; None for all.
        motion: The way along which the path leads: its times count from where that begins; None from the first call on.
    """

    def __init__(
        self,
        time: Float[np.ndarray, " K"],
        knots: Float[np.ndarray, "K nv"],
        gain: float,
        robot: Robot,
        moving: Bool[np.ndarray, " nv"] | None = None,
        motion: FreeDirection | None = None,
    ):
        self._motion = motion
        self.time = np.array(time, dtype=np.float64)
        self.knots = np.array(knots, dtype=np.float64)
        self.gain = float(gain)
        self._robot, self._moving = robot, True if moving is None else moving
        self._spline = CubicSpline(self.time, self.knots, bc_type="natural")
        self._rate = self._spline.derivative()

    def __call__(self, q: ArrayLike, t: float = 0.0) -> Float[np.ndarray, " nv"]:
        """Velocity along the path and towards it [rad/s or m/s].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        first, end = float(self.time[0]), float(self.time[-1])
        if self._motion is not None:
            begins = self._motion.way_begins
            t = first if begins is None else t - begins
        goal = self._spline(min(max(t, first), end))
        error = self._robot.difference(np.asarray(q, dtype=np.float64), goal) * self._moving
        return self.gain * error + (self._rate(t) if first < t < end else 0.0)

    def __repr__(self) -> str:
        return f"PathPolicy({len(self.time)} knots over {self.time[-1] - self.time[0]:g} s, gain={self.gain:g})"


@final
class _Problem:
    """One call of `plan`."""

    def __init__(
        self,
        constraint: Constraint,
        motion: FreeDirection,
        start: ArrayLike,
        seed: int,
        limits: Limits | None,
        collision: SelfCollision | bool,
        scene: Around,
        dt: float,
        takes: Sequence[Take] = (),
    ):
        if not isinstance(motion, FreeDirection):
            raise ConfigurationError(
                f"call plan(constraint, motion, start): the motion is {an(motion)}; "
                + "motion(constraint, distance=... | angle=...) makes one"
            )
        self.rows = motion.rows(constraint)
        robot = constraint.robot
        if robot is None:
            raise FeatureError("a way is planned for a robot: the features have none")
        self.robot, self.constraint, self.motion = robot, constraint, motion.with_distance(motion.wanted)
        self.start = robot.checked_posture(start)
        self.limits, self.dt = limits or Limits(robot), dt
        self.takes, self.seed, self.rng = takes, seed, np.random.default_rng(seed)
        self.missing: MissingExtraError | None = None  # what would look for a way around it
        self.vain = 0  # searches for an approach that found none
        self.unreached: tuple[str, str] | None = None  # what stands between the start and a posture of hold
        unsuited = next((b for b in robot.blocks if b.kind in ("floating", "planar", "other")), None)
        if unsuited is not None:
            raise FeatureError(
                f"joint {unsuited.name!r} is {unsuited.kind}: a way is planned for revolute, continuous and prismatic "
                "joints only; load the robot with a fixed base"
            )
        endless = np.flatnonzero(~np.isfinite(self.limits.velocity))
        if len(endless):
            raise ConfigurationError(
                f"joint {robot.joint_names[endless[0]]!r} has no velocity limit, in units of which margins are counted"
                ": state it in the robot's description, or pass limits=Limits(robot, velocity=...)"
            )
        self.positions = robot.positions(self.start)
        self.stations, self.notes = Stations.of(self.motion, self.start, self.limits), ()
        tip = self.limits.tip
        if tip is not None and (times := self.stations.tip_speed / tip.pace) > 1.01:  # a pace leaves 2 %
            self._take_longer(times, f"{tip.speed:.3g} m/s at the tip")
        around = Surroundings()
        if scene is not None:
            if not isinstance(scene, Scene) and scene != "assumed":
                raise ConfigurationError(
                    f"a scene is a Scene, None for nothing, or left out to be assumed, not {an(scene)}"
                )
            features: Any = self.rows.features
            around = Surroundings.of(None if scene == "assumed" else scene, robot, features.frame)
        shown = [np.array(x, dtype=np.float64) for x in constraint.provenance.get("postures", ()) if len(x) == robot.nv]
        passed = [q for take in takes for q in take.q[::LOOKED_AT]]
        self.clear = Clearance(robot, collision, around, self.positions, [*shown, *passed])
        self.notes = (*self.clear.notes, *self._contradicted(around), *self.notes)

    def _contradicted(self, around: Surroundings) -> Iterator[str]:
        """What the recordings say against a stated scene, in sentences."""
        stated, deepest = set(around.names) - around.assumed, dict[str, tuple[float, str]]()
        for take in self.takes if stated else ():
            for q in take.q[::LOOKED_AT] if np.allclose(take.moved, np.eye(4)) else ():
                pair = self.clear.touching(q, distance=0.0)
                if pair is not None and (name := pair.links[1]) in stated:
                    deepest[name] = max(deepest.get(name, (0.0, "")), (-pair.distance, take.name))
        for name, (depth, take) in deepest.items():
            yield f"{take} passes {1e3 * depth:.0f} mm inside {name!r}: the scene does not stand where it was shown"

    def check(self) -> None:
        """Refuse a start, a way or a grasp that cannot be."""
        check_inside(self.robot, self.positions)
        touching = self.clear.touching(self.positions, distance=0.0)
        if touching is not None:
            one, other = touching.links
            raise TargetError(
                f"at the start {one!r} and {other!r} touch, {-touching.distance:.2g} m deep: start elsewhere"
                + (f", or correct {other!r} in the scene" if other in self.clear.around.names else "")
            )

    def marches(self, candidates: int, stations: Stations | None = None) -> Marches:
        """Postures along the way."""
        return marches_of(stations or self.stations, self.rows, self.positions, candidates, self.rng)

    def slow_down(self, marches: Marches) -> bool:
        """Give the way more time, where no posture is found from which the joints are fast enough for it."""
        margin = float(np.max(marches.along[:, -1], initial=-np.inf))
        if not -np.inf < margin < -TIE:
            return False
        self._take_longer(SPARE * (1.0 - margin), "the joints are too slow for it")
        return True

    def _take_longer(self, times: float, why: str) -> None:
        """Slow the way down by a factor, and note why and how long it takes."""
        before, self.motion = self.motion.duration, self.motion.slowed(times)
        self.stations = Stations.of(self.motion, self.start, self.limits)
        far = way_in_words(self.motion.wanted, self.motion.unit)
        self.notes = (*self.notes, f"{why}: {far} takes {self.motion.duration:.3g} s instead of {before:.3g} s")

    def best(self, marches: Marches, said: Progress) -> Plan | None:
        """The plan with the largest margin that comes true in simulation; None if none does.

        Plans in which the hand takes hold turned as in the recordings come first, where these say how that was.
        """
        if self.stations.grip is None:
            return self._best(marches, said, False)
        found = self._best(marches.as_shown, said, True)
        if found is None and (found := self._best(marches, said, False)) is not None:
            note = "the hand takes hold turned otherwise than shown: so turned it finds no way"
            found = replace(found, notes=(*found.notes, note))
        return found

    def _best(self, marches: Marches, said: Progress, is_as_shown: bool) -> Plan | None:
        last = len(self.stations) - 1
        choices, tried = marches.choices(last), 0
        clear = self.clear.holding(marches.q[choices, 0])
        for march in choices.tolist():
            if self.vain >= VAIN and not clear.of_line(self.positions, marches.q[march, 0]):
                continue
            path = self._relaxed(marches.q[march], clear, is_as_shown)
            if path is None:
                continue
            if (tried := tried + 1) > _TRIED:
                break
            said("simulating the best of them", 0.3 + 0.08 * tried)
            for way in (nearest_turn(self.robot, path, self.positions), path):
                if (moved := self._approach(way[0], clear)) is not None:
                    law = self._law(self.motion, self.stations.time, way)
                    if (found := self._come_true(law, moved, clear, len(choices), way)) is not None:
                        return found
                    break
            else:
                self.unreached = clear.in_line(self.positions, path[0])
        return None

    def _relaxed(self, march: Postures, clear: Clearance, is_as_shown: bool) -> Postures | None:
        """The postures of a march, relaxed where that is clear and right too; None where something is in its way."""

        def right(way: Postures) -> bool:
            return (not is_as_shown or bool(self.stations.takes_hold_as_shown(way[:1])[0])) and clear.of_way(way)

        if not right(march):
            return None
        better = relaxed(self.stations, march)
        return better if right(better) else march

    def _approach(
        self, goal: Float[np.ndarray, " nv"], clear: Clearance
    ) -> tuple[ResolvedRateController, Rollout] | None:
        """The motion from the start to the posture of hold, and its law; None where something is in the way."""
        try:
            moved = moved_to(goal, self.start, self.limits, clear, self.seed, self.dt)
        except MissingExtraError as error:  # straight motions to other postures may be clear
            self.missing, moved = error, None
        if moved is None:
            self.vain += 1
            return None
        law, rollout = moved
        return law, replace(rollout, manipulability=manipulability_batch(self.rows, rollout.q).mu)

    def _law(self, motion: FreeDirection, time: Float[np.ndarray, " k"], path: Postures) -> ResolvedRateController:
        """What does a motion with its spare joints along postures at times since the way began [s]."""
        task = motion.with_distance(motion.wanted)  # which remembers its own start
        policy = PathPolicy(time, path, FOLLOWING, self.robot, self.stations.moving, task)
        return ResolvedRateController(self.constraint, task, policy, limits=self.limits, dt=self.dt)

    def follow(self, said: Progress) -> Plan | None:
        """The way as the first recording that comes true shows it, see `planning.following`; None if none does."""
        compared = 0
        for one in followed(self.motion, self.rows, self.takes, self.stations, self.positions):
            said(f"following {one.take.name}", 0.2 + 0.6 * compared / len(self.takes))
            compared += 1
            path = nearest_turn(self.robot, one.path, self.positions)
            clear = self.clear.holding([path[0]])
            came = self._came(one, path[0], clear) if clear.of_way(path) else None
            if came is None:
                continue
            how, moved = came
            motion, stations, notes = one.motion, one.stations, [f"follows {one.take.name}, the approach {how}"]
            if one.margins.speed < 0.0:
                motion = motion.slowed(SPARE * (1.0 - one.margins.speed))
                ways, stations = np.abs(stations.distance), Stations.of(motion, self.start, self.limits)
                path = np.column_stack([np.interp(np.abs(stations.distance), ways, x) for x in path.T])
                notes.append(f"the joints are too slow for it: it takes {motion.duration:.3g} s")
            found = self._come_true(self._law(motion, stations.time, path), moved, clear, compared, path, stations)
            if found is not None:
                return replace(found, take=one.take, notes=(*found.notes, *notes))
        return None

    def _came(
        self, one: Followed, hold: Float[np.ndarray, " nv"], clear: Clearance
    ) -> tuple[str, tuple[ResolvedRateController, Rollout]] | None:
        """How the hand comes to a posture of hold: as it was shown, else straight, else around what is in the way."""
        before = np.where(self.stations.moving, one.take.before, self.positions)
        before = carried(self.constraint.features, before, one.take.moved)
        knots = joined(nearest_turn(self.robot, before[::-1], hold)[::-1], self.positions, hold)
        if (moved := moved_as_shown(knots, self.start, self.limits, clear, self.dt)) is not None:
            mu = manipulability_batch(self.rows, moved[1].q).mu
            return "as shown", (moved[0], replace(moved[1], manipulability=mu))
        moved = self._approach(hold, clear)
        return (
            None
            if moved is None
            else ("straight" if clear.of_line(self.positions, hold) else "around what is in the way", moved)
        )

    def as_it_stands(self, found: Plan | None) -> Plan | None:
        """The way from the start with the ascent of mu, or with spare joints at rest.

        Args:
            found: The plan otherwise.

        Returns:
            None where that does not come true, or leaves less than the other plan by more than a tie.
        """
        if self.motion.hold(self.start) > 0.0:
            return None
        least, compared = (-np.inf, 0) if found is None else (found.margin - TIE, found.candidates)
        if node_margins(self.stations, self.positions[None], np.zeros(1, dtype=int)).least[0] < least:
            return None  # where the way begins it leaves less already
        clear = self.clear.holding([self.positions])
        if (moved := self._approach(self.positions, clear)) is None:
            return None
        for climbs in (True, False):
            task = self.motion.with_distance(self.motion.wanted)
            policy = task.ascent() if climbs else None
            law = ResolvedRateController(self.constraint, task, policy, limits=self.limits, dt=self.dt)
            stands = self._come_true(law, moved, clear, compared)
            if stands is not None and stands.margin >= least:
                return stands
        return None

    def _come_true(
        self,
        law: ResolvedRateController,
        moved: tuple[ResolvedRateController, Rollout],
        clear: Clearance,
        compared: int,
        path: Postures | None = None,
        stations: Stations | None = None,
    ) -> Plan | None:
        """The plan of a way after an approach; None where it does not come true in simulation.

        Args:
            law: What does the way.
            moved: The law of the approach, and its rollout.
            clear: What is clear.
            compared: Number of postures that were compared.
            path: Postures at stations, whose margins count; None for those of the simulation.
            stations: These; by default those of the problem.
        """
        to_hold, approach = moved
        way, outcome = simulate_way(self.robot, law, approach.q[-1], self.dt)
        joints, stations = unwound(self.robot, way.q), stations or self.stations
        if not outcome.is_done or outcome.strays or outcome.begins is None or not clear.of_way(joints):
            return None
        hold = self.positions if path is None else path[0]
        if path is None:
            time = outcome.begins + stations.time * (outcome.seconds or 0.0) / stations.time[-1]
            path = np.column_stack([np.interp(time, way.time, column) for column in joints.T])
        margins, held, end = margins_of(stations, path), outcome.begins, float(way.time[-1])
        approach = replace(approach, phases=(("approach", 0.0, float(approach.time[-1])),))
        done = ({**outcome.to_dict(), "margin": margins.margin},)
        way = replace(way, phases=(*((("hold", 0.0, held),) if held else ()), ("way", held, end)), ways=done)
        seen = (run.q[:: len(run) // _SEEN + 1] for run in (approach, way))
        way = replace(way, around=self.clear.plain(self.robot.positions(q) for q in np.concatenate([*seen])))
        numbers = margins.margin, margins, outcome, LawSequence(to_hold, law), compared, self.notes, self.clear.around
        return Plan(self.robot, hold, approach, way, *numbers)

    # ---- where there is no plan -----------------------------------------------------------------------------------

    def refusal(self, marches: Marches, candidates: int) -> NoPlanError:
        """How much of the way can be done, what stops it, and what would help, from all marches compared."""
        takes_hold = marches.q[np.isfinite(marches.least[:, 0]), 0]
        clear = marches.where(self.clear.holding(takes_hold))
        last, end = clear.reached, len(self.stations) - 1
        pair, helps = self._in_the_way(marches) if last < marches.reached == end else (None, ())
        if self.unreached is not None and last == end:
            pair = self.unreached
        if self.stations.holds_orientation:
            end_of = self.marches(candidates // 2, self.stations.free_to_turn())
            if end_of.reached == end:
                helps += ("a hand that may turn on the way could do it",)
        more = "".join(f"; {sentence}" for sentence in helps)
        if marches.reached < 0:
            low, high = self.stations.span
            q = self.rng.uniform(low, high, (min(candidates, 64), self.robot.nv))
            q, _ = self.stations.onto(q, np.zeros(len(q), dtype=int), 60)
            gap = np.min(np.linalg.norm(self.stations.hand.pose(q)[:, :3, 3] - self.stations.places[0], axis=1))
            return NoPlanError(
                "no posture takes hold: the handle is out of the arm's reach, "
                f"the hand comes within {gap:.2g} m of it{more}",
                largest=0.0,
                posture=None,
                stopped_by="the end of the arm's reach",
                helps=helps,
            )
        largest, stopped_by, posture = 0.0, self._stopped_by(marches), None
        if last >= 1:
            paths = [clear.q[march, : last + 1] for march in clear.choices(last)[:OTHERS]]
            ends = [self._largest(path) for path in paths]
            longest = max(range(len(ends)), key=lambda i: abs(ends[i][0]))
            largest, posture = ends[longest][0], paths[longest][0] if ends[longest][0] else None
            stopped_by = ends[longest][1] or stopped_by
        if pair is not None:
            stopped_by = f"{pair[0]} and {pair[1]}, which would touch" + (
                " on the way from the start to where the hand takes hold" if last == end else ""
            )
        return NoPlanError(
            f"no plan for {way_in_words(self.motion.wanted, self.motion.unit)}: "
            f"{way_in_words(largest, self.motion.unit)} at most, stopped by {stopped_by}{more}",
            largest=abs(largest),
            posture=posture,
            stopped_by=stopped_by,
            helps=helps,
        )

    def _in_the_way(self, marches: Marches) -> tuple[tuple[str, str] | None, tuple[str, ...]]:
        """The two things that are least in each other's way on the whole way, and what would help."""
        found: list[tuple[bool, float, tuple[str, str]]] = []
        choices = marches.choices(marches.reached)
        clear = self.clear.holding(marches.q[choices, 0])
        for march in choices[:LOOKED]:
            path = marches.q[march, : marches.reached + 1]
            pairs = [pair for q in path if (pair := clear.touching(q)) is not None]
            if pairs:
                deepest = min(pairs, key=lambda pair: pair.distance)
                several = len({pair.links[1] for pair in pairs}) > 1
                found.append((several, CLEARANCE - deepest.distance, deepest.links))
        if not found:
            return None, ()
        several, depth, (link, other) = min(found)
        moved = f"the {other} {np.ceil(100.0 * depth) / 100.0:.2f} m farther from {link} would leave room there"
        return (link, other), (moved,) if other in self.clear.around.names and not several else ()

    def _largest(self, path: Postures) -> tuple[float, str]:
        """How much of the way comes true from the beginning of a path, and what stops it before the end of that."""
        stopped_by, distance = "", float(self.stations.distance[len(path) - 1])
        times = max(1.0, SPARE * (1.0 - margins_of(self.stations, path).speed))
        while abs(distance) >= LEAST_SHARE * abs(self.motion.wanted):
            task = self.motion.with_distance(distance).slowed(times)
            time, there, _ = task.table(self.start, PERIOD, FEWEST, MOST)
            done = np.abs(self.stations.distance[: len(path)])
            knots = np.array([np.interp(np.abs(there), done, column) for column in path.T]).T
            law = self._law(task, time, knots)
            outcome = simulate_way(self.robot, law, self.robot.configuration(path[0]), self.dt)[1]
            if outcome.is_done and not outcome.strays:
                return distance, stopped_by
            if outcome.stopped_by is not None:
                stopped_by = outcome.stopped_by
            distance = LESS * (outcome.done if 0.0 < outcome.done / distance < 1.0 and not outcome.strays else distance)
        return 0.0, stopped_by

    def _stopped_by(self, marches: Marches) -> str:
        """What keeps the marches that come farthest from going on, in words."""
        last = marches.reached
        if last == len(self.stations) - 1:
            return "limits of the loop in simulation"
        farthest = marches.choices(last)
        ends = marches.q[farthest, last]
        limits = Counter(filter(None, (joint_at_limit(self.robot, q) for q in ends)))
        if 2 * sum(limits.values()) > len(ends):
            return limits.most_common(1)[0][0]
        A = self.stations.matrices(ends[:1], np.array([last]))[0]
        left, sigma, _ = np.linalg.svd(A, full_matrices=False)
        x, y, z, rx, ry, rz = left[:, -1] @ self.stations.rows[last]
        moves = np.hypot(np.hypot(x, y), z) >= np.hypot(np.hypot(rx, ry), rz)
        what, d = ("move along", (x, y, z)) if moves else ("turn about", (rx, ry, rz))
        words = ", ".join(f"{c:.2f}" for c in np.array(d) / np.linalg.norm(d))
        return f"a singularity: the hand can hardly {what} ({words}) there (singular value {sigma[-1]:.2g})"
