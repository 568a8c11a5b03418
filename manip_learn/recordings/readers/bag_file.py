"""A ROS 1 or ROS 2 bag, opened for its joint states, and its messages counted apart from the library.

`rosbags.highlevel.AnyReader` reads the same files, and with damage it gives what is left without a word: packed blocks
are therefore unpacked only as far as is plausible, and what was read is held against every count that the bag states.
"""

from __future__ import annotations

import bz2
import contextlib
import functools
import os
import sqlite3
import struct
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final
from urllib.parse import quote

from manip_learn.errors import MissingExtraError, RecordingError
from manip_learn.recordings.readers.mcap_records import McapContents, mcap_contents
from manip_learn.recordings.readers.recording import bomb, most_bytes, reason, refusal
from manip_learn.recordings.writers.mcap_writer import JOINT_STATE, STAMPED_WRENCH, WRENCH

try:
    import apsw
    import lz4.frame
    from rosbags import rosbag1, rosbag2
    from rosbags.rosbag1.reader import Header, RecordType, read_uint32
    from rosbags.rosbag2.reader import zstd  # the standard library's from Python 3.14 on, a package before
    from rosbags.rosbag2.storage_mcap import McapReader
    from rosbags.serde import SerdeError
    from rosbags.typesys import Stores, get_typestore
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError
except ImportError as error:
    raise MissingExtraError("reading ROS bags", "ros") from error

BLOCK = 1 << 20  # bytes
KINDS = (JOINT_STATE, WRENCH, STAMPED_WRENCH)  # of messages that are read

LARGEST_METADATA = 10_000_000  # bytes; it lists topics, not messages
# what the library was seen to raise on damaged bags, next to its own errors
DAMAGE = (
    *(rosbag1.ReaderError, rosbag2.ReaderError, SerdeError, YAMLError, apsw.Error, sqlite3.Error, zstd.ZstdError),
    *(struct.error, ArithmeticError, AssertionError, AttributeError, EOFError, LookupError, MemoryError, OSError),
    *(RuntimeError, TypeError, ValueError),
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
        wrench_topics: Topics with Wrench or WrenchStamped messages.
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
        self.wrench_topics = tuple(t for t, kind in self.topics.items() if kind in (WRENCH, STAMPED_WRENCH))

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
            wanted = [c for c in part.reader.connections if c.topic in topics and c.msgtype in KINDS]
            publishers = {c.id: _publisher(c, part.reader) for c in wanted}
            for connection, stamp, raw in part.reader.messages(wanted) if wanted else ():
                found[connection.topic] += 1
                content = _bounded(part.path, zstd.ZstdDecompressor, raw) if part.packed else raw
                yield connection.topic, publishers[connection.id], stamp, content
            asked = {c.topic: part.counts[c.topic] for c in wanted}
            _refuse_other_counts(part.path, found, asked, "its content")
            total += found
        if self._stated is not None:
            asked = {t: n for t, n in self._stated.items() if t in topics}
            _refuse_other_counts(self.path, total, asked, "metadata.yaml")

    def deserialised(self, raw: bytes, kind: str = JOINT_STATE) -> object:
        """A message as the library reads it."""
        types = _typestore(is_ros1=self.is_ros1)
        return (types.deserialize_ros1 if self.is_ros1 else types.deserialize_cdr)(raw, kind)


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
    except DAMAGE as error:
        raise refusal(
            path,
            "damaged",
            f"the bag cannot be read ({reason(error)}): repair it (`rosbag reindex`, `ros2 bag reindex`, "
            "`mcap recover`) or record it again",
        ) from error


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
        _refuse_side_files(path)
    # the library goes by the extension, and its SQLite address cannot hold every character of a path
    folder = stack.enter_context(tempfile.TemporaryDirectory())
    link = Path(folder) / ("bag.mcap" if is_mcap else "bag.db3")
    link.symlink_to(path.resolve())
    reader: Any = rosbag2.Reader(link)
    reader.open()
    stack.callback(reader.close)
    counts = _sqlite_counts(link, path, alone=True) if contents is None else contents.by_topic()
    return BagFile(path, [BagPart(path, reader.storage, counts)], notes=_checksum_notes([contents]))


def _ros1(path: Path, stack: contextlib.ExitStack) -> BagFile:
    reader = rosbag1.Reader(path)
    stack.callback(lambda: reader.close() if reader.bio is not None else None)
    reader.open()
    for position, chunk in reader.chunks.items():
        module = str(getattr(chunk.decompressor, "__module__", ""))
        for name, tool in (("bz2", bz2.BZ2Decompressor), ("lz4", lz4.frame.LZ4FrameDecompressor)):
            if name in module:
                reader.chunks[position] = chunk._replace(decompressor=functools.partial(_bounded, path, tool))
    counts = _ros1_counts(path, {c.id: c.topic for c in reader.connections})
    return BagFile(path, [BagPart(path, reader, counts)])


def _folder(path: Path, stack: contextlib.ExitStack) -> BagFile:
    metadata = path / "metadata.yaml"
    if metadata.stat().st_size > LARGEST_METADATA:
        raise refusal(metadata, "too-large", f"larger than {LARGEST_METADATA:,} bytes", in_full=True)
    contents: dict[Path, McapContents] = {}
    for file in path.iterdir():
        if file.suffix == ".zstd":
            _check_zstd(file)
        elif file.suffix == ".mcap":
            contents[file] = mcap_contents(file)
        elif file.suffix == ".db3":
            _refuse_side_files(file)
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
            counts = _sqlite_counts(Path(str(storage.path)), shown, alone=False)
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


def _bounded(path: Path, tool: Callable[[], Any], packed: bytes) -> bytes:
    """What a block or a message unpacks to, but never more than is plausible."""
    most = most_bytes(len(packed))
    content = tool().decompress(packed, max_length=most + 1)
    if len(content) > most:
        raise bomb(path, f"a block of {len(packed):,} bytes unpacks to more than {most:,}")
    return content


def _check_zstd(path: Path) -> None:
    """Refuse a zstd file that unpacks to far more than its size."""
    most, total = most_bytes(path.stat().st_size), 0
    with zstd.open(path, "rb") as file:
        while block := file.read(BLOCK):
            total += len(block)
            if total > most:
                raise bomb(path, f"its {path.stat().st_size:,} bytes unpack to more than {most:,}")


def _ros1_counts(path: Path, topics: dict[int, str]) -> Counter[str]:
    """Messages per topic of a ROS 1 bag, by its chunk information, which must agree with the index of every chunk."""
    seen: Counter[int] = Counter()
    indexed: Counter[int] = Counter()
    stated: Counter[int] = Counter()
    size = path.stat().st_size
    with path.open("rb") as file:
        file.readline()
        first = Header.read(file, RecordType.BAGHEADER)
        file.seek(read_uint32(file), os.SEEK_CUR)
        while (at := file.tell()) < size:
            header = Header.read(file)
            kind, length = header.get_uint8("op"), read_uint32(file)
            start = file.tell()
            if start + length > size:
                raise _damaged_bag(path, f"the record at byte {at} ends after the file")
            seen[kind] += 1
            if kind == RecordType.IDXDATA:
                indexed[header.get_uint32("conn")] += header.get_uint32("count")
            elif kind == RecordType.CHUNK_INFO:
                for _ in range(header.get_uint32("count")):
                    connection, count = read_uint32(file), read_uint32(file)
                    stated[connection] += count
            file.seek(start + length)
    for what, kind, field in (
        ("chunks", RecordType.CHUNK, "chunk_count"),
        ("chunks in the index", RecordType.CHUNK_INFO, "chunk_count"),
        ("connections", RecordType.CONNECTION, "conn_count"),
    ):
        if seen[kind] != (n := first.get_uint32(field)):
            raise _damaged_bag(path, f"it has {seen[kind]} {what}, its header states {n}")
    for connection in sorted(set(indexed) | set(stated)):
        if indexed[connection] != stated[connection]:
            name = topics.get(connection, f"connection {connection}")
            raise _damaged_bag(
                path, f"its chunks index {indexed[connection]} messages of {name}, it states {stated[connection]}"
            )
    return _by_topic(stated, topics)


def _damaged_bag(path: Path, text: str) -> RecordingError:
    return refusal(path, "damaged", f"the bag is damaged: {text}; `rosbag reindex` keeps what is left")


def _sqlite_counts(path: Path, shown: Path, *, alone: bool) -> Counter[str]:
    """Messages per topic in a rosbag2 database that SQLite finds sound; `shown` is what an error calls it.

    A database that stands alone, without metadata.yaml, must agree with the copy of that file in itself.
    """
    database = sqlite3.connect(f"file:{quote(str(path))}?mode=ro&immutable=1", uri=True)
    try:
        (verdict,) = database.execute("PRAGMA integrity_check(1)").fetchone()
        topics = dict(database.execute("SELECT id, name FROM topics"))
        counted = Counter(
            dict(database.execute("SELECT topic_id, count(*) FROM messages NOT INDEXED GROUP BY topic_id"))
        )
        tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        row = None
        if alone and "metadata" in tables:
            row = database.execute("SELECT metadata FROM metadata ORDER BY id DESC LIMIT 1").fetchone()
    finally:
        database.close()
    if verdict != "ok":
        raise _damaged_database(shown, f"SQLite finds {' '.join(str(verdict).split())[:80]}")
    lost = set(counted) - set(topics)
    if lost:
        raise _damaged_database(shown, f"{sum(counted[i] for i in lost)} messages belong to no topic")
    by_topic = _by_topic(counted, topics)
    stated = _stated(row[0]) if row is not None else None
    if stated is not None:
        _refuse_other_counts(shown, by_topic, stated, "its own metadata")
    return by_topic


def _damaged_database(path: Path, text: str) -> RecordingError:
    return refusal(
        path,
        "damaged",
        f"the database is damaged: {text}; `sqlite3 {path.name} .recover` and `ros2 bag reindex` keep what is left",
    )


def _stated(text: str) -> dict[str, int] | None:
    """Messages per topic in the metadata of a bag of one file, which a recorder that was killed has not filled in."""
    content: Any = YAML(typ="safe").load(text)
    content = content.get("rosbag2_bagfile_information", content) if isinstance(content, dict) else {}
    if not content.get("message_count") or len(content.get("relative_file_paths", ())) != 1:
        return None
    return {t["topic_metadata"]["name"]: int(t["message_count"]) for t in content["topics_with_message_count"]}


def _refuse_other_counts(path: Path, found: Counter[str], stated: dict[str, int], source: str) -> None:
    """Refuse a bag with more or fewer messages of a topic than it states."""
    for topic, n in stated.items():
        if found[topic] != n:
            raise refusal(
                path,
                "lost-messages",
                f"{found[topic]} messages of {topic} are there, {source} states {n}: the bag is damaged "
                "or a part of it is missing; copy it again, or run `ros2 bag reindex` to use what is left",
            )


def _refuse_side_files(path: Path) -> None:
    """Refuse a database with a write-ahead log or journal: its newest messages are not in the database yet."""
    for end in ("-wal", "-journal"):
        side = path.with_name(path.name + end)
        if side.is_file() and side.stat().st_size:
            raise refusal(
                path,
                "unfinished",
                f"in a copy of the folder, put the last messages into the database: sqlite3 {path.name} "
                "'PRAGMA wal_checkpoint(TRUNCATE); SELECT count(*) FROM messages;', then run `ros2 bag reindex` on the "
                f"folder. The recorder was killed, and they are in {side.name} only ({side.stat().st_size:,} bytes)",
            )


def _by_topic(counts: Counter[int], topics: dict[int, str]) -> Counter[str]:
    found: Counter[str] = Counter()
    for i, n in counts.items():
        found[topics.get(i, f"connection {i}")] += n
    return found
