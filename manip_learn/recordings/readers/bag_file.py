"""A ROS 1 or ROS 2 bag, opened for its joint states; bombs are refused, the exceptions of the library become one."""

from __future__ import annotations

import bz2
import contextlib
import sqlite3
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol, final

from manip_learn.errors import MissingExtraError, RecordingError
from manip_learn.recordings.readers.joint_state_layout import JointStateLayout, cdr_layout, ros1_layout
from manip_learn.recordings.readers.recording import reason

try:
    import apsw
    import lz4.frame
    from rosbags import rosbag1, rosbag2
    from rosbags.rosbag2.storage_mcap import McapReader
    from rosbags.serde import SerdeError
    from rosbags.typesys import Stores, get_typestore
    from ruamel.yaml.error import YAMLError
except ImportError as error:
    raise MissingExtraError("reading ROS bags", "ros") from error

ALWAYS_FINE, BOMB_RATIO = 50_000_000, 200  # bytes, and how much smaller packed
MCAP_MAGIC = b"\x89MCAP0\r\n"
MCAP_CHUNK = 0x06
BLOCK = 1 << 20
JOINT_STATE = "sensor_msgs/msg/JointState"
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


class _Decompressor(Protocol):
    def decompress(self, data: bytes, max_length: int = -1) -> bytes: ...


def most_bytes(packed: int) -> int:
    """Bytes that a packed block may unpack to."""
    return max(ALWAYS_FINE, BOMB_RATIO * packed)


@final
class BoundedDecompressor:
    """Unpacks one block of a ROS 1 bag, but never more than is plausible."""

    def __init__(self, path: Path, compression: str):
        self._path, self._compression = path, compression

    def __call__(self, data: bytes) -> bytes:
        """The unpacked block.

        Raises:
            RecordingError: It unpacks to more than 200 times its size and more than 50 MB.
        """
        most = most_bytes(len(data))
        tool: _Decompressor = bz2.BZ2Decompressor() if self._compression == "bz2" else lz4.frame.LZ4FrameDecompressor()
        content = tool.decompress(data, max_length=most + 1)
        if len(content) > most:
            raise bomb(self._path, f"a block of {len(data):,} bytes unpacks to more than {most:,}")
        return content


def check_mcap(path: Path) -> None:
    """Refuse an MCAP file whose blocks unpack, or claim to unpack, to far more than their size.

    Raises:
        RecordingError: A bomb.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(len(MCAP_MAGIC))
        while file.tell() + 9 <= size:
            code, length = struct.unpack("<BQ", file.read(9))
            start = file.tell()
            if code == MCAP_CHUNK:
                head = file.read(min(length, 32 + 4 + 64))
                if len(head) < 40:
                    return  # cut off: the reader says so
                (unpacked,) = struct.unpack_from("<Q", head, 16)
                if unpacked > most_bytes(length):
                    raise bomb(path, f"a block of {length:,} bytes claims to unpack to {unpacked:,}")
                (name_length,) = struct.unpack_from("<I", head, 28)
                compression = head[32 : 32 + name_length]
                if compression in (b"lz4", b"zstd"):
                    file.seek(start + 40 + name_length)
                    _check_claim(path, compression, file.read(max(length - 40 - name_length, 0)), unpacked)
            file.seek(start + length)


def _check_claim(path: Path, compression: bytes, packed: bytes, unpacked: int) -> None:
    """Refuse a block that unpacks to more than it claims; the library believes the claim."""
    from rosbags.rosbag2.reader import zstd

    tool: _Decompressor = lz4.frame.LZ4FrameDecompressor() if compression == b"lz4" else zstd.ZstdDecompressor()
    content = tool.decompress(packed, max_length=unpacked + 1)
    # a second frame behind the first would be unpacked as well
    if len(content) > unpacked or getattr(tool, "unused_data", b""):
        raise bomb(path, f"a block of {len(packed):,} bytes claims to unpack to {unpacked:,}, but there is more in it")


def check_zstd(path: Path) -> None:
    """Refuse a zstd file that unpacks to far more than its size.

    Raises:
        RecordingError: A bomb.
    """
    from rosbags.rosbag2.reader import zstd  # the standard library's from Python 3.14 on, a package before

    most, total = most_bytes(path.stat().st_size), 0
    with zstd.open(path, "rb") as file:
        while block := file.read(BLOCK):
            total += len(block)
            if total > most:
                raise bomb(path, f"its {path.stat().st_size:,} bytes unpack to more than {most:,}")


def bomb(path: Path, evidence: str) -> RecordingError:
    """The refusal of a file that unpacks to far too much."""
    return RecordingError(
        f"{path.name}: {evidence}: no recorded motion packs so well; if it is real, unpack it yourself first",
        code="bomb",
        path=path,
    )


@final
class BagFile:
    """An open bag.

    Attributes:
        path: File or folder.
        is_ros1: True for ROS 1.
        topics: Topic -> message type, all of them.
        joint_topics: Topics with JointState messages.
    """

    def __init__(self, path: Path, reader: Any, *, is_ros1: bool):
        self.path = path
        self.is_ros1 = is_ros1
        self._reader = reader
        self._connections = [c for c in reader.connections if c.msgtype == JOINT_STATE]
        self.topics: dict[str, str] = {c.topic: c.msgtype for c in reader.connections}
        self.joint_topics: tuple[str, ...] = tuple(dict.fromkeys(c.topic for c in self._connections))
        self._types = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)

    def messages(self, topics: tuple[str, ...]) -> Iterator[tuple[str, str, int, bytes]]:
        """Topic, publisher, stamp of the recorder [ns] and bytes of every message, in the order of these stamps.

        The publisher is the caller of a ROS 1 connection; of an MCAP file it is the channel, where the channels of a
        topic differ in their metadata; else it is empty.
        """
        wanted = [c for c in self._connections if c.topic in topics]
        publishers = {c.id: _publisher(c, self._reader) for c in wanted}
        for connection, stamp, raw in self._reader.messages(connections=wanted):
            yield connection.topic, publishers[connection.id], stamp, raw

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


def _publisher(connection: Any, reader: Any) -> str:
    if isinstance(reader, rosbag1.Reader):
        return connection.ext.callerid or ""
    storage = reader.storage
    if not isinstance(storage, McapReader):
        return ""
    of_topic = {i: c.metadata for i, c in storage.channels.items() if c.topic == connection.topic}
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
        raise RecordingError(
            f"{path.name}: the bag cannot be read ({reason(error)}): repair it (`rosbag reindex`, `ros2 bag reindex`, "
            "`mcap recover`) or record it again",
            code="damaged",
            path=path,
        ) from error


def _zstd_error() -> type[Exception]:
    from rosbags.rosbag2.reader import zstd

    return zstd.ZstdError


def _opened(path: Path, stack: contextlib.ExitStack) -> BagFile:
    if path.is_dir():
        _check_folder(path)
        reader: Any = rosbag2.Reader(path)
    else:
        with path.open("rb") as file:
            head = file.read(16)
        if head.startswith(b"#ROSBAG"):
            reader1 = rosbag1.Reader(path)
            stack.callback(lambda: reader1.close() if reader1.bio is not None else None)
            reader1.open()
            for position, chunk in reader1.chunks.items():
                name = getattr(chunk.decompressor, "__module__", "") or ""
                if "bz2" in name or "lz4" in name:
                    bounded = BoundedDecompressor(path, "bz2" if "bz2" in name else "lz4")
                    reader1.chunks[position] = chunk._replace(decompressor=bounded)
            return BagFile(path, reader1, is_ros1=True)
        is_mcap = head.startswith(b"\x89MCAP")
        if is_mcap:
            check_mcap(path)
        # the library goes by the extension, and its SQLite address cannot hold every character of a path
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        link = Path(folder) / ("bag.mcap" if is_mcap else "bag.db3")
        link.symlink_to(path.resolve())
        reader = rosbag2.Reader(link)
    reader.open()
    stack.callback(reader.close)
    return BagFile(path, reader, is_ros1=False)


def _check_folder(path: Path) -> None:
    metadata = path / "metadata.yaml"
    if metadata.stat().st_size > LARGEST_METADATA:
        raise RecordingError(f"{metadata}: larger than {LARGEST_METADATA:,} bytes", code="too-large", path=metadata)
    for file in path.iterdir():
        if file.suffix == ".zstd":
            check_zstd(file)
        elif file.suffix == ".mcap":
            check_mcap(file)
