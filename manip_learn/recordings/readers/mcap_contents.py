"""What an MCAP file holds, record by record: every message counted, apart from what the file's index says.

Layout of the records: https://mcap.dev/spec.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, final

import lz4.frame

from manip_learn.errors import RecordingError
from manip_learn.recordings.mcap_layout import CHANNEL, CHUNK, FOOTER, MAGIC, MESSAGE, SCHEMA, STATISTICS
from manip_learn.recordings.readers.packed_size import bomb, most_bytes

HEAD = 9  # bytes of a record in front of its content: its kind and length


class _Decompressor(Protocol):
    def decompress(self, data: bytes, max_length: int = -1) -> bytes: ...


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
                raise _damaged(path, "it ends without a footer, as the file of a recorder that was killed")
            kind, length = struct.unpack("<BQ", head)
            if start + HEAD + length > end:
                raise _damaged(path, f"the record at byte {start} ends after the file")
            if kind == CHUNK:
                _read_chunk(path, found, file.read(length))
            elif kind in (CHANNEL, MESSAGE, STATISTICS, FOOTER):
                _read_record(path, found, kind, file.read(length))
            else:
                file.seek(length, 1)
        if file.tell() != end:
            raise _damaged(path, f"there are {end - file.tell()} bytes after its footer")
    _compare(path, found)
    return found


def _read_chunk(path: Path, found: McapContents, chunk: bytes) -> None:
    found.chunks += 1
    if len(chunk) < 40:
        raise _damaged(path, f"a chunk has {len(chunk)} bytes only")
    unpacked, checksum, name_length = struct.unpack_from("<QII", chunk, 16)
    if unpacked > most_bytes(len(chunk)):
        raise bomb(path, f"a block of {len(chunk):,} bytes claims to unpack to {unpacked:,}")
    compression = chunk[32 : 32 + name_length]
    (packed_length,) = struct.unpack_from("<Q", chunk, 32 + name_length)
    packed = chunk[40 + name_length :]
    if packed_length != len(packed):
        raise _damaged(path, f"a chunk says {packed_length} bytes, it has {len(packed)}")
    content = _unpacked(path, compression, packed, unpacked) if compression else packed
    if len(content) != unpacked:
        raise _damaged(path, f"a chunk says {unpacked} bytes, it unpacks to {len(content)}")
    if checksum and zlib.crc32(content) != checksum:
        raise _damaged(path, "the checksum of a chunk is wrong")
    found.unchecked += not checksum
    at = 0
    while at < len(content):
        kind, length = struct.unpack_from("<BQ", content, at)
        at += HEAD
        if kind not in (SCHEMA, CHANNEL, MESSAGE) or at + length > len(content):
            raise _damaged(path, f"a chunk has a record of kind {kind} and {length} bytes at byte {at - HEAD}")
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
        raise _damaged(path, f"a chunk is compressed with {compression!r}; lz4 and zstd are read")
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
            raise _damaged(path, f"channel {channel} is called {found.topics[channel]!r} and {topic!r}")
    elif kind == STATISTICS:
        total, found.stated_chunks, length = struct.unpack_from("<Q14xI16xI", content)
        found.stated = dict(_pairs(content[46 : 46 + length]))
        if sum(found.stated.values()) != total and found.stated:
            raise _damaged(path, f"its statistics state {total} messages, by channel {sum(found.stated.values())}")
        if not found.stated and total != found.messages.total():
            raise _damaged(path, f"{found.messages.total()} messages are there, its statistics state {total}")


def _pairs(content: bytes) -> Iterator[tuple[int, int]]:
    yield from struct.iter_unpack("<HQ", content)


def _compare(path: Path, found: McapContents) -> None:
    unnamed = set(found.messages) - set(found.topics)
    if unnamed:
        raise _damaged(
            path, f"{found.messages[min(unnamed)]} messages belong to channel {min(unnamed)}, which is missing"
        )
    if found.stated is None:
        return
    if found.chunks != found.stated_chunks:
        raise _damaged(path, f"{found.chunks} chunks are there, its statistics state {found.stated_chunks}")
    for channel, stated in sorted(found.stated.items()):
        if stated != found.messages[channel]:
            name = found.topics.get(channel, f"channel {channel}")
            raise _damaged(
                path, f"{found.messages[channel]} messages of {name} are there, its statistics state {stated}"
            )
    unstated = [i for i, n in found.messages.items() if found.stated and n and i not in found.stated]
    if unstated:
        raise _damaged(path, f"messages of {found.topics[unstated[0]]} are there, its statistics state none")


def _damaged(path: Path, text: str) -> RecordingError:
    return RecordingError(
        f"{path.name}: the MCAP file is damaged: {text}; `mcap recover` (or `ros2 bag reindex` for the folder) keeps "
        "what is left",
        code="damaged",
        path=path,
    )
