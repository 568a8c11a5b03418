"""A ROS 1 or ROS 2 bag, opened by the library `rosbags`, and what the library does not check.

Its readers of single files are used, and the usual definitions of messages: its `AnyReader` refuses a whole bag for one
foreign message whose definition is incomplete, and unpacks without bounds. Of a damaged bag the library gives what is
left without a word, so what was read is compared with every number that the bag states.
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
from struct import Struct
from typing import Any, final

from manip_learn.errors import DAMAGE, MissingExtraError, RecordingError
from manip_learn.recordings.format_words import JOINT_STATE, STAMPED_WRENCH, WRENCH
from manip_learn.recordings.readers.limits import bomb, metadata_text, most_bytes
from manip_learn.recordings.readers.recording import reason, refusal

try:
    import apsw
    import lz4.frame
    from rosbags import rosbag1, rosbag2
    from rosbags.rosbag1.reader import Header, RecordType, read_uint32
    from rosbags.rosbag2.reader import zstd  # the standard library's from Python 3.14 on, a package before
    from rosbags.rosbag2.storage_mcap import McapReader
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
    from rosbags.serde import SerdeError
    from rosbags.typesys import Stores, get_typestore
    from ruamel.yaml.error import YAMLError
except ImportError as error:
    raise MissingExtraError("reading ROS bags", "ros") from error

BLOCK = 1 << 20  # bytes
# of https://mcap.dev/spec: codes of records, the head of a record, and that of a chunk from its unpacked size on
FOOTER, CHUNK, STATISTICS = 2, 6, 11
RECORD, CHUNK_SIZES = Struct("<BQ"), Struct("<16xQII")
# what the library was seen to raise on damaged bags, next to what Python raises
BAG_DAMAGE = (
    *(rosbag1.ReaderError, rosbag2.ReaderError, SerdeError, YAMLError, apsw.Error, zstd.ZstdError),
    *(AssertionError, *DAMAGE),
)


@final
@dataclass(frozen=True, eq=False)
class BagFile:
    """An open bag.

    Attributes:
        path: File or folder.
        parts: Of each of its files the path as the caller knows it, the library's reader, and topic -> number of
            messages by what the file says of itself.
        stated: Topic -> number of messages, as metadata.yaml states it; empty without one.
        packed: True if every message is compressed by itself.
        notes: What was noticed when it was opened.
    """

    path: Path
    parts: list[tuple[Path, Any, Counter[str]]]
    stated: Counter[str]
    packed: bool = False
    notes: tuple[str, ...] = ()

    @property
    def topics(self) -> dict[str, str]:
        """Topic -> message type."""
        return {c.topic: c.msgtype for _, reader, _ in self.parts for c in reader.connections}

    def of_kind(self, *kinds: str) -> tuple[str, ...]:
        """Topics with messages of these types."""
        return tuple(topic for topic, kind in self.topics.items() if kind in kinds)

    def messages(self, topics: tuple[str, ...]) -> Iterator[tuple[str, str, str, int, Any]]:
        """Topic, type, publisher, stamp of the recorder [ns] and content of every message, by file and stamp.

        The publisher is the caller of a ROS 1 connection; of an MCAP file it is the channel, where the channels of a
        topic differ in their metadata; else it is empty.

        Raises:
            RecordingError: At the end, if there were more or fewer messages than the bag states.
        """
        total: Counter[str] = Counter()
        for path, reader, stated in self.parts:
            found: Counter[str] = Counter()
            kinds = (JOINT_STATE, WRENCH, STAMPED_WRENCH)
            wanted = [c for c in reader.connections if c.topic in topics and c.msgtype in kinds]
            publishers = {c.id: _publisher(c, reader) for c in wanted}
            deserialised = _deserialiser(is_ros1=isinstance(reader, rosbag1.Reader))
            for c, stamp, raw in reader.messages(wanted) if wanted else ():
                found[c.topic] += 1
                content = _bounded(path, zstd.ZstdDecompressor, raw) if self.packed else raw
                yield c.topic, c.msgtype, publishers[c.id], stamp, deserialised(content, c.msgtype)
            # what belongs to no topic has a name of its own
            asked = {t: n for t, n in stated.items() if t in topics or t not in self.topics}
            _refuse_other_counts(path, found, asked, "its content")
            total += found
        _refuse_other_counts(self.path, total, {t: n for t, n in self.stated.items() if t in topics}, "metadata.yaml")


@functools.cache  # a store of types takes longer to build than a small bag to read
def _deserialiser(*, is_ros1: bool) -> Callable[[bytes, str], Any]:
    types: Any = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    return types.deserialize_ros1 if is_ros1 else types.deserialize_cdr


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
            yield (_folder if path.is_dir() else _file)(path, stack)
    except BAG_DAMAGE as error:
        raise refusal(
            path,
            "damaged",
            f"the bag cannot be read ({reason(error)}): repair it (`rosbag reindex`, `ros2 bag reindex`, "
            "`mcap recover`) or record it again",
        ) from error


def _file(path: Path, stack: contextlib.ExitStack) -> BagFile:
    with path.open("rb") as file:
        head = file.read(8)
    suffix = ".bag" if head.startswith(b"#ROSBAG") else ".mcap" if head.startswith(b"\x89MCAP") else ".db3"
    scans = [_scanned(path)] if suffix == ".mcap" else []
    if suffix == ".db3":
        _refuse_side_files(path)
    # the library goes by the suffix, and its SQLite address cannot hold every character of a path
    link = Path(stack.enter_context(tempfile.TemporaryDirectory())) / f"bag{suffix}"
    link.symlink_to(path.resolve())
    reader: Any = rosbag1.Reader(link) if suffix == ".bag" else rosbag2.Reader(link)
    reader.open()
    stack.callback(reader.close)
    if suffix == ".bag":
        return BagFile(path, [(path, reader, _ros1_counts(path, reader))], Counter())
    storage = reader.storage
    counts = _mcap_counts(path, storage, scans[0][0]) if scans else _sqlite_counts(path, storage)
    return BagFile(path, [(path, storage, counts)], Counter(), notes=_scan_notes(scans))


def _folder(path: Path, stack: contextlib.ExitStack) -> BagFile:
    metadata_text(path / "metadata.yaml")
    scans: dict[Path, McapScan] = {}
    for file in path.iterdir():
        if file.suffix == ".zstd":
            _refuse_packed_bomb(file)
        elif file.suffix == ".mcap":
            scans[file] = _scanned(file)
        elif file.suffix == ".db3":
            _refuse_side_files(file)
    reader: Any = rosbag2.Reader(path)
    reader.open()
    stack.callback(reader.close)
    whole, parts = reader.storage, []
    for storage in whole.storages:
        shown = path / storage.path.name
        if isinstance(storage, Sqlite3Reader):
            parts.append((shown, storage, _sqlite_counts(shown, storage)))
            continue
        if shown not in scans:  # it was packed
            scans[shown] = _scanned(Path(str(storage.path)))
        parts.append((shown, storage, _mcap_counts(shown, storage, scans[shown][0])))
    stated = _by_topic((c.topic, c.msgcount) for c in whole.connections)
    packed = whole.metadata.compression_mode == "message"
    return BagFile(path, parts, stated, packed, _scan_notes([scans[shown] for shown, *_ in parts if shown in scans]))


def _by_topic(counts: Iterable[tuple[str, int]]) -> Counter[str]:
    return sum((Counter({topic: n}) for topic, n in counts), Counter())


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


def _bounded(path: Path, tool: Callable[[], Any], packed: bytes, claim: int | None = None) -> bytes:
    """What a block or a message unpacks to, but never more than it claims, or than is plausible."""
    most, unpacking = most_bytes(len(packed)) if claim is None else claim, tool()
    content = unpacking.decompress(packed, max_length=most + 1)
    if len(content) > most or (claim is not None and unpacking.unused_data):  # a second frame would be unpacked, too
        raise bomb(path, f"a block of {len(packed):,} bytes unpacks to more than {most:,}")
    return content


def _refuse_packed_bomb(path: Path) -> None:
    """Refuse a zstd file that unpacks to far more than its size."""
    most, total = most_bytes(path.stat().st_size), 0
    with zstd.open(path, "rb") as file:
        while block := file.read(BLOCK):
            total += len(block)
            if total > most:
                raise bomb(path, f"its {path.stat().st_size:,} bytes unpack to more than {most:,}")


# of an MCAP file: chunks, those without a checksum, and whether the file states numbers of messages
McapScan = tuple[int, int, bool]


def _scanned(path: Path) -> McapScan:
    """Go through the records; no chunk may unpack to more than it claims, which the library would believe."""
    tools = {b"lz4": lz4.frame.LZ4FrameDecompressor, b"zstd": zstd.ZstdDecompressor}
    chunks = unchecked = kind = 0
    has_statistics = False
    with path.open("rb") as file:
        file.seek(8)
        while kind != FOOTER:
            head = file.read(RECORD.size)
            if len(head) < RECORD.size:
                raise _damaged_mcap(path, "it ends without a footer, as the file of a recorder that was killed")
            kind, length = RECORD.unpack(head)
            has_statistics |= kind == STATISTICS
            if kind != CHUNK:
                file.seek(length, 1)
                continue
            chunk = file.read(length)
            size, checksum, n = CHUNK_SIZES.unpack_from(chunk)
            if size > most_bytes(length):
                raise bomb(path, f"a block of {length:,} bytes claims to unpack to {size:,}")
            name, packed = chunk[CHUNK_SIZES.size :][:n], chunk[CHUNK_SIZES.size + n + 8 :]
            if name in tools:
                _bounded(path, tools[name], packed, size)
            chunks, unchecked = chunks + 1, unchecked + (not checksum)
    return chunks, unchecked, has_statistics


def _scan_notes(scans: Iterable[McapScan]) -> tuple[str, ...]:
    chunks, unchecked, has_statistics = zip(*scans, strict=True) if scans else ((), (), ())
    notes = []
    if any(unchecked):
        said = f"{sum(unchecked)} of {sum(chunks)} chunks have no checksum"
        notes.append(f"{said}: numbers that were damaged are not noticed")
    if not all(has_statistics):
        notes.append("the file states no number of messages: lost ones are not noticed")
    return tuple(notes)


def _mcap_counts(path: Path, storage: Any, n_chunks: int) -> Counter[str]:
    """Messages per topic by the statistics, or by the index of the chunks, of which none may be missing."""
    if storage.chunks and len(storage.chunks) != n_chunks:
        raise _damaged_mcap(path, f"{n_chunks} chunks are there, its index has {len(storage.chunks)}")
    by_channel = Counter(storage.statistics.channel_message_counts)
    if not by_channel:  # the numbers by channel may be left out
        by_channel = sum((Counter(chunk.channel_count) for chunk in storage.chunks), Counter())
    total = storage.statistics.message_count
    if by_channel.total() != total:
        raise _damaged_mcap(path, f"its statistics state {total} messages, by channel {by_channel.total()}")
    names = {c.id: c.topic for c in storage.connections}
    return _by_topic((names.get(i, f"channel {i}"), n) for i, n in by_channel.items())


def _damaged_mcap(path: Path, text: str) -> RecordingError:
    help_ = "`mcap recover` (or `ros2 bag reindex` for the folder) keeps what is left"
    return refusal(path, "damaged", f"the MCAP file is damaged: {text}; {help_}")


def _ros1_counts(path: Path, reader: Any) -> Counter[str]:
    """Messages per topic by the index; every chunk must be in it, and every record whole. Chunks become bounded."""

    def damaged(text: str) -> RecordingError:
        return refusal(path, "damaged", f"the bag is damaged: {text}; `rosbag reindex` keeps what is left")

    size, chunks = path.stat().st_size, 0
    with path.open("rb") as file:
        file.readline()
        while (at := file.tell()) < size:
            kind, length = Header.read(file).get_uint8("op"), read_uint32(file)
            if file.tell() + length > size:
                raise damaged(f"the record at byte {at} ends after the file")
            chunks += kind == RecordType.CHUNK
            file.seek(length, 1)
    if chunks != len(reader.chunk_infos):
        raise damaged(f"it has {chunks} chunks, its header states {len(reader.chunk_infos)}")
    tools = {bz2.decompress: bz2.BZ2Decompressor, lz4.frame.decompress: lz4.frame.LZ4FrameDecompressor}
    for position, chunk in reader.chunks.items():
        if chunk.decompressor in tools:
            tool = functools.partial(_bounded, path, tools[chunk.decompressor])
            reader.chunks[position] = chunk._replace(decompressor=tool)
    names = {c.id: c.topic for c in reader.connections}
    stated = (pair for info in reader.chunk_infos for pair in info.connection_counts.items())
    return _by_topic((names.get(i, f"connection {i}"), n) for i, n in stated)


def _sqlite_counts(path: Path, storage: Any) -> Counter[str]:
    """Messages per topic in a database that SQLite finds sound."""
    (verdict,) = storage.dbconn.execute("PRAGMA integrity_check(1)").fetchone()
    if verdict != "ok":
        raise refusal(
            path,
            "damaged",
            f"the database is damaged: SQLite finds {' '.join(str(verdict).split())[:80]}; "
            f"`sqlite3 {path.name} .recover` and `ros2 bag reindex` keep what is left",
        )
    names = {c.id: c.topic for c in storage.connections}
    rows = storage.dbconn.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id")
    return _by_topic((names.get(i, "no topic"), n) for i, n in rows)


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
