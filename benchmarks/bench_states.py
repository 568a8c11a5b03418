"""A control step in every state that a robot meets, as a ratio to the bare step at the same postures.

The bare step is Pinocchio's frame Jacobian, NumPy's pseudo-inverse and the product with the null space. Ratios are of
the best of interleaved rounds: neighbours only ever add time. In brackets, the quarter marks of the rounds' ratios.
"""

from __future__ import annotations

import math
import os
import statistics
import time
from collections.abc import Callable

import control_states as states
import numpy as np
import pytest
from timing import Ratio, keep, rounds_of

import manip_learn as ml

pytestmark = [pytest.mark.bench, pytest.mark.timeout(3600)]
ROUNDS = int(os.environ.get("BENCH_ROUNDS", "15"))
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
    """Ratio of one state with each engine; none where the arm has no such postures."""
    cases = states.cases_of(arm, state)
    if not cases:
        return {}
    candidates: dict[str, Callable[[], object]] = {"bare": states.bare_calls(arm, cases)}
    for name, law in states.engines(arm.far if state in FAR else arm.controller).items():
        candidates[name] = states.calls(law, cases)
    return ratios_of(rounds_of(candidates, 2, ROUNDS))


def cell(found: Ratio | None) -> str:
    """Ratio with its quarter marks."""
    return "" if found is None else f"{found.value:.2f} ({found.lower:.2f} to {found.upper:.2f})"


def test_every_state() -> None:
    """The table of states and robots, one for each engine."""
    arms = {name: states.arm_of(name) for name in states.ROBOTS}
    found = {(state, name): measured(arm, state) for state in states.STATES for name, arm in arms.items()}
    flat: dict[str, Ratio] = {}
    for engine in states.engines(arms["sawyer"].controller):
        lines = ["| state | " + " | ".join(arms) + " |", "|---" * (len(arms) + 1) + "|"]
        for state in states.STATES:
            ratios = [found[state, name].get(engine) for name in arms]
            lines.append(f"| {state} | " + " | ".join(map(cell, ratios)) + " |")
            if values := [ratio for ratio in ratios if ratio is not None]:  # medians over the robots
                flat[f"{engine}, {state}"] = Ratio(*np.median(np.array(values, dtype=np.float64), axis=0).tolist())
        print(
            f"\n{engine}: ratio to the bare step (quarter marks), load {os.getloadavg()[0]:.1f}\n\n" + "\n".join(lines)
        )
    keep("states", flat)


def test_whole_rollouts() -> None:
    """500 steps of the compiled law, from one start and from a table on all cores, in microseconds a step and core."""
    for name in ("sawyer", "ur5", "planar3"):
        arm = states.arm_of(name)
        if arm.controller.engine == "python":
            pytest.skip("NO manip_learn_fast: make fast")
        starts = np.array([states.inside(arm.robot, rng) for rng in states.seeds(5, 500)])
        cores = len(os.sched_getaffinity(0))
        for law, where in ((arm.controller, "reached"), (arm.far, "out of reach")):
            best = [math.inf, math.inf]
            for _ in range(ROUNDS):
                for i, q0 in enumerate((starts[0], starts)):
                    begun = time.perf_counter()
                    ml.simulate(arm.robot, law, q0, 5.0, 0.01)
                    best[i] = min(best[i], time.perf_counter() - begun)
            one, many = 1e6 * best[0] / 501, 1e6 * best[1] * cores / (501 * len(starts))
            print(f"{name}, target {where}: {one:.2f} us a step alone, {many:.2f} in a table of {len(starts)}")


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
        pair: dict[str, Callable[[], object]] = {"bare": states.calls(place, cases), "pose": states.calls(pose, cases)}
        flat[f"pose over position, {name}"] = ratios_of(rounds_of(pair, 2, ROUNDS))["pose"]
    keep("states", flat)


def law_towards(robot: ml.Robot, frame: str, axes: str, target: np.ndarray) -> ml.ResolvedRateController:
    """Two dense rows of the axes."""
    features = ml.FrameJacobian(robot, frame, axes)
    p = features.n_rows
    constraint = ml.Constraint(np.linalg.qr(np.random.default_rng(2).normal(size=(p, p)))[0][:2], features)
    task = ml.PointAttractor(target, max_speed=0.05)
    return ml.ResolvedRateController(constraint, task, ml.ManipulabilityAscent(constraint, gain=0.1), dt=states.DT)
