"""The generated sets of recordings that the learner is measured on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, final

from make_recordings import kinematic_sets, physics_sets
from make_recordings.arms import ROBOTS, Arm, load_arm
from make_recordings.kinds import FREE

from manip_learn.recordings.trajectory import Trajectory

FIRST_SEED = 1000
PHASES = ("drawer", "table", "door", "drawer_then_table", "door_then_drawer")
FIRM = {"drawer_firm", "table_flat", "door_firm", "hinge", "screw", "sleeve", "joystick"}
STUDIES = ("phases", "phases-pose", "physics", "free", "evidence", "mechanisms", "contaminated", "clean")


@final
@dataclass(frozen=True)
class Case:
    """One set of recordings.

    Attributes:
        kind, robot, seed: It is made from these.
        n: Demonstrations.
        noise: Of the encoders [rad].
        whole: With approach and retreat, or the contacts only.
        axes: Rows of Phi.
        physics: Made by dynamics rather than by kinematics alone.
        mixed: So many of the demonstrations come from another set of the kind, seed + 5000.
    """

    kind: str
    robot: str
    seed: int
    n: int = 6
    noise: float = 1e-4
    whole: bool = True
    axes: str = "xyz"
    physics: bool = False
    mixed: int = 0

    def make(self) -> tuple[Arm, list[Trajectory], dict[str, Any]]:
        """The arm, the trajectories and the truth."""
        arm, maker = load_arm(self.robot), physics_sets if self.physics else kinematic_sets
        made, truth = maker.make_set(self.kind, self.robot, self.seed, self.n - self.mixed, self.noise, self.whole)
        if self.mixed:
            more = kinematic_sets.make_set(self.kind, self.robot, self.seed + 5000, self.mixed, self.noise, self.whole)
            made = [*made, *more[0]]
            moved = [[[a, b, 1] for a, b, _ in windows] for windows in more[1]["windows"]]
            truth["windows"] += moved
            truth["mechanisms"] += more[1]["mechanisms"]
            truth["contaminated"] = list(range(self.n - self.mixed, self.n))
        names = arm.robot.joint_names
        return arm, [Trajectory(t, q, None, names, f"demo_{i}") for i, (t, q) in enumerate(made)], truth


def cases_of(study: str, sets: int, kinds: list[str] | None) -> Iterator[tuple[str, list[Case]]]:
    """Name of a line of the table, and its sets."""

    def of(names: Iterable[str], **settings: Any) -> Iterator[tuple[str, list[Case]]]:
        for kind in names:
            if not kinds or kind in kinds:
                axes = "pose" if kind in FIRM else "rotation" if kind == "glass" else "xyz"
                given = {"axes": axes} | settings
                yield kind, [Case(kind, ROBOTS[i % 4], FIRST_SEED + i, **given) for i in range(sets)]

    match study:
        case "phases":
            yield from of(PHASES)
        case "phases-pose":
            yield from of(("drawer_firm", "table_flat", "door_firm"))
        case "physics":
            yield from of(PHASES, physics=True)
        case "free":
            for whole in (True, False):
                yield from ((f"{k}{'' if whole else ', cut'}", c) for k, c in of(FREE, whole=whole))
        case "evidence":
            for noise in (1e-3, 3e-3):
                lines = of(("drawer", "table", "table_flat", "door", "tether"), n=5, noise=noise, whole=False)
                yield from ((f"{kind}, {noise:g} rad", cases) for kind, cases in lines)
        case "mechanisms":
            yield from of(("drawer", "drawer_firm", "table", "table_flat", "door", "door_firm", "hinge"), whole=False)
            yield from of(("tether", "joystick", "screw", "sleeve", "glass"), whole=False)
        case "contaminated":
            for whole in (True, False):
                where = "whole" if whole else "cut"
                named = ("drawer_other_direction", "door_other_place", "drawer_slip", "door_slip")
                yield from ((f"{kind}, {where}", cases) for kind, cases in of(named, n=8, whole=whole))
                for mixed in (1, 2, 4):
                    lines = of(("drawer", "door"), n=8, mixed=mixed, whole=whole)
                    yield from ((f"{kind}, {mixed} of 8, {where}", cases) for kind, cases in lines)
        case "clean":
            for whole in (True, False):
                lines = of(("drawer", "table", "door", "tether", "hinge"), n=8, whole=whole)
                yield from ((f"{kind}{'' if whole else ', cut'}", cases) for kind, cases in lines)
