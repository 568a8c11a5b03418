"""The generated sets of recordings that the learner is measured on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from make_recordings import kinematic_sets, physics_sets
from make_recordings.arms import ROBOTS, Arm, load_arm
from make_recordings.kinds import FREE
from scipy.interpolate import CubicSpline

from manip_learn.recordings.trajectory import Trajectory

PHASES = ("drawer", "table", "door", "drawer_then_table", "door_then_drawer")
FIRM = {"drawer_firm", "table_flat", "door_firm", "hinge", "screw", "sleeve", "joystick"}
CONTACTS = ("drawer_firm", "door_firm", "hinge", "screw", "sleeve", "joystick", "table_flat")
CONTACTS += ("table", "drawer", "door", "tether")
CUT = ("drawer", "drawer_firm", "table", "table_flat", "door", "door_firm", "hinge")
# study: sets of each of its lines in the full table
STUDIES = {
    "free": 17,
    "clean": 5,
    "evidence": 20,
    "contaminated": 5,
    "mechanisms": 10,
    "phases": 8,
    "lone": 8,
    "small-turn": 6,
    "phases-pose": 3,
    "physics": 2,
    "apart": 4,
    "timing": 3,
    "noise": 4,
}
SMALL_TURN = 5.0  # of a hinge [deg]
CUT_FREE = 1.5, 4.0  # length of a cut free motion [s]
LONG = 12.0  # [s]


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
        turn: Only so much of the way about the mechanism's axis is kept [deg]; None: all of it.
        lone: Only the last recording keeps its second contact; the others end before.
        duration: Each recording is slowed down or sped up to this [s]; None: as it is.
        apart: Half of the recordings are with furniture that is turned by so much [deg]; None: all with the same.
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
    turn: float | None = None
    lone: bool = False
    duration: float | None = None
    apart: float | None = None

    def make(self) -> tuple[Arm, list[Trajectory], dict[str, Any]]:
        """The arm, the trajectories and the truth."""
        arm, maker = load_arm(self.robot), physics_sets if self.physics else kinematic_sets
        noise = 0.0 if self.duration else self.noise
        made, truth = maker.make_set(self.kind, self.robot, self.seed, self.n - self.mixed, noise, self.whole)
        if self.apart:
            return arm, *self._halves(made, truth, arm)
        if self.mixed:
            more = kinematic_sets.make_set(self.kind, self.robot, self.seed + 5000, self.mixed, self.noise, self.whole)
            made = [*made, *more[0]]
            moved = [[[a, b, 1] for a, b, _ in windows] for windows in more[1]["windows"]]
            truth["windows"] += moved
            truth["mechanisms"] += more[1]["mechanisms"]
            truth["contaminated"] = list(range(self.n - self.mixed, self.n))
        rng = np.random.default_rng(self.seed)
        if self.kind in FREE and not self.whole:
            made = [_cut(t, q, rng) for t, q in made]
        if self.lone:
            made = [*(_ended(truth["windows"][i], *made[i]) for i in range(self.n - 1)), made[-1]]
        if self.turn:
            made = [_turned(arm, truth["mechanisms"][0], t, q, self.turn) for t, q in made]
        if self.duration:
            _stretch_windows(truth, made, self.duration)
            made = [_stretched(t, q, self.duration, self.noise, rng) for t, q in made]
        names = arm.robot.joint_names
        return arm, [Trajectory(t, q, None, names, f"demo_{i}") for i, (t, q) in enumerate(made)], truth

    def _halves(self, made: list[Recorded], truth: dict[str, Any], arm: Arm) -> tuple[list[Trajectory], dict[str, Any]]:
        """The first half of the recordings as they are, the other half with the furniture turned."""
        half = self.n // 2
        more, other = kinematic_sets.make_set(
            self.kind, self.robot, self.seed, self.n, self.noise, self.whole, tilt=self.apart or 0.0
        )
        made = [*made[:half], *more[half:]]
        truth["windows"] = truth["windows"][:half] + [[[a, b, 1] for a, b, _ in w] for w in other["windows"][half:]]
        truth["mechanisms"] += other["mechanisms"]
        names = arm.robot.joint_names
        return [Trajectory(t, q, None, names, f"demo_{i}") for i, (t, q) in enumerate(made)], truth


Recorded = tuple[np.ndarray, np.ndarray]


def _cut(t: np.ndarray, q: np.ndarray, rng: np.random.Generator) -> Recorded:
    """A part of a free motion, as long as a contact that somebody cut out, from its middle half."""
    length = min(int(rng.uniform(*CUT_FREE) / (t[1] - t[0])), len(t) // 2)
    start = int(rng.integers(len(t) // 4, 3 * len(t) // 4 - length + 1))
    return t[:length], q[start : start + length]


def _ended(windows: list[list[float]], t: np.ndarray, q: np.ndarray) -> Recorded:
    """A recording without its second contact: it ends halfway between the two."""
    (first, second), end = windows, 0.5 * (windows[0][1] + windows[1][0])
    windows[:] = [first] if second[0] >= end else windows
    return t[t < end], q[t < end]


def _turned(arm: Arm, mechanism: dict[str, Any], t: np.ndarray, q: np.ndarray, turn: float) -> Recorded:
    """The first stretch in which the tip goes so far about the axis [deg], and comes back as far as it does."""
    axis, point = np.array(mechanism["axis"]), np.array(mechanism["point"])
    arms = np.array([arm.pose(row)[:3, 3] for row in q]) - point
    radial = arms - np.outer(arms @ axis, axis)
    sine, cosine = np.cross(radial[0], radial) @ axis, radial @ radial[0]
    beyond = np.flatnonzero(np.abs(np.degrees(np.arctan2(sine, cosine))) > turn)
    end = int(beyond[0]) if len(beyond) else len(t)
    return t[:end], q[:end]


def _stretch_windows(truth: dict[str, Any], made: list[Recorded], duration: float) -> None:
    for windows, (t, _) in zip(truth["windows"], made, strict=True):
        windows[:] = [[a * duration / t[-1], b * duration / t[-1], k] for a, b, k in windows]


def _stretched(t: np.ndarray, q: np.ndarray, duration: float, noise: float, rng: np.random.Generator) -> Recorded:
    """The same motion in another time, with the encoders' noise."""
    at = np.arange(0.0, duration, 0.01)
    motion = CubicSpline(t * duration / t[-1], q)(at)
    return at, motion + rng.normal(0.0, noise, motion.shape)


def cases_of(study: str, sets: int, first_seed: int, kinds: list[str] | None) -> Iterator[tuple[str, list[Case]]]:
    """Name of a line of the table, and its sets; those of one kind have the seeds from the first one on."""

    def of(names: Iterable[str], **settings: Any) -> Iterator[tuple[str, list[Case]]]:
        for kind in names:
            if not kinds or kind in kinds:
                axes = "pose" if kind in FIRM else "rotation" if kind == "glass" else "xyz"
                given = {"axes": axes} | settings
                yield kind, [Case(kind, ROBOTS[i % 4], first_seed + i, **given) for i in range(sets)]

    match study:
        case "phases":
            yield from of(PHASES)
        case "phases-pose":
            yield from of(("drawer_firm", "table_flat", "door_firm"))
        case "physics":
            yield from of((*PHASES, "screw", "free"), physics=True)
            lines = of(("drawer", "table", "door", "tether", "screw", "free_sticking"), physics=True, whole=False)
            yield from ((f"{kind}, cut", cases) for kind, cases in lines)
            lines = of(("door_other_place", "drawer_slip", "door_slip"), n=8, physics=True)
            yield from ((f"{kind}, whole", cases) for kind, cases in lines)
        case "lone":
            yield from of(("drawer_then_table", "door_then_drawer"), lone=True)
        case "free":
            for whole in (True, False):
                yield from ((f"{k}{'' if whole else ', cut'}", c) for k, c in of(FREE, whole=whole))
        case "evidence":
            for noise in (1e-3, 3e-3):
                lines = of(("drawer", "table", "table_flat", "door", "tether"), n=5, noise=noise, whole=False)
                yield from ((f"{kind}, {noise:g} rad", cases) for kind, cases in lines)
        case "noise":
            for noise in (1e-5, 1e-4, 1e-3):
                lines = of(CONTACTS, noise=noise, whole=False)
                yield from ((f"{kind}, {noise:g} rad", cases) for kind, cases in lines)
        case "mechanisms":
            yield from of(CUT, whole=False)
            yield from of(("tether", "joystick", "screw", "sleeve", "glass"), whole=False)
        case "small-turn":
            lines = of(("door", "door_firm", "hinge"), whole=False, turn=SMALL_TURN)
            yield from ((f"{kind}, {SMALL_TURN:g} deg", cases) for kind, cases in lines)
        case "apart":
            for degrees in (1.0, 2.0, 5.0, 10.0, 20.0):
                lines = of(("table", "drawer"), n=8, whole=False, apart=degrees)
                yield from ((f"{kind}s {degrees:g} deg apart", cases) for kind, cases in lines)
        case "timing":
            lines = of((*PHASES, "free"), duration=LONG)
            yield from ((f"{kind}, 6 x {LONG:g} s", cases) for kind, cases in lines)
        case "contaminated":
            for whole in (True, False):
                where = "whole" if whole else "cut"
                named = ("drawer_other_direction", "door_other_place", "drawer_slip", "door_slip")
                yield from ((f"{kind}, {where}", cases) for kind, cases in of(named, n=8, whole=whole))
                for mixed in (1, 2, 3, 4):
                    lines = of(("drawer", "door"), n=8, mixed=mixed, whole=whole)
                    yield from ((f"{kind}, {mixed} of 8, {where}", cases) for kind, cases in lines)
        case "clean":
            for whole in (True, False):
                lines = of(("drawer", "table", "door", "tether", "hinge"), n=8, whole=whole)
                yield from ((f"{kind}{'' if whole else ', cut'}", cases) for kind, cases in lines)
