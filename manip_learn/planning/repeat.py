"""Reproduction of a skill, step by step: grasp, move, release, for every step, then retreat."""

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
from manip_learn.planning.plan import CHECK_STEP, Around, Plan, approach, plan
from manip_learn.planning.stations import Stations
from manip_learn.planning.ways import carry_hand, join_approach, nearest_turn
from manip_learn.recordings.load import Progress
from manip_learn.robot.joints import Frame
from manip_learn.robot.robot import Robot

TipSpeed = float | Literal["shown"] | None


@final
@dataclass(frozen=True, eq=False)
class StepDone:
    """Outcome of one step of a skill.

    Attributes:
        kind: `"reach"` (motion through free space) or `"way"` (motion along a constraint).
        wanted: Requested distance or angle of the motion [m or rad].
        done: Completed distance or angle [m or rad].
        unit: Unit of `wanted` and `done`, `"m"` or `"rad"`.
        deviation: Largest deviation from the mechanism [m or rad]; for a reach, distance of its end from the goal [m].
        margin: Smallest remaining share of the limits, see `Plan.margin`; None for a reach.
        stopped_by: Reason for stopping early, in words; None if the step was completed.
        fastest: Largest joint speed as a share of its limit, 0 to 1.
        place: Final position (3,) of the hand in this step, in the base frame [m]; for a reach, the grasp.
        name: Name of the step in words.
        grasp: Pose (4, 4) of the hand at the grasp, in the base frame [m]; None for a retreat.
        off: Distance of the grasp from the nearest demonstrated grasp [m], or of the end of a retreat from the
            demonstrated end; None if it is not known.
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
        """Return the attributes as a dictionary of JSON values; `wanted` and `done` are in m or degrees, as `unit`
        states.
        """
        size = 1.0 if self.unit == "m" else float(np.degrees(1.0))
        in_words = {"unit": "m" if self.unit == "m" else "deg", "place": self.place.tolist()}
        in_words["grasp"] = None if self.grasp is None else self.grasp.tolist()
        return vars(self) | in_words | {"wanted": size * self.wanted, "done": size * self.done}


@final
@dataclass(frozen=True, eq=False, repr=False)
class Repetition:
    """Reproduction of a skill.

    Attributes:
        skill: The skill, moved with its fixtures if `repeat` got a `fixture_transform`.
        rollout: The whole simulated motion; its phases are named after the steps.
        steps: Outcome of each step.
        controller: Controller of the whole motion, to be passed to `simulate`, `ServoLoop` or `run` with the same
            start.
        tip_path: Length of the path of the tip, the frame that the skill constrains [m].
        tip_speed: Largest speed of the tip over any step of the rollout [m/s].
        notes: Remarks, in sentences.
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
        """True if every step was completed."""
        return all(step.stopped_by is None for step in self.steps)

    def __repr__(self) -> str:
        return "\n".join([*(f"{i + 1}. {_sentence(step)}" for i, step in enumerate(self.steps)), self.pace])

    @property
    def pace(self) -> str:
        """Duration, path length and largest speed of the tip as one sentence."""
        return f"{self.rollout.time[-1]:.3g} s, {self.tip_path:.3g} m of the tip, at most {self.tip_speed:.2g} m/s"


def _sentence(step: StepDone) -> str:
    distance = f"{way_in_words(step.done, step.unit)} of {way_in_words(step.wanted, step.unit)}"
    margin = "" if step.margin is None else f", margin {step.margin:.0%}"
    return f"{step.name}: {distance}{margin}" + ("" if step.stopped_by is None else f"; stopped by {step.stopped_by}")


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
    """Plan and simulate the reproduction of a skill from a start configuration, all steps in the demonstrated order.

    Each motion follows a recording: its approach, its grasp, its distance or path, and its duration, or a longer one if
    the tip would be faster than `tip_speed`. After the last motion the hand retreats to the end of the recordings. If
    no recording can be followed, or none is known, the grasp configuration is searched (see `plan`).

    Args:
        skill: Skill from `ConstraintLearner.skill_` or `Skill.load`; or a constraint, for a skill with one motion.
        start: Configuration (nq,) of the robot before the first step [rad or m].
        fixture_transform: Homogeneous matrix (4, 4) of the rigid motion p' = R p + t of the fixtures (e.g. a cabinet)
            since the demonstrations, in the base frame [m]; None if they did not move.
        prefer: `"shown"` to follow recordings; `"room"` to search for the configuration with the largest margin first.
        scene: Obstacles that every step avoids: a `Scene`; `"assumed"` for an assumed floor; None for no obstacles.
        seed: Seed of the random configurations: the same seed gives the same motion.
        limits: Joint limits; None for the robot's own.
        dt: Time step of the simulation [s].
        tip_speed: Largest speed of the tip in every step [m/s]; a motion is never faster than demonstrated. The tip is
            the frame that the skill constrains. `"shown"` for the demonstrated speed, None for the joint limits only.
            If `limits` have a tip speed, the lower one applies.
        progress: Function that is called with the name of a stage and its completed share, 0 to 1; None for none.
        moved: Former name of `fixture_transform`, valid until 0.4. None if it is not used.

    Returns:
        The motion, the outcome of each step, the controller, and notes, e.g. about a motion that takes longer than
        demonstrated, or a tip speed that the arm cannot reach.

    Raises:
        NoPlanError: A step is infeasible; the message gives the step, the cause and possible remedies. The steps before
            it are not returned.
        TargetError: The start is outside the limits, the transform is not rigid, or the skill has no motion.
        ConfigurationError: `skill` is no skill, `start` has the wrong size, `tip_speed` is not positive, or `prefer` is
            another text.

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
        raise ConfigurationError(f"repeat() expects a Skill, got {an(skill)}; pass learner.skill_")
    robot = skill.robot
    if robot is None or not any(step.kind == "way" for step in skill.steps):
        raise TargetError("there is nothing to reproduce: the recordings show no motion of a robot")
    if prefer not in ("shown", "room"):
        raise ConfigurationError(f"prefer must be 'shown' or 'room', not {prefer!r}")
    if (transform := moved if fixture_transform is None else fixture_transform) is not None:
        skill = skill.moved(_check_rigid(transform))
    q, report = robot.checked_posture(start), progress or (lambda _title, _share: None)
    run = _SkillRun(skill, q, _limit_tip_speed(limits or Limits(robot), tip_speed, skill, q), dt, seed, scene)
    run.notes = [*skill.constraints[0].notes, *skill.notes]
    warnings = [str(doubt) for constraint in skill.constraints for doubt in constraint.provenance.get("warnings") or ()]
    if doubts := list(dict.fromkeys(warnings)):  # warnings about all recordings are repeated in each constraint
        count = counted(len(doubts), "warning")
        run.notes.append(f"learnt with {count}, read them before an arm moves: {'; '.join(doubts)}")
    if prefer == "shown" and not any(step.takes for step in skill.steps):
        run.notes.append("this task contains no recordings: the grasp configuration of each motion is searched")
    for number, step in enumerate(skill.steps):
        name = _name(number, step, skill)
        report(name, number / len(skill.steps))
        if step.kind == "way":
            followed = replace(step, takes=step.takes if prefer == "shown" else ())
            run.move(followed, name, lambda title, share, k=number: report(title, (k + share) / len(skill.steps)))
        else:
            if step.gripper is not None:
                run.grip(step, name, 0.0 if run.whole is None else run.whole.manipulability[-1])
            if step.place is not None:  # the plan of a motion includes its approach
                run.retreat(np.asarray(step.place), name)
    report("done", 1.0)
    return run.repetition()


def _limit_tip_speed(limits: Limits, tip_speed: TipSpeed, skill: Skill, q: Float[np.ndarray, " n"]) -> Limits:
    """Return limits with the requested tip speed, at a start q.

    Raises:
        ConfigurationError: A speed that is not positive, or another word.
    """
    # factor of the demonstrated speed, for the reserve of `Barriers.pace`; tip speed that is always allowed, however
    # slow the demonstration [m/s]
    spare, slowest = 1.05, 0.05
    if tip_speed is None:
        return limits
    speed = np.inf if tip_speed == "shown" else tip_speed
    if not isinstance(speed, int | float) or not speed > 0.0 or tip_speed == np.inf:
        expected = f"a positive number of metres per second such as {APPROACH_SPEED}"
        words, name = spoken("'shown', or None", "shown, or none"), advice("{}", "tip_speed", "--tip-speed")
        raise ConfigurationError(f"{name} is {tip_speed!r}: it must be {expected}, {words} for no limit")
    frames = [f for constraint in skill.constraints if (f := getattr(constraint.features, "frame", None)) is not None]
    takes = [take for step in skill.steps for take in step.takes]
    ways = [motion(way) for step in skill.steps if step.kind == "way" and (way := step.as_shown) is not None]
    speeds = [spare * Stations.of(way, q, limits).tip_speed for way in ways if isinstance(way, FreeDirection)]
    speeds += [_tip_speed(limits.robot, frames[0], take) for take in takes]
    most = max([*speeds, slowest if takes else APPROACH_SPEED])
    speed = min(speed, most) if takes or tip_speed == "shown" else speed
    return limits.with_tip_speed(speed, [frame.name for frame in frames])


def _tip_speed(robot: Robot, frame: Frame, take: Take) -> float:
    """Return the 98 % quantile of the speed of the tip in a recording [m/s]."""
    places = robot.frame_kinematics(frame).poses(take.q)[:, :3, 3]
    steps, times = np.linalg.norm(np.diff(places, axis=0), axis=1), np.diff(take.time)
    return float(np.quantile(steps[times > 0.0] / times[times > 0.0], 0.98)) if np.any(times > 0.0) else 0.0


def _name(number: int, step: Step, skill: Skill) -> str:
    if step.kind == "reach":
        return "reach" if step.place is None else "retreat"
    mechanism = None if step.constraint is None else step.constraint.mechanism
    noun = "way" if mechanism is None else mechanism.kind if mechanism.noun == "other" else mechanism.noun
    ways = [s for s in skill.steps[: number + 1] if s.kind == "way"]
    return f"{noun} {len(ways)}" if sum(s.kind == "way" for s in skill.steps) > 1 else noun


class _SkillRun:
    """Skill in progress, see `repeat`."""

    def __init__(self, skill: Skill, q: Float[np.ndarray, " n"], limits: Limits, dt: float, seed: int, scene: Around):
        self.skill, self.q, self.limits, self.dt, self.seed, self.scene = skill, q, limits, dt, seed, scene
        self.laws, self.done, self.notes = list[ResolvedRateController](), list[StepDone](), list[str]()
        self.whole: Rollout | None = None
        self.plan: Plan | None = None  # plan of the last motion

    def add(self, law: ResolvedRateController, rollout: Rollout, *done: StepDone) -> None:
        """Append a part of the motion, and the outcomes of the steps that end with it.

        Args:
            law: Controller of the part.
            rollout: The part, as simulated.
            *done: Outcomes of the steps.
        """
        self.laws.append(law)
        self.done += done
        self.whole = rollout if self.whole is None else self.whole.followed_by(rollout)
        self.q = self.whole.q[-1]

    def grip(self, step: Step, name: str, mu: float) -> None:
        """Close or open the gripper; the arm rests, and the fingers move to their demonstrated positions.

        Args:
            step: Step with the gripper's motion.
            name: Name of the step.
            mu: Manipulability to report during this part.
        """
        robot, fingers = self.limits.robot, dict(step.fingers)
        positions = robot.positions(self.q)
        goal = np.array([fingers.get(joint, x) for joint, x in zip(robot.joint_names, positions, strict=True)])
        task = JointMotion(self.limits, [positions, goal], gripper=step.gripper)
        law = ResolvedRateController(every_joint(robot), task, limits=self.limits, dt=self.dt)
        rollout = simulate(robot, law, self.q, task.duration, self.dt)
        phases = ((f"{name}: {step.gripper}", 0.0, float(rollout.time[-1])),)
        self.add(law, replace(rollout, phases=phases, manipulability=np.full(len(rollout), mu)))

    def move(self, step: Step, name: str, report: Progress) -> None:
        """Perform one motion along the learnt constraint, with its approach and grasp, as demonstrated in this step.

        Args:
            step: Step with the constraint and its recordings.
            name: Name of the step.
            report: Function of the name of a stage and its completed share.

        Raises:
            NoPlanError: The step is infeasible.
            TargetError: The step has no constraint, or no robot.
        """
        constraint, shared = step.as_shown, dict[str, Any](limits=self.limits, scene=self.scene, dt=self.dt)
        if constraint is None or constraint.robot is None:
            raise TargetError(f"step {name!r}: there is no constraint to move along")
        try:
            task = motion(constraint)
            self.plan = result = plan(constraint, task, self.q, self.seed, takes=step.takes, progress=report, **shared)
        except NoPlanError as refusal:
            raise NoPlanError(f"step {name!r}: {refusal}", **vars(refusal)) from refusal
        robot, frame = result.robot, constraint.features.frame.name  # type: ignore[attr-defined]  # checked by the plan
        hold, outcome, off = result.approach.q[-1], result.outcome, None
        grasp, end = robot.pose(hold, frame), robot.position(result.way.q[-1], frame)
        distance = float(np.linalg.norm(grasp[:3, 3] - robot.position(self.q, frame)))
        if constraint.shown is not None and len(constraint.shown.grasps):
            position = constraint.features.twist.pose(hold)[:3, 3]  # may be relative to another frame
            off = float(np.min(np.linalg.norm(constraint.shown.grasps[:, :3, 3] - position, axis=1)))
        fast, title = _largest_speed_share(result.approach, robot), f"grasp for {name}"
        numbers = abs(outcome.wanted), abs(outcome.done), outcome.unit, outcome.deviation, result.margin
        to_hold, along = result.controller.laws
        reach = StepDone("reach", distance, distance, "m", 0.0, None, None, fast, grasp[:3, 3], title, grasp, off)
        self.add(to_hold, _name_phases(result.approach, name), reach)
        way = _name_phases(result.way, name)
        if step.gripper is not None:
            self.grip(step, name, float(way.manipulability[0]))
            fingers, q = [robot.joint_index(joint) for joint in step.fingers], way.q.copy()
            q[:, fingers] = self.q[fingers]
            way = replace(way, q=q)
        self.add(along, way, StepDone("way", *numbers, outcome.stopped_by, outcome.fastest[1], end, name, grasp, off))
        self.notes += [note for note in result.notes if note not in self.notes]

    def retreat(self, place: Float[np.ndarray, " 3"], name: str) -> None:
        """Move the hand to where the recordings ended: as recorded, else straight, else around obstacles.

        Args:
            place: Position (3,) of the hand in the base frame [m].
            name: Name of the step.

        Raises:
            NoPlanError: The arm is in contact at the end of the last motion.
        """
        if self.plan is None:
            return
        last, limits, last_plan = self.plan.controller.laws[-1], self.limits, self.plan
        features: Any = last.constraint.features  # only rows of a frame have a place
        robot, take, knots = limits.robot, last_plan.take, None
        hand, here = FrameJacobian(robot, features.frame.name), robot.positions(self.q)
        distance = float(np.linalg.norm(place - hand.pose(self.q)[:3, 3]))
        if distance <= 1e-3:  # [m] it is there already
            return
        clear = Clearance(robot, True, last_plan.around, here, () if take is None else [*take.q[::CHECK_STEP]])

        def bring_hand(x: np.ndarray) -> np.ndarray:
            """Return a posture with the hand where the recordings ended, in the same orientation.

            Args:
                x: Joint positions (nv,) before [rad or m].
            """
            over = np.eye(4)
            over[:3, 3] = place - hand.pose(robot.configuration(x))[:3, 3]
            return carry_hand(hand, x[None], over)[0]

        if take is not None and features.relative_to is None:
            moving = [robot.moves(joint, hand.frame) for joint in robot.joint_names]
            after = nearest_turn(robot, carry_hand(hand, np.where(moving, take.after, here), take.moved), here)
            knots = join_approach(after, here, bring_hand(after[-1]))
        rows, end, stopped = last.task.rows(last.constraint), bring_hand(here), None  # rows of the last motion
        to = partial(approach, start=self.q, rows=rows, limits=limits, clear=clear, seed=self.seed, dt=self.dt)
        if (result := to(end, shown=knots)) is None:  # the hand stays where it has released
            stopped = " and ".join(clear.first_contact(here, end) or ("the arm", "something")) + ", which would collide"
            result = to(here)
        if result is None:
            raise NoPlanError(f"step {name!r}: the arm is in contact at the end of the last motion")
        _, law, rollout = result
        end, fast = hand.pose(rollout.q[-1])[:3, 3], _largest_speed_share(rollout, robot)
        off = float(np.linalg.norm(end - place))
        outcome = StepDone("reach", distance, max(0.0, distance - off), "m", off, None, stopped, fast, end, name)
        self.add(law, replace(rollout, phases=((name, 0.0, float(rollout.time[-1])),), ways=()), outcome)

    def repetition(self) -> Repetition:
        """Return the whole motion with its outcomes."""
        robot, whole = self.limits.robot, cast("Rollout", self.whole)  # a skill has a motion
        whole = replace(whole, constraint=whole.ways[0]["constraint"], target=None)  # not the values of the last part
        tip = robot.frame_kinematics(self.skill.constraints[0].features.frame)  # type: ignore[attr-defined]  # as above
        steps = np.linalg.norm(np.diff(tip.poses(whole.q)[:, :3, 3], axis=0), axis=1)
        numbers = float(np.sum(steps)), float(np.max(steps / np.diff(whole.time)))
        return Repetition(self.skill, whole, tuple(self.done), LawSequence(*self.laws), *numbers, tuple(self.notes))


def _largest_speed_share(rollout: Rollout, robot: Robot) -> float:
    """Return the largest share of a joint's velocity limit in a motion."""
    return float(np.max(np.abs(rollout.u) / robot.velocity_limit))


def _name_phases(rollout: Rollout, name: str) -> Rollout:
    """Return a rollout whose phases and ways carry the name of their step."""
    phases = tuple((f"{name}: {part}", start, end) for part, start, end in rollout.phases)
    ways = tuple({**way, "name": name, "constraint": rollout.constraint} for way in rollout.ways)
    return replace(rollout, phases=phases, ways=ways)


def _check_rigid(moved: ArrayLike) -> Float[np.ndarray, "4 4"]:
    T = finite(moved, 4, 4)
    if T is None or np.max(np.abs((R := T[:3, :3]) @ R.T - np.eye(3))) > 1e-6 or np.linalg.det(R) < 0:
        raise TargetError(
            "fixture_transform must be a rigid motion: four rows [R t; 0 0 0 1] of finite numbers, R a rotation, got "
            f"{np.array2string(np.asarray(moved), precision=3) if np.size(moved) <= 16 else an(moved)}"
        )
    return T
