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
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from manip_learn.errors import DAMAGE, MissingExtraError
from manip_learn.recordings.format_words import JOINT_STATE
from manip_learn.recordings.readers.limits import bomb, metadata_text, most_bytes
from manip_learn.recordings.readers.recording import check_regular, reason, refusal

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
LOST = "the bag is damaged or a part of it is missing; copy it again, or run `ros2 bag reindex` to use what is left"


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
                said = f"{found[topic]} messages of {topic} are there, the bag states {n}: {LOST}"
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
        alone = f", or give {parts[0]} itself" if parts else ""  # files that were renamed, or metadata of others
        raise refusal(
            path,
            "damaged",
            f"the bag cannot be read ({reason(error)}): repair it (`rosbag reindex`, `ros2 bag reindex`, "
            f"`mcap recover`) or record it again{alone}",
        ) from error


def _opened(path: Path, stack: contextlib.ExitStack) -> BagFile:
    place, head = path, b""
    if path.is_dir():
        metadata_text(path / "metadata.yaml")  # refuses one that is too large or too deep
        for file in path.iterdir():
            if file.is_file():
                check_regular(file)
            _check_before(file)
    else:
        with path.open("rb") as opened:
            head = opened.read(8)
        suffix = ".bag" if head.startswith(b"#ROSBAG") else ".mcap" if head.startswith(b"\x89MCAP") else ".db3"
        _check_before(path)
        # the library goes by the suffix, and its SQLite address cannot hold every character of a path
        place = Path(stack.enter_context(tempfile.TemporaryDirectory())) / f"bag{suffix}"
        place.symlink_to(path.resolve())
    reader: Any = rosbag1.Reader(place) if head.startswith(b"#ROSBAG") else rosbag2.Reader(place)
    reader.open()
    stack.callback(reader.close)
    if isinstance(reader, rosbag1.Reader):
        return _ros1(path, reader)
    storage: Any = reader.storage
    parts = storage.storages if path.is_dir() else [storage]
    for part in parts:
        if isinstance(part, McapReader):
            for chunk in part.chunks:
                _refuse_size(path, chunk.uncompressed_size, chunk.compressed_size)
        elif isinstance(part, Sqlite3Reader):
            _check_database(path, part)
    stated = _by_topic((c.topic, c.msgcount) for c in storage.connections)
    statistics: Any = getattr(storage, "statistics", None)  # of an MCAP file
    if statistics is not None and not statistics.channel_message_counts:
        return BagFile(path, parts, Counter())  # the numbers by channel may be left out
    if stated.total() != storage.metadata.message_count:
        said = f"of {storage.metadata.message_count} messages that the bag states {stated.total()} are of its topics"
        raise refusal(path, "lost-messages", f"{said}: {LOST}")
    return BagFile(path, parts, stated, storage.metadata.compression_mode == "message")


def _by_topic(counts: Iterable[tuple[str, int]]) -> Counter[str]:
    return sum((Counter({topic: n}) for topic, n in counts), Counter())


def _ros1(path: Path, reader: rosbag1.Reader) -> BagFile:
    """A bag whose chunks are unpacked within bounds, and what their index states."""
    tools = {bz2.decompress: bz2.BZ2Decompressor, lz4.frame.decompress: lz4.frame.LZ4FrameDecompressor}

    def bounded(tool: Callable[[], Any], packed: bytes) -> bytes:
        most = most_bytes(len(packed))
        content = tool().decompress(packed, max_length=most + 1)
        _refuse_size(path, len(content), len(packed))
        return content

    for position, chunk in reader.chunks.items():
        if chunk.decompressor in tools:
            tool: Any = functools.partial(bounded, tools[chunk.decompressor])
            reader.chunks[position] = chunk._replace(decompressor=tool)
    names = {c.id: c.topic for c in reader.connections}
    stated = (pair for info in reader.chunk_infos for pair in info.connection_counts.items())
    return BagFile(path, [reader], _by_topic((names.get(i, f"connection {i}"), n) for i, n in stated))


def _refuse_size(path: Path, unpacked: int, packed: int) -> None:
    """Refuse a block that unpacks to far more than its size."""
    if unpacked > most_bytes(packed):
        raise bomb(path, f"a block of {packed:,} bytes claims to unpack to {unpacked:,}")


def _refuse_claim(path: Path, head: bytes, packed: int) -> None:
    """Refuse a frame of zstd, known by its beginning, that states to unpack to far more than its size."""
    _refuse_size(path, zstd.get_frame_info(head).decompressed_size or 0, packed)


def _check_before(file: Path) -> None:
    """Refuse a packed file that claims too much, and a database with a write-ahead log or journal beside it.

    The newest messages are in the log and not in the database yet.
    """
    if file.suffix == ".zstd":
        with file.open("rb") as opened:
            _refuse_claim(file, opened.read(18), file.stat().st_size)  # the longest head of a frame
    for end in ("-wal", "-journal"):
        side = file.with_name(file.name + end)
        if side.is_file() and side.stat().st_size:
            raise refusal(
                file,
                "unfinished",
                f"in a copy of the folder, put the last messages into the database: sqlite3 {file.name} "
                "'PRAGMA wal_checkpoint(TRUNCATE); SELECT count(*) FROM messages;', then run `ros2 bag reindex` on the "
                f"folder. The recorder was killed, and they are in {side.name} only ({side.stat().st_size:,} bytes)",
            )


def _check_database(path: Path, storage: Any) -> None:
    """Refuse a database that SQLite finds unsound."""
    (verdict,) = storage.dbconn.execute("PRAGMA integrity_check(1)").fetchone()
    if verdict != "ok":
        raise refusal(
            path,
            "damaged",
            f"the database is damaged: SQLite finds {' '.join(str(verdict).split())[:80]}; "
            f"`sqlite3 {storage.path.name} .recover` and `ros2 bag reindex` keep what is left",
        )
