"""Results that no change of structure may change, see golden/make_golden.py."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.slow
def test_results_are_those_that_were_written_down():
    """Learning, kinematics, commands, rollouts and the command line give the stored numbers."""
    # another Python, as a user's: here the library was imported with its shapes checked, several times as slow
    script = [sys.executable, str(ROOT / "tests" / "golden" / "make_golden.py"), "--check"]
    ran = subprocess.run(
        script, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, f"results changed (case: key):\n{ran.stdout}\n{ran.stderr}"
