"""The library's own MCAP files: the header among the metadata, and the samples of a rollout bit for bit."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np

from manip_learn.recordings.mcap_layout import CHANNEL, CHUNK, MAGIC, MESSAGE, METADATA
from manip_learn.recordings.saved_motion import FileHeader, SavedMotion, refusal
from manip_learn.recordings.writers.joint_state_messages import rollout_sample_values
from manip_learn.recordings.writers.mcap_writer import HEADER_KEY, METADATA_NAME, ROLLOUT_TOPIC

LARGEST_METADATA = 10_000_000
MESSAGE_HEAD = 22  # channel, sequence, two stamps


def mcap_header(path: Path) -> str | None:
    """The library's header in an MCAP file, or None."""
    with path.open("rb") as file:
        for code, length in _records(file, path.stat().st_size):
            if code != METADATA or length > LARGEST_METADATA:
                continue
            content = file.read(length)
            name, at = _text(content, 0)
            if name != METADATA_NAME:
                continue
            end = at + 4 + struct.unpack_from("<I", content, at)[0]
            at += 4
            while at < min(end, len(content)):
                key, at = _text(content, at)
                value, at = _text(content, at)
                if key == HEADER_KEY:
                    return value
    return None


def read_saved_rollout(path: Path, header: FileHeader) -> SavedMotion:
    """The samples of a rollout.

    Raises:
        RecordingError: Blocks that another program has compressed, or samples that do not fit.
    """
    channels: set[int] = set()
    samples = []
    with path.open("rb") as file:
        size = path.stat().st_size
        for code, length in _records(file, size):
            if code != CHUNK:
                continue
            content = file.read(min(length, size))
            for inner, record in _chunk_records(path, content):
                if inner == CHANNEL:
                    (channel,), (topic, _) = struct.unpack_from("<H", record), _text(record, 4)
                    if topic == ROLLOUT_TOPIC:
                        channels.add(channel)
                elif inner == MESSAGE and struct.unpack_from("<H", record)[0] in channels:
                    samples.append(rollout_sample_values(record[MESSAGE_HEAD:]))
    if not samples:
        raise refusal(path, "too-short", f"the rollout has no samples on {ROLLOUT_TOPIC}")
    nq, nv = header.nq or len(header.joint_names), len(header.joint_names)
    for i, (_, q, u, _, _) in enumerate(samples):
        if len(q) != nq or len(u) != nv:
            raise refusal(
                path, "shape", f"sample {i} has {len(q)} columns of q and {len(u)} of u, {nq} and {nv} are needed"
            )
    numbers = np.array([s[0] for s in samples])
    q, u = np.array([s[1] for s in samples]), np.array([s[2] for s in samples])
    status = tuple(s[3] for s in samples)
    following = np.array([np.nan if s[4] is None else s[4] for s in samples]) if header.follows else None
    return SavedMotion(header, numbers[:, 0], q, u, numbers[:, 1], numbers[:, 2], status, path.name, following)


def _records(file: IO[bytes], size: int) -> Iterator[tuple[int, int]]:
    """Kind and length of the records at the top level; the file stands at their content."""
    file.seek(len(MAGIC))
    while file.tell() + 9 <= size:
        code, length = struct.unpack("<BQ", file.read(9))
        start = file.tell()
        yield code, length
        if start + length > size:
            return
        file.seek(start + length)


def _chunk_records(path: Path, chunk: bytes) -> Iterator[tuple[int, bytes]]:
    compression, at = _text(chunk, 28)
    if compression:
        raise refusal(
            path,
            "compressed",
            f"another program has packed its blocks with {compression[:20]}: unpack it (`mcap decompress`), or save "
            "the rollout again",
        )
    at += 8
    while at + 9 <= len(chunk):
        code, length = struct.unpack_from("<BQ", chunk, at)
        at += 9
        if at + length > len(chunk):
            raise ValueError(f"a record of {length:,} bytes ends after its block")
        yield code, chunk[at : at + length]
        at += length


def _text(content: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", content, at)
    text = content[at + 4 : at + 4 + length]
    if len(text) != length:
        raise ValueError("a text ends after its record")
    return text.decode(), at + 4 + length
