"""The faults that `make mutants` puts into the library are those that people make, one at a time."""

from __future__ import annotations

import ast

from mutants import faults_of, nearest_tests

TEXT = '''
"""A file."""

LIMIT = 2.0


def shares(a, b):
    """The promise."""
    if not a < b:
        raise ValueError(a - b)
    return np.cos(abs(a) - 3.0 * b, divided(a, b))


def sent(arm):
    for joint in arm:
        joint.stop(True)
'''
WORDS = {
    "2.0  ->  4.0", "not a < b  ->  a < b", "a < b  ->  a <= b", "abs(a) - 3.0 * b  ->  abs(a) + 3.0 * b",
    "abs(a)  ->  a", "3.0 * b  ->  3.0 / b", "3.0  ->  6.0", "divided(a, b)  ->  divided(b, a)",
    "joint.stop(True)  ->  pass", "True  ->  False",
    "if not a < b:     raise ValueError(a - b)  ->  if not not a < b:     raise ValueError(a - b)",
    "return np.cos(abs(a) - 3.0 * b, divided(a, b))  ->  return None",
    "np.cos(abs(a) - 3.0 * b, divided(a, b))  ->  np.sin(abs(a) - 3.0 * b, divided(a, b))",
}  # fmt: skip


def test_each_kind_of_fault_is_made():
    """Another comparison, sign, constant or call, exchanged arguments, a dropped call; each alone, and no more."""
    found = list(faults_of(TEXT))
    assert {fault.words for fault in found} == WORDS and len(found) == len(WORDS)
    (fault,) = (fault for fault in found if fault.words == "divided(a, b)  ->  divided(b, a)")
    assert (fault.line, fault.promise) == (11, "The promise.")
    plain = ast.unparse(ast.parse(TEXT)).splitlines()
    for fault in found:
        changed = [pair for pair in zip(plain, fault.text.splitlines(), strict=True) if pair[0] != pair[1]]
        assert len(changed) == 1, fault


def test_the_nearest_test_files_come_first():
    """Those that bear the file's name, then those that import it and least else."""
    assert nearest_tests("manip_learn/linalg.py")[0] == "tests/test_linalg.py"
    assert "tests/test_experiments.py" in nearest_tests("manip_learn/experiments/metrics.py")
