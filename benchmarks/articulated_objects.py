"""Axis, place and pitch of doors, drawers and screws: ours beside `ripl_articulation`, from the same recordings.

    PYTHONPATH=examples:benchmarks python benchmarks/articulated_objects.py [--sets 4] [--first-seed 60000]

Ours reads joint positions, theirs the poses of the tip that our kinematics gives for them. It runs in an environment of
its own (`.venv-bench-ripl_articulation`, made at first use), or in that of `--python`. It answers with a twist and
leaves the type open: here a line turns by less than 1 degree in all, a hinge advances by less than 5 mm/rad (the
flattest screw of the recordings has 20), and the rest are screws. Both lines were drawn to suit it. Errors are against
the mechanism that the recordings were made with, whether or not the type is right. Seconds are of the processor.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from make_recordings.arms import ROBOTS
from peer_controllers import SCRIPTS, interpreter
from recording_cases import FIRM, Case
from recording_scores import TYPES, mechanism_figures

import manip_learn as ml
from manip_learn.errors import NotIdentifiableError

PEER = "ripl_articulation"
STILL, FLAT = np.radians(1.0), 0.005  # less turning is a line [rad], less advance a hinge [m/rad]
ERRORS = {"axis deg": "deg", "place mm": "mm", "pitch %": "%"}
Line = tuple[str, list[Case]]


def lines(sets: int, first_seed: int) -> Iterator[Line]:
    """Name of each line of the table, and its sets."""

    def of(kind: str, n: int, noise: float, whole: bool = False) -> list[Case]:
        axes = "pose" if kind in FIRM else "xyz"
        return [Case(kind, ROBOTS[i % 4], first_seed + i, n, noise, whole, axes) for i in range(sets)]

    for kind in ("drawer_firm", "door_firm", "hinge", "screw", "drawer", "door"):
        for n in (1, 6):
            for noise in (1e-4, 1e-3):
                yield f"{kind} | {n} | {noise:g}", of(kind, n, noise)
    yield "drawer_firm, whole | 6 | 0.0001", of("drawer_firm", 6, 1e-4, whole=True)
    yield "table_flat | 6 | 0.0001", of("table_flat", 6, 1e-4)


def mechanism_of(answer: dict[str, Any]) -> ml.Mechanism | None:
    """Type, axis, place and pitch of a twist; None where nothing moves."""
    turn, travel = np.split(np.array(answer["twist"]), 2)
    if not np.linalg.norm(answer["twist"]) > 0.0:
        return None
    if np.linalg.norm(turn) * answer["most"] < STILL:
        return ml.Mechanism("line", travel / np.linalg.norm(travel))
    square = turn @ turn
    pitch, point = float(turn @ travel / square), np.cross(turn, travel) / square
    return ml.Mechanism("hinge" if abs(pitch) < FLAT else "screw", turn / np.sqrt(square), point, pitch=pitch)


def figures(found: ml.Mechanism | None, truth: dict[str, Any]) -> dict[str, float]:
    """Whether the type is right, and the errors of what there is, right or not."""
    true_type = TYPES.get(truth["type"], truth["type"])
    if found is None:
        return {"type right": 0.0}
    as_it_is = replace(found, type=true_type, grip="loose" if truth["held"] == "loose" else "firm", uncertainty={})
    return mechanism_figures(as_it_is, truth) | {"type right": float(found.type == true_type)}


def measured(cases: list[Case], folder: Path, python: str) -> dict[str, list[dict[str, float]]]:
    """Figures of ours and of each setting of theirs, set by set.

    Raises:
        subprocess.CalledProcessError: The peer failed.
    """
    out: dict[str, list[dict[str, float]]] = {"ours": []}
    poses: dict[str, np.ndarray] = {"recordings": np.array([case.n for case in cases])}
    truths = []
    for number, case in enumerate(cases):
        arm, demos, truth = case.make()
        truths.append(truth["mechanisms"][0])
        poses |= {f"{number}|{j}": np.array([arm.pose(q) for q in demo.q]) for j, demo in enumerate(demos)}
        maps = [ml.FrameJacobian(arm.robot, truth["tip"], case.axes, reference) for reference in ("world", "local")]
        began = time.process_time()
        try:
            found = ml.ConstraintLearner(maps).fit(demos).report_.mechanism
        except NotIdentifiableError:
            found = None
        seconds = time.process_time() - began
        out["ours"].append(figures(found, truths[-1]) | {"s": seconds})
    np.savez(folder / "cases.npz", **poses)
    command = [python, str(SCRIPTS / f"{PEER}_peer.py"), "articulation", str(folder / "cases.npz"), str(folder / "a")]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    subprocess.run(command, check=True, env=environment, stderr=subprocess.PIPE, text=True)
    for answers, truth in zip(json.loads((folder / "a").read_text(encoding="utf-8")), truths, strict=True):
        for name, answer in answers.items():
            out.setdefault(name, []).append(figures(mechanism_of(answer), truth) | {"s": answer["seconds"]})
    return out


def cells(found: list[dict[str, float]]) -> str:
    """Types right, and the median of each error with the worst."""
    words = [f"{sum(f['type right'] for f in found):.0f} of {len(found)}"]
    for name in (*ERRORS, "s"):
        values = [f[name] for f in found if name in f]
        words.append(f"{np.median(values):.2g} ({max(values):.2g})" if values else "")
    return " | ".join(words)


def main() -> None:
    """Print the table line by line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sets", type=int, default=4, help="of each line; the robots take turns")
    parser.add_argument("--first-seed", type=int, default=60_000)
    parser.add_argument("--kinds", nargs="+", help="only lines of these kinds")
    parser.add_argument("--python", help="interpreter of an environment that exists")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    python = interpreter(PEER, {PEER: given.python} if given.python else {})
    names = "kind | recordings | noise [rad] | estimator | type right | axis [deg] | place [mm] | pitch [%] | time [s]"
    text = f"| {names} |\n" + "|---" * 9 + "|\n"
    print(text, end="", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        for name, cases in lines(given.sets, given.first_seed):
            if given.kinds and name.partition(" |")[0] not in given.kinds:
                continue
            found = measured(cases, Path(folder), python)
            part = "".join(f"| {name} | {who} | {cells(f)} |\n" for who, f in found.items())
            print(part, end="", flush=True)
            text += part
    if given.out is not None:
        given.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
