"""Motion along a free direction of a constraint: a drawer, a door, a screw, by metres or by radians."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.mechanism_rows import rows_of
from manip_learn.constraint.mechanism import KIND_BY_NAME
from manip_learn.constraint.place import AXES, Chart
from manip_learn.control import policies
from manip_learn.control.tasks.driven_motion import Course, Origin, Unit, along_path, driven_motion, way_in_words
from manip_learn.control.tasks.motion_profile import MotionProfile
from manip_learn.control.tasks.point_attractor import PointAttractor, SinglePassTask, Task, VelocityAndJacobian
from manip_learn.control.tasks.shown_places import DemonstratedStarts, shown_sense, straight
from manip_learn.errors import ConstraintError, ManipLearnError, TargetError, advice, an
from manip_learn.linalg import finite
from manip_learn.robot.robot import Robot

DONE = {"m": 1e-3, "rad": math.radians(0.2)}  # tolerance of a complete motion: a millimetre, 0.2 degrees
RAMP = 0.5  # [s] from rest to the speed: 0.1 m/s with 0.3 m/s2 at most
APPROACH_SPEED = 0.25  # [m/s] of a hand that approaches the mechanism: the reduced speed of ISO 10218-1 near people
_SETTLING = 0.5  # [s] longest settling time of the hand at the mechanism: e^-5 of a lag, at gain 10 /s
# [m] distance at which the hand is at the mechanism: a tenth of the deviation of 2 mm that is allowed during the
# motion, twice the encoders' noise
HOLD_GAP = 2e-4


@final
class FreeDirection(SinglePassTask):
    """Task that moves the hand along a free direction of a constraint by a distance, and holds the constrained rows.

    A drawer moves by metres along its rail, a door or a screw by radians about its axis (one turn is 2 pi). The speed
    rises and falls smoothly over `ramp`. Feedback keeps the constrained coordinates at their values at the start, so
    that the hand stays on the line, circle or helix. If limits slow the arm down it arrives later; it never moves
    faster than `speed`.

    The motion starts at the posture and the time of the first call. If a later call has a time at or before that
    start, the motion starts again. `reset` clears the start.

    With `take_hold` the hand first moves straight to the mechanism if it is not there: to the nearest start pose of
    the demonstrations from which the motion stays within the demonstrated range (see `hold`).

    Args:
        constraint: Constraint of the hand; pass the same one to the controller. Its rows are either constant (rows of a
            frame's Jacobian, also relative to another frame, of the centre of mass, or of any features with
            coordinates) or rows of a mechanism.
        distance: Distance along the free direction [m], or angle [rad]; negative for the opposite sense. If constant
            rows leave one direction free, its positive sense is the one in which its largest component along the rows
            is positive (see `direction`); for mechanisms it is the sense of the axis, right-handed.
        speed: Largest speed [m/s or rad/s], positive.
        direction: Direction of the motion, needed if several are free: one number per feature row, or three for x, y,
            z; they are projected onto the free directions. The other free directions are left to the null-space policy.
            For a cylinder or a sleeve the name of a row (`"tangential"`, `"axial"`, `"turn"`, `"slide"`), for a ball
            joint the axis of the rotation in the base frame.
        gain: Rate at which deviations are corrected [1/s].
        ramp: Time from rest to `speed` [s].
        start: Configuration (nq,) or joint positions (nv,) at which the motion starts [rad or m]; None for the posture
            of the first call.
        unit: `"m"` for a translation or `"rad"` for a rotation, if the constraint leaves both free; None for any.
        straight: True to hold the other free translations, too, so that the hand's position moves along the motion
            only; False leaves them to the null-space policy.
        keep_orientation: True to keep the orientation of the hand, too, e.g. because a gripper has closed on a handle.
        pause: Time for which the hand is at rest at the mechanism before the motion begins, e.g. to close a gripper
            [s]. Meanwhile the null-space policy moves the arm to a better posture.
        take_hold: True to move to the mechanism first. The constraint must contain its position: all contacts with it
            began at one pose, or it was learnt with a loose grip.
        as_shown: True to begin at the start pose of the contacts, even if the hand is on the mechanism already. If
            several directions are free, the hand also follows the demonstrated path with its timing, and `distance` and
            `speed` are ignored.

    Attributes:
        learnt: The constraint that was passed.
        constraint: Constraint with the held rows and the driven row.
        unit: Unit of the distance, `"m"` or `"rad"`.
        wanted: The whole distance [m or rad].
        grip_shown: Orientation of the hand at the start pose of the contacts, and the largest angle from it in the
            other contacts [rad]; None if not known.
        counts: Sign with which distances are reported: -1 if the positive sense of the demonstrations is the negative
            sense of this task, otherwise 1.
        way_begins: Time at which the hand was at the mechanism and the motion began [s]; None before.

    Raises:
        ConstraintError: No direction is free, or several are and `direction` is missing; the message lists them.
        FeatureError: The features have no coordinates.
        TargetError: An invalid distance, speed, gain or ramp, or a direction that is held.

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("planar3")
        >>> constraint = ml.Constraint([[0, 1]], ml.FrameJacobian(robot, "tip", axes="x y"))
        >>> task = ml.FreeDirection(constraint, distance=0.3, speed=0.1)  # along x, y held [m], [m/s]
        >>> controller = ml.ResolvedRateController(constraint, task)
        >>> rollout = ml.simulate(robot, controller, [0.3, 0.8, 0.4], duration=task.duration + 1.0)
        >>> round(task.progress(rollout.q[-1]), 3)
        0.3
    """

    slides = False  # every other direction is constrained: an arm that cannot continue stops
    waits = True  # the motion continues after an interruption
    damping = 0.01  # [m or 1] damping makes a hand stray: of 40 drawers near a singularity 32 open, and 8 with 0.05

    def __init__(
        self,
        constraint: Constraint,
        distance: float,
        speed: float,
        *,
        direction: ArrayLike | str | None = None,
        gain: float = 10.0,
        ramp: float = RAMP,
        start: ArrayLike | None = None,
        unit: Unit | None = None,
        straight: bool = False,
        keep_orientation: bool = False,
        pause: float = 0.0,
        take_hold: bool = False,
        as_shown: bool = False,
    ):
        way = _number("distance", distance, positive=False)
        self._profile = MotionProfile(way, _number("speed", speed), _number("ramp", ramp))
        self.gain, self.pause = _number("gain", gain), _number("pause", pause) if pause else 0.0
        self.learnt, self.counts, demo = constraint, 1.0, constraint.shown
        held_constraint = constraint.with_orientation() if keep_orientation else _grip_constraint(constraint)
        if as_shown and demo is not None and not demo.is_way:
            self._motion, self._profile = along_path(held_constraint, demo, self._profile.ramp)
        else:
            self._motion = driven_motion(held_constraint, direction, unit, straight)
        self.constraint = self._motion.constraint
        self.unit: Unit = self._motion.unit
        if keep_orientation and (robot := constraint.robot) is not None:
            A = self.constraint(robot.random_configuration(np.random.default_rng(0)))
            b = self.constraint.selection.dot(self._motion.driven)
            if np.linalg.norm(A.dot(np.linalg.lstsq(A, b)[0]) - b) > 1e-6 * np.linalg.norm(b):
                fix = advice(": leave out {}", "keep_orientation=True", "--keep-orientation")
                raise ConstraintError(f"{robot.nv} joints cannot move along this and keep the hand's orientation{fix}")
        self._starts: DemonstratedStarts | None = None
        self.grip_shown: tuple[Float[np.ndarray, "3 3"], float] | None = None
        if demo is not None and (take_hold or as_shown):
            self._starts = DemonstratedStarts(constraint.mechanism, demo, self._motion, as_shown)
            self.grip_shown = demo.orientation, demo.turned
        self._start = None if start is None else self._motion.origin(start)
        self.reset()

    @property
    def duration(self) -> float:
        """Duration of the motion if no limit slows it down [s]; it includes the approach if the start is known."""
        return self.pause + self._profile.duration + (0.0 if self._approach is None else self._approach[0].duration)

    def reset(self) -> None:
        """Clear the start: the next call starts the motion again."""
        self.wanted = self._profile.distance
        self._course = None if self._start is None else Course(self._motion, self._start)
        self._start_time, self._latest = math.inf, -math.inf
        self.way_begins: float | None = None
        self._approach: tuple[MotionProfile, Chart] | None = None
        self._place, self._ahead = 0.0, self._motion.driven

    def hold(self, q: ArrayLike) -> float:
        """Return the distance from the hand to the pose at which the motion starts [m].

        It is 0 if the hand is there, or if the position of the mechanism is not known.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
            FeatureError: The features have no coordinates.
        """
        return self._find_start(q)[2]

    def _find_start(self, q: ArrayLike) -> tuple[Origin, Origin, float]:
        """Return the pose of the hand, or of `start`, the pose at which the motion begins, and their distance [m]."""
        here = self._motion.origin(q) if self._start is None else self._start
        return here, *((here, 0.0) if self._starts is None else self._starts.nearest(here, self.wanted))

    def duration_from(self, q: ArrayLike) -> float:
        """Return the duration of the motion from a posture, if no limit slows it down [s].

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
            FeatureError: The features have no coordinates.
        """
        far = self.hold(q)
        ramp = self._profile.ramp
        to_hold = 0.0 if far <= HOLD_GAP else MotionProfile(far, APPROACH_SPEED, ramp).duration + _SETTLING
        return self.pause + self._profile.duration + to_hold

    def table(
        self, start: ArrayLike, period: float, fewest: int, most: int
    ) -> tuple[Float[np.ndarray, " L"], Float[np.ndarray, " L"], list[np.ndarray]]:
        """Return a table of the planned motion from the grasp to its end, at evenly spaced times.

        Args:
            start: Configuration (nq,) or joint positions (nv,) before the motion [rad or m].
            period: Time between two entries [s]; it is adapted so that the number of entries is in range.
            fewest: Smallest number of entries.
            most: Largest number of entries.

        Returns:
            Times (L,) [s], distances along the motion (L,) [m or rad], and L goals: poses (4, 4) or coordinates.
        """
        chart = self._motion.chart_at(self._find_start(start)[1])
        number = min(max(math.ceil(self._profile.duration / period) + 1, fewest), most)
        time = np.linspace(0.0, self._profile.duration, number)
        distance = np.array([self._profile.at(t)[0] for t in time.tolist()])
        return time, distance, [chart.pose((s,)) for s in distance.tolist()]

    def ascent(self, gain: float = policies.ASCENT_GAIN) -> policies.SampledPolicy:
        """Return the null-space policy that keeps the arm away from singularities and joint limits during the motion.

        It is a `RoomAscent` of the held and the driven rows, because the manipulability of the held rows alone may rise
        while the driven direction is being lost. If the demonstrator kept the hand's orientation by habit, the policy
        also turns the hand to the demonstrated orientation (`KeptOrientation`).

        Args:
            gain: Rate of the ascent [rad^2/s].
        """
        return self.as_kept(policies.RoomAscent(self.constraint, self._profile.speed, gain))

    def as_kept(self, policy: policies.SampledPolicy) -> policies.SampledPolicy:
        """Return a policy plus a pull towards the demonstrated orientation of the hand (`KeptOrientation`).

        Args:
            policy: The policy; it is returned unchanged unless the demonstrator kept the orientation by habit.
        """
        mechanism, demo = self.learnt.mechanism, self.learnt.shown
        rms = 0.0 if mechanism is None or mechanism.grip != "kept" else math.radians(mechanism.orientation_rms or 0.0)
        if demo is None or not rms or len(demo.hand) != len(demo.path):
            return policy
        sense = 1.0 if self._starts is None else self._starts.sense

        def orientation() -> Float[np.ndarray, "3 3"]:
            return demo.turned_at(0.0 if self.way_begins is None else sense * self._place)

        return policies.KeptOrientation(policy, self.learnt.features.twist, orientation, rms)

    def with_distance(self, distance: float) -> FreeDirection:
        """Return a copy of this motion with another distance and without a start.

        Args:
            distance: Signed distance [m or rad].

        Raises:
            TargetError: The distance is 0 or not a finite number.
        """
        return self._with(_profile=replace(self._profile, distance=_number("distance", distance, positive=False)))

    def slowed(self, times: float) -> FreeDirection:
        """Return a slower copy of this motion, without a start.

        Args:
            times: Factor by which its speed is divided.
        """
        return self._with(_profile=replace(self._profile, speed=self._profile.peak / times))

    def taking_hold(self, grasp: Origin) -> FreeDirection:
        """Return a copy of this motion that starts from another grasp pose, and has no start posture.

        Args:
            grasp: Pose of the hand at the grasp (4, 4) in the base frame.
        """
        return self._with(_starts=None if self._starts is None else self._starts.with_grasp(grasp))

    def _with(self, **others: Any) -> FreeDirection:
        other = copy.copy(self)
        vars(other).update(others)
        other.reset()
        return other

    def progress(self, q: ArrayLike) -> float:
        """Return the distance along the motion that a posture has reached [m or rad].

        It is 0 before the motion began, unless `start` was given.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return 0.0 if self.way_begins is None and self._start_time < math.inf else self.progress_near(q, self._place)

    def meant(self, t: float) -> float:
        """Return the planned distance along the motion at a time [m or rad]; 0 before the motion began.

        Args:
            t: Time [s].
        """
        return 0.0 if self.way_begins is None else self._profile.at(t - self.way_begins)[0]

    def progress_near(self, q: ArrayLike, near: float) -> float:
        """Return the distance along the motion that a posture has reached, near an estimate [m or rad].

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            near: Estimate [m or rad]; of all angles that differ by full turns, the nearest to it is returned.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return 0.0 if self._course is None else self._course.evaluate(q, near)[0]

    def is_over(self, q: ArrayLike, t: float) -> bool:
        """Return True if the whole distance is covered, to 1 mm or 0.2 degrees, and the planned duration has passed.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s].
        """
        is_late = self.way_begins is not None and t - self.way_begins >= self._profile.duration
        return is_late and abs(self.wanted - self.progress(q)) <= DONE[self.unit]

    def deviation(self, q: ArrayLike, progress: float = 0.0) -> float:
        """Return the deviation of the held rows from their values on the motion, as a norm [m or rad].

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            progress: Distance along the motion at which the values are taken [m or rad].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return 0.0 if self._course is None else self._course.deviation(q, progress)

    def rows(self, constraint: Constraint) -> Constraint:
        """Return the constraint with the held rows and the driven row.

        Args:
            constraint: The constraint of the task.

        Raises:
            ConstraintError: The constraint is not the task's.
        """
        if constraint is not self.learnt and constraint is not self.constraint:
            raise ConstraintError("the task moves along another constraint: pass the same one to both")
        return self.constraint

    def velocity_and_jacobian(self, constraint: Constraint, q: np.ndarray, t: float) -> VelocityAndJacobian:
        """Return the task's velocity b, and the Jacobian E of its error, from a single evaluation of the pose.

        The velocity leads along the motion, and back to it from a deviation. If limits or a singularity stop the hand,
        its goal on the motion waits.

        Args:
            constraint: Not used; the task's own constraint counts.
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s].
        """
        course, goal, rate = self._advance_clock(q, t)
        most = math.inf if self.way_begins is None else self._profile.speed
        self._place, self._ahead, off = course.evaluate(q, self._place)
        rate = min(max(rate + self.gain * (goal - self._place), -most), most)
        rows, features = self.constraint.selection, self.constraint.features
        E = features.coordinates_jacobian(q) if features.twist is None else None
        return rows.dot(rate * self._ahead - self.gain * off), None if E is None else rows.dot(E)

    def driven_rows(self, constraint: Constraint) -> Float[np.ndarray, "d s"]:
        """Return the direction of the motion in terms of the rows, shape (1, s); all rows (s, s) during the approach.

        Args:
            constraint: The constraint of the controller.
        """
        if self.way_begins is None:
            return super().driven_rows(constraint)
        row = self.constraint.selection.dot(self._ahead if self._ahead.any() else self._motion.driven)
        return row[None] / math.sqrt(row.dot(row))

    def goal(self) -> Origin | None:
        """Return the end of the motion: the position in the rows' axes, a pose (4, 4), or coordinates.

        It is None before the first call, unless `start` was given.
        """
        if self._course is None:
            return None
        end, names = self._course.chart.pose((self.wanted,)), self.constraint.features.row_names
        is_place = end.ndim == 2 and set(names) <= set(AXES[:3])
        return end[[AXES.index(name) for name in names], 3] if is_place else end

    def error(self, constraint: Constraint, q: np.ndarray, t: float) -> float:
        """Return the norm of the remaining distance and the deviation of the held rows [m or rad].

        Args:
            constraint: Not used; the task's own constraint counts.
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            t: Time [s].
        """
        course, _, _ = self._advance_clock(q, t)
        place = course.evaluate(q, self._place)[0]
        return math.hypot(self.wanted - place, course.deviation(q, place))

    def _advance_clock(self, q: ArrayLike, t: float) -> tuple[Course, float, float]:
        """Return the course of the motion, the intended progress along it [m or rad], and its rate."""
        if t <= self._start_time < self._latest:
            self.reset()
        if self._course is None or self._start_time == math.inf:
            start, origin, far = self._find_start(q)
            self._start_time, self._course = t, Course(self._motion, origin)
            if far > HOLD_GAP:
                self._approach = MotionProfile(far, APPROACH_SPEED, self._profile.ramp), straight(start, origin)
        self._latest = t
        if self.way_begins is None and self._approach is not None and self._starts is not None:
            profile, chart = self._approach
            late = t - self._start_time - profile.duration  # [s]
            near = HOLD_GAP if late < _SETTLING else 2e-3  # smallest distance with a noise of 1e-3 rad
            if late < 0.0 or self._starts.pose_distance(self._motion.origin(q), self._course.origin) > near:
                share = profile.at(t - self._start_time)[0] / profile.distance
                return Course(self._motion, chart.pose((share,))), 0.0, 0.0
        if self.way_begins is None:
            self.way_begins = t + self.pause
        return self._course, *self._profile.at(t - self.way_begins)

    def __repr__(self) -> str:
        p = self._profile
        return f"FreeDirection(distance={p.distance:g} {self.unit}, speed={p.speed:g} {self.unit}/s)"


def _grip_constraint(constraint: Constraint) -> Constraint:
    """Return all rows that a firm grip holds, if the constraint has only rows of the hand's position; else its own.

    Rows that no posture moves are left out: the arm's kinematics hold them.
    """
    mechanism, provenance = constraint.mechanism, constraint.provenance
    if mechanism is None or mechanism.grip != "firm" or "whole" not in provenance or mechanism.name not in KIND_BY_NAME:
        return constraint.about_its_mechanism()
    robot, twist = constraint.robot, constraint.features.twist
    features, selection = rows_of(KIND_BY_NAME[mechanism.name], mechanism.located(), None, twist)
    some = np.array([robot.random_configuration(np.random.default_rng(k)) for k in range(20)])  # type: ignore[union-attr]
    U, sizes, _ = np.linalg.svd(np.hstack([*(selection @ features.batch(some))]), full_matrices=False)
    return Constraint(U[:, sizes > 1e-6 * sizes[0]].T @ selection, features, provenance)


def _number(name: str, value: float, positive: bool = True) -> float:
    number = finite(value)
    if number is None or number == 0.0 or (positive and number < 0.0):
        kind = "a number" if number is None else "a finite number other than 0 (negative: the other way)"
        raise TargetError(f"the {name} must be {'a positive number' if positive else kind}, got {value!r}")
    return float(number)


def motion(
    constraint: Constraint,
    distance: float | None = None,
    angle: float | None = None,
    *,
    direction: ArrayLike | str | None = None,
    speed: float | None = None,
    keep_orientation: bool = False,
    pause: float = 0.0,
    beyond_shown: bool = False,
    along: float | None = None,
    turn: float | None = None,
) -> FreeDirection:
    """Return a task that moves the hand along a free direction of a constraint, and holds the constrained rows.

    Without a distance, angle and direction it reproduces the demonstrations: the hand grasps at the start pose of the
    contacts, and moves in the same direction, by the same distance (the median), in the same time; on a surface it
    follows the path of the most typical recording. If the demonstrator moved the constrained rows on purpose to a
    target (b is not known), the task goes to that target.

    If the hand is not on the mechanism, it first moves straight to the start pose of the contacts. If these differ, it
    moves to the nearest one from which the motion stays within the demonstrated range (which is known for constraints
    learnt with a loose grip). If several translations are free, those across the motion are held.

    Args:
        constraint: Constraint, learnt or written by hand; pass the same one to the controller.
        distance: Distance [m], for a line, a plane, or another mechanism that slides; positive in the demonstrated
            sense, negative for the opposite. If the demonstrations have no common sense, the positive sense along a
            line is the one in which the largest component of its direction is positive. None: the demonstrated
            distance, or `angle`.
        angle: Angle [rad], for a hinge, a screw or a ball joint; positive in the demonstrated sense, or right-handed
            about the axis if the demonstrations have no common sense. None: the demonstrated angle, or `distance`.
        direction: Direction of the motion, needed if several are free: on a plane three numbers, or one per row of the
            features; for a ball joint the axis of the rotation in the base frame; for a cylinder the name of a row
            (`"tangential"`, `"axial"`). `"shown"` is the demonstrated sense and `"back"` the opposite one; the selected
            sense then counts as positive. None for the only free direction, or for a motion as demonstrated.
        speed: Largest speed [m/s or rad/s]; by default the demonstrated speed if the motion reproduces the
            demonstrations, otherwise 0.1 m/s at the hand.
        keep_orientation: True to keep the orientation of the hand, too, e.g. because a gripper has closed on a handle.
        pause: Time at rest on the mechanism before the motion begins, e.g. to close a gripper [s]; meanwhile the
            null-space policy moves the arm to a better posture.
        beyond_shown: True to allow distances longer than the demonstrated range.
        along: Former name of `distance`, valid until 0.4. None if it is not used.
        turn: Former name of `angle`, valid until 0.4. None if it is not used.

    Returns:
        A `FreeDirection`; a `PointAttractor` if the demonstrator moved the rows on purpose to a target.

    Raises:
        TargetError: `constraint` is no `Constraint`; both `distance` and `angle` are given; neither is given, and the
            constraint has no demonstrated motion; a number is invalid, or exceeds the demonstrated range; the direction
            is held.
        ConstraintError: The mechanism does not slide or does not turn; no direction is free, or several are and none
            was selected (the message lists them); the demonstrated sense is needed and not known.

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("sawyer")
        >>> drawer = ml.Constraint([[0, 1, 0], [0, 0, 1]], ml.FrameJacobian(robot, "right_gripper_tip"))
        >>> ml.motion(drawer, distance=0.3)
        FreeDirection(distance=0.3 m, speed=0.1 m/s)
    """
    if not isinstance(constraint, Constraint):
        raise TargetError(f"call motion(constraint, distance=... | angle=...): got {an(constraint)} in its place")
    distance, angle = along if distance is None else distance, turn if angle is None else angle
    demo, mechanism = constraint.shown, constraint.mechanism
    word = direction if isinstance(direction, str) and direction in ("shown", "back") else None
    again, heading = distance is None and angle is None, direction if word is None else None
    if again and isinstance(heading, str):
        raise TargetError(f"the direction is {heading!r}, it must be 'shown', as the recordings went, or 'back'")
    if again and (aim := constraint.intention) is not None:
        if not aim.common:
            go = f"the {len(aim.targets)} recordings go to different targets, {aim.spread:.2g} m or rad apart"
            raise TargetError(f"{go}: name one{advice(' with {}', 'PointAttractor(target)', '--target')}")
        return PointAttractor(aim.target, aim.gain)  # type: ignore[return-value]  # of such rows alone
    if (again and (demo is None or heading is not None)) or (distance is not None and angle is not None):
        lacking = "the constraint has no demonstrated motion: " if again and demo is None else ""
        how = advice(": {}", "distance=0.3 [m] or angle=0.7 [rad]", "--along 0.3 (metres) or --turn 40 (degrees)")
        raise TargetError(f"{lacking}give one distance or angle{how or ' to `manip-learn control`'}")
    unit: Unit = "m" if angle is None else "rad"
    amount: Any = distance if angle is None else angle
    # mechanisms that do not move by this unit, their motion, and the argument for it
    types, does = ("line", "plane"), "slides and does not turn"
    instead = advice(": use {}", "distance= [m]", "--along METRES")
    if unit == "m":
        types, does = ("hinge", "screw", "ball"), "turns and does not slide"
        instead = advice(": use {}", "angle= [rad]", "--turn DEGREES")
    if again and demo is not None:
        unit, amount = demo.unit, demo.extent
        speed = amount / max(demo.seconds - RAMP, RAMP) if speed is None else speed
    elif mechanism is not None and mechanism.type in types:
        raise ConstraintError(f"the learnt mechanism {does} ({mechanism.sentence}){instead}")
    if speed is None:
        lever = 0.0 if mechanism is None else mechanism.radius or 0.0
        hand_speed = 0.1  # [m/s] default: a drawer of 0.3 m in 3.5 s, less than half of ISO 10218-1
        speed = hand_speed if unit == "m" else hand_speed / max(lever, 0.2)  # no faster with a shorter lever
    more: dict[str, Any] = {"direction": heading, "unit": unit, "straight": True, "take_hold": True, "as_shown": again}
    task = FreeDirection(constraint, amount, speed, keep_orientation=keep_orientation, pause=pause, **more)
    if not beyond_shown:
        _check_shown(task)
    sense = 0.0 if heading is not None else shown_sense(demo, task._motion, of_most=again)
    if sense == 0.0 and word is not None:
        why = "they went to both sides of where they began, or the constraint was not learnt by this version"
        fix = "leave the direction out, and choose the sign"
        raise ConstraintError(f"the recordings do not define a positive sense: {why}; {fix}")
    if (sense < 0.0) != (word == "back"):
        task = task.with_distance(-task.wanted)  # the opposite sense, which counts as positive
        task.counts = -1.0
    return task


def _check_shown(task: FreeDirection) -> None:
    """Refuse a motion that is longer than the demonstrated range, or than the reach of the arm."""
    demo, twist, total = task.learnt.shown, task.learnt.features.twist, abs(task.wanted)
    words = f"a motion of {way_in_words(total, task.unit)} is longer than"
    beyond = 2e-3 if task.unit == "m" else math.radians(0.2)  # the play of a drawer's rails
    if demo is not None and demo.is_way and demo.unit == task.unit and total > demo.span + beyond:
        more = advice(", or allow it with {}", "beyond_shown=True", "--beyond-shown")
        raise TargetError(f"{words} the demonstrations ({way_in_words(demo.span, task.unit)}): shorten it{more}")
    if task.unit == "m" and twist is not None and total > (most := 2.0 * twist.robot.reach(twist.frame)):
        raise TargetError(f"{words} the reach of the arm in any direction ({most:.2g} m): distances are in metres")


def motion_to(
    constraint: Constraint,
    point: ArrayLike,
    q: ArrayLike,
    *,
    speed: float | None = None,
    keep_orientation: bool = False,
) -> FreeDirection:
    """Return a task that turns a hand on a hinge or a screw until it is as near to a point as the mechanism allows.

    Args:
        constraint: Constraint with the rows of a mechanism.
        point: Point in the base frame, shape (3,) [m].
        q: Configuration (nq,) or joint positions (nv,) at the start, with the hand on the mechanism [rad or m].
        speed: Largest speed [rad/s]; None for the default of `motion`.
        keep_orientation: True to keep the orientation of the hand, too.

    Raises:
        TargetError: The point is not three finite numbers, the hand is not on the mechanism, or it is as near to the
            point as possible already.
        ConstraintError: The mechanism does not turn about an axis.
    """
    mechanism, twist = constraint.mechanism, constraint.features.twist
    if mechanism is None or mechanism.kind not in ("hinge", "screw"):
        how = advice(" with {}", "motion(constraint, distance=... | angle=...)", "--along or --turn")
        raise ConstraintError(
            f"the learnt task has no single rotation axis to reach a point: give a distance or angle{how}"
        )
    if (place := finite(point, 3)) is None:
        raise TargetError(f"the point must be three finite numbers (x, y, z) [m], got {point!r}")
    there = np.eye(4)
    there[:3, 3] = place
    angle = float(mechanism.by_place().at(twist.pose(q), np.inf).coordinates(there)[0])
    if abs(angle) < 1e-6:
        raise TargetError("the hand is as near to the point as the mechanism allows: choose another point")
    task = motion(constraint, angle=angle, speed=speed, keep_orientation=keep_orientation, beyond_shown=True)
    task = task.with_distance(angle)  # about the axis, whatever the demonstrated sense
    if (far := task.hold(q)) > 0.0:
        how = advice(", or use {}, which moves there first", "motion(constraint, angle=...)", "--turn")
        raise TargetError(f"the hand is {far:.3g} m away from the {mechanism.type}: start on it{how}")
    return task


def null_policy(
    name: str, task: Task, constraint: Constraint, robot: Robot, gain: float | None, rest: ArrayLike | None
) -> policies.NullSpacePolicy:
    """Return the null-space policy that a name on the command line selects.

    Args:
        name: `"manipulability"`, `"zero"` or `"attractor"`.
        task: Task of the controller.
        constraint: Learnt constraint.
        robot: The robot.
        gain: Gain of the policy, in the units of its class (`ManipulabilityAscent` or `JointAttractor`); None for its
            default.
        rest: Rest posture of the attractor, a configuration (nq,) or joint positions (nv,) [rad or m]; None for
            `Robot.neutral`.

    Raises:
        ManipLearnError: Unknown name.
    """
    arguments = () if gain is None else (gain,)
    if name == "manipulability":
        climb = policies.ManipulabilityAscent(task.rows(constraint), *arguments)
        return task.as_kept(climb) if isinstance(task, FreeDirection) else climb
    if name == "zero":
        return policies.ZeroPolicy(constraint.nv)
    if name == "attractor":
        return policies.JointAttractor(robot.neutral() if rest is None else rest, *arguments, robot=robot)
    raise ManipLearnError(f"unknown policy {name!r}: use one of manipulability, zero, attractor")
