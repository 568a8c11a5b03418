"""A motion -> a file: NPZ, CSV or MCAP by its name, and a JointTrajectory as text."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from manip_learn.atomic_write import write_atomically
from manip_learn.errors import OutputError
from manip_learn.recordings.format_words import MARK, yaml_text
from manip_learn.recordings.saved_motion import PREFIX, SavedMotion, column_groups, column_line
from manip_learn.recordings.writers.mcap_writer import mcap_bytes, nanoseconds

TYPE = "trajectory_msgs/msg/JointTrajectory"


def csv_bytes(motion: SavedMotion) -> bytes:
    """The table, UTF-8."""
    arrays = motion.arrays
    groups = column_groups(motion.header, arrays)
    table = np.column_stack([arrays[name] for name in groups if name != "status"])
    words = [[word] for word in arrays["status"]] if "status" in groups else [[]] * len(table)
    lines = [MARK + motion.header.to_json(len(motion)), column_line(groups)]
    lines += [",".join([*map(repr, row), *word]) for row, word in zip(table.tolist(), words, strict=True)]
    return ("\n".join(lines) + "\n").encode()


def npz_bytes(motion: SavedMotion) -> bytes:
    """The archive."""
    header = motion.header
    texts = {"format": PREFIX + header.kind, "header": header.to_json(len(motion)), "joint_names": header.joint_names}
    arrays = {name: np.array(text, dtype=str) for name, text in texts.items()} | dict(motion.arrays)
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
    return stream.getvalue()


def joint_trajectory_bytes(motion: SavedMotion) -> bytes:
    """The text, UTF-8.

    Raises:
        OutputError: Numbers that are not finite, or times that whole nanoseconds cannot tell apart.
    """
    names = motion.header.joint_names
    if motion.arrays["q"].shape[1] != len(names):
        raise OutputError("a JointTrajectory needs one position per joint, the motion has configurations")
    times = nanoseconds(motion.arrays["time"], from_first=True).tolist()
    lines = [
        MARK + motion.header.to_json(len(motion)),
        f'# ros2 topic pub --once <controller>/joint_trajectory {TYPE} "$(cat FILE)"',
        '{"header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},',
        f' "joint_names": {json.dumps(list(names))},',
        ' "points": [',
    ]
    known = {"positions": motion.arrays["q"], "velocities": motion.arrays.get("u")}
    for i, time in enumerate(times):
        point: dict[str, Any] = {name: array[i].tolist() for name, array in known.items() if array is not None}
        point["time_from_start"] = dict(zip(("sec", "nanosec"), divmod(time, 1_000_000_000), strict=True))
        try:
            lines.append(f"  {yaml_text(point)}{',' if i + 1 < len(times) else ''}")
        except ValueError as error:
            raise OutputError(f"a JointTrajectory can hold finite numbers only ({error})") from error
    return "\n".join([*lines, " ]}", ""]).encode()


WRITERS: Mapping[str, Callable[[SavedMotion], bytes]] = {".npz": npz_bytes, ".csv": csv_bytes, ".mcap": mcap_bytes}
ELSEWHERE = {  # endings that are refused with what to do
    ".rrd": "a Rerun recording shows the robot too; use manip_learn.playback.write_rerun(robot, rollouts, path), or "
    "`manip-learn export ROBOT FILE... --out x.rrd`",
    ".jsonl": "JSON lines are not written any more; .npz and .csv are read back bit for bit",
}


def write_motion(path: str | os.PathLike[str], motion: SavedMotion) -> Path:
    """Write a motion, whole or not at all.

    Returns:
        The absolute path that was written.

    Raises:
        OutputError: No format of that name, it cannot be written, or the format cannot hold the motion.
    """
    suffix = Path(path).suffix.lower()
    refused = f"cannot write {os.fspath(path)!r}: "
    if suffix not in WRITERS:
        usual = f"the ending says the format, and it is {suffix or 'missing'!r}; use one of {', '.join(WRITERS)}"
        raise OutputError(refused + ELSEWHERE.get(suffix, usual))
    try:
        content = WRITERS[suffix](motion)
    except UnicodeEncodeError as error:
        raise OutputError(f"{refused}a name in it is no text ({error})") from error
    return write_atomically(path, content)
