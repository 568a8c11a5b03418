"""Compressed bags: what would unpack to far more than any recording is refused before it fills the memory."""

from __future__ import annotations

import bz2
import struct
from pathlib import Path
from typing import Protocol, final

from manip_learn.errors import MissingExtraError, RecordingError

try:
    import lz4.frame
except ImportError as error:
    raise MissingExtraError("reading ROS bags", "ros") from error

ALWAYS_FINE, BOMB_RATIO = 50_000_000, 200  # bytes, and how much smaller packed
MCAP_MAGIC = b"\x89MCAP0\r\n"
MCAP_CHUNK = 0x06
BLOCK = 1 << 20


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
