"""A motion -> a file: NPZ, CSV or MCAP by its name, and a JointTrajectory as text."""

from __future__ import annotations

import io
import json
import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from manip_learn.atomic_write import write_atomically
from manip_learn.errors import MissingExtraError, OutputError
from manip_learn.recordings.format_words import JOINT_STATE, MARK, yaml_text
from manip_learn.recordings.saved_motion import PREFIX, SavedMotion, column_groups, column_line
from manip_learn.recordings.trajectory import BESIDE_POSITIONS

TYPE = "trajectory_msgs/msg/JointTrajectory"
SECOND = 1_000_000_000  # [ns]; a stamp of zero means "not set" in ROS: motions that start at zero start at one second
LAST_STAMP = 2**31 * SECOND  # [ns] seconds are int32 in ROS


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


def mcap_bytes(motion: SavedMotion) -> bytes:
    """An MCAP bag of JointState messages for ROS 2.

    Raises:
        OutputError: Times that stamps of whole nanoseconds cannot tell apart, or no room for temporary files.
        MissingExtraError: The extra `ros` is not installed.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2.writer import Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise MissingExtraError("writing MCAP", "ros") from error
    stamps = nanoseconds(motion.arrays["time"], from_first=False)
    if stamps.size and stamps[0] == 0:
        stamps = stamps + SECOND
    store: Any = get_typestore(Stores.ROS2_HUMBLE)
    types, names, nothing = store.types, list(motion.header.joint_names), np.empty(0)
    known = (motion.arrays.get(name) for name in ("q", *BESIDE_POSITIONS))  # configurations are no positions of joints
    arrays = [None if x is None or x.shape[1] != len(names) else np.ascontiguousarray(x) for x in known]
    try:
        with tempfile.TemporaryDirectory() as folder:
            with Writer(Path(folder) / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
                joints = writer.add_connection("/joint_states", JOINT_STATE, typestore=store)
                for i, stamp in enumerate(stamps.tolist()):
                    time = types["builtin_interfaces/msg/Time"](*divmod(stamp, SECOND))
                    numbers = [nothing if x is None else x[i] for x in arrays]
                    state = types[JOINT_STATE](types["std_msgs/msg/Header"](time, ""), names, *numbers)
                    writer.write(joints, stamp, store.serialize_cdr(state, JOINT_STATE))
            return (Path(folder) / "bag" / "bag.mcap").read_bytes()
    except OSError as error:
        text = f"cannot write the bag in {tempfile.gettempdir()}: {error.strerror}; make room, or set TMPDIR"
        raise OutputError(text) from error


def nanoseconds(time: Float[np.ndarray, " T"], *, from_first: bool) -> Int[np.ndarray, " T"]:
    """Times as whole nanoseconds.

    Args:
        time: [s].
        from_first: Count from the first sample; otherwise from zero, or from the first sample where a stamp could not
            hold that.

    Raises:
        OutputError: Two samples are less than a nanosecond apart, or the motion is longer than a stamp can say.
    """
    if not np.all(np.isfinite(time)):
        raise OutputError("the motion has times that are not finite: they cannot be written as stamps")
    start = float(time[0]) if time.size else 0.0
    relative = from_first or start < 0.0 or float(np.max(time, initial=0.0)) * 1e9 >= LAST_STAMP
    stamps = np.rint((time - start if relative else time) * 1e9)
    if np.any(np.diff(stamps) <= 0) or np.max(stamps, initial=0.0) >= LAST_STAMP:
        raise OutputError(
            "the times cannot be written as stamps of whole nanoseconds: they must increase by a nanosecond or more, "
            "over less than 68 years; write NPZ or CSV"
        )
    return stamps.astype(np.int64)


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
    points = []
    for i, time in enumerate(times):
        point: dict[str, Any] = {name: array[i].tolist() for name, array in known.items() if array is not None}
        point["time_from_start"] = dict(zip(("sec", "nanosec"), divmod(time, SECOND), strict=True))
        try:
            points.append(f"  {yaml_text(point)}")
        except ValueError as error:
            raise OutputError(f"a JointTrajectory can hold finite numbers only ({error})") from error
    return "\n".join([*lines, ",\n".join(points), " ]}", ""]).encode()


_WRITERS: Mapping[str, Callable[[SavedMotion], bytes]] = {".npz": npz_bytes, ".csv": csv_bytes, ".mcap": mcap_bytes}
ELSEWHERE = {  # endings that are refused with what to do
    ".rrd": "a Rerun recording is not written any more; docs/interop.md logs a rollout with Rerun's own package",
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
    if suffix not in _WRITERS:
        usual = f"the ending says the format, and it is {suffix or 'missing'!r}; use one of {', '.join(_WRITERS)}"
        raise OutputError(refused + ELSEWHERE.get(suffix, usual))
    try:
        content = _WRITERS[suffix](motion)
    except UnicodeEncodeError as error:
        raise OutputError(f"{refused}a name in it is no text ({error})") from error
    return write_atomically(path, content)
