"""Packed blocks of bags, unpacked only as far as is plausible."""

from __future__ import annotations

import bz2
from pathlib import Path
from typing import Protocol, final

import lz4.frame

from manip_learn.errors import RecordingError

ALWAYS_FINE, BOMB_RATIO = 50_000_000, 200  # bytes, and how much smaller packed
BLOCK = 1 << 20


def most_bytes(packed: int) -> int:
    """Bytes that a packed block may unpack to."""
    return max(ALWAYS_FINE, BOMB_RATIO * packed)


def bomb(path: Path, evidence: str) -> RecordingError:
    """The refusal of a file that unpacks to far too much."""
    return RecordingError(
        f"{path.name}: {evidence}: no recorded motion packs so well; if it is real, unpack it yourself first",
        code="bomb",
        path=path,
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
