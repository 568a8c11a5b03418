"""Planner of a grasp configuration, an approach and a motion, so that the whole motion is feasible from any start."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.manipulability import manipulability_batch
from manip_learn.constraint.shown import Take
from manip_learn.control.barriers import CLEARANCE
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.joint_motion import ARRIVED, JointMotion, LawSequence, every_joint
from manip_learn.control.limits import Limits, check_inside
from manip_learn.control.policies import NullSpacePolicy
from manip_learn.control.rollout import Rollout
from manip_learn.control.simulation import WayDone, joint_at_limit, simulate, simulate_way
from manip_learn.control.tasks.driven_motion import way_in_words
from manip_learn.control.tasks.motion import FreeDirection
from manip_learn.errors import ConfigurationError, FeatureError, MissingExtraError, NoPlanError, TargetError, an
from manip_learn.planning import ways
from manip_learn.planning.clearance import Clearance, Links, Surroundings
from manip_learn.planning.joint_path import joint_path
from manip_learn.planning.scene import Scene
from manip_learn.planning.stations import Margins, Postures, Stations, path_margins
from manip_learn.recordings.load import Progress
from manip_learn.robot.robot import Robot

CHECK_STEP = 6  # of the postures of a recording, one in this many is checked for collisions
Around = Scene | Literal["assumed"] | None


@final
@dataclass(frozen=True, eq=False, repr=False)
class Plan:
    """Planned and simulated motion: a grasp configuration, the approach to it, and the motion along the constraint.

    Attributes:
        robot: The robot.
        q_grasp: Joint positions (nv,) of the grasp configuration [rad or m].
        approach: Simulated motion from the start to the grasp configuration.
        way: Simulated motion along the constraint, from the time of the grasp.
        margin: Smallest remaining share of the limits along the motion, at most 1: of the joint ranges, of the joint
            speeds, of the speed in the weakest direction (`manip_learn.planning.stations` has the formula).
        margins: The three margins, with the joint and the position along the motion that limit them.
        outcome: Outcome of the simulated motion: distance, deviation, speed.
        controller: Controller of approach and motion, to be passed to `simulate` or `ServoLoop` with the same start.
        candidates: Number of grasp configurations that were compared.
        notes: Checks that were not made, and other remarks, in sentences.
        around: Obstacles that approach and motion avoid.
        take: Recording that the plan follows; None for a plan from a search.
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
        """Approach and motion as one rollout, with the phases `"approach"`, `"hold"` and `"way"`."""
        return self.approach.followed_by(self.way)

    def save(self, path: str | Path) -> Path:
        """Write approach and motion as one file, see `Rollout.save` for formats and errors.

        Args:
            path: File to write.

        Returns:
            Path of the written file.
        """
        return self.rollout.save(path)

    @property
    def sentence(self) -> str:
        """The plan in one or more sentences."""
        change = float(np.max(np.abs(self.approach.q[-1] - self.approach.q[0]), initial=0.0))
        moved = "grasp as it stands" if change < ARRIVED else f"grasp after {self.approach.time[-1]:.1f} s"
        return (
            f"{moved}, then {way_in_words(self.outcome.done, self.outcome.unit)} in {self.outcome.seconds:.3g} s; "
            f"margin {self.margin:.0%}: {self.margins.limited_by}"
        )

    def __repr__(self) -> str:
        return f"Plan({self.sentence})"

    def to_dict(self) -> dict[str, Any]:
        """Return the figures of the plan as a dictionary of JSON values.

        Returns:
            `margin`, `limited_by`, `least_singular_value`, `hold` (joint positions of the grasp configuration [rad or
            m]), `approach_seconds`, `candidates`, `notes`, and `clear_of` (names of the obstacles).
        """
        return {
            "margin": self.margin,
            "limited_by": self.margins.limited_by,
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
    candidates: int = 384,
    limits: Limits | None = None,
    collision: Links = True,
    scene: Around = "assumed",
    dt: float = 0.01,
    progress: Progress | None = None,
    takes: Sequence[Take] = (),
) -> Plan:
    """Plan a grasp configuration with which the whole motion is feasible, the approach to it, and the motion.

    A redundant arm can grasp a handle in many configurations, and the choice decides whether a drawer opens completely.
    The grasp pose is part of the motion (see `motion`). For each of hundreds of configurations, the remaining share of
    the joint limits over the whole motion (margin, see `Plan.margin`) is computed. The configuration with the largest
    margin is chosen; among margins within 0.01 of each other, the one with the larger manipulability of the constrained
    and driven rows. Its motion is simulated and accepted if it completes within 2 mm of the mechanism; otherwise the
    next configuration is tried. If the current configuration is as good, the arm grasps there. Approach and motion keep
    a clearance of 5 mm from the arm's own links and from the scene.

    Args:
        constraint: Learnt constraint of the hand.
        motion: Motion along it, from `motion`.
        start: Configuration (nq,) of the robot before the approach [rad or m].
        seed: Seed of the random configurations: the same seed gives the same plan.
        candidates: Number of configurations from which the search begins. With 2,000, the best margin of a drawer rises
            by less than 0.01 (measured at ff412730).
        limits: Joint limits; None for the robot's own.
        collision: Pairs of links that must not touch, as a `SelfCollision`; True for all of the robot's shapes, False
            for none.
        scene: Obstacles, a `Scene`; None for no obstacles; `"assumed"` for a floor under the base, below all
            configurations of the recordings and the start.
        dt: Time step of the simulation [s].
        progress: Function that is called with the name of a stage and its completed share, 0 to 1; None for none.
        takes: Recordings of this motion, see `Step.takes`. If one is feasible, the plan follows it without a search.

    Returns:
        The plan, whose simulated motion is free of collisions.

    Raises:
        NoPlanError: The motion is infeasible from every configuration that was tried; the message gives the feasible
            part, the cause, and possible remedies.
        TargetError: The start is outside the limits or in collision, the motion exceeds the demonstrated range, or the
            grasp pose does not fit the mechanism.
        MissingExtraError: The straight approach is in collision, and RoboPlan is not installed.
        ConfigurationError: The start has the wrong size, a joint has no velocity limit, or a value is not a finite
            number.
        FeatureError: The constraint's features have no frame, or the robot has a floating or planar base.

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("sawyer")
        >>> drawer = ml.Constraint([[0, 1, 0], [0, 0, 1]], ml.FrameJacobian(robot, "right_gripper_tip"))
        >>> plan = ml.plan(drawer, ml.motion(drawer, distance=-0.2), [0.0, -1.0, 0.0, 1.7, 0.0, 0.8, 0.0], seed=0)
        >>> bool(plan.outcome.is_done), plan.way.q.shape[1]
        (True, 7)
    """
    fewest = 8  # two candidates at each of three stations, and two to spare
    if candidates < fewest:
        raise ConfigurationError(f"a plan needs {fewest} candidates or more, got {candidates!r}")
    report = progress or (lambda _title, _share: None)
    problem = _Problem(constraint, motion, start, seed, limits, collision, scene, dt, takes)
    if takes and (result := problem.follow(report)) is not None:
        return result
    result = problem.search(candidates, report)
    note = "no recording could be followed: the grasp configuration was searched"
    return replace(result, notes=(*result.notes, note)) if takes else result


Approach = tuple[str, ResolvedRateController, Rollout]  # motion to a posture: in words, its law, and as simulated


def approach(
    goal: Float[np.ndarray, " nv"],
    start: Float[np.ndarray, " nq"],
    rows: Constraint,
    limits: Limits,
    clear: Clearance,
    seed: int,
    dt: float,
    shown: Postures | None = None,
) -> Approach | None:
    """Plan and simulate a joint motion to a goal: as recorded; if this is not possible, straight; else around
    obstacles.

    Args:
        goal: Goal joint positions (nv,) [rad or m].
        start: Start configuration (nq,) [rad or m].
        rows: Constraint whose manipulability is stored in the rollout.
        limits: Joint limits.
        clear: Collision check.
        seed: Seed of the path around obstacles.
        dt: Time step of the simulation [s].
        shown: Waypoints (k, nv) of a recorded motion [rad or m]; None if there is none.

    Returns:
        Kind of motion in words, its controller and its rollout; None if no motion is free of collisions, or if it does
        not arrive.

    Raises:
        MissingExtraError: The straight motion is in collision, and RoboPlan is not installed.
    """
    speed_share = 0.25  # share of the velocity limits: people may be near, as in ISO 10218-1
    robot = limits.robot

    def through(how: str, knots: ArrayLike, smooth: bool) -> Approach | None:
        task = JointMotion(limits, knots, speed_share, through=smooth)
        law = ResolvedRateController(every_joint(robot), task, limits=limits, dt=dt)
        rollout = simulate(robot, law, start, task.duration + 1.0, dt)
        arrived = np.flatnonzero((rollout.task_error < ARRIVED) & (rollout.time >= task.duration))
        if not len(arrived):
            return None
        rollout = rollout.until(float(rollout.time[arrived[0]]))
        return how, law, replace(rollout, manipulability=manipulability_batch(rows, rollout.q).mu)

    inside = shown is not None and np.all((shown >= limits.lower) & (shown <= limits.upper))
    if shown is not None and inside and clear.is_path_clear(shown) and (result := through("as shown", shown, True)):
        return result
    path = joint_path(robot, robot.positions(start), goal, limits, clear, seed)
    if path is None:
        return None
    return through("straight" if len(path) == 2 else "around what is in the way", path, False)


@final
@dataclass(frozen=True, eq=False, repr=False)
class PathPolicy(NullSpacePolicy):
    r"""Null-space policy that follows a joint path in time.

    .. math::

        \pi(q, t) = \dot q^*(t) + k \, (q^*(t) - q)

    The path is a cubic spline; before its first and after its last knot its velocity is 0.

    Attributes:
        path: Spline :math:`q^*` of joint positions (nv,), over the time since the motion began [s].
        gain: Gain k, the rate at which deviations decay [1/s].
        robot: The robot.
        moving: Mask (nv,) of the joints that follow the path; the deviation of the others is not corrected.
        motion: Task motion to which the path belongs; the time t is counted from its beginning.
    """

    path: CubicSpline
    gain: float
    robot: Robot
    moving: Bool[np.ndarray, " nv"]
    motion: FreeDirection

    def __call__(self, q: ArrayLike, t: float = 0.0) -> Float[np.ndarray, " nv"]:
        """Return the joint velocity (nv,) along the path and towards it [rad/s or m/s].

        Args:
            q: Configuration (nq,) [rad or m].
            t: Time since the start of the controller [s].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        first, end, begins = float(self.path.x[0]), float(self.path.x[-1]), self.motion.way_begins
        t = first if begins is None else t - begins
        error = self.robot.difference(np.asarray(q, dtype=np.float64), self.path(min(max(t, first), end))) * self.moving
        return self.gain * error + (self.path(t, 1) if first < t < end else 0.0)

    def __repr__(self) -> str:
        return f"PathPolicy({len(self.path.x)} knots over {np.ptp(self.path.x):g} s, gain={self.gain:g})"


def _slow_down(motion: FreeDirection, times: float, why: str) -> tuple[FreeDirection, str]:
    """Return a motion slowed down by a factor, and the reason with both durations in words."""
    slow, distance = motion.slowed(times), way_in_words(motion.wanted, motion.unit)
    return slow, f"{why}: {distance} takes {slow.duration:.3g} s instead of {motion.duration:.3g} s"


@final
@dataclass(eq=False)
class _Problem:
    """Planning problem with the arguments of `plan`."""

    constraint: Constraint
    motion: FreeDirection
    start: Any
    seed: int
    limits: Any
    collision: Links
    scene: Around
    dt: float
    takes: Sequence[Take]

    def __post_init__(self) -> None:
        constraint, motion, takes = self.constraint, self.motion, self.takes
        if not isinstance(motion, FreeDirection):
            raise ConfigurationError(
                f"plan() expects the task returned by motion(), got {an(motion)}; "
                + "motion(constraint, distance=... | angle=...) makes one"
            )
        self.rows = motion.rows(constraint)
        robot = constraint.robot
        if robot is None:
            raise FeatureError("a plan needs a robot: the features have none")
        self.robot, self.motion, self.rng = robot, motion.with_distance(motion.wanted), np.random.default_rng(self.seed)
        self.start, self.limits = robot.checked_posture(self.start), self.limits or Limits(robot)
        self.failures = 0  # failed searches for an approach
        self.missing_extra: MissingExtraError | None = None  # raised if no plan works without RoboPlan
        self.contact: tuple[str, str] | None = None  # pair in contact between the start and a grasp configuration
        if unsuited := [b for b in robot.blocks if b.kind in ("floating", "planar", "other")]:
            raise FeatureError(
                f"joint {unsuited[0].name!r} is {unsuited[0].kind}: plan() supports revolute, continuous and "
                "prismatic joints only; load the robot with a fixed base"
            )
        if len(endless := np.flatnonzero(~np.isfinite(self.limits.velocity))):
            raise ConfigurationError(
                f"joint {robot.joint_names[endless[0]]!r} has no velocity limit, the unit of the margins"
                ": state it in the robot's description, or pass limits=Limits(robot, velocity=...)"
            )
        self.positions = robot.positions(self.start)
        self.notes, tip = (), self.limits.barriers
        self.stations = Stations.of(self.motion, self.start, self.limits)
        if (times := self.stations.tip_speed / tip.pace) > 1.01:  # a pace leaves 2 %
            self.motion, slower = _slow_down(self.motion, times, f"{tip.speed:.3g} m/s at the tip")
            self.stations, self.notes = Stations.of(self.motion, self.start, self.limits), (slower,)
        around = Surroundings()
        if (scene := self.scene) is not None:
            if not isinstance(scene, Scene) and scene != "assumed":
                expected = "scene must be a Scene, None for no obstacles, or 'assumed'"
                raise ConfigurationError(f"{expected}, not {an(scene)}")
            features: Any = self.rows.features
            around = Surroundings.of(None if scene == "assumed" else scene, robot, features.frame)
        demos = [np.array(x, dtype=np.float64) for x in constraint.provenance.get("postures", ()) if len(x) == robot.nv]
        passed = [q for take in takes for q in take.q[::CHECK_STEP]]
        self.clear = Clearance(robot, self.collision, around, self.positions, [*demos, *passed])
        self.notes = (*self.clear.notes, *self._contradictions(around), *self.notes)

        check_inside(robot, self.positions)
        if (touching := self.clear.nearest_contact(self.positions, distance=0.0)) is not None:
            one, other = touching.links
            raise TargetError(
                f"at the start {one!r} and {other!r} touch, {abs(1e3 * touching.distance):.2g} mm deep: start elsewhere"
                + (f", or correct {other!r} in the scene" if other in self.clear.around.names else "")
            )

    def _contradictions(self, around: Surroundings) -> Iterator[str]:
        """Yield contradictions between the recordings and the given scene, in sentences."""
        stated, deepest = set(around.names) - around.assumed, dict[str, tuple[float, str]]()
        for take in self.takes if stated else ():
            for q in take.q[::CHECK_STEP] if np.allclose(take.moved, np.eye(4)) else ():
                pair = self.clear.nearest_contact(q, distance=0.0)
                if pair is not None and (name := pair.links[1]) in stated:
                    deepest[name] = max(deepest.get(name, (0.0, "")), (-pair.distance, take.name))
        for name, (depth, take) in deepest.items():
            yield f"{take} passes {1e3 * depth:.0f} mm inside {name!r}: the scene does not match the demonstrations"

    def marches(self, candidates: int, stations: Stations | None = None) -> ways.PathCandidates:
        """Return candidate postures along the motion.

        Args:
            candidates: Number of seeds.
            stations: Other stations; None for the stations of the motion.
        """
        return ways.propagate_candidates(stations or self.stations, self.positions, candidates, self.rng)

    def follow(self, report: Progress) -> Plan | None:
        """Return a plan that follows the first feasible recording, see `planning.ways`; None if there is none.

        Args:
            report: Function of the name of a stage and its completed share.
        """
        candidates = ways.follow_recordings(self.motion, self.takes, self.stations, self.positions)
        for compared, one in enumerate(candidates):
            name = "the arm as it stands" if one.take is None else one.take.name
            report(f"following {name}", 0.2 + 0.6 * compared / (len(self.takes) + 1))
            clear = self.clear.for_grasps(one.path[:1])
            if clear.is_path_clear(one.path) and (result := self._simulate(one, clear, compared + 1)) is not None:
                return result
        return None

    def search(self, candidates: int, report: Progress) -> Plan:
        """Search for the plan with the largest margin that completes in simulation.

        Grasps with the demonstrated orientation of the hand come first, if it is known.

        Args:
            candidates: Number of seeds.
            report: Function of the name of a stage and its completed share.

        Returns:
            Plan, with a note if the orientation of its grasp was not demonstrated.

        Raises:
            NoPlanError: The motion is infeasible from every configuration that was tried.
            MissingExtraError: A straight approach is not clear, and RoboPlan is not installed.
        """
        # factor of the number of seeds in the second search; number of simulated choices, the best margin first
        factor, n_simulated = 4, 8
        for share, number in enumerate((candidates, factor * candidates)):
            report("comparing postures", 0.1 + 0.4 * share)
            marches = self.marches(number)
            choices = marches.choices(len(self.stations) - 1)
            clear = self.clear.for_grasps(marches.q[choices, 0])
            for one in islice(self._relaxed_paths(marches, choices, clear), n_simulated):
                report("simulating the best of them", 0.3 + 0.4 * share)
                if (result := self._simulate(one, clear, len(choices))) is None:
                    continue
                report("planned", 1.0)
                if np.array_equal(one.path[0], self.positions) or self.stations.grasps_as_shown(one.path[:1])[0]:
                    return result
                note = "the orientation of the grasp differs from the demonstrations: with theirs no plan was found"
                return replace(result, notes=(*result.notes, note))
        if self.missing_extra is not None:
            raise self.missing_extra
        report("looking for what would help", 0.9)
        raise self.refusal(marches, candidates)

    def _relaxed_paths(
        self, marches: ways.PathCandidates, choices: Int[np.ndarray, " k"], clear: Clearance
    ) -> Iterator[ways.Candidate]:
        """Yield clear marches; relaxed if the result is also clear and grasps with the same orientation."""
        # after this many failed searches for an approach, half a second each, only straight ones are tried
        most_failures = 3
        as_shown = self.stations.grasps_as_shown
        for march, stands in zip(choices.tolist(), marches.begin_at_start(choices).tolist(), strict=True):
            path = marches.q[march]
            if not clear.is_path_clear(path) or (
                self.failures >= most_failures and not clear.is_line_clear(self.positions, path[0])
            ):
                continue
            better = ways.relax(self.stations, path, pinned=stands)
            if as_shown(better[:1])[0] >= as_shown(path[:1])[0] and clear.is_path_clear(better):
                path = better
            yield ways.Candidate(self.motion, self.stations, path)

    def _simulate(self, one: ways.Candidate, clear: Clearance, compared: int) -> Plan | None:
        """Simulate a candidate with clear postures; return None if it has no approach or does not complete."""
        # factor of the shortest duration, so that feedback has some speed to spare; postures checked for `around`
        spare, n_checked = 1.1, 60
        motion, stations, take, notes = one.motion, one.stations, one.take, self.notes
        path, turned = one.path, ways.nearest_turn(self.robot, one.path, self.positions)
        if path_margins(stations, turned).margin >= min(ways.GOOD_MARGIN, one.margins.margin):
            path = turned  # the shorter approach
        if (approach := self._approach(path[0], take, clear)) is None:
            return None
        how, to_hold, reach = approach
        if one.margins.speed < 0.0:
            motion, slower = _slow_down(motion, spare * (1.0 - one.margins.speed), "the joints are too slow for it")
            before, stations = np.abs(stations.distance), Stations.of(motion, self.start, self.limits)
            path = np.column_stack([np.interp(np.abs(stations.distance), before, x) for x in path.T])
            notes = (*notes, slower)
        law = self._law(motion, stations.time, path)
        way, outcome = simulate_way(self.robot, law, reach.q[-1], self.dt)
        begins, end = outcome.begins, float(way.time[-1])
        if (
            not outcome.is_done
            or outcome.strays
            or begins is None
            or not clear.is_path_clear(self.robot.unwrapped(way.q))
        ):
            return None
        if take is not None:
            notes = (*notes, f"follows {take.name}, the approach {how}")
        margins = path_margins(stations, path)
        reach = replace(reach, phases=(("approach", 0.0, float(reach.time[-1])),))
        outcomes = ({**outcome.to_dict(), "margin": margins.margin},)
        way = replace(way, phases=(*((("hold", 0.0, begins),) if begins else ()), ("way", begins, end)), ways=outcomes)
        postures = np.concatenate([run.q[:: len(run) // n_checked + 1] for run in (reach, way)])
        way = replace(way, around=self.clear.plain(map(self.robot.positions, postures)))
        numbers = margins.margin, margins, outcome, LawSequence(to_hold, law), compared, notes
        return Plan(self.robot, path[0], reach, way, *numbers, self.clear.around, take)

    def _approach(self, hold: Float[np.ndarray, " nv"], take: Take | None, clear: Clearance) -> Approach | None:
        """Return the motion from the start to a grasp configuration; None if there is no clear one."""
        knots = None
        if take is not None:
            before = np.where(self.stations.moving, take.before, self.positions)
            before = ways.carry_hand(self.constraint.features, before, take.moved)
            knots = ways.join_approach(ways.nearest_turn(self.robot, before[::-1], hold)[::-1], self.positions, hold)
        try:
            if result := approach(hold, self.start, self.rows, self.limits, clear, self.seed, self.dt, knots):
                return result
        except MissingExtraError as error:  # straight motions to other postures may be clear
            self.missing_extra = error
        self.failures, self.contact = self.failures + 1, clear.first_contact(self.positions, hold)
        return None

    def _law(self, motion: FreeDirection, time: Float[np.ndarray, " k"], path: Postures) -> ResolvedRateController:
        """Return the controller of a motion with null-space postures at times since the motion began [s]."""
        gain = 5.0  # [1/s] pull back to the planned postures, half of the task's own feedback
        task = motion.with_distance(motion.wanted)  # a new task without a remembered start
        spline = CubicSpline(time, path, bc_type="natural")
        policy = PathPolicy(spline, gain, self.robot, self.stations.moving, task)
        return ResolvedRateController(self.constraint, task, policy, limits=self.limits, dt=self.dt)

    # ---- refusals -------------------------------------------------------------------------------------------------

    def refusal(self, marches: ways.PathCandidates, candidates: int) -> NoPlanError:
        """Return the refusal with the feasible part of the motion, the cause, and possible remedies, from all marches.

        Args:
            marches: All marches that were compared.
            candidates: Number of seeds.
        """
        # share of the motion to the last station with a clear posture that a plan for no more can reach
        share = 0.95
        holding = self.clear.for_grasps(marches.q[np.isfinite(marches.least[:, 0]), 0])
        clear = marches.where(holding)
        end, last, largest, posture = len(self.stations) - 1, clear.reached, 0.0, None
        stopped_by = self._limiting_cause(marches)
        pair = self.contact if last == end else None
        helps = tuple[str, ...]()
        if last < marches.reached == end:
            pair, helps = self._blocking_pair(marches.q[marches.choices(end)[0]], holding)
        free = self.stations.with_rows(np.eye(6)[:3])
        if self.stations.holds_orientation and self.marches(candidates // 2, free).reached == end:
            helps += ("a hand that is free to rotate could complete it",)
        if last >= 1 and not (last == end and pair):
            largest, posture = share * float(self.stations.distance[last]), clear.q[clear.choices(last)[0], 0]
        if pair is not None:
            where = " on the approach to the grasp" if last == end else ""
            stopped_by = f"{pair[0]} and {pair[1]}, which would collide{where}"
        requested, most = (way_in_words(distance, self.motion.unit) for distance in (self.motion.wanted, largest))
        more = "".join(f"; {sentence}" for sentence in helps)
        text = f"no plan for {requested}: {most} at most, stopped by {stopped_by}{more}"
        return NoPlanError(text, largest=abs(largest), posture=posture, stopped_by=stopped_by, helps=helps)

    def _blocking_pair(self, path: Postures, clear: Clearance) -> tuple[tuple[str, str] | None, tuple[str, ...]]:
        """Return the pair in deepest contact on a path, and possible remedies."""
        pairs = [pair for q in path if (pair := clear.nearest_contact(q)) is not None]
        deepest = min(pairs, key=lambda pair: pair.distance, default=None)
        if deepest is None or deepest.links[1] not in clear.around.names or len({pair.links[1] for pair in pairs}) > 1:
            return None if deepest is None else deepest.links, ()
        (link, thing), depth = deepest.links, np.ceil(1e2 * (CLEARANCE - deepest.distance)) / 1e2
        return deepest.links, (f"the {thing} {depth:.2f} m further from {link} would leave enough room",)

    def _limiting_cause(self, marches: ways.PathCandidates) -> str:
        """Return the limit that stops the marches that come farthest, in words."""
        last = marches.reached
        if last < 0:
            gap = ways.distance_to_grasp(self.stations, self.positions, self.rng)
            return f"the end of the arm's reach: the hand comes within {gap:.2g} m of the grasp"
        if last == len(self.stations) - 1:
            return "limits of the loop in simulation"
        q = marches.q[marches.choices(last)[:1], last]
        if (joint := joint_at_limit(self.robot, q[0])) is not None:
            return joint
        A = self.stations.matrices(q, np.array([last]))[0]
        directions, sigma, _ = np.linalg.svd(A, full_matrices=False)
        x, y, z, rx, ry, rz = directions[:, -1] @ self.stations.rows[last]
        moves = np.hypot(np.hypot(x, y), z) >= np.hypot(np.hypot(rx, ry), rz)
        what, d = ("move along", (x, y, z)) if moves else ("turn about", (rx, ry, rz))
        words = ", ".join(f"{c:.2f}" for c in np.array(d) / np.linalg.norm(d))
        return f"a singularity: the hand can hardly {what} ({words}) there (singular value {sigma[-1]:.2g})"
