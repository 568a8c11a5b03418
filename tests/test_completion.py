"""What the shell offers: robots and flags."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest


def offered(line: str, folder: Path, shell: str = "bash") -> list[str]:
    """What a shell gets for an unfinished line, from the program itself."""
    words = line.split(" ")
    environment = dict(os.environ, _MANIP_LEARN_COMPLETE=f"complete_{shell}", PYTHONPATH=os.pathsep.join(sys.path))
    if shell == "bash":
        environment |= {"COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)}
    else:
        environment |= {"_TYPER_COMPLETE_ARGS": line, "_TYPER_COMPLETE_FISH_ACTION": "get-args"}
    done = subprocess.run(
        [sys.executable, "-m", "manip_learn"], env=environment, cwd=folder, capture_output=True, text=True, timeout=60
    )
    assert done.stderr == ""
    return done.stdout.split()


@pytest.mark.parametrize("shell", ["bash", "fish"])
def test_names_and_flags(shell: str, tmp_path: Path) -> None:
    """A robot by its first letters, a flag of the command."""
    assert "sawyer" in offered("manip-learn inspect saw", tmp_path, shell)
    assert "--columns" in offered("manip-learn learn sawyer --col", tmp_path, shell)
