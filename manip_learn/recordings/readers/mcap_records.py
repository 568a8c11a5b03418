"""The records of an MCAP file, counted and checked apart from any library: https://mcap.dev/spec.

Libraries believe what a chunk claims to unpack to, skip what is damaged, and do not compare what they found with the
file's statistics: a bomb fills the memory, and lost messages are not noticed.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

from manip_learn.errors import MissingExtraError, RecordingError
from manip_learn.recordings.readers.recording import bomb, most_bytes, refusal
from manip_learn.recordings.writers.mcap_writer import (
    CHANNEL,
    CHUNK,
    FOOTER,
    HEADER_KEY,
    MAGIC,
    MESSAGE,
    METADATA,
    METADATA_NAME,
    SCHEMA,
    STATISTICS,
    text_at,
)

HEAD = 9  # bytes of a record in front of its content: its kind and length
CHUNK_HEAD = 32  # bytes of a chunk in front of the name of its compression


def mcap_header(path: Path) -> str | None:
    """The library's own header in an MCAP file, or None.

    Raises:
        RecordingError: Damaged.
    """
    for _, content in records(path, (METADATA,)):
        name, at = text_at(content, 0)
        at += 4  # the size of the mapping
        while name == METADATA_NAME and at < len(content):
            key, at = text_at(content, at)
            value, at = text_at(content, at)
            if key == HEADER_KEY:
                return value
    return None


def messages_of(path: Path, topic: str) -> Iterator[bytes]:
    """The messages of a topic in the chunks of a file.

    Raises:
        RecordingError: Damaged, or a bomb.
    """
    channels: set[int] = set()
    for _, chunk in records(path, (CHUNK,)):
        for kind, content in records_in(path, unpacked(path, chunk)[0]):
            if kind == CHANNEL and text_at(content, 4)[0] == topic:
                channels.add(int.from_bytes(content[:2], "little"))
            elif kind == MESSAGE and int.from_bytes(content[:2], "little") in channels:
                yield content[22:]  # after channel, sequence and two stamps


def records(path: Path, kinds: Collection[int]) -> Iterator[tuple[int, bytes]]:
    """Kind and content of the records of some kinds, outside of chunks.

    Raises:
        RecordingError: Records that do not fit into the file.
    """
    end = path.stat().st_size - len(MAGIC)
    with path.open("rb") as file:
        file.seek(len(MAGIC))
        kind = 0
        while kind != FOOTER:
            start = file.tell()
            head = file.read(HEAD)
            if len(head) < HEAD:
                raise _damaged(path, "it ends without a footer, as the file of a recorder that was killed")
            kind, length = struct.unpack("<BQ", head)
            if start + HEAD + length > end:
                raise _damaged(path, f"the record at byte {start} ends after the file")
            if kind in kinds:
                yield kind, file.read(length)
            else:
                file.seek(length, 1)
        if file.tell() != end:
            raise _damaged(path, f"there are {end - file.tell()} bytes after its footer")


def records_in(path: Path, content: bytes) -> Iterator[tuple[int, bytes]]:
    """Kind and content of the records in an unpacked chunk.

    Raises:
        RecordingError: Other records than a chunk may have, or one that ends after it.
    """
    at = 0
    while at < len(content):
        kind, length = struct.unpack_from("<BQ", content, at)
        at += HEAD
        if kind not in (SCHEMA, CHANNEL, MESSAGE) or at + length > len(content):
            raise _damaged(path, f"a chunk has a record of kind {kind} and {length} bytes at byte {at - HEAD}")
        yield kind, content[at : at + length]
        at += length


def unpacked(path: Path, chunk: bytes) -> tuple[bytes, bool]:
    """The content of a chunk, and whether it had a checksum.

    Raises:
        RecordingError: A bomb, which unpacks or claims to unpack to far more than its size, or damaged.
    """
    if len(chunk) < CHUNK_HEAD + 8:
        raise _damaged(path, f"a chunk has {len(chunk)} bytes only")
    size, checksum, name_length = struct.unpack_from("<QII", chunk, 16)
    if size > most_bytes(len(chunk)):
        raise bomb(path, f"a block of {len(chunk):,} bytes claims to unpack to {size:,}")
    compression = chunk[CHUNK_HEAD : CHUNK_HEAD + name_length]
    (packed_length,) = struct.unpack_from("<Q", chunk, CHUNK_HEAD + name_length)
    content = chunk[CHUNK_HEAD + name_length + 8 :]
    if packed_length != len(content):
        raise _damaged(path, f"a chunk says {packed_length} bytes, it has {len(content)}")
    if compression:
        content = _decompressed(path, compression, content, size)
    if len(content) != size:
        raise _damaged(path, f"a chunk says {size} bytes, it unpacks to {len(content)}")
    if checksum and zlib.crc32(content) != checksum:
        raise _damaged(path, "the checksum of a chunk is wrong")
    return content, bool(checksum)


def _decompressed(path: Path, compression: bytes, packed: bytes, size: int) -> bytes:
    """The content of a block, which must not be more than it claims: the library would believe the claim."""
    try:
        import lz4.frame
        from rosbags.rosbag2.reader import zstd  # the standard library's from Python 3.14 on, a package before
    except ImportError as error:
        raise MissingExtraError("reading compressed MCAP files", "ros") from error
    tools: dict[bytes, Any] = {b"lz4": lz4.frame.LZ4FrameDecompressor, b"zstd": zstd.ZstdDecompressor}
    if compression not in tools:
        raise _damaged(path, f"a chunk is compressed with {compression!r}; lz4 and zstd are read")
    tool = tools[compression]()
    try:
        content = tool.decompress(packed, max_length=size + 1)
    except (RuntimeError, zstd.ZstdError) as error:
        raise _damaged(path, f"a chunk cannot be unpacked ({error})") from error
    # a second frame behind the first would be unpacked as well
    if len(content) > size or tool.unused_data:
        raise bomb(path, f"a block of {len(packed):,} bytes claims to unpack to {size:,}, but there is more in it")
    return content


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
        found: Counter[str] = Counter(dict.fromkeys(self.topics.values(), 0))
        for channel, n in self.messages.items():
            found[self.topics[channel]] += n
        return found


def mcap_contents(path: Path) -> McapContents:
    """Everything that the file holds.

    Raises:
        RecordingError: A bomb, records that do not fit into the file, or messages that the file's statistics do not
            have, or the other way round.
    """
    found = McapContents()
    for kind, content in records(path, (CHUNK, CHANNEL, MESSAGE, STATISTICS)):
        if kind == CHUNK:
            inner, has_checksum = unpacked(path, content)
            found.chunks += 1
            found.unchecked += not has_checksum
            for inner_kind, record in records_in(path, inner):
                _count(path, found, inner_kind, record)
        else:
            _count(path, found, kind, content)
    _compare(path, found)
    return found


def _count(path: Path, found: McapContents, kind: int, content: bytes) -> None:
    if kind == MESSAGE:
        found.messages[content[0] + 256 * content[1]] += 1
    elif kind == CHANNEL:
        channel, topic = int.from_bytes(content[:2], "little"), text_at(content, 4)[0]
        if found.topics.setdefault(channel, topic) != topic:
            raise _damaged(path, f"channel {channel} is called {found.topics[channel]!r} and {topic!r}")
    elif kind == STATISTICS:
        total, found.stated_chunks, length = struct.unpack_from("<Q14xI16xI", content)
        found.stated = dict(struct.iter_unpack("<HQ", content[46 : 46 + length]))
        stated = sum(found.stated.values())
        if found.stated and stated != total:
            raise _damaged(path, f"its statistics state {total} messages, by channel {stated}")
        if not found.stated and total != found.messages.total():
            raise _damaged(path, f"{found.messages.total()} messages are there, its statistics state {total}")


def _compare(path: Path, found: McapContents) -> None:
    unnamed = set(found.messages) - set(found.topics)
    if unnamed:
        channel = min(unnamed)
        raise _damaged(path, f"{found.messages[channel]} messages belong to channel {channel}, which is missing")
    if found.stated is None:
        return
    if found.chunks != found.stated_chunks:
        raise _damaged(path, f"{found.chunks} chunks are there, its statistics state {found.stated_chunks}")
    for channel in sorted({*found.stated, *(found.messages if found.stated else ())}):
        there, stated = found.messages[channel], found.stated.get(channel, 0)
        if stated != there:
            name = found.topics.get(channel, f"channel {channel}")
            raise _damaged(path, f"{there} messages of {name} are there, its statistics state {stated}")


def _damaged(path: Path, text: str) -> RecordingError:
    help_ = "`mcap recover` (or `ros2 bag reindex` for the folder) keeps what is left"
    return refusal(path, "damaged", f"the MCAP file is damaged: {text}; {help_}")
