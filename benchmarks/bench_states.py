"""A control step in every state that a robot meets, as a ratio to the bare step at the same postures.

The bare step is Pinocchio's frame Jacobian, NumPy's pseudo-inverse and the product with the null space. Ratios are of
the best of interleaved rounds: neighbours only ever add time. In brackets, the quarter marks of the rounds' ratios.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import control_states as states
import numpy as np
import pytest
from bench_control_step import last_words
from peer_controllers import SCRIPTS, interpreter
from timing import Ratio, keep, rounds_of

import manip_learn as ml

pytestmark = [pytest.mark.bench, pytest.mark.timeout(3600)]
ROUNDS = int(os.environ.get("BENCH_ROUNDS", "15"))
COMPILED = find_spec("numba") is not None
FAR = ("velocity limits", "unreachable target")


def ratios_of(rounds: dict[str, list[float]]) -> dict[str, Ratio]:
    """Best over best, and the quarter marks of the ratios round by round, of each candidate but the bare step."""
    bare = rounds["bare"]
    out = {}
    for name, seconds in rounds.items():
        each = [a / b for a, b in zip(seconds, bare, strict=True)]
        lower, _, upper = statistics.quantiles(each, n=4)
        out[name] = Ratio(min(seconds) / min(bare), lower, upper)
    del out["bare"]
    return out


def measured(arm: states.Arm, state: str) -> dict[str, Ratio]:
    """Ratios of one state: the controller and the compiled one."""
    cases = states.cases_of(arm, state)
    if not cases:
        return {}
    law = arm.far if state in FAR else arm.controller
    candidates: dict[str, Callable[[], object]] = {
        "bare": states.bare_calls(arm, cases),
        "python": states.calls(law, cases),
    }
    if COMPILED:
        candidates["compiled"] = states.calls(ml.CompiledController(law), cases)
    return ratios_of(rounds_of(candidates, 2, ROUNDS))


def cell(found: dict[str, Ratio], which: str) -> str:
    """Ratio with its quarter marks."""
    if which not in found:
        return ""
    best, lower, upper = found[which]
    return f"{best:.2f} ({lower:.2f} to {upper:.2f})"


def test_every_state() -> None:
    """The table of states and robots."""
    flat: dict[str, Ratio] = {}
    tables: dict[str, list[str]] = {which: [] for which in ("python", "compiled")}
    arms = {name: states.arm_of(name) for name in states.ROBOTS}
    for state in states.STATES:
        found = {name: measured(arm, state) for name, arm in arms.items()}
        for which, lines in tables.items():
            lines.append(f"| {state} | " + " | ".join(cell(found[name], which) for name in arms) + " |")
            values = [ratios[which] for ratios in found.values() if which in ratios]
            if values:  # medians over the robots
                flat[f"{which}, {state}"] = Ratio(*np.median(np.array(values, dtype=np.float64), axis=0).tolist())
    for which, lines in tables.items():
        print(f"\n{which}, ratio to the bare step (quarter marks), load {os.getloadavg()[0]:.1f}\n")
        print("| state | " + " | ".join(arms) + " |\n" + "|---" * (len(arms) + 1) + "|")
        print("\n".join(lines))
    keep("states", flat)


def test_pose_targets() -> None:
    """A step towards a pose over one towards a position, s = 2 and 3 rows."""
    flat: dict[str, Ratio] = {}
    for name in ("sawyer", "panda locked", "ur5"):
        robot, frame, _ = states.robot_of(name)
        rng = np.random.default_rng(1)
        goal = robot.pose(states.inside(robot, rng), frame)
        place, pose = (
            law_towards(robot, frame, axes, target) for axes, target in (("xyz", goal[:3, 3]), ("pose", goal))
        )
        drawn = [states.Case(states.inside(robot, rng), None) for _ in range(200)]
        cases = [c for c in drawn if min(law(c.q).smallest_singular_value for law in (place, pose)) > 0.06][:24]
        kinds: dict[str, tuple[Callable[..., object], Callable[..., object]]] = {"": (place, pose)}
        if COMPILED:
            kinds[", compiled"] = (ml.CompiledController(place), ml.CompiledController(pose))
        for kind, (one, other) in kinds.items():
            pair: dict[str, Callable[[], object]] = {
                "bare": states.calls(one, cases),
                "pose": states.calls(other, cases),
            }
            rounds = rounds_of(pair, 2, ROUNDS)
            flat[f"pose over position{kind}, {name}"] = ratios_of(rounds)["pose"]
    keep("states", flat)


@pytest.mark.skipif(not COMPILED, reason="compiled steps need numba")
def test_ahead_of_placo(tmp_path: Path) -> None:
    """The compiled step, mu climbed, over placo's with limits, with and without its manipulability task, in turns."""
    try:
        python = interpreter("placo", {})
    except subprocess.CalledProcessError as error:
        pytest.skip(f"placo cannot be installed: {last_words(error)}")
    arm = states.arm_of("sawyer")
    cases = {state: states.cases_of(arm, state) for state in states.STATES}
    targets = {kind: law.task.target.tolist() for kind, law in (("target", arm.controller), ("far", arm.far))}
    document = {"urdf": str(arm.robot.source), "tip": states.ROBOTS["sawyer"][1], **targets, "far states": FAR}
    document["states"] = {state: [case.q.tolist() for case in found] for state, found in cases.items()}
    path = tmp_path / "cases.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    laws = {state: ml.CompiledController(arm.far if state in FAR else arm.controller) for state in cases}
    ours = {state: [] for state in cases}
    theirs: dict[tuple[str, str], list[float]] = {}
    for _ in range(3):
        command = [python, str(SCRIPTS / "placo_peer.py"), "states", str(path)]
        done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=600)
        for kind, times in json.loads(done.stdout.strip().splitlines()[-1]).items():
            for state, microseconds in times.items():
                theirs.setdefault((kind, state), []).append(microseconds)
        candidates = {state: states.calls(laws[state], found) for state, found in cases.items()}
        for state, seconds in rounds_of(candidates, 2, 9).items():
            ours[state].append(1e6 * min(seconds) / len(cases[state]))
    ratios = {
        f"compiled over placo with {kind}, {state}": min(ours[state]) / min(times)
        for (kind, state), times in theirs.items()
    }
    keep("placo", ratios)


def law_towards(robot: ml.Robot, frame: str, axes: str, target: np.ndarray) -> ml.ResolvedRateController:
    """Two dense rows of the axes."""
    features = ml.FrameJacobian(robot, frame, axes)
    p = features.n_rows
    constraint = ml.Constraint(np.linalg.qr(np.random.default_rng(2).normal(size=(p, p)))[0][:2], features)
    task = ml.PointAttractor(target, max_speed=0.05)
    return ml.ResolvedRateController(constraint, task, ml.ManipulabilityAscent(constraint, gain=0.1), dt=states.DT)


@pytest.mark.skipif(not COMPILED, reason="compiled runs need numba")
def test_random_runs() -> None:
    """The slowest steps of compiled runs from 60 random starts, reachable and not: the 99th percentile, and the mean
    step of a rollout over that of a free one.
    """
    flat: dict[str, Ratio] = {}
    for name in ("sawyer", "panda as loaded", "ur5"):
        arm = states.arm_of(name)
        starts = np.array([states.inside(arm.robot, rng) for rng in states.seeds(77, 60)])
        tails = []
        for law in (arm.controller, arm.far):
            compiled = ml.CompiledController(law)
            cases = [states.Case(q, None) for start in starts[:12] for q in compiled.rollout(start, 200, 0.01).q[::5]]
            each = np.array([fastest(compiled, case) for case in cases])
            rounds = rounds_of({"bare": states.bare_calls(arm, cases)}, 1, 5)
            tails.append(float(np.percentile(each, 99)) / (min(rounds["bare"]) / len(cases)))
        law, free = ml.CompiledController(arm.controller), free_law(arm)
        cases = states.cases_of(arm, "free")
        candidates: dict[str, Callable[[], object]] = {
            "bare": states.bare_calls(arm, cases),
            "free": lambda law=free, cases=cases: [law.rollout(case.q, 500, 0.01) for case in cases],
            "random": lambda law=law, starts=starts: [law.rollout(q, 500, 0.01) for q in starts],
        }
        best = {kind: min(seconds) for kind, seconds in rounds_of(candidates, 1, ROUNDS).items()}
        bare = best["bare"] / len(cases)
        steps = {"free": best["free"] / (501 * len(cases)), "random": best["random"] / (501 * len(starts))}
        flat[f"step of a compiled run, free, {name}"] = Ratio(steps["free"] / bare)
        flat[f"step of a compiled run, 60 random starts, {name}"] = Ratio(steps["random"] / bare)
        flat[f"random starts over free, {name}"] = Ratio(steps["random"] / steps["free"])
        for kind, tail in zip(("reachable", "unreachable"), tails, strict=True):
            flat[f"99th percentile, {kind}, {name}"] = Ratio(tail)
    keep("states", flat)


def free_law(arm: states.Arm) -> ml.CompiledController:
    """The controller without limits: what a step costs where nothing is in its way."""
    law = arm.controller
    return ml.CompiledController(
        ml.ResolvedRateController(law.constraint, law.task, law.null_policy, limits=False, dt=states.DT)
    )


def fastest(law: Callable[..., object], case: states.Case, tries: int = 5) -> float:
    """Seconds of one call, the best of a few: what this posture costs, not what a neighbour adds."""
    best = np.inf
    for _ in range(tries):
        begin = time.perf_counter()
        law(case.q, 0.0, states.DT, case.previous)
        best = min(best, time.perf_counter() - begin)
    return best
