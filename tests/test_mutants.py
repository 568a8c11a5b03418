"""The faults that `make mutants` puts into the library are those that people make, one at a time."""

from __future__ import annotations

import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent / "mutation"
sys.path.insert(0, str(FOLDER))
from faults import faults_of  # noqa: E402
from uses import rings_around  # noqa: E402

TEXT = '''
"""A file."""

LIMIT = 2.0
COUNT = 12


def shares(a, b):
    """The promise."""
    if not a < b:
        raise ValueError(a - b)
    return np.hypot(abs(a) - 3.0 * b, divided(a, b))


def sent(arm):
    for joint in arm:
        joint.stop(True)
'''
WORDS = {
    "2.0  ->  4.0", "2.0  ->  1.0", "12  ->  24", "12  ->  6",
    "if not a < b:  ->  if not not a < b:", "not a < b  ->  a < b", "a < b  ->  a <= b",
    "return np.hypot(abs(a) - 3.0 * b, divided(a, b))  ->  return None",
    "np.hypot(abs(a) - 3.0 * b, divided(a, b))  ->  np.maximum(abs(a) - 3.0 * b, divided(a, b))",
    "abs(a) - 3.0 * b  ->  abs(a) + 3.0 * b", "abs(a) - 3.0 * b  ->  abs(a)", "abs(a)  ->  a",
    "3.0 * b  ->  3.0 / b", "3.0  ->  6.0", "3.0  ->  1.5", "divided(a, b)  ->  divided(b, a)",
    "joint.stop(True)  ->  pass", "True  ->  False", "sent  ->  returns at once",
}  # fmt: skip


def test_each_kind_of_fault_is_made():
    """Another comparison, sign, constant or call, exchanged arguments, a dropped call, an early return; no more."""
    found = faults_of(TEXT)
    assert {fault.words for fault in found} == WORDS and len(found) == len(WORDS)
    (fault,) = (fault for fault in found if fault.words == "divided(a, b)  ->  divided(b, a)")
    assert (fault.line, fault.promise) == (12, "The promise.")
    changed = [pair for pair in zip(TEXT.splitlines(), fault.text().splitlines(), strict=False) if pair[0] != pair[1]]
    assert "divided(b, a)" in fault.text() and "LIMIT = 2.0" in fault.text() and changed
    for fault in found:
        compile(fault.text(), "faulty", "exec")


def test_the_nearest_test_files_come_first():
    """Those that bear the file's name, then those that use least beside it, then users of users; none that is slow."""
    users = {
        "manip_learn/experiments/metrics.py": ["manip_learn/experiments/rmse.py", "tests/test_learner.py"],
        "manip_learn/experiments/rmse.py": ["tests/test_experiments.py", "tests/test_paper.py"],
        "manip_learn/learning/learner.py": ["tests/test_learner.py"],
    }
    rings = list(rings_around("manip_learn/experiments/metrics.py", users, 1))
    assert rings == [["tests/test_metrics.py"], ["tests/test_learner.py"], ["tests/test_experiments.py"]]
