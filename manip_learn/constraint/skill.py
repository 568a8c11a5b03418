"""Skill: the constraints and steps of a demonstrated task, in order."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, final, get_args

import numpy as np
from jaxtyping import Float

from manip_learn.atomic_write import write_atomically
from manip_learn.constraint.constraint import Constraint, damage_error, read_constraint_file, with_checksum
from manip_learn.constraint.shown import Shown, Take
from manip_learn.errors import DAMAGE, counted
from manip_learn.robot.robot import Robot

MAX_TAKES = 12  # recordings stored with a step
StepKind = Literal["reach", "way"]
Gripping = Literal["close", "open"]


@final
@dataclass(frozen=True, eq=False)
class Step:
    """One step of a skill.

    Attributes:
        kind: `"way"` for a motion along the free directions of a constraint (contact); `"reach"` for a motion through
            free space to the start of the next `"way"`, or to the end of the recordings.
        constraint: For a `"way"` its constraint; for a `"reach"` the constraint of the next `"way"`, or None if there
            is none.
        shown: Demonstrated motion along the constraint in this step; None for a `"reach"`.
        gripper: Gripper action of a `"way"`, after the grasp and before the next `"reach"`; None if the recordings show
            none.
        fingers: Finger joint -> its target position [rad or m]; empty if the gripper joints were not recorded.
        place: shape (3,), final position of the hand, for a `"reach"` to the end of the recordings, in the base frame
            [m]; None for other steps.
        takes: Recorded joint motions of a `"way"`; empty in files of version 0.2.
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
        """The constraint of this step with the demonstrated motion of this step; None if there is no constraint."""
        constraint = self.constraint
        return constraint if constraint is None or self.shown is None else constraint.showing(self.shown)


@final
@dataclass(frozen=True, eq=False, repr=False)
class Skill:
    """A learnt task: constraints, and steps in the order of the demonstration.

    Attributes:
        constraints: All learnt constraints, best supported first.
        steps: Steps in order.
        notes: Remarks about the order of the steps, in sentences.

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
        """The robot of the first constraint; None if its features have no robot."""
        return self.constraints[0].robot

    def __repr__(self) -> str:
        lines = [f"{i + 1}. {_in_words(step)}" for i, step in enumerate(self.steps[:8])]
        lines += [f"... and {len(self.steps) - 8} more"] if len(self.steps) > 8 else []
        return "\n".join([f"Skill of {counted(len(self.steps), 'step')}", *lines])

    def moved(self, transform: Float[np.ndarray, "4 4"]) -> Skill:
        """Return the skill for fixtures (e.g. a cabinet) that were moved by p' = R p + t in the base frame.

        Args:
            transform: Homogeneous matrix (4, 4) of R and t [m].

        Returns:
            The moved skill.
        """
        transform = np.asarray(transform, dtype=np.float64)
        moved = {id(c): c.moved(transform) for c in self.constraints}
        steps = []
        for step in self.steps:
            motion = step.shown and step.shown.moved(transform)
            place = None if step.place is None else transform[:3, :3] @ step.place + transform[:3, 3]
            takes = step.takes  # takes relative to another frame do not change
            if step.constraint is not None and step.constraint.features.relative_to is None:
                takes = tuple(replace(take, moved=transform @ take.moved) for take in takes)
            constraint = moved.get(id(step.constraint))
            steps.append(replace(step, constraint=constraint, shown=motion, place=place, takes=takes))
        return replace(self, constraints=tuple(moved[id(c)] for c in self.constraints), steps=tuple(steps))

    def to_dict(self) -> dict[str, Any]:
        """Return the content of a skill file as a dictionary of JSON values.

        It is the content of the first constraint's file, with the other constraints and the steps added.

        Raises:
            FeatureError: The features are Python functions, which cannot be saved.
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
        return with_checksum(self.constraints[0].to_dict() | {"skill": skill})

    def save(self, path: str | Path) -> Path:
        """Write the skill to a JSON file; after an error, no incomplete file is left.

        `Constraint.load` can also read the file and returns the first constraint.

        Args:
            path: File to write.

        Returns:
            Path of the written file.

        Raises:
            OutputError: The file cannot be written.
            FeatureError: The features are Python functions, which cannot be saved.
        """
        return write_atomically(path, json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n")

    @staticmethod
    def load(path: str | Path, robot: Robot, *, same_urdf: bool = True) -> Skill:
        """Read a skill file, or a constraint file as a skill with one constraint.

        Args:
            path: JSON file written by `save`, or by `Constraint.save`.
            robot: The robot, loaded with the same locked joints.
            same_urdf: Require the identical URDF with joints locked at the same positions, see `Constraint.load`.

        Returns:
            The skill.

        Raises:
            ConstraintMismatchError: The file is for another robot, has another schema, is damaged, was changed after it
                was saved, or is neither a skill nor a constraint.
        """
        content, source = read_constraint_file(Path(path)), str(path)
        first = Constraint.from_dict(content, robot, source=source, same_urdf=same_urdf)
        saved = content.get("skill")
        if saved is None:
            return single_constraint_skill(first)
        try:
            others = [Constraint.from_dict(c, robot, source=source, same_urdf=same_urdf) for c in saved["others"]]
            constraints = (first, *others)
            steps = tuple(_step(entry, constraints) for entry in saved["steps"])
            return Skill(constraints, steps, tuple(map(str, saved.get("notes", ()))))
        except DAMAGE as error:
            raise damage_error(source, error) from error


def _step(entry: Mapping[str, Any], constraints: tuple[Constraint, ...]) -> Step:
    """Build a step from its entry in a file.

    Raises:
        ValueError: Invalid kind or gripper action.
    """
    kind, number, gripper, place = (entry[name] for name in ("kind", "constraint", "gripper", "place"))
    if kind not in get_args(StepKind) or gripper not in (None, *get_args(Gripping)):
        raise ValueError(f"invalid step: kind {kind!r}, gripper {gripper!r}")
    position = None if place is None else np.array(place, dtype=np.float64).reshape(3)
    constraint = None if number is None else constraints[int(number)]
    fingers = {str(name): float(value) for name, value in entry.get("fingers", {}).items()}
    takes = tuple(map(Take.from_dict, entry.get("takes", ())))
    return Step(kind, constraint, Shown.from_dict(entry["shown"]), gripper, position, fingers, takes)


def single_constraint_skill(constraint: Constraint) -> Skill:
    """Return a skill with one constraint: a reach to the grasp, then a motion along the constraint.

    Args:
        constraint: The constraint, with its demonstrated motion if there is one.

    Returns:
        A skill with two steps, `"reach"` and `"way"`.
    """
    return Skill((constraint,), (Step("reach", constraint), Step("way", constraint, constraint.shown)))


def _in_words(step: Step) -> str:
    """Return a step as text."""
    if step.kind == "reach":
        return "move to the next grasp" if step.place is None else "move to the end of the recordings"
    mechanism = None if step.constraint is None else step.constraint.mechanism
    direction = "along its free directions" if mechanism is None else f"along {mechanism.sentence}"
    return direction if step.shown is None else f"{direction}: {step.shown.extent:.3g} {step.shown.unit}"
