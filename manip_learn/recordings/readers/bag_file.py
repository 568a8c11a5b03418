"""A ROS 1 or ROS 2 bag, opened for its joint states; the library's many exceptions become one."""

from __future__ import annotations

import contextlib
import sqlite3
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, final

from manip_learn.errors import MissingExtraError, RecordingError
from manip_learn.recordings.readers.bag_safety import BoundedDecompressor, check_mcap, check_zstd
from manip_learn.recordings.readers.joint_state_layout import JointStateLayout, cdr_layout, ros1_layout
from manip_learn.recordings.readers.reason import reason

try:
    import apsw
    from rosbags import rosbag1, rosbag2
    from rosbags.serde import SerdeError
    from rosbags.typesys import Stores, get_typestore
    from ruamel.yaml.error import YAMLError
except ImportError as error:
    raise MissingExtraError("reading ROS bags", "ros") from error

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

    def messages(self, topics: tuple[str, ...]) -> Iterator[tuple[str, int, bytes]]:
        """Topic, stamp of the recorder [ns] and bytes of every message, in the order of the recorder's stamps."""
        wanted = [c for c in self._connections if c.topic in topics]
        for connection, stamp, raw in self._reader.messages(connections=wanted):
            yield connection.topic, stamp, raw

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
