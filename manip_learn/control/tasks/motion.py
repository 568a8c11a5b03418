"""Motion along what a constraint leaves free: a drawer, a door, a screw, by metres or by radians."""

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
from manip_learn.control.tasks.point_attractor import OneLook, PointAttractor, Task, VelocityAndJacobian
from manip_learn.control.tasks.shown_places import ShownPlaces, shown_sense, straight
from manip_learn.errors import ConstraintError, ManipLearnError, TargetError, advice, an
from manip_learn.linalg import finite
from manip_learn.robot.robot import Robot

HAND_SPEED = 0.1  # [m/s] of the hand where none is asked for: a drawer of 0.3 m in 3.5 s, less than half of ISO 10218-1
DONE = {"m": 1e-3, "rad": math.radians(0.2)}  # what may be missing of a way that is done: a millimetre, 0.2 degrees
RAMP = 0.5  # [s] from rest to the speed: 0.1 m/s with 0.3 m/s2 at most
APPROACH_SPEED = 0.25  # [m/s] of a hand on its way to the mechanism: the reduced speed of ISO 10218-1 beside people
_SETTLING = 0.5  # [s] at most until the hand is there after its way to the mechanism: e^-5 of a lag, at gain 10 /s
TAKEN = 2e-4  # [m] the hand is at the mechanism: a tenth of the 2 mm that it may be off it, twice the encoders' noise


@final
class FreeDirection(OneLook):
    """Move along what a constraint leaves free, by so much, at such a speed, and hold what it holds.

    A drawer moves by metres along its rail, a door or a screw by radians about its axis (one turn is 2 pi). The speed
    rises and falls smoothly over `ramp`. Feedback keeps the constrained coordinates at their values at the start: on
    the line, on the circle, on the helix. Where limits slow the arm down it arrives later, and never moves faster
    than `speed`.

    The motion starts with the first call: its posture and time are the start. A call at or before that time after
    later ones is a new run and starts again. `reset` forgets the start.

    With `take_hold` the hand first goes straight to where the mechanism is, if it is not there: to the nearest place at
    which the task was shown and from which the way stays within what was shown (see `hold`).

    Args:
        constraint: What holds the hand; the controller gets the same. Constant rows (the rows of one frame's Jacobian,
            relative to another frame, of the centre of mass, or any features with coordinates) or rows of a mechanism.
        distance: Way along the free direction [m], or angle [rad]; negative for the other way. For one free direction
            of constant rows, the positive sense is that of its largest number along the rows (see `direction`), for
            mechanisms that of the axis, right-handed.
        speed: Largest rate [m/s or rad/s], positive.
        direction: Along which direction, where several are free: numbers along the features' rows, or three for
            x, y, z; projected onto what is free. The other free directions are left to the null-space policy. For a
            cylinder or a sleeve the name of a row (`"tangential"`, `"axial"`, `"turn"`, `"slide"`), for a ball the
            axis of the turn.
        gain: Rate at which deviations are taken back [1/s].
        ramp: Time from rest to the speed [s].
        start: Posture at which the motion starts, where it is not that of the first call.
        unit: `"m"` or `"rad"`: which free directions are meant, where the constraint leaves both free.
        straight: The hand's place moves along the way only: free translations beside it stand still too, rather than
            being left to the null-space policy.
        keep_orientation: The hand does not turn either, as of a gripper that has closed on a handle.
        pause: Time for which the hand stands still at the mechanism before the way begins, as to close a gripper [s];
            the null-space policy meanwhile brings the arm into a better posture.
        take_hold: Go to the mechanism first, where the constraint says where that is: all contacts with it began at
            one place, or it was learnt with a loose grip.
        as_shown: Begin where the contacts began, even if the hand is on the mechanism already; and, where several
            directions are free, go along the path that was shown, in its time: `distance` and `speed` do not count.

    Attributes:
        learnt: The constraint.
        constraint: The constrained rows and the driven one.
        unit: Unit of the distance, `"m"` or `"rad"`.
        wanted: The whole way [m or rad].
        grip_shown: How the hand was turned where contacts began, and how far from that in others [rad]; None if not
            known.
        counts: 1, or -1 where the caller counts a way as positive that is negative here: as the recordings went.
        way_begins: Time at which the hand was at the mechanism and the way began [s]; None as long as it is not there.

    Raises:
        ConstraintError: The constraint leaves nothing free, or several directions without `direction`; lists them.
        FeatureError: Features that have no coordinates.
        TargetError: Distance, speed, gain or ramp that is no such thing, or a direction that is held.

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

    slides = False  # beside the way is what the constraint holds: an arm that cannot go on stands
    waits = True  # the way goes on where it was interrupted
    damping = 0.01  # [m or 1] damping lets a hand stray: of 40 drawers near a singularity 32 open, and 8 with 0.05

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
        self.learnt, self.counts, shown = constraint, 1.0, constraint.shown
        held = constraint.with_orientation() if keep_orientation else _held_by_the_grip(constraint)
        if as_shown and shown is not None and not shown.is_way:
            self._motion, self._profile = along_path(held, shown, self._profile.ramp)
        else:
            self._motion = driven_motion(held, direction, unit, straight)
        self.constraint = self._motion.constraint
        self.unit: Unit = self._motion.unit
        if keep_orientation and (robot := constraint.robot) is not None:
            A = self.constraint(robot.random_configuration(np.random.default_rng(0)))
            b = self.constraint.selection.dot(self._motion.driven)
            if np.linalg.norm(A.dot(np.linalg.lstsq(A, b)[0]) - b) > 1e-6 * np.linalg.norm(b):
                fix = advice(": leave out {}", "keep_orientation=True", "--keep-orientation")
                raise ConstraintError(f"{robot.nv} joints cannot move along this and keep the hand's orientation{fix}")
        self._shown: ShownPlaces | None = None
        self.grip_shown: tuple[Float[np.ndarray, "3 3"], float] | None = None
        if shown is not None and (take_hold or as_shown):
            self._shown = ShownPlaces(constraint.mechanism, shown, self._motion, as_shown)
            self.grip_shown = shown.orientation, shown.turned
        self._start = None if start is None else self._motion.origin(start)
        self.reset()

    @property
    def duration(self) -> float:
        """How long the motion takes where no limit slows it down, with the way to the mechanism if known [s]."""
        return self.pause + self._profile.duration + (0.0 if self._approach is None else self._approach[0].duration)

    def reset(self) -> None:
        """Forget the start: the next call is the first one again."""
        self.wanted = self._profile.distance
        self._course = None if self._start is None else Course(self._motion, self._start)
        self._begun, self._latest = math.inf, -math.inf
        self.way_begins: float | None = None
        self._approach: tuple[MotionProfile, Chart] | None = None
        self._place, self._ahead = 0.0, self._motion.driven

    def hold(self, q: ArrayLike) -> float:
        """Return how far a hand at posture q has to go to the mechanism [m]; 0 if it is there, or if not known."""
        return self._begins(q)[2]

    def _begins(self, q: ArrayLike) -> tuple[Origin, Origin, float]:
        """Return where a hand is, or was said to be, where the motion begins, and how far that is [m]."""
        here = self._motion.origin(q) if self._start is None else self._start
        return here, *((here, 0.0) if self._shown is None else self._shown.nearest(here, self.wanted))

    def duration_from(self, q: ArrayLike) -> float:
        """Return how long the motion takes from posture q where no limit slows it down [s]."""
        far = self.hold(q)
        to_hold = 0.0 if far <= TAKEN else MotionProfile(far, APPROACH_SPEED, self._profile.ramp).duration + _SETTLING
        return self.pause + self._profile.duration + to_hold

    def table(
        self, start: ArrayLike, period: float, fewest: int, most: int
    ) -> tuple[Float[np.ndarray, " L"], Float[np.ndarray, " L"], list[np.ndarray]]:
        """Return the way as it is meant to go, from where the hand takes hold: times [s], distances and goals.

        Args:
            start: Posture before the motion.
            period: Between two entries [s], where `fewest` and `most` leave it.
            fewest: Number of entries at least.
            most: And at most.
        """
        chart = self._motion.chart_at(self._begins(start)[1])
        number = min(max(math.ceil(self._profile.duration / period) + 1, fewest), most)
        time = np.linspace(0.0, self._profile.duration, number)
        distance = np.array([self._profile.at(t)[0] for t in time.tolist()])
        return time, distance, [chart.pose((s,)) for s in distance.tolist()]

    def ascent(self, gain: float = policies.ASCENT_GAIN) -> policies.SampledPolicy:
        """Return the policy that climbs the room left on the way: of rows held and driven, and of joints' ranges.

        The rows that are held do not say how well the hand can move along the way: the manipulability of these alone
        may rise while the driven direction is being lost. With it the hand turns as it was shown, where that was kept
        by habit (`KeptOrientation`).
        """
        return self.as_kept(policies.RoomAscent(self.constraint, self._profile.speed, gain))

    def as_kept(self, policy: policies.SampledPolicy) -> policies.SampledPolicy:
        """Return a policy, summed with the wish that the hand turns as it was shown where that was kept by habit."""
        known, shown = self.learnt.mechanism, self.learnt.shown
        rms = 0.0 if known is None or known.grip != "kept" else math.radians(known.orientation_rms or 0.0)
        if shown is None or not rms or len(shown.hand) != len(shown.path):
            return policy
        sense = 1.0 if self._shown is None else self._shown.sense

        def wanted() -> Float[np.ndarray, "3 3"]:
            return shown.turned_at(0.0 if self.way_begins is None else sense * self._place)

        return policies.KeptOrientation(policy, self.learnt.features.twist, wanted, rms)

    def with_distance(self, distance: float) -> FreeDirection:
        """Return this motion by another distance [m or rad], from a start of its own."""
        return self._with(_profile=replace(self._profile, distance=_number("distance", distance, positive=False)))

    def slowed(self, times: float) -> FreeDirection:
        """Return this motion slowed down by a factor, from a start of its own."""
        return self._with(_profile=replace(self._profile, speed=self._profile.peak / times))

    def taking_hold(self, grasp: Origin) -> FreeDirection:
        """Return this motion for a hand that takes hold at a pose (4, 4), from a start of its own."""
        return self._with(_shown=None if self._shown is None else self._shown.only(grasp))

    def _with(self, **others: Any) -> FreeDirection:
        other = copy.copy(self)
        vars(other).update(others)
        other.reset()
        return other

    def progress(self, q: ArrayLike) -> float:
        """Return how far the way has come at posture q [m or rad]; 0 before it began, unless `start` was given."""
        return 0.0 if self.way_begins is None and self._begun < math.inf else self.progress_near(q, self._place)

    def meant(self, t: float) -> float:
        """Return how far the way should have come at a time [m or rad]; 0 before it began."""
        return 0.0 if self.way_begins is None else self._profile.at(t - self.way_begins)[0]

    def progress_near(self, q: ArrayLike, near: float) -> float:
        """Return the progress of a posture on the way [m or rad]; of angles a turn apart the one next to `near`."""
        return 0.0 if self._course is None else self._course.look(q, near)[0]

    def is_over(self, q: ArrayLike, t: float) -> bool:
        """Return whether the whole way is done at posture q, and its time is over at t [s]."""
        is_late = self.way_begins is not None and t - self.way_begins >= self._profile.duration
        return is_late and abs(self.wanted - self.progress(q)) <= DONE[self.unit]

    def deviation(self, q: ArrayLike, progress: float = 0.0) -> float:
        """Return how far the rows are from where they are held, that much of the way done [m or rad]."""
        return 0.0 if self._course is None else self._course.deviation(q, progress)

    def rows(self, constraint: Constraint) -> Constraint:
        """Return the constrained rows and the driven one.

        Raises:
            ConstraintError: Another constraint than that of the task.
        """
        if constraint is not self.learnt and constraint is not self.constraint:
            raise ConstraintError("the task moves along another constraint: give both the same one")
        return self.constraint

    def velocity_and_jacobian(self, constraint: Constraint, q: np.ndarray, t: float) -> VelocityAndJacobian:
        """Return b and E from one look at the pose: along the motion and onto it, from where the hand is.

        Where limits or a singularity stop the way, the hand so does not follow a goal that goes on without it.
        """
        course, wanted, rate = self._now(q, t)
        most = math.inf if self.way_begins is None else self._profile.speed
        self._place, self._ahead, off = course.look(q, self._place)
        rate = min(max(rate + self.gain * (wanted - self._place), -most), most)
        rows, features = self.constraint.selection, self.constraint.features
        E = features.coordinates_jacobian(q) if features.twist is None else None
        return rows.dot(rate * self._ahead - self.gain * off), None if E is None else rows.dot(E)

    def driven_rows(self, constraint: Constraint) -> Float[np.ndarray, "d s"]:
        """Return the row along the motion; all rows on the way to the mechanism."""
        if self.way_begins is None:
            return super().driven_rows(constraint)
        row = self.constraint.selection.dot(self._ahead if self._ahead.any() else self._motion.driven)
        return row[None] / math.sqrt(row.dot(row))

    def goal(self) -> Origin | None:
        """Return where the motion ends; None before the first call, unless `start` was given."""
        if self._course is None:
            return None
        end, names = self._course.chart.pose((self.wanted,)), self.constraint.features.row_names
        is_place = end.ndim == 2 and set(names) <= set(AXES[:3])
        return end[[AXES.index(name) for name in names], 3] if is_place else end

    def error(self, constraint: Constraint, q: np.ndarray, t: float) -> float:
        """Return the way that is left, and the deviation of the constrained coordinates, as one norm [m or rad]."""
        course, _, _ = self._now(q, t)
        place = course.look(q, self._place)[0]
        return math.hypot(self.wanted - place, course.deviation(q, place))

    def _now(self, q: ArrayLike, t: float) -> tuple[Course, float, float]:
        """From where the way counts, how far along it the hand should be, and how fast."""
        if t <= self._begun < self._latest:
            self.reset()
        if self._course is None or self._begun == math.inf:
            start, origin, far = self._begins(q)
            self._begun, self._course = t, Course(self._motion, origin)
            if far > TAKEN:
                self._approach = MotionProfile(far, APPROACH_SPEED, self._profile.ramp), straight(start, origin)
        self._latest = t
        if self.way_begins is None and self._approach is not None and self._shown is not None:
            profile, chart = self._approach
            late = t - self._begun - profile.duration  # [s]
            near = TAKEN if late < _SETTLING else 2e-3  # postures with noise of 1e-3 rad come no nearer
            if late < 0.0 or self._shown.apart(self._motion.origin(q), self._course.origin) > near:
                share = profile.at(t - self._begun)[0] / profile.distance
                return Course(self._motion, chart.pose((share,))), 0.0, 0.0
        if self.way_begins is None:
            self.way_begins = t + self.pause
        return self._course, *self._profile.at(t - self.way_begins)

    def __repr__(self) -> str:
        p = self._profile
        return f"FreeDirection(distance={p.distance:g} {self.unit}, speed={p.speed:g} {self.unit}/s)"


def _held_by_the_grip(constraint: Constraint) -> Constraint:
    """Return all rows that a firm grip holds, where the constraint has those of the hand's place alone; else its own.

    Rows that no posture moves are left out: the arm's build holds them.
    """
    known, learnt = constraint.mechanism, constraint.provenance
    if known is None or known.grip != "firm" or "whole" not in learnt or known.name not in KIND_BY_NAME:
        return constraint.about_its_mechanism()
    robot, twist = constraint.robot, constraint.features.twist
    features, selection = rows_of(KIND_BY_NAME[known.name], known.located(), None, twist)
    some = np.array([robot.random_configuration(np.random.default_rng(k)) for k in range(20)])  # type: ignore[union-attr]
    U, sizes, _ = np.linalg.svd(np.hstack([*(selection @ features.batch(some))]), full_matrices=False)
    return Constraint(U[:, sizes > 1e-6 * sizes[0]].T @ selection, features, learnt)


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
    """Return a task: the hand goes along what the constraint leaves free, and holds what it holds.

    With nothing named it does what was shown: it takes hold where the contacts of the recordings began, and goes the
    way that they went, as far (the median), in the time that they took; on a surface it follows the path of the most
    typical recording. Rows that the demonstrator moved on purpose (b unknown) go to the target of the recordings.

    If the hand is not on the mechanism, it first goes straight to where the contacts began; where they began at
    different places, to the nearest one from which the way stays within what was shown (known for constraints that were
    learnt with a loose grip). Where several translations are free, those beside the way stand still.

    Args:
        constraint: Learnt or written by hand; the controller gets the same.
        distance: Way [m], of a line, a plane, or another mechanism that slides; positive as the recordings went, and
            negative for the other way. Where no recording says which way, the positive sense along a line is that of
            the largest number of its direction.
        angle: Angle [rad], of a hinge, a screw, a ball; positive as the recordings went, else right-handed about its
            axis.
        direction: Which way, where several are free: along a plane three numbers, or one per row of the features; about
            a ball the axis of the turn; of a cylinder the name of a row (`"tangential"`, `"axial"`). Or `"shown"`: as
            the recordings went, which must say so, and `"back"`: the other way; that way then counts as positive.
        speed: Largest rate [m/s or rad/s]; by default that of the recordings where they are done again, else the hand
            moves at 0.1 m/s.
        keep_orientation: The hand does not turn either, as of a gripper that has closed on a handle.
        pause: Time at rest on the mechanism before the way begins, as to close a gripper [s]; the null-space policy
            uses it to leave a bad posture.
        beyond_shown: Ways longer than what was shown are made, too.
        along: Former name of `distance`, valid until 0.4.
        turn: Former name of `angle`, valid until 0.4.

    Returns:
        A `FreeDirection`; of rows that were moved on purpose a `PointAttractor`.

    Raises:
        TargetError: Both of `distance` and `angle`; neither, and the constraint does not know what was shown; a number
            that is none, or more than what was shown; a direction that is held.
        ConstraintError: The mechanism does not move that way, nothing is free, or several directions are and none was
            named; says which are. The recordings do not say which way is the one shown.

    >>> import manip_learn as ml
    >>> robot = ml.load_robot("sawyer")
    >>> drawer = ml.Constraint([[0, 1, 0], [0, 0, 1]], ml.FrameJacobian(robot, "right_gripper_tip"))
    >>> ml.motion(drawer, distance=0.3)
    FreeDirection(distance=0.3 m, speed=0.1 m/s)
    """
    if not isinstance(constraint, Constraint):
        raise TargetError(f"call motion(constraint, distance=... | angle=...): got {an(constraint)} in its place")
    distance, angle = along if distance is None else distance, turn if angle is None else angle
    shown, known = constraint.shown, constraint.mechanism
    word = direction if isinstance(direction, str) and direction in ("shown", "back") else None
    again, named = distance is None and angle is None, direction if word is None else None
    if again and isinstance(named, str):
        raise TargetError(f"the direction is {named!r}, it must be 'shown', as the recordings went, or 'back'")
    if again and (meant := constraint.intention) is not None:
        if not meant.common:
            go = f"the {len(meant.targets)} recordings go to different targets, {meant.spread:.2g} m or rad apart"
            raise TargetError(f"{go}: name one{advice(' with {}', 'PointAttractor(target)', '--target')}")
        return PointAttractor(meant.target, meant.gain)  # type: ignore[return-value]  # of such rows alone
    if (again and (shown is None or named is not None)) or (distance is not None and angle is not None):
        lacking = "the constraint does not know what was shown: " if again and shown is None else ""
        how = advice(": {}", "distance=0.3 [m] or angle=0.7 [rad]", "--along 0.3 (metres) or --turn 40 (degrees)")
        raise TargetError(f"{lacking}say how far to go, once{how}")
    unit: Unit = "m" if angle is None else "rad"
    amount: Any = distance if angle is None else angle
    # mechanisms that do not move by this unit, what they do, and what to give
    types, does = ("line", "plane"), "slides and does not turn"
    instead = advice(": use {}", "distance= [m]", "--along METRES")
    if unit == "m":
        types, does = ("hinge", "screw", "ball"), "turns and does not slide"
        instead = advice(": use {}", "angle= [rad]", "--turn DEGREES")
    if again and shown is not None:
        unit, amount = shown.unit, shown.extent
        speed = amount / max(shown.seconds - RAMP, RAMP) if speed is None else speed
    elif known is not None and known.type in types:
        raise ConstraintError(f"what was learnt {does} ({known.sentence}){instead}")
    if speed is None:
        lever = 0.0 if known is None else known.radius or 0.0
        speed = HAND_SPEED if unit == "m" else HAND_SPEED / max(lever, 0.2)  # nearer to the axis no faster
    asked: dict[str, Any] = {"direction": named, "unit": unit, "straight": True, "take_hold": True, "as_shown": again}
    task = FreeDirection(constraint, amount, speed, keep_orientation=keep_orientation, pause=pause, **asked)
    if not beyond_shown:
        _check_shown(task)
    sense = 0.0 if named is not None else shown_sense(shown, task._motion, of_most=again)
    if sense == 0.0 and word is not None:
        why = "they went to both sides of where they began, or the constraint was not learnt by this version"
        fix = "leave the direction out, and choose the sign"
        raise ConstraintError(f"the recordings do not say which way is the one shown: {why}; {fix}")
    if (sense < 0.0) != (word == "back"):
        task = task.with_distance(-task.wanted)  # the other way, which counts as positive
        task.counts = -1.0
    return task


def _check_shown(task: FreeDirection) -> None:
    """Refuse a way that is longer than the places are apart at which it was shown, or than the arm can go."""
    shown, twist, wanted = task.learnt.shown, task.learnt.features.twist, abs(task.wanted)
    words = f"the way of {way_in_words(wanted, task.unit)} is longer than"
    beyond = 2e-3 if task.unit == "m" else math.radians(0.2)  # the play of a drawer's rails
    if shown is not None and shown.is_way and shown.unit == task.unit and wanted > shown.span + beyond:
        more = advice(", or allow it with {}", "beyond_shown=True", "--beyond-shown")
        raise TargetError(f"{words} what was shown ({way_in_words(shown.span, task.unit)}): ask for no more{more}")
    if task.unit == "m" and twist is not None and wanted > (most := 2.0 * twist.robot.reach(twist.frame)):
        raise TargetError(f"{words} the arm can go in any direction ({most:.2g} m): ways are in metres")


def motion_to(
    constraint: Constraint,
    point: ArrayLike,
    q: ArrayLike,
    *,
    speed: float | None = None,
    keep_orientation: bool = False,
) -> FreeDirection:
    """Return a task: a hand on a hinge or a screw turns it until it is as near to a point as the mechanism allows.

    Args:
        constraint: Of rows of a mechanism.
        point: shape (3,), in the base frame [m].
        q: Posture of the hand at the start, on the mechanism.
        speed: As for `motion`.
        keep_orientation: As for `motion`.

    Raises:
        TargetError: Not three finite numbers, a hand that is not on the mechanism or next to the point already.
        ConstraintError: A mechanism that does not turn about an axis.
    """
    known, twist = constraint.mechanism, constraint.features.twist
    if known is None or known.kind not in ("hinge", "screw"):
        how = advice(" with {}", "motion(constraint, distance=... | angle=...)", "--along or --turn")
        raise ConstraintError(f"what was learnt turns about no one axis, towards a point: say how far to go{how}")
    if (place := finite(point, 3)) is None:
        raise TargetError(f"the point must be three finite numbers (x, y, z) [m], got {point!r}")
    there = np.eye(4)
    there[:3, 3] = place
    angle = float(known.by_place().at(twist.pose(q), np.inf).coordinates(there)[0])
    if abs(angle) < 1e-6:
        raise TargetError("the hand is as near to the point as the mechanism allows: name another")
    task = motion(constraint, angle=angle, speed=speed, keep_orientation=keep_orientation, beyond_shown=True)
    task = task.with_distance(angle)  # about the axis, whichever way was shown
    if (far := task.hold(q)) > 0.0:
        how = advice(", or say how far with {}, which goes there first", "motion(constraint, angle=...)", "--turn")
        raise TargetError(f"the hand is {far:.3g} m away from the {known.type}: start on it{how}")
    return task


def null_policy(
    name: str, task: Task, constraint: Constraint, robot: Robot, gain: float | None, rest: ArrayLike | None
) -> policies.NullSpacePolicy:
    """Return a null-space policy by its name on the command line, with its own gain if none is given.

    Raises:
        ManipLearnError: Unknown name.
    """
    given = () if gain is None else (gain,)
    if name == "manipulability":
        climb = policies.ManipulabilityAscent(task.rows(constraint), *given)
        return task.as_kept(climb) if isinstance(task, FreeDirection) else climb
    if name == "zero":
        return policies.ZeroPolicy(constraint.nv)
    if name == "attractor":
        return policies.JointAttractor(robot.neutral() if rest is None else rest, *given, robot=robot)
    raise ManipLearnError(f"unknown policy {name!r}: use one of manipulability, zero, attractor")
