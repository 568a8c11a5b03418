"""The cost of learning, stated in pseudo-inverses: processor time over that of `np.linalg.pinv` of a 3 x 7 matrix.

Promises: cost linear in the samples; ten million samples streamed in less than 500 MB. Each fit runs in a process of
its own, so that its peak memory is its own.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from timing import Ratio, keep

pytestmark = [pytest.mark.bench, pytest.mark.timeout(1800)]
RUN = Path(__file__).with_name("learning_run.py")
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
MEMORY = 500.0  # MB of any streamed fit
MILLION = 1_000_000


def measured(folder: Path, **job: Any) -> dict[str, float]:
    """One fit in a fresh process."""
    return child({"joints": 7, "axes": "xyz", "constraints": 2, "how": "stream", "folder": str(folder)} | job)


def child(job: dict[str, Any]) -> dict[str, Any]:
    """What `learning_run.py` answers."""
    done = subprocess.run(
        [sys.executable, str(RUN), json.dumps(job)],
        capture_output=True, text=True, timeout=900, env={**os.environ, **ONE_THREAD}, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


def row(title: str, samples: int, result: dict[str, float]) -> None:
    """A line of the table."""
    print(
        f"  {title:30s} {samples:10,d} samples {result['cpu']:7.2f} s {result['pinvs'] / samples:7.4f} pinvs/sample "
        f"{result['peak']:6.0f} MB peak ({result['before']:.0f} before)  off by {result['angle']:.1e} deg"
    )


@pytest.mark.parametrize("kind", ["held", "joint"])
def test_growth_over_samples(kind: str, tmp_path: Path) -> None:
    """Streamed and from memory: linear in the samples, and memory that does not grow with what is streamed."""
    print(f"\n{kind}, 7 joints, 3 rows, 2 constraints")
    sizes = (100_000, MILLION, 3 * MILLION) if kind == "joint" else (100_000, MILLION, 3 * MILLION, 10 * MILLION)
    streamed = {}
    for n in sizes:
        streamed[n] = measured(tmp_path, kind=kind, samples=n)
        row("stream, without the reading", n, streamed[n])
    listed = measured(tmp_path, kind=kind, samples=MILLION, how="list")
    row("list in memory", MILLION, listed)
    largest = max(sizes)
    assert streamed[largest]["peak"] <= MEMORY
    assert streamed[largest]["peak"] <= streamed[3 * MILLION]["peak"] + 50.0
    per_sample = {n: x["pinvs"] / n for n, x in streamed.items()}
    assert per_sample[largest] < 1.6 * per_sample[MILLION]
    keep("learning", {f"{kind}, a sample of a million, streamed": per_sample[MILLION]})


@pytest.mark.parametrize(
    ("name", "kind", "settings"),
    [
        ("joint", "joint", {"estimator": "joint"}),
        ("joint, affine, 2 rows", "joint", {"estimator": "joint", "n_constraints": 2, "policy_model": "affine"}),
        ("auto, b varies", "joint", {}),
        ("auto, b = 0", "held", {}),
        ("null-space, b = 0, 2 rows", "held", {"estimator": "null-space", "n_constraints": 2}),
    ],
)
def test_fixed_cost(name: str, kind: str, settings: dict[str, Any], tmp_path: Path) -> None:
    """A first answer while the arm is still in the demonstrator's hand: 1,000 samples, in thousands of pinvs."""
    rounds = int(os.environ.get("BENCH_ROUNDS", "7"))
    result = child({"kind": kind, "samples": 1_000, "rounds": rounds, "settings": settings, "folder": str(tmp_path)})
    lower, median, upper = statistics.quantiles([x / 1000 for x in result["ratios"]], n=4)
    print(f"\n{name}: {median:.1f} thousand pinvs ({lower:.1f} .. {upper:.1f})")
    keep("learning", {f"1,000 samples, {name} [1000 pinvs]": Ratio(min(result["ratios"]) / 1000, lower, upper)})


@pytest.mark.parametrize("kind", ["held", "joint"])
def test_beside_all_at_once(kind: str, tmp_path: Path) -> None:
    """An even choice of the samples against the same estimator on all samples at once."""
    n = 100_000
    choice = measured(tmp_path, kind=kind, samples=n, how="list")
    at_once = measured(tmp_path, kind=kind, samples=n, how="at once")
    print(f"\n{kind}, beside all at once")
    row("an even choice", n, choice)
    row("all at once", n, at_once)
    print(f"  {at_once['cpu'] / choice['cpu']:.1f} times as fast")
    assert choice["cpu"] < at_once["cpu"]


@pytest.mark.parametrize("kind", ["held", "joint"])
def test_growth_over_joints(kind: str, tmp_path: Path) -> None:
    """Planar arms of 3 to 12 joints; three rows, one constraint."""
    print(f"\n{kind}, planar arms, 1 constraint")
    for joints in (3, 5, 8, 12):
        result = measured(tmp_path, kind=kind, samples=100_000, joints=joints, constraints=1, how="list")
        row(f"{joints} joints", 100_000, result)


@pytest.mark.parametrize("kind", ["held", "joint"])
def test_growth_over_constraints(kind: str, tmp_path: Path) -> None:
    """All six rows of a 7-joint arm, one to five constraints."""
    print(f"\n{kind}, 7 joints, 6 rows")
    for s in (1, 2, 3, 5):
        result = measured(tmp_path, kind=kind, samples=100_000, axes="pose", constraints=s, how="list")
        row(f"{s} constraint(s)", 100_000, result)
