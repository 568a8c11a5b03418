"""A motion as MCAP: JointState messages for ROS, a rollout's samples on a topic of their own, the header as metadata.

The layout is that of https://mcap.dev/spec: uncompressed chunks with message indexes, and a summary.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import final

import numpy as np

from manip_learn.recordings.saved_motion import SavedMotion
from manip_learn.recordings.writers.joint_state_messages import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    DEFINITIONS,
    FOLLOWED_SAMPLE,
    FOOTER,
    HEADER,
    JOINT_STATE,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA,
    METADATA_INDEX,
    ROLLOUT_SAMPLE,
    SCHEMA,
    STATISTICS,
    joint_state_encoder,
    nanoseconds,
    rollout_sample,
)

METADATA_NAME, HEADER_KEY = "manip_learn", "header"
JOINT_TOPIC, ROLLOUT_TOPIC = "/joint_states", "/rollout"
CHUNK_BYTES = 1_000_000
NOT_SET = 1_000_000_000  # [ns] a stamp of zero means "not set" in ROS: such motions start at one second


def mcap_bytes(motion: SavedMotion) -> bytes:
    """The file.

    Raises:
        OutputError: Times that stamps of whole nanoseconds cannot tell apart.
    """
    stamps = nanoseconds(motion.time, from_first=False)
    if stamps.size and stamps[0] == 0:
        stamps = stamps + NOT_SET
    topics = [(JOINT_TOPIC, JOINT_STATE)]
    if motion.header.kind == "rollout":
        topics.append((ROLLOUT_TOPIC, ROLLOUT_SAMPLE if motion.following_error is None else FOLLOWED_SAMPLE))
    file = _McapFile(topics)
    file.metadata(METADATA_NAME, {HEADER_KEY: motion.header.to_json(len(motion.time))})
    for stamp, messages in zip(stamps.tolist(), _messages(motion, stamps), strict=True):
        for channel, message in enumerate(messages, 1):
            file.message(channel, stamp, message)
    return file.finished()


def _messages(motion: SavedMotion, stamps: np.ndarray) -> Iterator[list[bytes]]:
    header, nothing = motion.header, np.empty(0)
    encode = joint_state_encoder(header.joint_names)
    are_positions = motion.q.shape[1] == len(header.joint_names)  # configurations are only in the rollout's samples
    for i, stamp in enumerate(stamps.tolist()):
        q, u = motion.q[i], nothing if motion.u is None else motion.u[i]
        effort = nothing if motion.effort is None else motion.effort[i]
        messages = [encode(stamp, q if are_positions else nothing, u, effort)]
        if motion.manipulability is not None and motion.task_error is not None:
            numbers = float(motion.time[i]), float(motion.manipulability[i]), float(motion.task_error[i])
            following = None if motion.following_error is None else float(motion.following_error[i])
            messages.append(rollout_sample(numbers, q, u, str(motion.status[i]), following))
        yield messages


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
        head = struct.pack("<QQQI", first, last, size, 0) + _text("") + struct.pack("<Q", size)
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
