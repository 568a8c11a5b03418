"""A motion as MCAP, and the records of any MCAP file: JointState messages for ROS, a rollout's samples on a topic of
their own, the header as metadata.

The layout is that of https://mcap.dev/spec: uncompressed chunks with checksums and message indexes, and a summary.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from typing import final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.errors import OutputError
from manip_learn.recordings.format_words import JOINT_STATE, STAMPED_WRENCH
from manip_learn.recordings.saved_motion import SavedMotion

MAGIC = b"\x89MCAP0\r\n"
# codes of records, as the specification of MCAP numbers them
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = 1, 2, 3, 4, 5, 6, 7, 8
STATISTICS, METADATA, METADATA_INDEX, DATA_END = 0x0B, 0x0C, 0x0D, 0x0F  # codes of records
METADATA_NAME, HEADER_KEY = "manip_learn", "header"
JOINT_TOPIC, WRENCH_TOPIC, ROLLOUT_TOPIC = "/joint_states", "/wrench", "/rollout"
CHUNK_BYTES = 1_000_000  # after which a chunk is closed; the specification asks for none
SECOND = 1_000_000_000  # [ns]; a stamp of zero means "not set" in ROS: motions that start at zero start at one second
LAST_STAMP = 2**31 * SECOND  # [ns] seconds are int32 in ROS

ROLLOUT_SAMPLE = "manip_learn_msgs/msg/RolloutSample"
FOLLOWED_SAMPLE = "manip_learn_msgs/msg/FollowedSample"  # with the following error
_SAMPLE = "float64 time\nfloat64 manipulability\nfloat64 task_error\nfloat64[] q\nfloat64[] u\nstring status\n"
_RULE = "=" * 80 + "\n"  # between definitions, as the specification of MCAP wants it [characters]
_HEADER = f"{_RULE}MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
_HEADER += f"{_RULE}MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
# definitions as MCAP wants them: the message, then what it refers to
DEFINITIONS = {
    JOINT_STATE: "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    + _HEADER,
    STAMPED_WRENCH: f"std_msgs/Header header\ngeometry_msgs/Wrench wrench\n{_HEADER}"
    f"{_RULE}MSG: geometry_msgs/Wrench\ngeometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n"
    f"{_RULE}MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n",
    ROLLOUT_SAMPLE: _SAMPLE,
    FOLLOWED_SAMPLE: _SAMPLE + "float64 following_error\n",
}
CDR_LITTLE_ENDIAN = b"\x00\x01\x00\x00"


def mcap_bytes(motion: SavedMotion) -> bytes:
    """The file.

    Raises:
        OutputError: Times that stamps of whole nanoseconds cannot tell apart.
    """
    stamps = nanoseconds(motion.time, from_first=False)
    if stamps.size and stamps[0] == 0:
        stamps = stamps + SECOND
    topics = [(JOINT_TOPIC, JOINT_STATE)]
    if motion.wrench is not None:
        topics.append((WRENCH_TOPIC, STAMPED_WRENCH))
    if motion.header.kind == "rollout":
        topics.append((ROLLOUT_TOPIC, ROLLOUT_SAMPLE if motion.following_error is None else FOLLOWED_SAMPLE))
    file = _McapFile(topics)
    file.metadata(METADATA_NAME, {HEADER_KEY: motion.header.to_json(len(motion.time))})
    for stamp, messages in zip(stamps.tolist(), _messages(motion, stamps), strict=True):
        for channel, message in enumerate(messages, 1):
            file.message(channel, stamp, message)
    return file.finished()


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


def _messages(motion: SavedMotion, stamps: np.ndarray) -> Iterator[list[bytes]]:
    header, nothing = motion.header, np.empty(0)
    encode = joint_state_encoder(header.joint_names)
    are_positions = motion.q.shape[1] == len(header.joint_names)  # configurations are only in the rollout's samples
    for i, stamp in enumerate(stamps.tolist()):
        q, u = motion.q[i], nothing if motion.u is None else motion.u[i]
        effort = nothing if motion.effort is None else motion.effort[i]
        messages = [encode(stamp, q if are_positions else nothing, u, effort)]
        if motion.wrench is not None:
            messages.append(stamped_wrench(stamp, motion.wrench[i]))
        if motion.manipulability is not None and motion.task_error is not None:
            numbers = float(motion.time[i]), float(motion.manipulability[i]), float(motion.task_error[i])
            following = None if motion.following_error is None else float(motion.following_error[i])
            messages.append(rollout_sample(numbers, q, u, str(motion.status[i]), following))
        yield messages


def joint_state_encoder(names: tuple[str, ...]) -> Callable[[int, np.ndarray, np.ndarray, np.ndarray], bytes]:
    """A function (stamp [ns], positions, velocities, efforts) -> message; each array may be empty."""
    head = b"\x01\x00\x00\x00\x00"  # frame_id: empty
    body = bytearray(struct.pack("<I", len(names)))
    for name in names:
        _align(body, 4, 8 + len(head) + 3)
        body += _text(name + "\x00")
    middle = head + b"\x00" * 3 + bytes(body)

    def encode(stamp: int, positions: np.ndarray, velocities: np.ndarray, efforts: np.ndarray) -> bytes:
        message = bytearray(struct.pack("<iI", *divmod(stamp, SECOND)) + middle)
        for values in (positions, velocities, efforts):
            _append_doubles(message, values)
        return CDR_LITTLE_ENDIAN + bytes(message)

    return encode


def stamped_wrench(stamp: int, wrench: Float[np.ndarray, " 6"]) -> bytes:
    """A message: stamp [ns], no frame, since that of the sensor is not known, and the numbers."""
    message = bytearray(struct.pack("<iI", *divmod(stamp, SECOND)) + _text("\x00"))
    _align(message, 8)
    return CDR_LITTLE_ENDIAN + bytes(message) + np.ascontiguousarray(wrench, dtype="<f8").tobytes()


def rollout_sample(
    numbers: tuple[float, float, float], q: np.ndarray, u: np.ndarray, status: str, following: float | None = None
) -> bytes:
    """One sample: (time, manipulability, task error), posture, velocities, status, and the following error if known."""
    message = bytearray(struct.pack("<3d", *numbers))
    _append_doubles(message, q)
    _append_doubles(message, u)
    _align(message, 4)
    message += _text(status + "\x00")
    if following is not None:
        _align(message, 8)
        message += struct.pack("<d", following)
    return CDR_LITTLE_ENDIAN + bytes(message)


def _append_doubles(message: bytearray, values: np.ndarray) -> None:
    _align(message, 4)
    message += struct.pack("<I", len(values))
    if len(values):
        _align(message, 8)
        message += np.ascontiguousarray(values, dtype="<f8").tobytes()


def _align(message: bytearray, size: int, before: int = 0) -> None:
    """CDR aligns numbers to their size, counted from the start of the message."""
    message += b"\x00" * (-(before + len(message)) % size)


def _text(value: str) -> bytes:
    content = value.encode()
    return struct.pack("<I", len(content)) + content


def _mapping(content: dict[str, str]) -> bytes:
    pairs = b"".join(_text(k) + _text(v) for k, v in content.items())
    return struct.pack("<I", len(pairs)) + pairs


def _record(code: int, content: bytes) -> bytes:
    return struct.pack("<BQ", code, len(content)) + content


@final
class _McapFile:
    """Bytes of an MCAP file as they grow."""

    def __init__(self, topics: list[tuple[str, str]]):
        self._types = b""
        for i, (topic, kind) in enumerate(topics, 1):
            definition = _text(kind) + _text("ros2msg") + _text(DEFINITIONS[kind])
            self._types += _record(SCHEMA, struct.pack("<H", i) + definition)
            self._types += _record(CHANNEL, struct.pack("<HH", i, i) + _text(topic) + _text("cdr") + _mapping({}))
        self._counts = dict.fromkeys(range(1, len(topics) + 1), 0)
        self._bytes = bytearray(MAGIC + _record(HEADER, _text("ros2") + _text("manip_learn")))
        self._summary = b""
        self._n_chunks = 0
        self._first, self._last = 0, 0
        self._n_metadata = 0
        self._begin_chunk()

    def _begin_chunk(self) -> None:
        self._chunk = bytearray(self._types)
        self._index: dict[int, list[tuple[int, int]]] = {}

    def metadata(self, name: str, content: dict[str, str]) -> None:
        """Text beside the messages."""
        record = _record(METADATA, _text(name) + _mapping(content))
        self._summary += _record(METADATA_INDEX, struct.pack("<QQ", len(self._bytes), len(record)) + _text(name))
        self._bytes += record
        self._n_metadata += 1

    def message(self, channel: int, stamp: int, content: bytes) -> None:
        """One message; stamps must not decrease [ns]."""
        sequence = self._counts[channel]
        self._first = stamp if not any(self._counts.values()) else self._first
        self._last, self._counts[channel] = stamp, sequence + 1
        self._index.setdefault(channel, []).append((stamp, len(self._chunk)))
        head = struct.pack("<HIQQ", channel, sequence % 2**32, stamp, stamp)
        self._chunk += _record(MESSAGE, head + content)
        if len(self._chunk) > CHUNK_BYTES:
            self._end_chunk()

    def _end_chunk(self) -> None:
        stamps = [stamp for entries in self._index.values() for stamp, _ in entries]
        first, last, size = min(stamps), max(stamps), len(self._chunk)
        head = struct.pack("<QQQI", first, last, size, zlib.crc32(self._chunk)) + _text("") + struct.pack("<Q", size)
        start, record = len(self._bytes), _record(CHUNK, head + bytes(self._chunk))
        self._bytes += record
        places = b""
        for channel, entries in self._index.items():
            places += struct.pack("<HQ", channel, len(self._bytes))
            pairs = b"".join(struct.pack("<QQ", *entry) for entry in entries)
            self._bytes += _record(MESSAGE_INDEX, struct.pack("<HI", channel, len(pairs)) + pairs)
        index = struct.pack("<QQQQ", first, last, start, len(record)) + struct.pack("<I", len(places)) + places
        index += struct.pack("<Q", len(self._bytes) - start - len(record)) + _text("")
        self._summary += _record(CHUNK_INDEX, index + struct.pack("<QQ", size, size))
        self._n_chunks += 1
        self._begin_chunk()

    def finished(self) -> bytes:
        """The whole file."""
        if self._index:
            self._end_chunk()
        self._bytes += _record(DATA_END, struct.pack("<I", 0))
        start, n = len(self._bytes), len(self._counts)
        counts = b"".join(struct.pack("<HQ", *pair) for pair in self._counts.items())
        statistics = struct.pack("<QHIIIIQQ", sum(self._counts.values()), n, n, 0, self._n_metadata, self._n_chunks,
                                 self._first, self._last)  # fmt: skip
        statistics += struct.pack("<I", len(counts)) + counts
        self._bytes += self._types + _record(STATISTICS, statistics) + self._summary
        self._bytes += _record(FOOTER, struct.pack("<QQI", start, 0, 0)) + MAGIC
        return bytes(self._bytes)
