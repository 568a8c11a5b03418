"""A skill done again, step by step: take hold, go the way that was shown, let go, on to the next, and retreat."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, cast, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.shown import Take, Unit
from manip_learn.constraint.skill import Skill, Step, single_constraint_skill
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.joint_motion import JointMotion, LawSequence, every_joint
from manip_learn.control.limits import Limits
from manip_learn.control.rollout import Rollout
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks.driven_motion import way_in_words
from manip_learn.control.tasks.motion import APPROACH_SPEED, FreeDirection, motion
from manip_learn.errors import ConfigurationError, NoPlanError, TargetError, advice, an, counted, spoken
from manip_learn.linalg import finite
from manip_learn.planning.clearance import Clearance
from manip_learn.planning.plan import LOOKED_AT, Around, Plan, approach, plan
from manip_learn.planning.stations import Stations
from manip_learn.planning.ways import carried, joined, nearest_turn
from manip_learn.recordings.load import Progress
from manip_learn.robot.joints import Frame
from manip_learn.robot.robot import Robot

_ROOM = 1.05  # times the speed of a way that was shown, with what `Barriers.pace` leaves out
TipSpeed = float | Literal["shown"] | None
LEAST_SPEED = 0.05  # [m/s] at which a tip may go anyhow, however slowly a hand was guided


@final
@dataclass(frozen=True, eq=False)
class StepDone:
    """What became of a step.

    Attributes:
        kind: `"reach"` or `"way"`.
        wanted: How far the hand was to go [m], or turn [rad].
        done: How far it went.
        unit: Of both.
        deviation: Largest distance off what holds the hand [m or rad]; of a reach, from where it was to end [m].
        margin: Of a way, as that of a plan; None of a reach.
        stopped_by: What ended it before it was done, in words; None if it was done.
        fastest: Largest share of a joint's velocity limit that it took.
        place: shape (3,), where the hand was at its end: where it took hold, of a way its farthest place [m].
        name: What it was, in words.
        grasp: shape (4, 4), of the hand where it takes hold; None of a retreat.
        off: Distance of that from the nearest place where a contact began [m]; None where that is not known.
    """

    kind: str
    wanted: float
    done: float
    unit: Unit
    deviation: float
    margin: float | None
    stopped_by: str | None
    fastest: float
    place: Float[np.ndarray, " 3"]
    name: str
    grasp: Float[np.ndarray, "4 4"] | None = None
    off: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """The JSON answer: lengths in m, angles in degrees."""
        size = 1.0 if self.unit == "m" else float(np.degrees(1.0))
        in_words = {"unit": "m" if self.unit == "m" else "deg", "place": self.place.tolist()}
        in_words["grasp"] = None if self.grasp is None else self.grasp.tolist()
        return vars(self) | in_words | {"wanted": size * self.wanted, "done": size * self.done}


@final
@dataclass(frozen=True, eq=False, repr=False)
class Repetition:
    """A skill done again.

    Attributes:
        skill: What was done, where its fixtures stand now.
        rollout: The whole motion, as simulated; its phases are named after the steps.
        steps: What became of each.
        controller: Does it, in `simulate`, in a `ServoLoop` and in `run`, from the start.
        tip_path: Length of the path of the tip, the frame that the skill holds [m].
        tip_speed: Largest speed of the tip over any step of the rollout [m/s].
        notes: What to know of it, in sentences.
    """

    skill: Skill
    rollout: Rollout
    steps: tuple[StepDone, ...]
    controller: LawSequence
    tip_path: float
    tip_speed: float
    notes: tuple[str, ...] = ()

    @property
    def is_done(self) -> bool:
        """Whether every step was done, all of it."""
        return all(step.stopped_by is None for step in self.steps)

    def __repr__(self) -> str:
        return "\n".join([*(f"{i + 1}. {_said(step)}" for i, step in enumerate(self.steps)), self.pace])

    @property
    def pace(self) -> str:
        """How long all of it takes, how far the tip goes, and how fast at most, in words."""
        return f"{self.rollout.time[-1]:.3g} s, {self.tip_path:.3g} m of the tip, at most {self.tip_speed:.2g} m/s"


def _said(step: StepDone) -> str:
    far = f"{way_in_words(step.done, step.unit)} of {way_in_words(step.wanted, step.unit)}"
    margin = "" if step.margin is None else f", margin {step.margin:.0%}"
    return f"{step.name}: {far}{margin}" + ("" if step.stopped_by is None else f"; stopped by {step.stopped_by}")


def repeat(
    skill: Skill | Constraint,
    start: ArrayLike,
    fixture_transform: ArrayLike | None = None,
    *,
    prefer: Literal["shown", "room"] = "shown",
    scene: Around = "assumed",
    seed: int = 0,
    limits: Limits | None = None,
    dt: float = 0.01,
    tip_speed: TipSpeed = APPROACH_SPEED,
    progress: Progress | None = None,
    moved: ArrayLike | None = None,
) -> Repetition:
    """Do again what the recordings show, from any start: every step in the order in which it was shown.

    Each way follows a recording: the hand comes, takes hold and goes as it did there, as far as was shown, or along the
    path that was shown, in the time that was shown, or longer where the tip would be faster than `tip_speed`. After the
    last way it goes where the recordings ended. Where no recording can be followed, or none is known, the posture in
    which the hand takes hold is searched (see `plan`).

    Args:
        skill: As learnt (`ConstraintLearner.skill_`) or loaded; a constraint stands for its one way.
        start: Posture before the first step.
        fixture_transform: shape (4, 4), a rigid motion in the base's frame: the fixtures stand elsewhere, p' = R p + t
            [m].
        prefer: `"shown"`, or `"room"`: the posture that leaves most room for the way is searched first.
        scene: What stands around, as of `plan`: kept clear of by every step.
        seed: Of the random postures: the same seed gives the same motion.
        limits: Of the joints; the robot's own by default.
        dt: Step of the simulation [s].
        tip_speed: Largest speed of the tip in every step, of approach, way and retreat [m/s], and no more than was
            shown; the tip is the frame that the skill holds. `"shown"`: as fast as was shown. None: no limit but those
            of the joints. The lower one counts where `limits` have a speed, too.
        progress: As for `simulate`.
        moved: Former name of `fixture_transform`, valid until 0.4.

    Returns:
        The motion, the outcome of each step, the controller that does it, and notes: of a way that takes longer than it
        was shown with both times, of a tip speed that the arm cannot reach with both speeds.

    Raises:
        NoPlanError: A step that cannot be done; says which, what stops it and what would help. Nothing is returned of
            the steps before it.
        TargetError: A start outside the limits, a motion of the fixtures that is not rigid, nothing to do again.
        ConfigurationError: No skill, a start of another size, or a tip speed that is not positive.

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("sawyer")
        >>> demos = ml.load_demonstrations("sawyer_drawer", robot)[:6]  # or a folder of your own
        >>> learner = ml.ConstraintLearner(ml.FrameJacobian(robot, "right_gripper_tip", axes="xyz")).fit(demos)
        >>> again = ml.repeat(learner.skill_, demos[0].q[0])
        >>> again.is_done, [step.kind for step in again.steps]
        (True, ['reach', 'way'])
        >>> again.tip_speed <= 0.25  # [m/s]
        True
    """
    if isinstance(skill, Constraint):
        skill = single_constraint_skill(skill)
    if not isinstance(skill, Skill):
        raise ConfigurationError(f"call repeat(skill, start): the skill is {an(skill)}; learner.skill_ is one")
    robot = skill.robot
    if robot is None or not any(step.kind == "way" for step in skill.steps):
        raise TargetError("there is nothing to do again: the recordings show no way with a robot")
    if prefer not in ("shown", "room"):
        raise ConfigurationError(f"prefer is {prefer!r}: it must be 'shown' or 'room'")
    if (transform := moved if fixture_transform is None else fixture_transform) is not None:
        skill = skill.moved(_rigid(transform))
    q, said = robot.checked_posture(start), progress or (lambda _title, _share: None)
    again = _Again(skill, q, _limited(limits or Limits(robot), tip_speed, skill, q), dt, seed, scene)
    again.notes = [*skill.constraints[0].notes, *skill.notes]
    told = [str(doubt) for constraint in skill.constraints for doubt in constraint.provenance.get("warnings") or ()]
    if doubts := list(dict.fromkeys(told)):  # those of all recordings stand with each constraint
        said_of = counted(len(doubts), "warning")
        again.notes.append(f"learnt with {said_of}, read them before an arm moves: {'; '.join(doubts)}")
    if prefer == "shown" and not any(step.takes for step in skill.steps):
        again.notes.append("no recording is kept with this task: the posture of each way is searched")
    for number, step in enumerate(skill.steps):
        name = _name(number, step, skill)
        said(name, number / len(skill.steps))
        if step.kind == "way":
            followed = replace(step, takes=step.takes if prefer == "shown" else ())
            again.way(followed, name, lambda title, share, k=number: said(title, (k + share) / len(skill.steps)))
        else:
            if step.gripper is not None:
                again.grip(step, name, 0.0 if again.whole is None else again.whole.manipulability[-1])
            if step.place is not None:  # to a way its plan goes
                again.retreat(np.asarray(step.place), name)
    said("done", 1.0)
    return again.repetition()


def _limited(limits: Limits, tip_speed: TipSpeed, skill: Skill, q: Float[np.ndarray, " n"]) -> Limits:
    """Return limits with the speed of the tip that is asked for, at a start q.

    Raises:
        ConfigurationError: A speed that is not positive, or another word.
    """
    if tip_speed is None:
        return limits
    speed = np.inf if tip_speed == "shown" else tip_speed
    if not isinstance(speed, int | float) or not speed > 0.0 or tip_speed == np.inf:
        wanted = f"a positive number of metres per second such as {APPROACH_SPEED}"
        words, name = spoken("'shown', or None", "shown, or none"), advice("{}", "tip_speed", "--tip-speed")
        raise ConfigurationError(f"{name} is {tip_speed!r}: it must be {wanted}, {words} for no limit")
    frames = [f for constraint in skill.constraints if (f := getattr(constraint.features, "frame", None)) is not None]
    takes = [take for step in skill.steps for take in step.takes]
    ways = [motion(way) for step in skill.steps if step.kind == "way" and (way := step.as_shown) is not None]
    shown = [_ROOM * Stations.of(way, q, limits).tip_speed for way in ways if isinstance(way, FreeDirection)]
    shown += [_tip_speed(limits.robot, frames[0], take) for take in takes]
    most = max([*shown, LEAST_SPEED if takes else APPROACH_SPEED])
    speed = min(speed, most) if takes or tip_speed == "shown" else speed
    return limits.with_tip_speed(speed, [frame.name for frame in frames])


def _tip_speed(robot: Robot, frame: Frame, take: Take) -> float:
    """The largest speed of the tip in a recording, but for one in fifty of its samples [m/s]."""
    places = robot.frame_kinematics(frame).poses(take.q)[:, :3, 3]
    steps, times = np.linalg.norm(np.diff(places, axis=0), axis=1), np.diff(take.time)
    return float(np.quantile(steps[times > 0.0] / times[times > 0.0], 0.98)) if np.any(times > 0.0) else 0.0


def _name(number: int, step: Step, skill: Skill) -> str:
    if step.kind == "reach":
        return "reach" if step.place is None else "retreat"
    mechanism = None if step.constraint is None else step.constraint.mechanism
    what = "way" if mechanism is None else mechanism.kind if mechanism.noun == "other" else mechanism.noun
    ways = [s for s in skill.steps[: number + 1] if s.kind == "way"]
    return f"{what} {len(ways)}" if sum(s.kind == "way" for s in skill.steps) > 1 else what


class _Again:
    """What has been done of a skill, see `repeat`."""

    def __init__(self, skill: Skill, q: Float[np.ndarray, " n"], limits: Limits, dt: float, seed: int, scene: Around):
        self.skill, self.q, self.limits, self.dt, self.seed, self.scene = skill, q, limits, dt, seed, scene
        self.laws, self.done, self.notes = list[ResolvedRateController](), list[StepDone](), list[str]()
        self.whole: Rollout | None = None
        self.plan: Plan | None = None  # of the last way

    def add(self, law: ResolvedRateController, rollout: Rollout, *done: StepDone) -> None:
        """A part of the motion, and what became of the steps that end with it."""
        self.laws.append(law)
        self.done += done
        self.whole = rollout if self.whole is None else self.whole.followed_by(rollout)
        self.q = self.whole.q[-1]

    def grip(self, step: Step, name: str, mu: float) -> None:
        """The gripper closes or opens; the arm stands meanwhile, and joints of fingers go where they went."""
        robot, fingers = self.limits.robot, dict(step.fingers)
        positions = robot.positions(self.q)
        goal = np.array([fingers.get(joint, x) for joint, x in zip(robot.joint_names, positions, strict=True)])
        task = JointMotion(self.limits, [positions, goal], gripper=step.gripper)
        law = ResolvedRateController(every_joint(robot), task, limits=self.limits, dt=self.dt)
        rollout = simulate(robot, law, self.q, task.duration, self.dt)
        phases = ((f"{name}: {step.gripper}", 0.0, float(rollout.time[-1])),)
        self.add(law, replace(rollout, phases=phases, manipulability=np.full(len(rollout), mu)))

    def way(self, step: Step, name: str, said: Progress) -> None:
        """Take hold and go along what was learnt, as it was shown in this step."""
        constraint, shared = step.as_shown, dict[str, Any](limits=self.limits, scene=self.scene, dt=self.dt)
        if constraint is None or constraint.robot is None:
            raise TargetError(f"step {name!r}: no constraint to go along")
        try:
            shown = motion(constraint)
            self.plan = found = plan(constraint, shown, self.q, self.seed, takes=step.takes, progress=said, **shared)
        except NoPlanError as refusal:
            raise NoPlanError(f"step {name!r}: {refusal}", **vars(refusal)) from refusal
        robot, frame = found.robot, constraint.features.frame.name  # type: ignore[attr-defined]  # a plan has looked
        held, came, off = found.approach.q[-1], found.outcome, None
        grasp, end = robot.pose(held, frame), robot.position(found.way.q[-1], frame)
        far = float(np.linalg.norm(grasp[:3, 3] - robot.position(self.q, frame)))
        if constraint.shown is not None and len(constraint.shown.grasps):
            seen = constraint.features.twist.pose(held)[:3, 3]  # perhaps from another frame
            off = float(np.min(np.linalg.norm(constraint.shown.grasps[:, :3, 3] - seen, axis=1)))
        fast, title = _fastest(found.approach, robot), f"take hold for {name}"
        numbers = abs(came.wanted), abs(came.done), came.unit, came.deviation, found.margin
        to_hold, along = found.controller.laws
        reach = StepDone("reach", far, far, "m", 0.0, None, None, fast, grasp[:3, 3], title, grasp, off)
        self.add(to_hold, _named(found.approach, name), reach)
        way = _named(found.way, name)
        if step.gripper is not None:
            self.grip(step, name, float(way.manipulability[0]))
            fingers, q = [robot.joint_index(joint) for joint in step.fingers], way.q.copy()
            q[:, fingers] = self.q[fingers]
            way = replace(way, q=q)
        self.add(along, way, StepDone("way", *numbers, came.stopped_by, came.fastest[1], end, name, grasp, off))
        self.notes += [note for note in found.notes if note not in self.notes]

    def retreat(self, place: Float[np.ndarray, " 3"], name: str) -> None:
        """The hand goes where the recordings ended: as it was shown, else straight, else around what is in the way."""
        if self.plan is None:
            return
        last, limits, found = self.plan.controller.laws[-1], self.limits, self.plan
        features: Any = last.constraint.features  # a place is known of a frame's rows
        robot, take, knots = limits.robot, found.take, None
        hand, here = FrameJacobian(robot, features.frame.name), robot.positions(self.q)
        far = float(np.linalg.norm(place - hand.pose(self.q)[:3, 3]))
        if far <= 1e-3:  # [m]: it is there
            return
        clear = Clearance(robot, True, found.around, here, () if take is None else [*take.q[::LOOKED_AT]])

        def brought(x: np.ndarray) -> np.ndarray:
            """Return a posture with the hand, turned as it is, where the recordings ended."""
            over = np.eye(4)
            over[:3, 3] = place - hand.pose(robot.configuration(x))[:3, 3]
            return carried(hand, x[None], over)[0]

        if take is not None and features.relative_to is None:
            moving = [robot.moves(joint, hand.frame) for joint in robot.joint_names]
            after = nearest_turn(robot, carried(hand, np.where(moving, take.after, here), take.moved), here)
            knots = joined(after, here, brought(after[-1]))
        rows, end, stopped = last.task.rows(last.constraint), brought(here), None  # those of the way that is left
        to = partial(approach, start=self.q, rows=rows, limits=limits, clear=clear, seed=self.seed, dt=self.dt)
        if (moved := to(end, shown=knots)) is None:  # the hand stays where it has let go
            stopped = " and ".join(clear.in_line(here, end) or ("the arm", "something")) + ", which would touch"
            moved = to(here)
        if moved is None:
            raise NoPlanError(f"step {name!r}: the arm touches something where the last way ends")
        _, law, rollout = moved
        end, fast = hand.pose(rollout.q[-1])[:3, 3], _fastest(rollout, robot)
        off = float(np.linalg.norm(end - place))
        done = StepDone("reach", far, max(0.0, far - off), "m", off, None, stopped, fast, end, name)
        self.add(law, replace(rollout, phases=((name, 0.0, float(rollout.time[-1])),), ways=()), done)

    def repetition(self) -> Repetition:
        """The whole motion."""
        robot, whole = self.limits.robot, cast("Rollout", self.whole)  # a skill has a way
        whole = replace(whole, constraint=whole.ways[0]["constraint"], target=None)  # not those of its last part
        tip = robot.frame_kinematics(self.skill.constraints[0].features.frame)  # type: ignore[attr-defined]  # as above
        far = np.linalg.norm(np.diff(tip.poses(whole.q)[:, :3, 3], axis=0), axis=1)
        numbers = float(np.sum(far)), float(np.max(far / np.diff(whole.time)))
        return Repetition(self.skill, whole, tuple(self.done), LawSequence(*self.laws), *numbers, tuple(self.notes))


def _fastest(rollout: Rollout, robot: Robot) -> float:
    """The largest share of a joint's velocity limit that a motion takes."""
    return float(np.max(np.abs(rollout.u) / robot.velocity_limit))


def _named(rollout: Rollout, name: str) -> Rollout:
    """A rollout whose phases and ways say to which step they belong."""
    phases = tuple((f"{name}: {part}", start, end) for part, start, end in rollout.phases)
    ways = tuple({**way, "name": name, "constraint": rollout.constraint} for way in rollout.ways)
    return replace(rollout, phases=phases, ways=ways)


def _rigid(moved: ArrayLike) -> Float[np.ndarray, "4 4"]:
    T = finite(moved, 4, 4)
    if T is None or np.max(np.abs((R := T[:3, :3]) @ R.T - np.eye(3))) > 1e-6 or np.linalg.det(R) < 0:
        raise TargetError(
            "fixture_transform must be a rigid motion: four rows [R t; 0 0 0 1] of finite numbers, R a rotation, got "
            f"{np.array2string(np.asarray(moved), precision=3) if np.size(moved) <= 16 else an(moved)}"
        )
    return T
