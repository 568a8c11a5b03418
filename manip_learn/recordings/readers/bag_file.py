"""A ROS 1 or ROS 2 bag, opened by the library `rosbags`.

Its readers of single files are used, and the usual definitions of messages: its `AnyReader` refuses a whole bag for one
foreign message whose definition is incomplete. Of a damaged bag the library gives what is left without a word, so what
was read is compared with the numbers of messages that the bag states.
"""

from __future__ import annotations

import bz2
import contextlib
import functools
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from manip_learn.errors import DAMAGE, MissingExtraError
from manip_learn.recordings.format_words import JOINT_STATE
from manip_learn.recordings.readers.recording import bomb, check_regular, metadata_text, most_bytes, reason_of, refusal

try:
    import apsw
    import lz4.frame
    from rosbags import rosbag1, rosbag2
    from rosbags.rosbag2.reader import zstd  # the standard library's from Python 3.14 on, a package before
    from rosbags.rosbag2.storage_mcap import McapReader
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
    from rosbags.serde import SerdeError
    from rosbags.typesys import Stores, get_typestore
    from ruamel.yaml.error import YAMLError
except ImportError as error:
    raise MissingExtraError("reading ROS bags", "ros") from error

# what the library was seen to raise on damaged bags, next to what Python raises
BAG_DAMAGE = (
    *(rosbag1.ReaderError, rosbag2.ReaderError, SerdeError, YAMLError, apsw.Error, zstd.ZstdError),
    *(AssertionError, *DAMAGE),
)
_LOST = "the bag is damaged or a part of it is missing; copy it again, or run `ros2 bag reindex` to use what is left"


@final
@dataclass(frozen=True, eq=False)
class BagFile:
    """An open bag.

    Attributes:
        path: File or folder.
        parts: The library's reader of each of its files.
        stated: Topic -> number of messages, as the bag states it; empty where it states none.
        packed: True if every message is compressed by itself.
    """

    path: Path
    parts: list[Any]
    stated: Counter[str]
    packed: bool = False

    @property
    def topics(self) -> dict[str, str]:
        """Topic -> message type."""
        return {c.topic: c.msgtype for reader in self.parts for c in reader.connections}

    def messages(self, topics: tuple[str, ...]) -> Iterator[tuple[str, int, Any]]:
        """Topic, stamp of the recorder [ns] and content of every JointState, by file and stamp.

        Raises:
            RecordingError: At the end, if there were more or fewer messages than the bag states.
        """
        found: Counter[str] = Counter()
        for reader in self.parts:
            deserialised = _deserialiser(is_ros1=isinstance(reader, rosbag1.Reader))
            wanted = [c for c in reader.connections if c.topic in topics and c.msgtype == JOINT_STATE]
            for c, stamp, raw in reader.messages(wanted) if wanted else ():
                found[c.topic] += 1
                if self.packed:
                    _refuse_claim(self.path, raw, len(raw))
                yield c.topic, stamp, deserialised(zstd.decompress(raw) if self.packed else raw, c.msgtype)
        for topic in topics:
            if self.stated and found[topic] != (n := self.stated[topic]):
                said = f"{found[topic]} messages of {topic} are there, the bag states {n}: {_LOST}"
                raise refusal(self.path, "lost-messages", said)


@functools.cache  # a store of types takes longer to build than a small bag to read
def _deserialiser(*, is_ros1: bool) -> Callable[[bytes, str], Any]:
    types: Any = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    return types.deserialize_ros1 if is_ros1 else types.deserialize_cdr


@contextlib.contextmanager
def open_bag(path: Path) -> Iterator[BagFile]:
    """Open a bag; errors of the library inside the `with` block become refusals too.

    Raises:
        RecordingError: Damaged, encrypted, not indexed, or a bomb.
    """
    try:
        with contextlib.ExitStack() as stack:
            yield _opened(path, stack)
    except BAG_DAMAGE as error:
        parts = sorted(p for p in path.iterdir() if p.suffix in (".mcap", ".db3")) if path.is_dir() else []
        text = f"the bag cannot be read ({reason_of(error)}): repair it (`rosbag reindex`, `ros2 bag reindex`, "
        text += "`mcap recover`) or record it again"  # or files were renamed, or the metadata are those of others
        text += f", or give {parts[0]} itself" if parts else ""
        raise refusal(path, "damaged", text) from error


def _opened(path: Path, stack: contextlib.ExitStack) -> BagFile:
    place, files = path, list(path.iterdir()) if path.is_dir() else [path]
    for file in files:
        _check_before(file)
    is_ros1 = False
    if path.is_dir():
        metadata_text(path / "metadata.yaml")  # refuses one that is too large or too deep
    else:
        head = check_regular(path)
        is_ros1 = head.startswith(b"#ROSBAG")
        suffix = ".bag" if is_ros1 else ".mcap" if head.startswith(b"\x89MCAP") else ".db3"
        # the library goes by the suffix, and its SQLite address cannot hold every character of a path
        place = Path(stack.enter_context(tempfile.TemporaryDirectory())) / f"bag{suffix}"
        place.symlink_to(path.resolve())
    reader: Any = rosbag1.Reader(place) if is_ros1 else rosbag2.Reader(place)
    reader.open()
    stack.callback(reader.close)
    stated = Counter[str]()
    if is_ros1:
        # the library unpacks its blocks within bounds only
        tools = {bz2.decompress: bz2.BZ2Decompressor, lz4.frame.decompress: lz4.frame.LZ4FrameDecompressor}

        def bounded(tool: Callable[[], Any], packed: bytes) -> bytes:
            content = tool().decompress(packed, max_length=most_bytes(len(packed)) + 1)
            _refuse_size(path, len(content), len(packed))
            return content

        for position, chunk in reader.chunks.items():
            if chunk.decompressor in tools:
                tool: Any = functools.partial(bounded, tools[chunk.decompressor])
                reader.chunks[position] = chunk._replace(decompressor=tool)
        names = {c.id: c.topic for c in reader.connections}
        for number, n in (pair for info in reader.chunk_infos for pair in info.connection_counts.items()):
            stated[names.get(number, f"connection {number}")] += n
        return BagFile(path, [reader], stated)
    storage: Any = reader.storage
    parts = storage.storages if path.is_dir() else [storage]
    for part in parts:
        is_mcap, is_database = (isinstance(part, kind) for kind in (McapReader, Sqlite3Reader))
        for chunk in part.chunks if is_mcap else ():
            _refuse_size(path, chunk.uncompressed_size, chunk.compressed_size)
        if is_database:
            (verdict,) = part.dbconn.execute("PRAGMA integrity_check(1)").fetchone()
            if verdict != "ok":
                text = f"the database is damaged: SQLite finds {' '.join(str(verdict).split())[:80]}; `sqlite3 "
                text += f"{part.path.name} .recover` and `ros2 bag reindex` keep what is left"
                raise refusal(path, "damaged", text)
    statistics: Any = getattr(storage, "statistics", None)  # of an MCAP file
    if statistics is not None and not statistics.channel_message_counts:
        return BagFile(path, parts, stated)  # the numbers by channel may be left out
    for c in storage.connections:
        stated[c.topic] += c.msgcount
    if stated.total() != storage.metadata.message_count:
        said = f"of {storage.metadata.message_count} messages that the bag states {stated.total()} are of its topics"
        raise refusal(path, "lost-messages", f"{said}: {_LOST}")
    return BagFile(path, parts, stated, storage.metadata.compression_mode == "message")


def _refuse_size(path: Path, unpacked: int, packed: int) -> None:
    if unpacked > most_bytes(packed):
        raise bomb(path, f"a block of {packed:,} bytes claims to unpack to {unpacked:,}")


def _refuse_claim(path: Path, head: bytes, packed: int) -> None:
    """Refuse a frame of zstd, known by its beginning, that states to unpack to far more than its size."""
    _refuse_size(path, zstd.get_frame_info(head).decompressed_size or 0, packed)


def _check_before(file: Path) -> None:
    """Refuse a file of a bag that only stands for one, claims too much, or has a write-ahead log or journal beside it.

    The newest messages are in the log and not in the database yet.
    """
    head = b"" if file.is_dir() else check_regular(file)
    if file.suffix == ".zstd":
        _refuse_claim(file, head[:18], file.stat().st_size)  # the longest head of a frame
    for side in (file.with_name(file.name + end) for end in ("-wal", "-journal")):
        if side.is_file() and (size := side.stat().st_size):
            text = f"in a copy of the folder, put the last messages into the database: sqlite3 {file.name} 'PRAGMA "
            text += "wal_checkpoint(TRUNCATE); SELECT count(*) FROM messages;', then run `ros2 bag reindex` on the "
            text += f"folder. The recorder was killed, and they are in {side.name} only ({size:,} bytes)"
            raise refusal(file, "unfinished", text)
