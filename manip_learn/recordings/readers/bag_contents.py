"""What a bag holds, counted apart from the library; packed blocks are unpacked only as far as is plausible.

Layout of MCAP records: https://mcap.dev/spec.
"""

from __future__ import annotations

import bz2
import os
import sqlite3
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, final
from urllib.parse import quote

import lz4.frame
from rosbags.rosbag1.reader import Header, RecordType, read_uint32
from ruamel.yaml import YAML

from manip_learn.errors import RecordingError
from manip_learn.recordings.readers.recording import refusal
from manip_learn.recordings.writers.joint_state_messages import (
    CHANNEL,
    CHUNK,
    FOOTER,
    MAGIC,
    MESSAGE,
    SCHEMA,
    STATISTICS,
)

ALWAYS_FINE, BOMB_RATIO = 50_000_000, 200  # bytes, and how much smaller packed
BLOCK = 1 << 20


def most_bytes(packed: int) -> int:
    """Bytes that a packed block may unpack to."""
    return max(ALWAYS_FINE, BOMB_RATIO * packed)


def bomb(path: Path, evidence: str) -> RecordingError:
    """The refusal of a file that unpacks to far too much."""
    return refusal(
        path, "bomb", f"{evidence}: no recorded motion packs so well; if it is real, unpack it yourself first"
    )


class _Decompressor(Protocol):
    def decompress(self, data: bytes, max_length: int = -1) -> bytes: ...


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


def unpacked_message(path: Path, packed: bytes) -> bytes:
    """A message that was compressed by itself.

    Raises:
        RecordingError: A bomb.
    """
    from rosbags.rosbag2.reader import zstd

    most = most_bytes(len(packed))
    content = zstd.ZstdDecompressor().decompress(packed, max_length=most + 1)
    if len(content) > most:
        raise bomb(path, f"a message of {len(packed):,} bytes unpacks to more than {most:,}")
    return content


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


SIDE_FILES = ("-wal", "-journal")


def ros1_counts(path: Path, topics: dict[int, str]) -> Counter[str]:
    """Messages per topic of a ROS 1 bag, by its chunk information, which must agree with the index of every chunk.

    Args:
        path: The bag.
        topics: Connection -> topic.

    Raises:
        RecordingError: Chunks, connections or messages that one part of the file states and another one has not.
    """
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
    for what, kind, n in (
        ("chunks", RecordType.CHUNK, first.get_uint32("chunk_count")),
        ("chunks in the index", RecordType.CHUNK_INFO, first.get_uint32("chunk_count")),
        ("connections", RecordType.CONNECTION, first.get_uint32("conn_count")),
    ):
        if seen[kind] != n:
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


def sqlite_counts(path: Path, shown: Path, *, alone: bool) -> Counter[str]:
    """Messages per topic in a rosbag2 database, once SQLite has found it sound.

    Args:
        path: The database.
        shown: What the message calls it.
        alone: True if there is no metadata.yaml: then the copy in the database itself must agree.

    Raises:
        RecordingError: Damaged, messages of topics that are missing, or more or fewer messages than stated.
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
        refuse_other_counts(shown, by_topic, stated, "its own metadata")
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


def refuse_other_counts(path: Path, found: Counter[str], stated: dict[str, int], source: str) -> None:
    """Refuse a bag with more or fewer messages of a topic than it states.

    Raises:
        RecordingError: Code `lost-messages`.
    """
    for topic, n in stated.items():
        if found[topic] != n:
            raise refusal(
                path,
                "lost-messages",
                f"{found[topic]} messages of {topic} are there, {source} states {n}: the bag is damaged "
                "or a part of it is missing; copy it again, or run `ros2 bag reindex` to use what is left",
            )


def refuse_side_files(path: Path) -> None:
    """Refuse a database with a write-ahead log or journal: its newest messages are not in the database yet.

    Raises:
        RecordingError: Code `unfinished`.
    """
    for end in SIDE_FILES:
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


HEAD = 9  # bytes of a record in front of its content: its kind and length


@final
@dataclass
class McapContents:
    """What was found in the records.

    Attributes:
        topics: Channel -> topic.
        messages: Channel -> number of messages.
        stated: The same, as the file's own statistics say; None without them.
        chunks: Number of chunks.
        stated_chunks: The same, as the statistics say.
        unchecked: Chunks without a checksum.
    """

    topics: dict[int, str] = field(default_factory=dict)
    messages: Counter[int] = field(default_factory=Counter)
    stated: dict[int, int] | None = None
    chunks: int = 0
    stated_chunks: int = 0
    unchecked: int = 0

    def by_topic(self) -> Counter[str]:
        """Topic -> number of messages."""
        return Counter(
            {t: sum(self.messages[i] for i, u in self.topics.items() if u == t) for t in self.topics.values()}
        )


def mcap_contents(path: Path) -> McapContents:
    """Everything that the file holds.

    Raises:
        RecordingError: A bomb (blocks that unpack, or claim to unpack, to far more than their size), records that do
            not fit into the file, or messages that the file's statistics do not have, or the other way round.
    """
    found = McapContents()
    end = path.stat().st_size - len(MAGIC)
    with path.open("rb") as file:
        file.seek(len(MAGIC))
        kind = 0
        while kind != FOOTER:
            start = file.tell()
            head = file.read(HEAD)
            if len(head) < HEAD:
                raise _damaged_mcap(path, "it ends without a footer, as the file of a recorder that was killed")
            kind, length = struct.unpack("<BQ", head)
            if start + HEAD + length > end:
                raise _damaged_mcap(path, f"the record at byte {start} ends after the file")
            if kind == CHUNK:
                _read_chunk(path, found, file.read(length))
            elif kind in (CHANNEL, MESSAGE, STATISTICS, FOOTER):
                _read_record(path, found, kind, file.read(length))
            else:
                file.seek(length, 1)
        if file.tell() != end:
            raise _damaged_mcap(path, f"there are {end - file.tell()} bytes after its footer")
    _compare(path, found)
    return found


def _read_chunk(path: Path, found: McapContents, chunk: bytes) -> None:
    found.chunks += 1
    if len(chunk) < 40:
        raise _damaged_mcap(path, f"a chunk has {len(chunk)} bytes only")
    unpacked, checksum, name_length = struct.unpack_from("<QII", chunk, 16)
    if unpacked > most_bytes(len(chunk)):
        raise bomb(path, f"a block of {len(chunk):,} bytes claims to unpack to {unpacked:,}")
    compression = chunk[32 : 32 + name_length]
    (packed_length,) = struct.unpack_from("<Q", chunk, 32 + name_length)
    packed = chunk[40 + name_length :]
    if packed_length != len(packed):
        raise _damaged_mcap(path, f"a chunk says {packed_length} bytes, it has {len(packed)}")
    content = _unpacked(path, compression, packed, unpacked) if compression else packed
    if len(content) != unpacked:
        raise _damaged_mcap(path, f"a chunk says {unpacked} bytes, it unpacks to {len(content)}")
    if checksum and zlib.crc32(content) != checksum:
        raise _damaged_mcap(path, "the checksum of a chunk is wrong")
    found.unchecked += not checksum
    at = 0
    while at < len(content):
        kind, length = struct.unpack_from("<BQ", content, at)
        at += HEAD
        if kind not in (SCHEMA, CHANNEL, MESSAGE) or at + length > len(content):
            raise _damaged_mcap(path, f"a chunk has a record of kind {kind} and {length} bytes at byte {at - HEAD}")
        if kind == MESSAGE:
            found.messages[content[at] + 256 * content[at + 1]] += 1
        elif kind == CHANNEL:
            _read_record(path, found, kind, content[at : at + length])
        at += length


def _unpacked(path: Path, compression: bytes, packed: bytes, unpacked: int) -> bytes:
    """The content of a block, which must not be more than it claims: the library would believe the claim."""
    from rosbags.rosbag2.reader import zstd

    tools: dict[bytes, Any] = {b"lz4": lz4.frame.LZ4FrameDecompressor, b"zstd": zstd.ZstdDecompressor}
    if compression not in tools:
        raise _damaged_mcap(path, f"a chunk is compressed with {compression!r}; lz4 and zstd are read")
    tool: _Decompressor = tools[compression]()
    content = tool.decompress(packed, max_length=unpacked + 1)
    # a second frame behind the first would be unpacked as well
    if len(content) > unpacked or getattr(tool, "unused_data", b""):
        raise bomb(path, f"a block of {len(packed):,} bytes claims to unpack to {unpacked:,}, but there is more in it")
    return content


def _read_record(path: Path, found: McapContents, kind: int, content: bytes) -> None:
    if kind == MESSAGE:
        found.messages[struct.unpack_from("<H", content)[0]] += 1
    elif kind == CHANNEL:
        channel, length = struct.unpack_from("<HxxI", content)
        topic = content[8 : 8 + length].decode("utf-8")
        if found.topics.setdefault(channel, topic) != topic:
            raise _damaged_mcap(path, f"channel {channel} is called {found.topics[channel]!r} and {topic!r}")
    elif kind == STATISTICS:
        total, found.stated_chunks, length = struct.unpack_from("<Q14xI16xI", content)
        found.stated = dict(_pairs(content[46 : 46 + length]))
        if sum(found.stated.values()) != total and found.stated:
            raise _damaged_mcap(path, f"its statistics state {total} messages, by channel {sum(found.stated.values())}")
        if not found.stated and total != found.messages.total():
            raise _damaged_mcap(path, f"{found.messages.total()} messages are there, its statistics state {total}")


def _pairs(content: bytes) -> Iterator[tuple[int, int]]:
    yield from struct.iter_unpack("<HQ", content)


def _compare(path: Path, found: McapContents) -> None:
    unnamed = set(found.messages) - set(found.topics)
    if unnamed:
        raise _damaged_mcap(
            path, f"{found.messages[min(unnamed)]} messages belong to channel {min(unnamed)}, which is missing"
        )
    if found.stated is None:
        return
    if found.chunks != found.stated_chunks:
        raise _damaged_mcap(path, f"{found.chunks} chunks are there, its statistics state {found.stated_chunks}")
    for channel, stated in sorted(found.stated.items()):
        if stated != found.messages[channel]:
            name = found.topics.get(channel, f"channel {channel}")
            raise _damaged_mcap(
                path, f"{found.messages[channel]} messages of {name} are there, its statistics state {stated}"
            )
    unstated = [i for i, n in found.messages.items() if found.stated and n and i not in found.stated]
    if unstated:
        raise _damaged_mcap(path, f"messages of {found.topics[unstated[0]]} are there, its statistics state none")


def _damaged_mcap(path: Path, text: str) -> RecordingError:
    return refusal(
        path,
        "damaged",
        f"the MCAP file is damaged: {text}; `mcap recover` (or `ros2 bag reindex` for the folder) keeps what is left",
    )
