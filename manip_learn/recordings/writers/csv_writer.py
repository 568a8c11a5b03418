"""A motion as a text table: a comment with the header, a line of column names, one line per sample.

Numbers are written with as many digits as it takes to read the same float64 again.
"""

from __future__ import annotations

import csv
import io

import numpy as np

from manip_learn.recordings.saved_motion import FileHeader, SavedMotion

MARK = "# manip_learn "
VELOCITY_SUFFIX, EFFORT_SUFFIX = "_velocity", "_effort"


def column_names(header: FileHeader, with_velocities: bool, with_efforts: bool = False) -> list[str]:
    """Names of the columns: `time`, postures, velocities, efforts, and of a rollout its curves and status."""
    joints = list(header.joint_names)
    is_joints = header.nq in (None, len(joints))
    postures = joints if is_joints else [f"q[{i}]" for i in range(header.nq or 0)]
    velocities = [f"{n}{VELOCITY_SUFFIX}" for n in joints] if with_velocities else []
    efforts = [f"{n}{EFFORT_SUFFIX}" for n in joints] if with_efforts else []
    following = ["following_error"] if header.follows else []
    curves = ["manipulability", "task_error", *following, "status"] if header.kind == "rollout" else []
    return ["time", *postures, *velocities, *efforts, *curves]


def column_line(header: FileHeader, with_velocities: bool, with_efforts: bool = False) -> str:
    """The line of column names; names with commas are quoted."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="").writerow(column_names(header, with_velocities, with_efforts))
    return " ".join(stream.getvalue().splitlines())


def csv_bytes(motion: SavedMotion) -> bytes:
    """The table, UTF-8."""
    columns = [motion.time[:, None], motion.q, motion.u, motion.effort]
    curves = motion.manipulability, motion.task_error, motion.following_error
    columns += [None if c is None else c[:, None] for c in curves]
    table = np.hstack([c for c in columns if c is not None])
    words = [[word] for word in motion.status] or [[]] * len(table)
    named = column_line(motion.header, motion.u is not None, motion.effort is not None)
    lines = [MARK + motion.header.to_json(), named]
    lines += [",".join([*map(repr, row), *word]) for row, word in zip(table.tolist(), words, strict=True)]
    return ("\n".join(lines) + "\n").encode()
