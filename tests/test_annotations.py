"""Annotations: every name in them exists, and nothing public returns just anything."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

CHILD = Path(__file__).parent / "annotations_child.py"


def test_every_annotation_resolves():
    """`typing.get_type_hints` works on each class, method and function of the library; nothing public returns Any."""
    result = subprocess.run([sys.executable, CHILD], capture_output=True, text=True, timeout=100)
    assert result.returncode == 0, result.stdout + result.stderr
    assert int(result.stdout.split()[0]) > 1000, result.stdout
