"""A ROS 1 or ROS 2 bag, opened for its joint states, and the byte layout of these messages."""

from __future__ import annotations

import contextlib
import functools
import sqlite3
import struct
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from manip_learn.errors import MissingExtraError, RecordingError
from manip_learn.recordings.readers.recording import reason, refusal
from manip_learn.recordings.writers.joint_state_messages import JOINT_STATE

MOST_JOINTS = 10_000


@final
@dataclass(frozen=True, eq=False)
class JointStateLayout:
    """Where the numbers are in messages that have the same joints.

    Attributes:
        size: Bytes of the message.
        order: `"<"` or `">"`, byte order.
        names: Joint names in the message.
        stamp_at: Offset of the seconds; the nanoseconds follow.
        position_at: Offset of the positions, or None if the message has none.
        velocity_at: Offset of the velocities, or None.
        effort_at: Offset of the efforts, or None.
        fixed: Offsets of the bytes that every message of this layout shares.
        template: The shared bytes.
    """

    size: int
    order: str
    names: tuple[str, ...]
    stamp_at: int
    position_at: int | None
    velocity_at: int | None
    effort_at: int | None
    fixed: Int[np.ndarray, " k"]
    template: UInt8[np.ndarray, " k"]

    def matches(self, messages: UInt8[np.ndarray, "N size"]) -> Bool[np.ndarray, " N"]:
        """Messages (one per row) that have this layout."""
        return np.all(messages[:, self.fixed] == self.template, axis=1)

    def stamps(self, messages: UInt8[np.ndarray, "N size"]) -> Int[np.ndarray, " N"]:
        """Header stamps [ns]."""
        parts = np.ascontiguousarray(messages[:, self.stamp_at : self.stamp_at + 8]).view(self.order + "u4")
        return parts[:, 0].astype(np.int64) * 1_000_000_000 + parts[:, 1].astype(np.int64)

    def numbers(self, messages: UInt8[np.ndarray, "N size"], at: int | None) -> Float[np.ndarray, "N n"] | None:
        """One number per joint from an offset on; None if the messages have none."""
        if at is None:
            return None
        block = np.ascontiguousarray(messages[:, at : at + 8 * len(self.names)])
        return block.view(self.order + "f8").astype(np.float64)


@final
class _Cursor:
    """Reads one message field by field and remembers which bytes are shared by messages of the same layout."""

    def __init__(self, raw: bytes, order: str, at: int, *, cdr: bool):
        self.raw, self.order, self.at, self.cdr = raw, order, at, cdr
        self.fixed: list[int] = []

    def count(self) -> int:
        """An unsigned 32-bit number that belongs to the layout."""
        if self.cdr:  # CDR aligns numbers to their size, counted after the 4 bytes in front
            self.at += -(self.at - 4) % 4
        (value,) = struct.unpack_from(self.order + "I", self.raw, self.at)
        self.fixed += range(self.at, self.at + 4)
        self.at += 4
        return value

    def text(self, *, shared: bool) -> str:
        """A string."""
        length = self.count()
        content = self.raw[self.at : self.at + length]
        if len(content) != length:
            raise ValueError("a string ends after the message")
        if shared:
            self.fixed += range(self.at, self.at + length)
        self.at += length
        return content.rstrip(b"\x00").decode("utf-8")

    def doubles(self) -> tuple[int, int]:
        """Offset and number of the entries of an array of numbers."""
        length = self.count()
        if self.cdr and length:
            self.at += -(self.at - 4) % 8
        start = self.at
        self.at += 8 * length
        if self.at > len(self.raw):
            raise ValueError(f"an array of {length} numbers ends after the message")
        return start, length


def ros1_layout(raw: bytes) -> JointStateLayout:
    """Layout of a ROS 1 message.

    Raises:
        ValueError: Not a JointState.
        struct.error: Too short.
    """
    return _layout(_Cursor(raw, "<", 12, cdr=False), stamp_at=4)


def cdr_layout(raw: bytes) -> JointStateLayout:
    """Layout of a ROS 2 message.

    Raises:
        ValueError: Not a JointState, or an encoding other than plain CDR.
        struct.error: Too short.
    """
    if raw[:2] not in (b"\x00\x00", b"\x00\x01"):
        raise ValueError(f"the message is not plain CDR, it starts with {raw[:4]!r}")
    return _layout(_Cursor(raw, "<" if raw[1] else ">", 12, cdr=True), stamp_at=4)


def _layout(cursor: _Cursor, stamp_at: int) -> JointStateLayout:
    if cursor.cdr:
        cursor.fixed += (0, 1)
    cursor.text(shared=False)  # the header's frame
    n = cursor.count()
    if n > MOST_JOINTS:
        raise ValueError(f"the message names {n} joints")
    names = tuple(cursor.text(shared=True) for _ in range(n))
    position_at, n_positions = cursor.doubles()
    velocity_at, n_velocities = cursor.doubles()
    effort_at, n_efforts = cursor.doubles()
    fixed = np.array(cursor.fixed, dtype=np.int64)
    return JointStateLayout(
        size=len(cursor.raw),
        order=cursor.order,
        names=names,
        stamp_at=stamp_at,
        position_at=position_at if n_positions == n and n else None,
        velocity_at=velocity_at if n_velocities == n and n else None,
        effort_at=effort_at if n_efforts == n and n else None,
        fixed=fixed,
        template=np.frombuffer(cursor.raw, dtype=np.uint8)[fixed],
    )


try:
    import apsw
    from rosbags import rosbag1, rosbag2
    from rosbags.rosbag2.storage_mcap import McapReader
    from rosbags.serde import SerdeError
    from rosbags.typesys import Stores, get_typestore
    from ruamel.yaml.error import YAMLError

    from manip_learn.recordings.readers.bag_contents import (
        BoundedDecompressor,
        McapContents,
        check_zstd,
        mcap_contents,
        refuse_other_counts,
        refuse_side_files,
        ros1_counts,
        sqlite_counts,
        unpacked_message,
    )
except ImportError as error:
    raise MissingExtraError("reading ROS bags", "ros") from error

LARGEST_METADATA = 10_000_000
# what the library was seen to raise on damaged bags, next to its own errors
DAMAGE = (
    rosbag1.ReaderError,
    rosbag2.ReaderError,
    SerdeError,
    YAMLError,
    apsw.Error,
    sqlite3.Error,
    struct.error,
    ArithmeticError,
    AssertionError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)


@final
@dataclass(frozen=True, eq=False)
class BagPart:
    """One file of a bag.

    Attributes:
        path: The file as the caller knows it.
        reader: The library's reader of this file.
        counts: Topic -> number of its messages in the file, counted without the library.
        packed: True if every message is compressed by itself.
    """

    path: Path
    reader: Any
    counts: Counter[str]
    packed: bool = False


@final
class BagFile:
    """An open bag.

    Attributes:
        path: File or folder.
        is_ros1: True for ROS 1.
        topics: Topic -> message type, all of them.
        joint_topics: Topics with JointState messages.
        notes: What was noticed when it was opened.
    """

    def __init__(
        self, path: Path, parts: list[BagPart], stated: dict[str, int] | None = None, notes: tuple[str, ...] = ()
    ):
        self.path = path
        self.is_ros1 = any(isinstance(p.reader, rosbag1.Reader) for p in parts)
        self.notes = notes
        self._parts = parts
        self._stated = stated
        connections = [c for p in parts for c in p.reader.connections]
        self.topics: dict[str, str] = {c.topic: c.msgtype for c in connections}
        self.joint_topics = tuple(dict.fromkeys(c.topic for c in connections if c.msgtype == JOINT_STATE))
        self._types = _typestore(is_ros1=self.is_ros1)

    def messages(self, topics: tuple[str, ...]) -> Iterator[tuple[str, str, int, bytes]]:
        """Topic, publisher, stamp of the recorder [ns] and bytes of every message, file by file in order of the stamps.

        The publisher is the caller of a ROS 1 connection; of an MCAP file it is the channel, where the channels of a
        topic differ in their metadata; else it is empty.

        Raises:
            RecordingError: At the end, if there were more or fewer messages than the bag states.
        """
        total: Counter[str] = Counter()
        for part in self._parts:
            found: Counter[str] = Counter()
            wanted = [c for c in part.reader.connections if c.topic in topics and c.msgtype == JOINT_STATE]
            publishers = {c.id: _publisher(c, part.reader) for c in wanted}
            for connection, stamp, raw in part.reader.messages(wanted) if wanted else ():
                found[connection.topic] += 1
                content = unpacked_message(part.path, raw) if part.packed else raw
                yield connection.topic, publishers[connection.id], stamp, content
            asked = {c.topic: part.counts[c.topic] for c in wanted}
            refuse_other_counts(part.path, found, asked, "its content")
            total += found
        if self._stated is not None:
            asked = {t: n for t, n in self._stated.items() if t in topics}
            refuse_other_counts(self.path, total, asked, "metadata.yaml")

    def layout(self, raw: bytes) -> JointStateLayout:
        """Where the numbers are in a message; checked against the library's own reading of it.

        Raises:
            ValueError: Not a JointState.
        """
        layout = ros1_layout(raw) if self.is_ros1 else cdr_layout(raw)
        message: Any = (
            self._types.deserialize_ros1(raw, JOINT_STATE)
            if self.is_ros1
            else self._types.deserialize_cdr(raw, JOINT_STATE)
        )
        if tuple(message.name) != layout.names:
            raise ValueError(f"the joint names are read as {tuple(message.name)} and as {layout.names}")
        self._compare(raw, layout, message)
        return layout

    @staticmethod
    def _compare(raw: bytes, layout: JointStateLayout, message: Any) -> None:
        for values, at in ((message.position, layout.position_at), (message.velocity, layout.velocity_at)):
            n = len(layout.names)
            expected = values.astype(layout.order + "f8").tobytes()
            if at is not None and raw[at : at + 8 * n] != expected:
                raise ValueError("the numbers of a message are read differently by the library")
        seconds, nanoseconds = struct.unpack_from(layout.order + "II", raw, layout.stamp_at)
        if (seconds, nanoseconds) != (message.header.stamp.sec % 2**32, message.header.stamp.nanosec):
            raise ValueError("the stamp of a message is read differently by the library")


@functools.cache  # it takes longer to build than a small bag to read
def _typestore(*, is_ros1: bool) -> Any:
    return get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)


def _publisher(connection: Any, reader: Any) -> str:
    if isinstance(reader, rosbag1.Reader):
        return connection.ext.callerid or ""
    if not isinstance(reader, McapReader):
        return ""
    of_topic = {i: c.metadata for i, c in reader.channels.items() if c.topic == connection.topic}
    first = min(i for i, metadata in of_topic.items() if metadata == of_topic[connection.id])
    return f"channel {first}" if len(set(of_topic.values())) > 1 else ""


@contextlib.contextmanager
def open_bag(path: Path) -> Iterator[BagFile]:
    """Open a bag; errors of the library inside the `with` block become refusals too.

    Raises:
        RecordingError: Damaged, encrypted, not indexed, or a bomb.
    """
    try:
        with contextlib.ExitStack() as stack:
            yield _opened(path, stack)
    except RecordingError:
        raise
    except (*DAMAGE, _zstd_error()) as error:
        raise refusal(
            path,
            "damaged",
            f"the bag cannot be read ({reason(error)}): repair it (`rosbag reindex`, `ros2 bag reindex`, "
            "`mcap recover`) or record it again",
        ) from error


def _zstd_error() -> type[Exception]:
    from rosbags.rosbag2.reader import zstd

    return zstd.ZstdError


def _opened(path: Path, stack: contextlib.ExitStack) -> BagFile:
    if path.is_dir():
        return _folder(path, stack)
    with path.open("rb") as file:
        head = file.read(16)
    if head.startswith(b"#ROSBAG"):
        return _ros1(path, stack)
    is_mcap = head.startswith(b"\x89MCAP")
    contents = mcap_contents(path) if is_mcap else None
    if not is_mcap:
        refuse_side_files(path)
    # the library goes by the extension, and its SQLite address cannot hold every character of a path
    folder = stack.enter_context(tempfile.TemporaryDirectory())
    link = Path(folder) / ("bag.mcap" if is_mcap else "bag.db3")
    link.symlink_to(path.resolve())
    reader: Any = rosbag2.Reader(link)
    reader.open()
    stack.callback(reader.close)
    counts = sqlite_counts(link, path, alone=True) if contents is None else contents.by_topic()
    return BagFile(path, [BagPart(path, reader.storage, counts)], notes=_checksum_notes([contents]))


def _ros1(path: Path, stack: contextlib.ExitStack) -> BagFile:
    reader = rosbag1.Reader(path)
    stack.callback(lambda: reader.close() if reader.bio is not None else None)
    reader.open()
    for position, chunk in reader.chunks.items():
        name = getattr(chunk.decompressor, "__module__", "") or ""
        if "bz2" in name or "lz4" in name:
            bounded = BoundedDecompressor(path, "bz2" if "bz2" in name else "lz4")
            reader.chunks[position] = chunk._replace(decompressor=bounded)
    counts = ros1_counts(path, {c.id: c.topic for c in reader.connections})
    return BagFile(path, [BagPart(path, reader, counts)])


def _folder(path: Path, stack: contextlib.ExitStack) -> BagFile:
    metadata = path / "metadata.yaml"
    if metadata.stat().st_size > LARGEST_METADATA:
        raise refusal(metadata, "too-large", f"larger than {LARGEST_METADATA:,} bytes", in_full=True)
    contents: dict[Path, McapContents] = {}
    for file in path.iterdir():
        if file.suffix == ".zstd":
            check_zstd(file)
        elif file.suffix == ".mcap":
            contents[file] = mcap_contents(file)
        elif file.suffix == ".db3":
            refuse_side_files(file)
    reader: Any = rosbag2.Reader(path)
    reader.open()
    stack.callback(reader.close)
    whole = reader.storage
    parts = []
    for storage in whole.storages:
        shown = path / storage.path.name
        if isinstance(storage, McapReader):
            if shown not in contents:
                contents[shown] = mcap_contents(Path(str(storage.path)))
            counts = contents[shown].by_topic()
        else:
            counts = sqlite_counts(Path(str(storage.path)), shown, alone=False)
        parts.append(BagPart(shown, storage, counts, packed=whole.metadata.compression_mode == "message"))
    stated: Counter[str] = Counter()
    for connection in whole.connections:
        stated[connection.topic] += connection.msgcount
    return BagFile(path, parts, dict(stated), _checksum_notes(contents.values()))


def _checksum_notes(contents: Iterable[McapContents | None]) -> tuple[str, ...]:
    found = [c for c in contents if c is not None]
    unchecked, chunks = sum(c.unchecked for c in found), sum(c.chunks for c in found)
    notes = []
    if unchecked:
        notes.append(f"{unchecked} of {chunks} chunks have no checksum: numbers that were damaged are not noticed")
    if any(c.stated is None for c in found):
        notes.append("the file states no number of messages: lost ones are not noticed")
    return tuple(notes)
