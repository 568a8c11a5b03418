"""The most memory that this process has held."""

from __future__ import annotations

import resource
import sys
from pathlib import Path


def peak_megabytes() -> float:
    """Peak of the resident memory [MiB]. On Linux ru_maxrss would count what the parent held when it forked."""
    status = Path("/proc/self/status")
    if status.exists():
        high_water = next(line for line in status.read_text(encoding="utf-8").splitlines() if line.startswith("VmHWM"))
        return int(high_water.split()[1]) / 1024  # in KiB, whatever it says
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024**2 if sys.platform == "darwin" else 1024)
