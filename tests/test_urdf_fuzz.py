"""Mutated robot descriptions: each is refused with a code or loads and computes; none harms the process.

By default for 8 s in all, or MANIP_LEARN_FUZZ_SECONDS; with `make fuzz` all 100,000 mutants.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from urdf_mutants import mutant

HERE = Path(__file__).parent
IS_LONG = os.environ.get("HYPOTHESIS_PROFILE") == "fuzz"
MUTANTS = 50_000
SECONDS = 1500.0 if IS_LONG else float(os.environ.get("MANIP_LEARN_FUZZ_SECONDS", "8")) / 2.0


@pytest.mark.fuzz
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("first", [0, MUTANTS], ids=["first half", "second half"])
def test_mutants_are_refused_or_work(first):
    """No signal, no hang, no error but ours, at most 512 MB; what loads gives finite poses and derivatives."""
    paths = os.pathsep.join([str(HERE), str(HERE.parent)])
    done = subprocess.run(
        [sys.executable, str(HERE / "urdf_mutants_child.py"), str(first), str(first + MUTANTS), str(SECONDS)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )
    lines = done.stdout.splitlines()
    assert done.returncode == 0, (
        f"mutant {lines[-1] if lines else '?'} ended the process: {done.returncode}\n{done.stderr}"
    )
    assert done.stderr == ""
    report = json.loads(lines[-1])
    assert not report["faults"], "\n".join(report["faults"][:20])
    assert report["megabytes"] <= 512.0
    loaded = report["seen"].get("accept", 0) + report["seen"].get("warn", 0)
    assert loaded > 0.05 * (len(lines) - 1), "the mutants have become too wild to test what comes after validation"
    if IS_LONG:
        assert len(lines) - 1 == MUTANTS


def test_a_seed_names_its_mutant():
    """The number in a report is enough to have the mutant again."""
    assert mutant(12345) == mutant(12345)
    assert mutant(12345) != mutant(12346)
