"""A skill: everything that the recordings of a task show, in the order in which it was done."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, final, get_args

import numpy as np
from jaxtyping import Float

from manip_learn.atomic_write import write_atomically
from manip_learn.constraint.constraint import Constraint, damaged, read_constraint_file, signed
from manip_learn.constraint.shown import Shown, Take
from manip_learn.errors import DAMAGE, counted
from manip_learn.robot.robot import Robot

MOST_TAKES = 12  # kept with a step
StepKind = Literal["reach", "way"]
Gripping = Literal["close", "open"]


@final
@dataclass(frozen=True, eq=False)
class Step:
    """One part of a skill.

    Attributes:
        kind: `"reach"`: the hand goes through the air to where the next way begins, or to where the recordings ended;
            `"way"`: it goes along what a constraint leaves free.
        constraint: Of a way, and of a reach the one that the hand goes to; None where the recordings ended.
        shown: What was shown along the constraint here; None of a reach.
        gripper: What a gripper does once the hand has taken hold, and before it reaches for something else, if the
            recordings say so.
        fingers: Joint -> where it goes then [rad or m]; a gripper whose joints were not recorded has none.
        place: shape (3,), where the hand goes at the end of a skill, in the base frame [m]; None of other steps.
        takes: Of a way, the recordings that showed it; none in files of 0.2.
    """

    kind: StepKind
    constraint: Constraint | None
    shown: Shown | None = None
    gripper: Gripping | None = None
    place: Float[np.ndarray, " 3"] | None = None
    fingers: Mapping[str, float] = field(default_factory=dict)
    takes: tuple[Take, ...] = ()

    @property
    def as_shown(self) -> Constraint | None:
        """The constraint, with what was shown along it in this step."""
        known = self.constraint
        return known if known is None or self.shown is None else known.showing(self.shown)


@final
@dataclass(frozen=True, eq=False, repr=False)
class Skill:
    """What a task consists of: constraints, and steps in the order in which they were shown.

    Attributes:
        constraints: Every constraint that was learnt, best supported first.
        steps: In order.
        notes: What to know of the order, in sentences.

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("sawyer")
        >>> demos = ml.load_demonstrations("sawyer_drawer", robot)[:6]  # or a folder of your own
        >>> learner = ml.ConstraintLearner(ml.FrameJacobian(robot, "right_gripper_tip", axes="xyz")).fit(demos)
        >>> [step.kind for step in learner.skill_.steps]
        ['reach', 'way']
    """

    constraints: tuple[Constraint, ...]
    steps: tuple[Step, ...]
    notes: tuple[str, ...] = ()

    @property
    def robot(self) -> Robot | None:
        """The robot that it was shown with."""
        return self.constraints[0].robot

    def __repr__(self) -> str:
        lines = [f"{i + 1}. {_in_words(step)}" for i, step in enumerate(self.steps[:8])]
        lines += [f"... and {len(self.steps) - 8} more"] if len(self.steps) > 8 else []
        return "\n".join([f"Skill of {counted(len(self.steps), 'step')}", *lines])

    def moved(self, transform: Float[np.ndarray, "4 4"]) -> Skill:
        """Return the skill at fixtures that stand elsewhere: p' = R p + t in the base's frame."""
        transform = np.asarray(transform, dtype=np.float64)
        elsewhere = {id(c): c.moved(transform) for c in self.constraints}
        steps = []
        for step in self.steps:
            shown = step.shown and step.shown.moved(transform)
            place = None if step.place is None else transform[:3, :3] @ step.place + transform[:3, 3]
            takes = step.takes  # of a hand that is seen from another frame nothing moves in the base's
            if step.constraint is not None and step.constraint.features.relative_to is None:
                takes = tuple(replace(take, moved=transform @ take.moved) for take in takes)
            constraint = elsewhere.get(id(step.constraint))
            steps.append(replace(step, constraint=constraint, shown=shown, place=place, takes=takes))
        return replace(self, constraints=tuple(elsewhere[id(c)] for c in self.constraints), steps=tuple(steps))

    def to_dict(self) -> dict[str, Any]:
        """Return the content of a skill's file: that of its first constraint, with the others and the steps beside it.

        Raises:
            FeatureError: The features are Python functions and cannot be written down.
        """
        number = {id(c): i for i, c in enumerate(self.constraints)}
        steps = [
            vars(step)
            | {"constraint": number.get(id(step.constraint)), "shown": step.shown and step.shown.to_dict()}
            | {"place": None if step.place is None else step.place.tolist(), "fingers": dict(step.fingers)}
            | {"takes": [take.to_dict() for take in step.takes]}
            for step in self.steps
        ]
        others = [c.to_dict() for c in self.constraints[1:]]
        skill = {"others": others, "steps": steps, "notes": list(self.notes)}
        return signed(self.constraints[0].to_dict() | {"skill": skill})

    def save(self, path: str | Path) -> Path:
        """Write a JSON file, whole or not at all; `Constraint.load` of it gives the first constraint.

        Raises:
            OutputError: It cannot be written.
            FeatureError: The features are Python functions and cannot be written down.
        """
        return write_atomically(path, json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n")

    @staticmethod
    def load(path: str | Path, robot: Robot, *, same_urdf: bool = True) -> Skill:
        """Read a skill; of a file that holds a constraint alone, its one way.

        Args:
            path: JSON file written by `save`, or by `Constraint.save`.
            robot: The robot, loaded with the same locked joints.
            same_urdf: As for `Constraint.load`.

        Raises:
            ConstraintMismatchError: Another robot, another schema, a damaged or a changed file, or no skill at all.
        """
        content, source = read_constraint_file(Path(path)), str(path)
        first = Constraint.from_dict(content, robot, source=source, same_urdf=same_urdf)
        saved = content.get("skill")
        if saved is None:
            return one_way(first)
        try:
            others = [Constraint.from_dict(c, robot, source=source, same_urdf=same_urdf) for c in saved["others"]]
            constraints = (first, *others)
            steps = tuple(_step(entry, constraints) for entry in saved["steps"])
            return Skill(constraints, steps, tuple(map(str, saved.get("notes", ()))))
        except DAMAGE as error:
            raise damaged(source, error) from error


def _step(entry: Mapping[str, Any], constraints: tuple[Constraint, ...]) -> Step:
    kind, number, gripper, place = (entry[name] for name in ("kind", "constraint", "gripper", "place"))
    if kind not in get_args(StepKind) or gripper not in (None, *get_args(Gripping)):
        raise ValueError(f"a step of kind {kind!r} with gripper {gripper!r}")
    where = None if place is None else np.array(place, dtype=np.float64).reshape(3)
    constraint = None if number is None else constraints[int(number)]
    fingers = {str(name): float(value) for name, value in entry.get("fingers", {}).items()}
    takes = tuple(map(Take.from_dict, entry.get("takes", ())))
    return Step(kind, constraint, Shown.from_dict(entry["shown"]), gripper, where, fingers, takes)


def one_way(constraint: Constraint) -> Skill:
    """Return the skill of a single constraint: to take hold, and its way."""
    return Skill((constraint,), (Step("reach", constraint), Step("way", constraint, constraint.shown)))


def _in_words(step: Step) -> str:
    if step.kind == "reach":
        return "go to where it begins" if step.place is None else "go to where the recordings ended"
    mechanism = None if step.constraint is None else step.constraint.mechanism
    what = "along what is free" if mechanism is None else f"along {mechanism.sentence}"
    return what if step.shown is None else f"{what}: {step.shown.extent:.3g} {step.shown.unit}"
