"""How far an answer of the learner is from the truth of generated recordings."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from make_recordings.arms import Arm

import manip_learn as ml
from manip_learn.learning.report import LearningReport
from manip_learn.linalg import null_basis
from manip_learn.recordings.trajectory import Trajectory

MOVING = 0.01  # slower than this the tip rests, which counts for neither side [m/s]
IN_ONE_ONLY = "appears in one recording only"  # reason of a phase
PLACES = 12  # postures of each contact at which rows are compared
TYPES = {"slide": "line", "upright": "held-orientation", "sleeve": "other"}
# errors, and the columns that say whether they are below what is stated for 68 % of cases
INSIDE = {"axis deg": "axis in", "place mm": "place in", "radius mm": "radius in", "pitch %": "pitch in"}
PARTS = {"xyz": slice(0, 3), "rotation": slice(3, 6), "pose": slice(0, 6)}


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
    part = free[PARTS[axes]]
    left, sizes, _ = np.linalg.svd(part)
    return left[:, int(np.count_nonzero(sizes > 1e-6)) :].T


def postures(trajectory: Trajectory, start: float, end: float) -> np.ndarray:
    """Some of the postures of a contact, evenly chosen."""
    inside = np.flatnonzero((trajectory.time >= start) & (trajectory.time <= end))
    return trajectory.q[inside[:: max(1, len(inside) // PLACES)]]


def row_angle(A: np.ndarray, q: np.ndarray, arm: Arm, mechanism: dict[str, Any], axes: str) -> tuple[bool, float]:
    """Whether A(q) has as many rows as the mechanism holds, and the largest angle between the two [deg]."""
    learnt = np.linalg.qr((A @ np.linalg.pinv(arm.robot.jacobian(q, arm.tip)[PARTS[axes]])).T)[0]
    true = true_rows(mechanism, arm.pose(q)[:3, 3], axes)
    cosine = np.linalg.svd(true @ learnt, compute_uv=False)[-1] if len(true) else 0.0
    return len(true) == learnt.shape[1], float(np.degrees(np.arccos(min(cosine, 1.0))))


def rows_figures(
    learner: ml.ConstraintLearner, arm: Arm, demos: list[Trajectory], truth: dict[str, Any], axes: str
) -> dict[str, float]:
    """Number of rows, and the largest angle between rows learnt and true ones, of the worst constraint."""
    wrong, angles = False, []
    names = {t.name: i for i, t in enumerate(demos)}
    for index, mechanism in enumerate(truth["mechanisms"]):
        windows = [(i, a, b) for i, w in enumerate(truth["windows"]) for a, b, k in w if k == index]
        if len(windows) < 2 or (index > 0 and truth["contaminated"]):
            continue
        number = _best_constraint(learner.report_, windows, names)
        if number is None:
            return {"rows right": 0.0}
        constraint, found = learner.constraints_[number], []
        for i, a, b in windows:
            for q in postures(demos[i], a, b):
                same, angle = row_angle(constraint(q), q, arm, mechanism, axes)
                wrong |= not same
                found.append(angle)
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


def phases_figures(
    report: LearningReport, arm: Arm, demos: list[Trajectory], truth: dict[str, Any]
) -> dict[str, float]:
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


def mechanisms_figures(
    learner: ml.ConstraintLearner, demos: list[Trajectory], truth: dict[str, Any]
) -> dict[str, float]:
    """The worst of the mechanisms."""
    worst: dict[str, float] = {"type right": 1.0}
    for index, mechanism in enumerate(truth["mechanisms"][: 1 if truth["contaminated"] else None]):
        windows = [(i, a, b) for i, w in enumerate(truth["windows"]) for a, b, k in w if k == index]
        if len(windows) < 2:
            continue
        number = _best_constraint(learner.report_, windows, {t.name: i for i, t in enumerate(demos)})
        figures = (
            {"type right": 0.0} if number is None else mechanism_figures(learner.reports_[number].mechanism, mechanism)
        )
        worst["type right"] = min(worst["type right"], figures.pop("type right"))
        for name, value in figures.items():
            better = min if name in INSIDE.values() else max
            worst[name] = better(value, worst.get(name, value))
    return worst


def mechanism_figures(found: ml.Mechanism | None, truth: dict[str, Any]) -> dict[str, float]:
    """Whether the type is right, errors of its parameters, and whether they are within what is stated."""
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
    stated = {"axis deg": ("axis", 1.0), "place mm": ("point", 1e3), "radius mm": ("radius", 1e3)}
    if found.pitch is not None and truth["pitch"]:
        stated["pitch %"] = ("pitch", 100.0 / abs(truth["pitch"]))
    return figures | {
        INSIDE[name]: float(figures[name] <= factor * found.uncertainty[what])
        for name, (what, factor) in stated.items()
        if name in figures and what in found.uncertainty
    }


def lone_figures(report: LearningReport, truth: dict[str, Any]) -> dict[str, float]:
    """Whether contacts that one recording alone shows are named, and how many are named that are none."""
    said = [p for p in report.phases if p.reason == IN_ONE_ONLY]
    contacts = [(i, a, b, k) for i, windows in enumerate(truth["windows"]) for a, b, k in windows]
    numbers = [k for *_, k in contacts]
    named, right = 0.0, 0
    for i, a, b, k in contacts:
        here = [p for p in said if p.trajectory == f"demo_{i}" and min(p.end, b) - max(p.start, a) > 0.5 * (b - a)]
        if numbers.count(k) == 1:
            named, right = float(bool(here)), right + len(here)
    return {"lone wrong": float(len(said) - right)} | (
        {"lone named": named} if 1 in map(numbers.count, numbers) else {}
    )


def odd_figures(report: LearningReport, n: int, contaminated: list[int], either: bool) -> dict[str, float]:
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
