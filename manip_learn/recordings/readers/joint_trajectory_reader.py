"""A JointTrajectory as text, JSON behind comment lines: what `manip-learn export` writes for a controller."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from manip_learn.recordings.saved_motion import FileHeader, SavedMotion, refusal

LARGEST = 500_000_000  # bytes


def is_joint_trajectory(path: Path) -> bool:
    """Whether the line after the header is a comment too: in a table it would be the names of the columns."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        file.readline()
        return file.read(2) == "# "


def read_joint_trajectory(path: Path, header: FileHeader) -> SavedMotion:
    """The motion; times count from its first point.

    Raises:
        RecordingError: No JointTrajectory, or a point that lacks a number; names the point.
        ValueError: Not JSON; and whatever else a damaged file raises.
    """
    size = path.stat().st_size
    if size > LARGEST:
        raise refusal(path, "too-large", f"a JointTrajectory of {size:,} bytes, more than {LARGEST:,}: split it")
    lines = path.read_text(encoding="utf-8-sig").splitlines()
    content = json.loads("\n".join("" if line.startswith("#") else line for line in lines))
    if tuple(content["joint_names"]) != header.joint_names:
        raise refusal(path, "joint-names", "its joint_names are not those of the first line: export it again")
    points = content["points"]
    nv = len(header.joint_names)
    has_u = bool(points) and "velocities" in points[0]
    for i, point in enumerate(points):
        for name in ("positions", "velocities") if has_u else ("positions",):
            values = point.get(name)
            if not isinstance(values, list) or len(values) != nv or not all(type(v) in (int, float) for v in values):
                raise refusal(path, "shape", f"point {i}: {name} must be {nv} numbers, they are {values!r:.60}")
    stamps = [p["time_from_start"]["sec"] * 1_000_000_000 + p["time_from_start"]["nanosec"] for p in points]
    time = np.array(stamps, dtype=np.int64) * 1e-9
    q = np.array([p["positions"] for p in points], dtype=np.float64).reshape(-1, nv)
    u = np.array([p["velocities"] for p in points], dtype=np.float64).reshape(-1, nv) if has_u else None
    return SavedMotion(header, time, q, u, name=path.name)
