"""Start-up: processor time of whole commands over that of loading the libraries that all of them need.

The unit is `python -c "import numpy, scipy.linalg, pinocchio"`.
"""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
from pathlib import Path

import pytest
from timing import Ratio, keep

pytestmark = [pytest.mark.bench, pytest.mark.timeout(900)]
DATA = Path(__file__).resolve().parents[1] / "examples" / "data"
UNIT = ("-c", "import numpy, scipy.linalg, pinocchio")
COMMANDS = {
    "--help": ("--help",),
    "learn --help": ("learn", "--help"),
    "inspect sawyer": ("inspect", "sawyer"),
    "learn, 50 CSV files": ("learn", "sawyer", str(DATA / "sawyer_drawer"), "--frame", "right_gripper_tip"),
}


def processor_time(arguments: tuple[str, ...], folder: Path) -> float:
    """User and system time of a Python process [s], whose modules are compiled as those of an installation are."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    subprocess.run(
        [sys.executable, *arguments],
        stdout=subprocess.DEVNULL, cwd=folder, env=environment, check=True, timeout=120,
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def test_commands_load_what_they_use(tmp_path: Path) -> None:
    """Each command in turns with the bare libraries."""
    seconds: dict[str, list[float]] = {name: [] for name in ("libraries", *COMMANDS)}
    for arguments in COMMANDS.values():  # compiles what has not been run before
        processor_time(("-m", "manip_learn", *arguments), tmp_path)
    for _ in range(int(os.environ.get("BENCH_ROUNDS", "5"))):
        seconds["libraries"].append(processor_time(UNIT, tmp_path))
        for name, arguments in COMMANDS.items():
            seconds[name].append(processor_time(("-m", "manip_learn", *arguments), tmp_path))
    found = {}
    for name in COMMANDS:
        rounds = [a / b for a, b in zip(seconds[name], seconds["libraries"], strict=True)]
        lower, _, upper = statistics.quantiles(rounds, n=4)
        found[name] = Ratio(min(seconds[name]) / min(seconds["libraries"]), lower, upper)
        print(f"  {name:24s} {found[name].value:5.2f} of the libraries alone ({lower:.2f} .. {upper:.2f})")
    keep("startup", found)
