"""How well whole, mixed and loosely held recordings are learnt, on generated sets that nothing was tuned on.

    python benchmarks/whole_recordings.py --studies phases free --sets 12 --out table.md

Each set is learnt by `ConstraintLearner([world, local])`, as the command line does, and compared with the mechanism
that it was made with. Set i of a kind has the seed 1000 + i and the robots take turns. No learnt quantity takes part in
the truth.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

from make_recordings import kinematic_sets, physics_sets
from make_recordings.arms import ROBOTS, Arm, load_arm
from make_recordings.kinds import FREE

import manip_learn as ml
from manip_learn.errors import NotIdentifiableError
from manip_learn.learning.report import LearningReport
from manip_learn.linalg import null_basis
from manip_learn.recordings.trajectory import Trajectory

FIRST_SEED = 1000
MOVING = 0.01  # slower than this the tip rests, which counts for neither side [m/s]
PLACES = 12  # postures of each contact at which rows are compared
PHASES = ("drawer", "table", "door", "drawer_then_table", "door_then_drawer")
FIRM = {"drawer_firm", "table_flat", "door_firm", "hinge", "screw", "sleeve", "joystick"}
TYPES = {"slide": "line", "upright": "held-orientation", "sleeve": "other"}
COLUMNS = (
    "refused",
    "warned",
    "rows right",
    "wrong, no warning",
    "found %",
    "outside %",
    "boundary s",
    "direction deg",
    "type right",
    "axis deg",
    "place mm",
    "radius mm",
    "pitch %",
    "odd missed",
    "false alarms",
    "cpu s",
)
COUNTED = {"refused", "warned", "rows right", "wrong, no warning", "type right", "odd missed", "false alarms"}
LARGE_IS_GOOD = {"found %"}


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


@final
@dataclass(frozen=True)
class Outcome:
    """What was learnt from one set: figures by the names of the columns, and words about what went wrong."""

    case: Case
    figures: dict[str, float]
    words: str = ""
    why: list[str] = field(default_factory=list)


def judge(case: Case) -> Outcome:
    """Learn one set and compare it with the truth."""
    arm, demos, truth = case.make()
    maps = [ml.FrameJacobian(arm.robot, truth["tip"], case.axes, reference) for reference in ("world", "local")]
    learner, started = ml.ConstraintLearner(maps), time.process_time()
    try:
        learner.fit(demos)
    except NotIdentifiableError as refusal:
        figures = {"refused": 1.0, "cpu s": time.process_time() - started}
        if truth["mechanisms"]:
            figures |= {"rows right": 0.0, "type right": 0.0}
        if truth["contaminated"]:
            figures |= {"odd missed": float(len(truth["contaminated"]))}
        return Outcome(case, figures, f"refused ({refusal.code}): {refusal}")
    report = learner.report_
    figures = {"refused": 0.0, "warned": float(bool(report.warnings)), "cpu s": time.process_time() - started}
    if truth["mechanisms"]:
        figures |= _rows(learner, arm, demos, truth, case.axes) | _mechanisms(learner, demos, truth)
        figures["wrong, no warning"] = float(not figures["rows right"] and not report.warnings)
        if case.whole and not truth["contaminated"]:
            figures |= _phases(report, arm, demos, truth)
        figures |= _odd(report, len(demos), truth["contaminated"], bool(case.mixed))
    return Outcome(case, figures, str(report))


def true_rows(mechanism: dict[str, Any], position: np.ndarray, axes: str) -> np.ndarray:
    """Rows of the tip's velocity (linear part first) that are zero at a place, among those of the axes asked for."""
    axis = np.array(mechanism["axis"] or [0.0, 0.0, 1.0])
    firm, across, none = mechanism["held"] == "firm", null_basis(axis[None]).T, np.zeros((3, 3))
    arm = position - np.array(mechanism["point"] or [0.0, 0.0, 0.0])
    # velocity of the point of the hand that is at the mechanism's point: v + (c - p) x ... = v - [c - p] w
    x, y, z = -arm
    carried = np.hstack([np.eye(3), -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])])
    turning = np.hstack([np.zeros((2, 3)), across])
    match mechanism["type"]:
        case "slide":
            rows = np.hstack([across, np.zeros((2, 3))])
            rows = np.vstack([rows, np.hstack([none, np.eye(3)])]) if firm else rows
        case "plane":
            rows = np.hstack([axis, np.zeros(3)])[None]
            rows = np.vstack([rows, turning]) if firm else rows
        case "upright":
            rows = turning
        case "ball":
            rows = carried if firm else np.hstack([arm / np.linalg.norm(arm), np.zeros(3)])[None]
        case _ if firm:
            along = axis @ carried - np.hstack([np.zeros(3), (mechanism["pitch"] or 0.0) * axis])
            rows = np.vstack([turning, across @ carried])
            rows = rows if mechanism["type"] == "sleeve" else np.vstack([rows, along])
        case _:
            radial = across.T @ (across @ arm)
            rows = np.vstack(
                [np.hstack([axis, np.zeros(3)]), np.hstack([radial / np.linalg.norm(radial), np.zeros(3)])]
            )
    free = null_basis(np.linalg.qr(rows.T)[0].T)
    part = free[{"xyz": slice(0, 3), "rotation": slice(3, 6), "pose": slice(0, 6)}[axes]]
    left, sizes, _ = np.linalg.svd(part)
    return left[:, int(np.count_nonzero(sizes > 1e-6)) :].T


def _rows(
    learner: ml.ConstraintLearner, arm: Arm, demos: list[Trajectory], truth: dict[str, Any], axes: str
) -> dict[str, float]:
    """Number of rows, and the largest angle between rows learnt and true ones, of the worst constraint."""
    used = {"xyz": slice(0, 3), "rotation": slice(3, 6), "pose": slice(0, 6)}[axes]
    wrong, angles = False, []
    names = {t.name: i for i, t in enumerate(demos)}
    for index, mechanism in enumerate(truth["mechanisms"]):
        windows = [(i, a, b) for i, w in enumerate(truth["windows"]) for a, b, k in w if k == index]
        if not windows or (index > 0 and truth["contaminated"]):
            continue
        number = _best_constraint(learner.report_, windows, names)
        if number is None:
            return {"rows right": 0.0}
        constraint, found = learner.constraints_[number], []
        for i, a, b in windows:
            inside = np.flatnonzero((demos[i].time >= a) & (demos[i].time <= b))
            for q in demos[i].q[inside[:: max(1, len(inside) // PLACES)]]:
                J = arm.robot.jacobian(q, arm.tip)[used]
                learnt = np.linalg.qr((constraint(q) @ np.linalg.pinv(J)).T)[0]
                true = true_rows(mechanism, arm.pose(q)[:3, 3], axes)
                wrong |= len(true) != learnt.shape[1]
                cosine = np.linalg.svd(true @ learnt, compute_uv=False)[-1] if len(true) else 0.0
                found.append(np.degrees(np.arccos(min(cosine, 1.0))))
        angles.append(float(np.median(found)))
    return {"rows right": float(not wrong), "direction deg": max(angles)}


def _best_constraint(
    report: LearningReport, windows: Iterable[tuple[int, float, float]], names: dict[str, int]
) -> int | None:
    """The constraint whose stretches overlap these windows most."""
    shared: dict[int, float] = {}
    for phase in report.phases:
        for i, a, b in windows:
            if phase.constraint is not None and names[phase.trajectory] == i:
                overlap = max(0.0, min(b, phase.end) - max(a, phase.start))
                shared[phase.constraint] = shared.get(phase.constraint, 0.0) + overlap
    shared = {k: v for k, v in shared.items() if v > 0.0}
    return max(shared, key=lambda k: shared[k]) if shared else None


def _phases(report: LearningReport, arm: Arm, demos: list[Trajectory], truth: dict[str, Any]) -> dict[str, float]:
    """Share found and share outside where the tip moves, and the median error of the boundaries: of the worst task."""
    names, worst = {t.name: i for i, t in enumerate(demos)}, {"found %": 100.0, "outside %": 0.0, "boundary s": 0.0}
    for index in range(len(truth["mechanisms"])):
        windows = [(i, a, b) for i, w in enumerate(truth["windows"]) for a, b, k in w if k == index]
        number, right, true, answered, edges = _best_constraint(report, windows, names), 0, 0, 0, []
        for i, a, b in windows:
            t = demos[i]
            tip = np.array([arm.pose(q)[:3, 3] for q in t.q])
            moving = np.linalg.norm(np.gradient(tip, t.time, axis=0), axis=1) > MOVING
            is_true = moving & (t.time >= a) & (t.time <= b)
            spans = [p for p in report.phases if p.trajectory == t.name and p.constraint == number is not None]
            said = moving & np.any([(t.time >= p.start) & (t.time <= p.end) for p in spans] or [moving & False], axis=0)
            right, true, answered = right + (said & is_true).sum(), true + is_true.sum(), answered + said.sum()
            if np.any(said & is_true):
                edges += [abs(t.time[said][k] - t.time[is_true][k]) for k in (0, -1)]
        worst["found %"] = min(worst["found %"], 100.0 * right / max(true, 1))
        worst["outside %"] = max(worst["outside %"], 100.0 * (answered - right) / max(answered, 1))
        worst["boundary s"] = max(worst["boundary s"], float(np.median(edges)) if edges else np.inf)
    return worst


def _mechanisms(learner: ml.ConstraintLearner, demos: list[Trajectory], truth: dict[str, Any]) -> dict[str, float]:
    """The worst of the mechanisms."""
    worst: dict[str, float] = {"type right": 1.0}
    for index, mechanism in enumerate(truth["mechanisms"][: 1 if truth["contaminated"] else None]):
        windows = [(i, a, b) for i, w in enumerate(truth["windows"]) for a, b, k in w if k == index]
        number = _best_constraint(learner.report_, windows, {t.name: i for i, t in enumerate(demos)})
        figures = {"type right": 0.0} if number is None else _mechanism(learner.reports_[number], mechanism)
        worst["type right"] = min(worst["type right"], figures.pop("type right"))
        worst |= {name: max(value, worst.get(name, 0.0)) for name, value in figures.items()}
    return worst


def _mechanism(report: LearningReport, truth: dict[str, Any]) -> dict[str, float]:
    """Whether the type is right, and errors of its parameters."""
    found = report.mechanism
    if found is None:
        return {"type right": 0.0}
    held = "loose" if truth["held"] == "loose" else "firm"
    figures = {"type right": float(found.type == TYPES.get(truth["type"], truth["type"]) and found.grip == held)}
    if not figures["type right"]:
        return figures
    axis = None if truth["axis"] is None or found.axis is None else np.array(truth["axis"])
    if axis is not None:
        figures["axis deg"] = float(np.degrees(np.arcsin(min(1.0, np.linalg.norm(np.cross(axis, found.axis))))))
    if found.point is not None and found.type in ("hinge", "ball", "screw", "other"):
        apart = found.point - np.array(truth["point"])
        apart = apart if axis is None else apart - (apart @ axis) * axis
        figures["place mm"] = 1e3 * float(np.linalg.norm(apart))
    if found.radius is not None and truth["radius"] and held == "loose":
        figures["radius mm"] = 1e3 * abs(found.radius - truth["radius"])
    if found.pitch is not None and truth["pitch"]:
        figures["pitch %"] = 100.0 * abs(found.pitch / truth["pitch"] - 1.0)
    return figures


def _odd(report: LearningReport, n: int, contaminated: list[int], either: bool) -> dict[str, float]:
    """How many odd recordings are not named, and how many of the others are.

    With as many odd ones as others either half may be called the odd one, or a constraint of its own.
    """
    named = {int(o.trajectory.removeprefix("demo_")) for o in report.odd_trajectories}
    if not contaminated:
        return {"false alarms": float(len(named))}
    times = np.zeros((n, len({p.constraint for p in report.phases}) + 1))
    for p in report.phases:
        if p.constraint is not None:
            times[int(p.trajectory.removeprefix("demo_")), p.constraint] += p.end - p.start
    label = np.where(times.sum(axis=1) > 0.0, times.argmax(axis=1), -1)
    odd, rest = set(contaminated), set(range(n)) - set(contaminated)
    counts = []
    for one, other in ((odd, rest), (rest, odd))[: 2 if either and len(odd) == len(rest) else 1]:
        main = np.bincount(label[sorted(other)] + 1).argmax() - 1
        told = named | {i for i in range(n) if label[i] not in (-1, main)}
        counts.append((float(len(one - told)), float(len(told & other))))
    missed, alarms = min(counts)
    return {"odd missed": missed, "false alarms": alarms}


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


def line_of(study: str, name: str, outcomes: list[Outcome]) -> str:
    """One line of the table: counts, and medians with the worst."""
    cells = [study, name, str(len(outcomes))]
    for column in COLUMNS:
        values = np.array([o.figures[column] for o in outcomes if column in o.figures])
        if not len(values):
            cells.append("")
        elif column in COUNTED:
            cells.append(f"{values.sum():.0f}")
        else:
            worst = values.min() if column in LARGE_IS_GOOD else values.max()
            cells.append(f"{np.median(values):.3g} ({worst:.3g})")
    return "| " + " | ".join(cells) + " |"


STUDIES = ("phases", "phases-pose", "physics", "free", "evidence", "mechanisms", "contaminated", "clean")


def losing(o: Outcome) -> bool:
    """Whether something about it is not as it should be."""
    f = o.figures
    wrong = f.get("rows right") == 0.0 or f.get("type right") == 0.0 or f.get("found %", 100.0) < 95.0
    wrong |= f.get("outside %", 0.0) > 3.0 or f.get("odd missed", 0.0) > 0.0 or f.get("false alarms", 0.0) > 0.0
    return wrong or (o.case.kind in FREE and f["refused"] == 0.0) or f.get("direction deg", 0.0) > 0.1


def main(arguments: list[str] | None = None, write: Callable[[str], None] = print) -> None:
    """Measure, and write one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--studies", nargs="+", choices=STUDIES, default=list(STUDIES))
    parser.add_argument("--kinds", nargs="+", help="only these kinds of recordings")
    parser.add_argument("--sets", type=int, default=12, help="sets of each kind")
    parser.add_argument("--out", type=Path, help="file for the table")
    parser.add_argument("--losing", action="store_true", help="say what was answered where it is wrong")
    given = parser.parse_args(arguments)
    lines = ["| study | kind | sets | " + " | ".join(COLUMNS) + " |", "|---" * (3 + len(COLUMNS)) + "|"]
    write("\n".join(lines))
    for study in given.studies:
        for name, cases in cases_of(study, given.sets, given.kinds):
            outcomes = [judge(case) for case in cases]
            lines.append(line_of(study, name, outcomes))
            write(lines[-1])
            for o in outcomes:
                if given.losing and losing(o):
                    numbers = {k: round(v, 3) for k, v in o.figures.items()}
                    write(f"    {o.case.robot} {o.case.seed} {numbers}: {o.words[:600]}")
            if given.out:
                given.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
