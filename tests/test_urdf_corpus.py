"""Hostile, unusual and mutated robot descriptions: each gets a verdict or works, and none harms the process.

Mutants take 8 s in all, or MANIP_LEARN_FUZZ_SECONDS; with `make fuzz` all 100,000 are tried.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from urdf_corpus import corpus
from urdf_mutants import mutant

HERE = Path(__file__).parent
CASES = corpus()
BATCH = 80
MAX_MEGABYTES = 512.0
MUTANTS = 50_000
IS_LONG = os.environ.get("HYPOTHESIS_PROFILE") == "fuzz"
MUTANT_SECONDS = 1500.0 if IS_LONG else float(os.environ.get("MANIP_LEARN_FUZZ_SECONDS", "8")) / 2.0


def run(*command: object, timeout: float) -> subprocess.CompletedProcess[str]:
    """What a child process answers; the arguments of `urdf_child.py`, or of Python."""
    paths = os.pathsep.join([str(HERE), str(HERE.parent)])
    env = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    arguments = [sys.executable, *map(str, command)]
    return subprocess.run(arguments, capture_output=True, text=True, timeout=timeout, check=False, env=env)


@pytest.mark.parametrize("first", range(0, len(CASES), BATCH))
def test_every_case_gets_its_verdict(first, tmp_path):
    """The verdict is the frozen one; no signal, no hang, at most 512 MB, nothing printed by the libraries."""
    last = min(first + BATCH, len(CASES))
    done = run(HERE / "urdf_child.py", "corpus", first, last, tmp_path, timeout=110)
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    culprit = CASES[first + min(len(answers), last - first - 1)]
    assert done.returncode == 0, f"{culprit.category}: {culprit.name} ended the process\n{done.stderr[-2000:]}"
    assert done.stderr[-2000:] == ""
    wrong = [
        f"{case.category}: {case.name}: {answer['verdict']}, expected {case.verdict}"
        for case, answer in zip(CASES[first:last], answers, strict=True)
        if answer["verdict"] != case.verdict
    ]
    assert not wrong, "\n".join(wrong)
    assert max(a["megabytes"] for a in answers) <= MAX_MEGABYTES


@pytest.mark.fuzz
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("first", [0, MUTANTS], ids=["first half", "second half"])
def test_mutants_are_refused_or_work(first):
    """No signal, no hang, no error but ours, at most 512 MB; what loads gives finite poses and derivatives."""
    done = run(HERE / "urdf_child.py", "mutants", first, first + MUTANTS, MUTANT_SECONDS, timeout=1800)
    lines = done.stdout.splitlines()
    assert done.returncode == 0, f"mutant {lines[-1] if lines else '?'} ended the process: {done.stderr}"
    assert done.stderr == ""
    report = json.loads(lines[-1])
    assert not report["faults"], "\n".join(report["faults"][:20])
    assert report["megabytes"] <= MAX_MEGABYTES
    loaded = report["seen"].get("accept", 0) + report["seen"].get("warn", 0)
    assert loaded > 0.05 * (len(lines) - 1), "the mutants have become too wild to test what comes after validation"
    assert len(lines) - 1 == MUTANTS or not IS_LONG
    assert mutant(12345) == mutant(12345) != mutant(12346)  # a seed names its mutant
