"""A skill done again, step by step: take hold, go the way that was shown, let go, on to the next, and retreat."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.shown import Unit
from manip_learn.constraint.skill import Skill, Step, one_way
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.law_sequence import JointMotion, LawSequence, every_joint
from manip_learn.control.limits import Limits
from manip_learn.control.rollout import Rollout
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks.driven_motion import way_in_words
from manip_learn.control.tasks.motion import APPROACH_SPEED, FreeDirection, motion
from manip_learn.control.way import simulate_way
from manip_learn.errors import ConfigurationError, NoPlanError, TargetError, an
from manip_learn.linalg import complement_rows, finite
from manip_learn.planning.clearance import Clearance
from manip_learn.planning.plan import Around, moved_to, plan
from manip_learn.planning.surroundings import FRONT, LEAF, Surroundings
from manip_learn.recordings.trajectory_source import Progress
from manip_learn.robot.robot import Robot

_NEAR = 1e-3  # [m] a hand this near to where it is to go is there


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

    def to_dict(self) -> dict[str, Any]:
        """The JSON answer: lengths in m, angles in degrees."""
        size = 1.0 if self.unit == "m" else float(np.degrees(1.0))
        return {
            "kind": self.kind,
            "name": self.name,
            "wanted": size * self.wanted,
            "done": size * self.done,
            "unit": "m" if self.unit == "m" else "deg",
            "deviation": self.deviation,
            "margin": self.margin,
            "fastest": self.fastest,
            "place": self.place.tolist(),
            "stopped_by": self.stopped_by,
        }


@final
@dataclass(frozen=True, eq=False, repr=False)
class Repetition:
    """A skill done again.

    Attributes:
        skill: What was done, where its fixtures stand now.
        rollout: The whole motion, as simulated; its phases are named after the steps.
        steps: What became of each.
        controller: Does it, in `simulate`, in a `ServoLoop` and in `run`, from the start.
        notes: What to know of it, in sentences.
    """

    skill: Skill
    rollout: Rollout
    steps: tuple[StepDone, ...]
    controller: LawSequence
    notes: tuple[str, ...] = ()

    @property
    def is_done(self) -> bool:
        """Whether every step was done, all of it."""
        return all(step.stopped_by is None for step in self.steps)

    def __repr__(self) -> str:
        return "\n".join(f"{i + 1}. {_said(step)}" for i, step in enumerate(self.steps))


def _said(step: StepDone) -> str:
    far = f"{way_in_words(step.done, step.unit)} of {way_in_words(step.wanted, step.unit)}"
    margin = "" if step.margin is None else f", margin {step.margin:.0%}"
    return f"{step.name}: {far}{margin}" + ("" if step.stopped_by is None else f"; stopped by {step.stopped_by}")


def repeat(
    skill: Skill | Constraint,
    start: ArrayLike,
    moved: ArrayLike | None = None,
    *,
    scene: Around = "assumed",
    seed: int = 0,
    limits: Limits | None = None,
    dt: float = 0.01,
    progress: Progress | None = None,
) -> Repetition:
    """Do again what the recordings show, from any start: every step in the order in which it was shown.

    Each way is planned (see `plan`): the hand takes hold where the contacts began, in the posture that leaves most room
    for the way, and goes as far as was shown, or along the path that was shown, in the time that was shown. After the
    last way the hand goes where the recordings ended.

    Args:
        skill: As learnt (`ConstraintLearner.skill_`) or loaded; a constraint stands for its one way.
        start: Posture before the first step.
        moved: shape (4, 4), a rigid motion in the base's frame: the fixtures stand elsewhere, p' = R p + t [m].
        scene: What stands around, as of `plan`: kept clear of by every step.
        seed: Of the random postures: the same seed gives the same motion.
        limits: Of the joints; the robot's own by default.
        dt: Step of the simulation [s].
        progress: As for `simulate`.

    Raises:
        NoPlanError: A step that cannot be done; says which, what stops it and what would help. Nothing is returned of
            the steps before it.
        TargetError: A start outside the limits, a motion of the fixtures that is not rigid, nothing to do again.
        ConfigurationError: No skill, or a start of another size.

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("sawyer")
        >>> demos = ml.load_demonstrations("sawyer_drawer", robot)[:6]  # or a folder of your own
        >>> learner = ml.ConstraintLearner(ml.FrameJacobian(robot, "right_gripper_tip", axes="xyz")).fit(demos)
        >>> again = ml.repeat(learner.skill_, demos[0].q[0])
        >>> again.is_done, [step.kind for step in again.steps]
        (True, ['reach', 'way'])
    """
    if isinstance(skill, Constraint):
        skill = one_way(skill)
    if not isinstance(skill, Skill):
        raise ConfigurationError(f"call repeat(skill, start): the skill is {an(skill)}; learner.skill_ is one")
    robot = skill.robot
    if robot is None or not skill.steps:
        raise TargetError("there is nothing to do again: the recordings show no step with a robot")
    notes, around = [*skill.constraints[0].notes, *skill.notes], Surroundings()
    if moved is not None:
        skill = skill.moved(_rigid(moved))
    q, said = robot.checked_posture(start), progress or (lambda _title, _share: None)
    limits = limits or Limits(robot)
    laws: list[ResolvedRateController] = []
    done: list[StepDone] = []
    whole: Rollout | None = None
    for number, step in enumerate(skill.steps):
        name = _name(number, step, skill)
        said(name, number / len(skill.steps))
        parts: list[_Part] = []
        if step.kind == "reach" and step.gripper is not None:
            parts = [_grip(step, name, q, robot, limits, dt, 0.0 if whole is None else whole.manipulability[-1])]
            q = parts[-1].rollout.q[-1]
        if step.kind == "way":
            parts, around = [*parts, *(found := _way(step, name, q, scene, seed, limits, dt))[0]], found[1]
        elif step.place is not None:  # to a way its plan goes
            parts += _retreat(skill, step, name, q, around, seed, limits, dt)
        for part in parts:
            laws.append(part.law)
            done += part.done
            notes += [note for note in part.notes if note not in notes]
            whole = part.rollout if whole is None else whole.followed_by(part.rollout)
            q = whole.q[-1]
    if whole is None:
        raise TargetError("there is nothing to do again: the skill has no way")
    said("done", 1.0)
    guide = next((way["constraint"] for way in whole.ways), whole.constraint)
    whole = replace(whole, constraint=guide, target=None)  # not those of its last part
    return Repetition(skill, whole, tuple(done), LawSequence(*laws), tuple(notes))


def _name(number: int, step: Step, skill: Skill) -> str:
    if step.kind == "reach":
        return "retreat"
    mechanism = None if step.constraint is None else step.constraint.mechanism
    what = "way" if mechanism is None else mechanism.noun
    ways = [s for s in skill.steps[: number + 1] if s.kind == "way"]
    return f"{what} {len(ways)}" if sum(s.kind == "way" for s in skill.steps) > 1 else what


class _Part(NamedTuple):
    """A law, its rollout, and what became of the steps that end with it."""

    law: ResolvedRateController
    rollout: Rollout
    done: tuple[StepDone, ...] = ()
    notes: tuple[str, ...] = ()


def _grip(
    step: Step, name: str, q: Float[np.ndarray, " n"], robot: Robot, limits: Limits, dt: float, mu: float
) -> _Part:
    """The gripper closes or opens; the arm stands meanwhile, and joints of fingers go where they went."""
    positions, fingers = robot.positions(q), dict(step.fingers)
    goal = np.array([fingers.get(joint, x) for joint, x in zip(robot.joint_names, positions, strict=True)])
    task = JointMotion(robot, [positions, goal], limits.velocity, gripper=step.gripper)
    law = ResolvedRateController(every_joint(robot), task, limits=limits, dt=dt)
    rollout = simulate(robot, law, q, task.duration, dt)
    rollout = replace(rollout, manipulability=np.full(len(rollout), mu))
    return _Part(law, replace(rollout, phases=((f"{name}: {step.gripper}", 0.0, float(rollout.time[-1])),)))


def _way(
    step: Step, name: str, q: Float[np.ndarray, " n"], scene: Around, seed: int, limits: Limits, dt: float
) -> tuple[list[_Part], Surroundings]:
    """Take hold and go along what was learnt, as it was shown in this step; and what stands around."""
    constraint = step.as_shown
    if constraint is None or constraint.robot is None:
        raise TargetError(f"step {name!r}: no constraint to go along")
    try:
        found = plan(constraint, motion(constraint), q, seed, scene=scene, limits=limits, dt=dt)
    except NoPlanError as refusal:
        facts = {"largest": refusal.largest, "posture": refusal.posture}
        raise NoPlanError(
            f"step {name!r}: {refusal}", stopped_by=refusal.stopped_by, helps=refusal.helps, **facts
        ) from refusal
    robot, frame = found.robot, constraint.features.frame.name  # type: ignore[attr-defined]  # a plan has looked
    hold, end = (robot.position(x, frame) for x in (found.approach.q[-1], found.way.q[-1]))
    far, outcome = float(np.linalg.norm(hold - robot.position(q, frame))), found.outcome
    fast = float(np.max(np.abs(found.approach.u) / robot.velocity_limit))
    reach = StepDone("reach", far, far, "m", 0.0, None, None, fast, hold, f"take hold for {name}")
    way = StepDone(
        "way",
        abs(outcome.wanted),
        abs(outcome.done),
        outcome.unit,
        outcome.deviation,
        found.margin,
        outcome.stopped_by,
        outcome.fastest[1],
        end,
        name,
    )
    to_hold, along = found.controller.laws
    approach, motion_along, grips = _named(found.approach, name), _named(found.way, name), []
    if step.gripper is not None:
        grips = [_grip(step, name, approach.q[-1], robot, limits, dt, float(motion_along.manipulability[0]))]
        q, fingers = motion_along.q.copy(), [robot.joint_index(joint) for joint in step.fingers]
        q[:, fingers] = grips[0].rollout.q[-1, fingers]
        motion_along = replace(motion_along, q=q)
    parts = [_Part(to_hold, approach, (reach,), found.notes), *grips, _Part(along, motion_along, (way,))]
    return parts, found.around.afterwards


def _named(rollout: Rollout, name: str) -> Rollout:
    """A rollout whose phases and ways say to which step they belong."""
    phases = tuple((f"{name}: {part}", start, end) for part, start, end in rollout.phases)
    ways = tuple({**way, "name": name, "constraint": rollout.constraint} for way in rollout.ways)
    around = tuple(
        {**thing, "name": f"{thing['name']} of {name}"} if thing["name"] in (FRONT, LEAF) else thing
        for thing in rollout.around
    )
    return replace(rollout, phases=phases, ways=ways, around=around)


def _retreat(
    skill: Skill,
    step: Step,
    name: str,
    q: Float[np.ndarray, " n"],
    around: Surroundings,
    seed: int,
    limits: Limits,
    dt: float,
) -> list[_Part]:
    """The hand goes straight to where the recordings ended, or the joints around what is in the way of that."""
    last = next(s.constraint for s in reversed(skill.steps) if s.constraint is not None)
    robot, frame = limits.robot, last.features.frame.name  # type: ignore[attr-defined]  # a place is known of a frame's rows
    away = np.asarray(step.place) - robot.position(q, frame)
    far = float(np.linalg.norm(away))
    if far <= _NEAR:
        return []  # it is there
    line = Constraint(complement_rows(away[None] / far), FrameJacobian(robot, frame))
    task = FreeDirection(line, far, APPROACH_SPEED, direction=away)
    law = ResolvedRateController(line, task, task.ascent(), limits=limits, dt=dt)
    rollout, outcome = simulate_way(robot, law, q, dt)
    if not outcome.is_done:
        raise NoPlanError(f"step {name!r}: the hand does not get to where the recordings ended: {outcome.stopped_by}")
    clear = Clearance(robot, True, around, robot.positions(q))
    done, fastest = abs(outcome.done), outcome.fastest[1]
    touching = next((pair for x in rollout.q if (pair := clear.touching(robot.positions(x))) is not None), None)
    notes: tuple[str, ...] = ()
    if touching is not None:
        goal, between = robot.positions(rollout.q[-1]), " and ".join(touching.links)
        if (moved := moved_to(goal, q, limits, clear, seed, dt) if clear(goal) else None) is not None:
            law, rollout = moved
            fastest = float(np.max(np.abs(rollout.u) / robot.velocity_limit))
        elif touching.links[1] in around.assumed:
            notes = (f"on the {name} {between} would touch, if that is where it was assumed to be: name a scene",)
        else:
            raise NoPlanError(f"step {name!r}: {between} would touch on the way to where the recordings ended")
    end = robot.position(rollout.q[-1], frame)
    off = float(np.linalg.norm(end - np.asarray(step.place)))
    rollout = replace(rollout, phases=((name, 0.0, float(rollout.time[-1])),), ways=())
    return [_Part(law, rollout, (StepDone("reach", far, done, "m", off, None, None, fastest, end, name),), notes)]


def _rigid(moved: ArrayLike) -> Float[np.ndarray, "4 4"]:
    T = finite(moved, 4, 4)
    turned = None if T is None else T[:3, :3]
    if T is None or turned is None or np.max(np.abs(turned @ turned.T - np.eye(3))) > 1e-6 or np.linalg.det(turned) < 0:
        raise TargetError(
            "moved must be a rigid motion: four rows [R t; 0 0 0 1] of finite numbers, R a rotation, got "
            f"{np.array2string(np.asarray(moved), precision=3) if np.size(moved) <= 16 else an(moved)}"
        )
    return T
