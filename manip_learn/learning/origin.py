"""Provenance of an answer: version of the library, date, recordings and settings."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import json
import subprocess
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from manip_learn.recordings.trajectory import Demonstrations, Trajectory, distinct_names

PACKAGE = "manip-learn"


def made(demonstrations: Demonstrations, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entry `provenance["made"]` of a constraint.

    Args:
        demonstrations: All recordings.
        settings: Settings of the learner.
    """
    names = distinct_names(demonstrations)
    return {
        "version": version(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "recordings": [{"name": n, "sha256": checksum(t)} for n, t in zip(names, demonstrations, strict=True)],
        "settings": {name: _plain(value) for name, value in settings.items()},
    }


def _plain(value: Any) -> Any:
    """Return a setting as JSON represents it."""
    number = value.item() if isinstance(value, np.generic) else value
    return number if number is None or isinstance(number, str | int | float) else str(number)


def checksum(trajectory: Trajectory) -> str:
    """Return the SHA-256 of the file of a trajectory; of its numbers if it was not read from a file."""
    if trajectory.sha256:
        return trajectory.sha256
    numbers = (trajectory.time, trajectory.q, *trajectory.arrays.values())
    return hashlib.sha256(b"".join(array.astype("<f8").tobytes() for array in numbers)).hexdigest()


@functools.cache
def version() -> str:
    """Return the version of the library, with the commit if known: `"0.1.0+d8918b7f"`, `-dirty` if changed since."""
    try:
        package = importlib.metadata.distribution(PACKAGE)
    except importlib.metadata.PackageNotFoundError:  # a folder on the path
        number, commit = "unknown", ""
    else:
        number = package.version
        commit = json.loads(package.read_text("direct_url.json") or "{}").get("vcs_info", {}).get("commit_id", "")[:8]
    root = Path(__file__).resolve().parents[2]
    if (root / ".git").exists():
        asked = [
            "git",
            "--no-optional-locks",
            "-C",
            str(root),
            "describe",
            "--always",
            "--abbrev=8",
            "--exclude=*",
            "--dirty",
        ]
        try:
            commit = subprocess.run(asked, capture_output=True, text=True, timeout=5.0, check=True).stdout.strip()
        except (OSError, subprocess.SubprocessError):  # no git here, or a checkout of somebody else
            pass
    return f"{number}+{commit}" if commit else number
