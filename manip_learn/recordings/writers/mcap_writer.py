"""A motion as an MCAP bag of JointState messages for ROS 2."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from manip_learn.errors import MissingExtraError, OutputError
from manip_learn.recordings.format_words import JOINT_STATE
from manip_learn.recordings.saved_motion import SavedMotion
from manip_learn.recordings.trajectory import BESIDE

SECOND = 1_000_000_000  # [ns]; a stamp of zero means "not set" in ROS: motions that start at zero start at one second
LAST_STAMP = 2**31 * SECOND  # [ns] seconds are int32 in ROS


def mcap_bytes(motion: SavedMotion) -> bytes:
    """The file.

    Raises:
        OutputError: Times that stamps of whole nanoseconds cannot tell apart, or no room for temporary files.
        MissingExtraError: The extra `ros` is not installed.
    """
    stamps = nanoseconds(motion.arrays["time"], from_first=False)
    if stamps.size and stamps[0] == 0:
        stamps = stamps + SECOND
    try:
        with tempfile.TemporaryDirectory() as folder:
            return _written(motion, stamps, Path(folder) / "bag").read_bytes()
    except OSError as error:
        text = f"cannot write the bag in {tempfile.gettempdir()}: {error.strerror}; make room, or set TMPDIR"
        raise OutputError(text) from error


def _written(motion: SavedMotion, stamps: Int[np.ndarray, " T"], folder: Path) -> Path:
    """The only file of a bag that the library writes."""
    try:
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2.writer import Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise MissingExtraError("writing MCAP", "ros") from error
    store: Any = get_typestore(Stores.ROS2_HUMBLE)
    types, names, nothing = store.types, list(motion.header.joint_names), np.empty(0)
    known = (motion.arrays.get(name) for name in ("q", *BESIDE))  # configurations are no positions of joints
    arrays = [None if x is None or x.shape[1] != len(names) else np.ascontiguousarray(x) for x in known]
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        joints = writer.add_connection("/joint_states", JOINT_STATE, typestore=store)
        for i, stamp in enumerate(stamps.tolist()):
            header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](*divmod(stamp, SECOND)), "")
            numbers = [nothing if x is None else x[i] for x in arrays]
            state = types[JOINT_STATE](header, names, *numbers)
            writer.write(joints, stamp, store.serialize_cdr(state, JOINT_STATE))
    return folder / f"{folder.name}.mcap"


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
