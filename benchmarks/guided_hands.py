"""How the learner answers people's hands, which no other generated set has: soft, shaking, pausing, correcting.

    python benchmarks/guided_hands.py --sets 100 --first-seed 61000 --out table.csv

A set is drawn from its seed: task, arm, number of recordings, whole or cut, rate, resolution, zeros of the joints,
play, lost samples, and the hand. Nothing that is learnt takes part in the truth. Even seeds are for tuning, odd ones
are held out; both are reported apart. An answer is right if the first constraint has as many rows as the mechanism that
most of its stretches are of; wrong in silence if it is not and nothing warns. The stated angle is compared where there
is one: rows about the axis of a mechanism state that of its axis instead.
"""

from __future__ import annotations

import argparse
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

from jaxtyping import Float
from make_recordings.arms import Arm, load_arm
from make_recordings.kinds import FREE
from make_recordings.kinematic_sets import make_set
from table_file import put

import manip_learn as ml
from manip_learn.errors import ManipLearnError
from manip_learn.linalg import null_basis

HELD = ("drawer", "drawer_firm", "table", "table_flat", "door", "door_firm", "hinge", "tether", "screw")
SERIES = ("drawer_then_table", "door_then_drawer")
ARMS = ("panda", "xarm7", "ur5", "sawyer")
PLACES = 8  # postures of each contact at which rows are compared
TYPES = {"slide": "line"}  # what the learner calls a mechanism of examples/make_recordings
HEADER = ["seed", "kind", "arm", "recordings", "whole", "rate", "quantum", "zeros", "outcome", "rows", "true rows"]
HEADER += ["off deg", "stated deg", "gap", "strength", "warnings", "type", "others", "cpu s", "words"]


@final
@dataclass(frozen=True)
class Hand:
    """How a person guides.

    Attributes:
        sway: Of the hand along what it should hold still, and beside the way, slow [m].
        shake: Tremor [m], and its frequency [Hz].
        aside: A pull that grows during each contact, other in each recording [m].
        pauses, corrections: Expected number in a recording.
        sticks: Share of a contact in which it sticks before it slips on.
        unsteady: Standard deviation of the logarithm of its pace.
    """

    sway: float
    shake: tuple[float, float]
    aside: float
    pauses: float
    corrections: float
    sticks: float
    unsteady: float

    @staticmethod
    def drawn(rng: np.random.Generator) -> Hand:
        """One of many people."""
        return Hand(
            float(rng.choice([0.0, 3e-4, 1e-3, 3e-3])),
            (float(rng.choice([0.0, 1e-4, 3e-4])), float(rng.uniform(5.0, 10.0))),
            float(rng.choice([0.0, 5e-4, 2e-3])),
            float(rng.choice([0.0, 0.5, 2.0])),
            float(rng.choice([0.0, 0.5, 2.0])),
            float(rng.choice([0.0, 0.0, 0.3, 0.6])),
            float(rng.uniform(0.05, 0.4)),
        )


@final
@dataclass(frozen=True)
class Recorder:
    """What the joints are measured with: samples a second [Hz], quantum [rad], noise [rad], the deviation of the
    joints' zeros [deg], play [rad], share of lost samples, and how far stamps are off [share of a step].
    """

    rate: float
    quantum: float
    noise: float
    zeros: float
    play: float
    lost: float
    late: float

    @staticmethod
    def drawn(rng: np.random.Generator) -> Recorder:
        """One of many arms."""
        coarse = rng.random() < 0.3
        return Recorder(
            float(rng.choice([30.0, 50.0] if coarse else [50.0, 100.0, 250.0, 500.0])),
            2.0 * np.pi / 4096 if coarse else float(rng.choice([0.0, 2.0 * np.pi / 65536])),
            float(rng.choice([1e-5, 1e-4])),
            float(rng.choice([0.0, 0.1, 0.3, 1.0])),
            float(rng.choice([0.0, 0.0, 1e-3])),
            float(rng.choice([0.0, 0.0, 0.05])),
            float(rng.choice([0.0, 0.0, 0.3])),
        )


@final
@dataclass(frozen=True, eq=False)
class HandSet:
    """Recordings of one task, and the truth: what kind they are, and for each the contacts (start, end, mechanism)."""

    seed: int
    kind: str
    arm: Arm
    whole: bool
    recorder: Recorder
    demos: list[ml.Trajectory]
    exact: list[ml.Trajectory]
    windows: list[list[tuple[float, float, int]]]
    mechanisms: list[dict[str, Any]]

    @staticmethod
    def of(seed: int) -> HandSet:
        """The set of a seed."""
        rng = np.random.default_rng([seed, 7])
        pool = HELD if (turn := rng.random()) < 0.65 else tuple(FREE) if turn < 0.85 else SERIES
        kind, arm_name = str(rng.choice(pool)), str(rng.choice(ARMS))
        n, whole = int(rng.choice([3, 5, 6, 8, 12])), bool(rng.random() < 0.6) or kind in SERIES
        motions, truth = make_set(kind, arm_name, seed, n, noise=0.0, whole=True)
        arm, hand, recorder = load_arm(arm_name), Hand.drawn(rng), Recorder.drawn(rng)
        zeros = np.radians(rng.normal(0.0, recorder.zeros, arm.robot.nv)) if recorder.zeros else 0.0
        demos, exact, windows = [], [], []
        for i, ((t, q), spans) in enumerate(zip(motions, truth["windows"], strict=True)):
            own = np.random.default_rng([seed, 7, i])
            when, way = paced(t, spans, hand, own)
            edges = [(float(np.interp(a, way, when)), float(np.interp(b, way, when)), int(k)) for a, b, k in spans]
            for a, b, contact in (
                [(0.0, when[-1], edges)] if whole or not edges else [(a, b, [e]) for e in edges for a, b in [e[:2]]]
            ):
                stamps = np.arange(a, b, 1.0 / recorder.rate)
                if recorder.lost:
                    stamps = stamps[own.random(len(stamps)) >= recorder.lost]
                true = np.column_stack([np.interp(np.interp(stamps, when, way), t, column) for column in q.T])
                true = swayed(arm, stamps, true, contact, hand, own)
                told = measured(true + zeros, recorder, own)
                late = recorder.late / recorder.rate * own.uniform(-0.5, 0.5, len(stamps))
                demos.append(ml.Trajectory(stamps + late - a, told, None, arm.robot.joint_names, f"demo_{len(demos)}"))
                exact.append(ml.Trajectory(stamps - a, true, None, arm.robot.joint_names, f"demo_{len(exact)}"))
                windows.append([(x - a, y - a, k) for x, y, k in contact])
        return HandSet(seed, kind, arm, whole, recorder, demos, exact, windows, truth["mechanisms"])


def paced(
    t: Float[np.ndarray, " T"], spans: list[list[float]], hand: Hand, rng: np.random.Generator
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Times, and where on the way the hand is then: at another pace, with pauses, steps back, and sticking."""
    dt, at, when, where = 0.005, 0.0, [0.0], [0.0]
    stops = np.sort(rng.uniform(0.0, t[-1], rng.poisson(hand.pauses))).tolist()
    turns = np.sort(rng.uniform(0.5, t[-1], rng.poisson(hand.corrections))).tolist()
    knots = np.exp(hand.unsteady * rng.normal(size=int(t[-1] / 0.5) + 3))
    stuck, back = 0.0, 0.0
    while at < t[-1]:
        pace = float(np.interp(at / 0.5, np.arange(len(knots)), knots))
        held = any(a + 0.2 < at < b - 0.2 for a, b, _ in spans)
        if stops and at >= stops[0]:
            stuck, _ = float(rng.uniform(0.3, 1.5)), stops.pop(0)
        if turns and at >= turns[0]:
            back, _ = float(rng.uniform(0.1, 0.4)), turns.pop(0)
        if held and hand.sticks and stuck <= 0.0 and rng.random() < dt / 0.4:
            stuck = 0.4 * hand.sticks
        if stuck > 0.0:
            stuck, pace = stuck - dt, 0.0
        elif back > 0.0:
            back, pace = back - dt, -0.8
        at = max(0.0, at + pace * dt)
        when.append(when[-1] + dt)
        where.append(min(at, t[-1]))
    width = 15  # samples of 5 ms: nobody's pace changes within less
    smooth = np.convolve(np.pad(where, width, mode="edge"), np.hanning(2 * width + 1) / width, "valid")
    return np.array(when), np.maximum.accumulate(smooth) if not hand.corrections else smooth


def slow(rng: np.random.Generator, time: Float[np.ndarray, " T"], n: int, period: float) -> Float[np.ndarray, "T n"]:
    """Smooth curves with deviation 1, a few of them."""
    parts = [
        rng.normal(size=n)
        * np.sin(2 * np.pi * time[:, None] / (period * rng.uniform(0.6, 2.0)) + rng.uniform(0, 6.3, n))
        for _ in range(4)
    ]
    return np.sum(parts, axis=0) / np.sqrt(2.0)


def swayed(
    arm: Arm,
    time: Float[np.ndarray, " T"],
    q: Float[np.ndarray, "T nv"],
    contacts: list[tuple[float, float, int]],
    hand: Hand,
    rng: np.random.Generator,
) -> Float[np.ndarray, "T nv"]:
    """The motion with what the hand adds at the tip: furniture gives way by so much, rows that are free do as well."""
    way = hand.sway * slow(rng, time, 3, 2.0) / np.sqrt(3.0)
    size, often = hand.shake
    way += (
        size
        * np.sin(2 * np.pi * often * time[:, None] + rng.uniform(0, 6.3, 3))
        * (1.0 + 0.3 * slow(rng, time, 3, 1.0))
    )
    for a, b, _ in contacts:
        share = np.clip((time - a) / max(b - a, 1e-6), 0.0, 1.0) * ((time >= a) & (time <= b))
        way += hand.aside * share[:, None] * rng.normal(size=3) / np.sqrt(3.0)
    if not np.any(way):
        return q
    J = np.stack([arm.jacobian(row)[:3] for row in q])
    return q + np.einsum("tji,tjk,tk->ti", J, np.linalg.inv(J @ J.transpose(0, 2, 1) + 1e-6 * np.eye(3)), way)


def measured(q: Float[np.ndarray, "T nv"], recorder: Recorder, rng: np.random.Generator) -> Float[np.ndarray, "T nv"]:
    """What the encoders tell."""
    told = q + rng.normal(0.0, recorder.noise, q.shape)
    if recorder.play:
        for k in range(1, len(told)):
            told[k] = np.clip(told[k - 1], told[k] - 0.5 * recorder.play, told[k] + 0.5 * recorder.play)
    return np.round(told / recorder.quantum) * recorder.quantum if recorder.quantum else told


def judged(seed: int) -> dict[str, Any]:
    """What is learnt from the set of a seed, beside its truth."""
    try:
        given = HandSet.of(seed)
    except RuntimeError:
        return {"seed": seed, "outcome": "not drawn"}
    r, robot, tip = given.recorder, given.arm.robot, given.arm.tip.name
    line: dict[str, Any] = {"seed": seed, "kind": given.kind, "arm": robot.name, "recordings": len(given.demos)}
    line |= {"whole": given.whole, "rate": r.rate, "quantum": f"{r.quantum:.1g}", "zeros": r.zeros}
    maps = [ml.FrameJacobian(robot, tip, "xyz", reference) for reference in ("world", "local")]
    started = time.process_time()
    try:
        learner = ml.ConstraintLearner(maps).fit(given.demos)
    except ManipLearnError as error:
        free = given.kind in FREE
        return line | {
            "outcome": "right" if free else "refused",
            "words": str(error)[:300],
            "cpu s": round(time.process_time() - started, 2),
        }
    report = learner.report_
    line |= {
        "cpu s": round(time.process_time() - started, 2),
        "warnings": len(report.warnings),
        "gap": f"{report.gap:.3g}",
    }
    line |= {"strength": f"{_strength(report):.3g}", "rows": report.n_constraints}
    line |= {"stated deg": f"{report.uncertainty_deg or 0:.3g}", "words": " | ".join(report.warnings)[:300]}
    told = [against_truth(learner, given, k) for k in range(len(learner.constraints_))]
    right, off, rows, kind = told[0]
    line |= {"off deg": f"{off:.3g}", "true rows": rows, "type": kind}
    others = zip(told[1:], learner.reports_[1:], strict=True)
    line["others"] = " ".join(f"{'right' if t[0] else 'wrong'} {r.gap:.3g}x{_strength(r):.3g}" for t, r in others)
    return line | {"outcome": "right" if right else "warned" if report.warnings else "silent"}


def _strength(report: ml.LearningReport) -> float:
    return min((x.strength for x in report.row_evidence[: report.n_constraints]), default=0.0)


def against_truth(learner: ml.ConstraintLearner, given: HandSet, number: int) -> tuple[bool, float, int, str]:
    """Whether a constraint has the rows of the mechanism it is of; how far off they are [deg], how many there are, and
    whether its type is told.
    """
    names, shared, total = {t.name: i for i, t in enumerate(given.demos)}, dict[int, float](), 0.0
    for p in (p for p in learner.report_.phases if p.constraint == number):
        total += p.end - p.start
        for a, b, k in given.windows[names[p.trajectory]]:
            shared[k] = shared.get(k, 0.0) + max(0.0, min(b, p.end) - max(a, p.start))
    n, constraint = learner.constraints_[number].n_constraints, learner.constraints_[number]
    if not shared or max(shared.values()) < 0.5 * total:
        return False, 90.0, 0, ""
    k = max(shared, key=lambda k: shared[k])
    mechanism, angles, same = given.mechanisms[k], list[float](), True
    for t, windows in zip(given.exact, given.windows, strict=True):
        for a, b, index in windows:
            inside = np.flatnonzero((t.time >= a) & (t.time <= b))
            for q in t.q[inside[:: max(1, len(inside) // PLACES)]] if index == k else ():
                found, angle = row_angle(constraint(q), q, given.arm, mechanism)
                same &= found
                angles.append(angle)
    mechanism_told = learner.reports_[number].mechanism
    off, told = float(np.median(angles)), "none"
    if mechanism_told is not None:
        kind, grip = TYPES.get(mechanism["type"], mechanism["type"]), mechanism["held"]
        alike = mechanism_told.type == kind and mechanism_told.grip == ("loose" if grip == "loose" else "firm")
        told = "right" if alike else "wrong"
    return same and off < 10.0, off, n, told


def true_rows(mechanism: dict[str, Any], position: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "s 3"]:
    """Rows of the tip's linear velocity that are zero at a place, orthonormal."""
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
        case "ball":
            rows = np.hstack([arm / np.linalg.norm(arm), np.zeros(3)])[None]
        case _ if firm:
            along = axis @ carried - np.hstack([np.zeros(3), (mechanism["pitch"] or 0.0) * axis])
            rows = np.vstack([turning, across @ carried, along])
        case _:
            radial = across.T @ (across @ arm)
            rows = np.hstack([np.array([axis, radial / np.linalg.norm(radial)]), np.zeros((2, 3))])
    free = null_basis(np.linalg.qr(rows.T)[0].T)[:3]
    left, sizes, _ = np.linalg.svd(free)
    return left[:, int(np.count_nonzero(sizes > 1e-6)) :].T


def row_angle(
    A: Float[np.ndarray, "s nv"], q: Float[np.ndarray, " nv"], arm: Arm, mechanism: dict[str, Any]
) -> tuple[bool, float]:
    """Whether A(q) has as many rows as the mechanism holds, and the largest angle between the two [deg]."""
    learnt = np.linalg.qr((A @ np.linalg.pinv(arm.robot.jacobian(q, arm.tip)[:3])).T)[0]
    true = true_rows(mechanism, arm.pose(q)[:3, 3])
    cosine = np.linalg.svd(true @ learnt, compute_uv=False)[-1] if len(true) else 0.0
    return len(true) == learnt.shape[1], float(np.degrees(np.arccos(min(cosine, 1.0))))


def main() -> None:
    """Learn every set, and print what came out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=100)
    parser.add_argument("--first-seed", type=int, default=61000)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--step", type=int, default=1, help="2: only the seeds of one half")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    seeds = range(given.first_seed, given.first_seed + given.step * given.sets, given.step)
    with ProcessPoolExecutor(given.jobs) as pool:
        lines = []
        for line in pool.map(judged, seeds):
            lines.append(line)
            print(f"\r{len(lines)} of {len(seeds)}  ", end="", file=sys.stderr, flush=True)
    put(HEADER, [[str(line.get(name, "")) for name in HEADER] for line in lines], given.out)
    for half in (0, 1):
        of_half = [line for line in lines if line["seed"] % 2 == half and line["outcome"] != "not drawn"]
        for what, is_free in (("held", False), ("free", True)):
            some = [line for line in of_half if (line["kind"] in FREE) == is_free]
            counts = {o: sum(line["outcome"] == o for line in some) for o in ("right", "refused", "warned", "silent")}
            inside = [
                float(x["off deg"]) <= 2.0 * float(x["stated deg"])
                for x in some
                if x["outcome"] == "right" and float(x.get("stated deg", 0.0)) > 0.0
            ]
            inside = f"{sum(inside)} of {len(inside)} within twice the stated angle"
            print(f"{'held out' if half else 'tuning'} {what}: {len(some)} sets, {counts}, {inside}")


if __name__ == "__main__":
    main()
