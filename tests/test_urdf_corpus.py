"""Hostile and unusual robot descriptions: each gets its expected verdict, and none harms the process."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from urdf_corpus import corpus

HERE = Path(__file__).parent
CASES = corpus()
BATCH = 80
MAX_MEGABYTES = 512.0


def run(first: int, last: int, folder: Path) -> tuple[list[dict], int, str]:
    """Answers of a child process to cases first ... last - 1, how it ended, and what it printed on stderr."""
    paths = os.pathsep.join([str(HERE), str(HERE.parent)])
    done = subprocess.run(
        [sys.executable, str(HERE / "urdf_corpus_child.py"), str(folder), str(first), str(last)],
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
        env={**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )
    return [json.loads(line) for line in done.stdout.splitlines()], done.returncode, done.stderr


@pytest.mark.parametrize("first", range(0, len(CASES), BATCH))
def test_every_case_gets_its_verdict(first, tmp_path):
    """The verdict is the frozen one; no signal, no hang, at most 512 MB, nothing printed by the libraries."""
    last = min(first + BATCH, len(CASES))
    answers, code, printed = run(first, last, tmp_path)
    done = len(answers)
    culprit = CASES[first + min(done, last - first - 1)]
    assert code == 0, f"{culprit.category}: {culprit.name} ended the process: {code}\n{printed[-2000:]}"
    assert printed[-2000:] == ""
    wrong = [
        f"{case.category}: {case.name}: {answer['verdict']}, expected {case.verdict}"
        for case, answer in zip(CASES[first:last], answers, strict=True)
        if answer["verdict"] != case.verdict
    ]
    assert not wrong, "\n".join(wrong)
    assert max(a["megabytes"] for a in answers) <= MAX_MEGABYTES


def test_the_corpus_is_large_and_varied():
    """At least 200 cases in twelve categories, no two with the same name."""
    count = Counter(case.category for case in CASES)
    assert len(CASES) >= 200
    assert len(count) == 12 and min(count.values()) >= 9
    assert len({(case.category, case.name) for case in CASES}) == len(CASES)


def test_a_hang_would_be_seen(tmp_path):
    """The harness itself: the alarm ends a case that takes too long, and the exit code tells."""
    script = (
        "import sys, time, urdf_corpus_child as child\n"
        f"sys.argv = ['', {str(tmp_path)!r}, '0', '1']\n"
        "child.SECONDS, child.verdict = 1, lambda case, folder: time.sleep(60)\n"
        "child.main()"
    )
    paths = os.pathsep.join([str(HERE), str(HERE.parent)])
    done = subprocess.run(
        [sys.executable, "-c", script], env={**os.environ, "PYTHONPATH": paths}, check=False, timeout=60
    )
    assert done.returncode == -signal.SIGALRM
