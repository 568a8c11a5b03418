"""What the records of an MCAP file are called: https://mcap.dev/spec."""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from manip_learn.errors import OutputError

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = 1, 2, 3, 4, 5, 6, 7, 8
STATISTICS, METADATA, METADATA_INDEX, DATA_END = 0x0B, 0x0C, 0x0D, 0x0F


JOINT_STATE = "sensor_msgs/msg/JointState"
ROLLOUT_SAMPLE = "manip_learn_msgs/msg/RolloutSample"
FOLLOWED_SAMPLE = "manip_learn_msgs/msg/FollowedSample"  # with the following error
_SAMPLE = "float64 time\nfloat64 manipulability\nfloat64 task_error\nfloat64[] q\nfloat64[] u\nstring status\n"
LAST_STAMP = 2**31 * 1_000_000_000  # [ns] seconds are int32 in ROS
# definitions as MCAP wants them: the message, then what it refers to
DEFINITIONS = {
    JOINT_STATE: "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    + "=" * 80
    + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    + "=" * 80
    + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
    ROLLOUT_SAMPLE: _SAMPLE,
    FOLLOWED_SAMPLE: _SAMPLE + "float64 following_error\n",
}
CDR_LITTLE_ENDIAN = b"\x00\x01\x00\x00"


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


def joint_state_encoder(names: tuple[str, ...]) -> Callable[[int, np.ndarray, np.ndarray, np.ndarray], bytes]:
    """A function (stamp [ns], positions, velocities, efforts) -> message; each array may be empty."""
    head = b"\x01\x00\x00\x00\x00"  # frame_id: empty
    body = bytearray(struct.pack("<I", len(names)))
    for name in names:
        _align(body, 4, 8 + len(head) + 3)
        text = name.encode() + b"\x00"
        body += struct.pack("<I", len(text)) + text
    middle = head + b"\x00" * 3 + bytes(body)

    def encode(stamp: int, positions: np.ndarray, velocities: np.ndarray, efforts: np.ndarray) -> bytes:
        message = bytearray(struct.pack("<iI", *divmod(stamp, 1_000_000_000)) + middle)
        for values in (positions, velocities, efforts):
            _append_doubles(message, values)
        return CDR_LITTLE_ENDIAN + bytes(message)

    return encode


def rollout_sample(
    numbers: tuple[float, float, float], q: np.ndarray, u: np.ndarray, status: str, following: float | None = None
) -> bytes:
    """One sample: (time, manipulability, task error), posture, velocities, status, and the following error if known."""
    message = bytearray(struct.pack("<3d", *numbers))
    _append_doubles(message, q)
    _append_doubles(message, u)
    _align(message, 4)
    text = status.encode() + b"\x00"
    message += struct.pack("<I", len(text)) + text
    if following is not None:
        _align(message, 8)
        message += struct.pack("<d", following)
    return CDR_LITTLE_ENDIAN + bytes(message)


def rollout_sample_values(
    message: bytes,
) -> tuple[tuple[float, float, float], np.ndarray, np.ndarray, str, float | None]:
    """What `rollout_sample` was given.

    Raises:
        ValueError: Another message.
        struct.error: Too short.
    """
    if message[:4] != CDR_LITTLE_ENDIAN:
        raise ValueError(f"a sample starts with {message[:4]!r}, plain CDR is needed")
    content = message[4:]
    numbers = struct.unpack_from("<3d", content, 0)
    at, arrays = 24, []
    for _ in range(2):
        at += -at % 4
        (count,) = struct.unpack_from("<I", content, at)
        at += 4
        at += -at % 8 if count else 0
        if at + 8 * count > len(content):
            raise ValueError(f"an array of {count} numbers ends after its message")
        arrays.append(np.frombuffer(content, "<f8", count, at))
        at += 8 * count
    at += -at % 4
    (length,) = struct.unpack_from("<I", content, at)
    text = content[at + 4 : at + 4 + length]
    at += 4 + length
    following = None
    if len(text) == length and len(content) == at + -at % 8 + 8:
        (following,) = struct.unpack_from("<d", content, at + -at % 8)
        at = len(content)
    if len(text) != length or at != len(content):
        raise ValueError("a sample does not end with its status or its following error")
    return (numbers[0], numbers[1], numbers[2]), arrays[0], arrays[1], text.rstrip(b"\x00").decode(), following


def _append_doubles(message: bytearray, values: np.ndarray) -> None:
    _align(message, 4)
    message += struct.pack("<I", len(values))
    if len(values):
        _align(message, 8)
        message += np.ascontiguousarray(values, dtype="<f8").tobytes()


def _align(message: bytearray, size: int, before: int = 0) -> None:
    """CDR aligns numbers to their size, counted from the start of the message."""
    message += b"\x00" * (-(before + len(message)) % size)
