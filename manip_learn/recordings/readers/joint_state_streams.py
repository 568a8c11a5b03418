"""Joint-state messages of a bag -> arrays, one stream per topic and set of joints."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.errors import RecordingError, advice, counted
from manip_learn.recordings.readers.bag_file import BagFile
from manip_learn.recordings.readers.joint_state_layout import JointStateLayout

BATCH = 16_384
MOST_LAYOUTS = 200


@final
@dataclass(frozen=True, eq=False)
class JointStateStream:
    """The messages of one publisher about one list of joints.

    Attributes:
        topic: Topic.
        publisher: Who published them, as far as the format says; else empty.
        names: Joints.
        stamps: shape (T,), header stamps [ns].
        received: shape (T,), stamps of the recorder [ns].
        positions: shape (T, n).
        velocities: shape (T, n), or None if any message has none.
        efforts: shape (T, n), likewise.
    """

    topic: str
    publisher: str
    names: tuple[str, ...]
    stamps: Int[np.ndarray, " T"]
    received: Int[np.ndarray, " T"]
    positions: Float[np.ndarray, "T n"]
    velocities: Float[np.ndarray, "T n"] | None
    efforts: Float[np.ndarray, "T n"] | None = None


@final
@dataclass
class _Pieces:
    stamps: list[np.ndarray] = field(default_factory=list)
    received: list[np.ndarray] = field(default_factory=list)
    positions: list[np.ndarray] = field(default_factory=list)
    velocities: list[np.ndarray | None] = field(default_factory=list)
    efforts: list[np.ndarray | None] = field(default_factory=list)


def joint_state_streams(bag: BagFile, topics: tuple[str, ...]) -> tuple[list[JointStateStream], list[str]]:
    """All streams of some topics, and what was left out.

    Raises:
        RecordingError: Messages that are no JointState.
    """
    pieces: dict[tuple[str, str, tuple[str, ...]], _Pieces] = {}
    layouts: dict[tuple[str, int], list[JointStateLayout]] = {}
    without_positions: dict[str, int] = {}
    for topic, publisher, received, raw in _batches(bag, topics):
        for layout, messages, stamps in _by_layout(bag, topic, raw, received, layouts):
            positions = layout.positions(messages)
            if positions is None:
                without_positions[topic] = without_positions.get(topic, 0) + len(messages)
                continue
            piece = pieces.setdefault((topic, publisher, layout.names), _Pieces())
            piece.stamps.append(layout.stamps(messages))
            piece.received.append(stamps)
            piece.positions.append(positions)
            piece.velocities.append(layout.velocities(messages))
            piece.efforts.append(layout.efforts(messages))
    streams = [
        JointStateStream(
            topic,
            publisher,
            names,
            np.concatenate(p.stamps),
            np.concatenate(p.received),
            np.concatenate(p.positions),
            _all_or_none(p.velocities),
            _all_or_none(p.efforts),
        )
        for (topic, publisher, names), p in pieces.items()
    ]
    notes = [
        f"{counted(n, 'message')} of {topic} have no positions, not used" for topic, n in without_positions.items()
    ]
    notes += [
        f"{n} of {sum(map(len, p.stamps))} messages of {topic} have no velocities, so those of the others are not used"
        for (topic, _, _), p in pieces.items()
        if 0 < (n := sum(len(s) for s, v in zip(p.stamps, p.velocities, strict=True) if v is None))
        and any(v is not None for v in p.velocities)
    ]
    return streams, notes


def _all_or_none(parts: list[np.ndarray | None]) -> np.ndarray | None:
    there = [p for p in parts if p is not None]
    return np.concatenate(there) if len(there) == len(parts) else None


def _batches(bag: BagFile, topics: tuple[str, ...]) -> Iterator[tuple[str, str, np.ndarray, list[bytes]]]:
    """Messages of one publisher of one topic at a time, with the recorder's stamps."""
    messages = bag.messages(topics)
    while batch := list(itertools.islice(messages, BATCH)):
        for source in dict.fromkeys(m[:2] for m in batch):
            mine = [m for m in batch if m[:2] == source]
            yield *source, np.array([m[2] for m in mine], dtype=np.int64), [m[3] for m in mine]


def _by_layout(
    bag: BagFile,
    topic: str,
    raw: list[bytes],
    received: np.ndarray,
    layouts: dict[tuple[str, int], list[JointStateLayout]],
) -> Iterator[tuple[JointStateLayout, np.ndarray, np.ndarray]]:
    """Groups of messages with one layout, as rows of bytes."""
    sizes = np.fromiter(map(len, raw), dtype=np.int64, count=len(raw))
    for size in np.unique(sizes):
        index = np.flatnonzero(sizes == size)
        rows = np.frombuffer(b"".join(raw[i] for i in index), dtype=np.uint8).reshape(len(index), int(size))
        known = layouts.setdefault((topic, int(size)), [])
        todo = np.ones(len(index), dtype=bool)
        tried = 0
        while np.any(todo):
            if tried == len(known):
                known.append(_new_layout(bag, topic, raw[index[np.argmax(todo)]], sum(map(len, layouts.values()))))
            layout = known[tried]
            tried += 1
            mine = todo & layout.matches(rows)
            if np.any(mine):
                bag.layout(raw[index[np.flatnonzero(mine)[-1]]])  # a sample more, read by the library as well
                yield layout, rows[mine], received[index[mine]]
                todo &= ~mine


def _new_layout(bag: BagFile, topic: str, raw: bytes, n_known: int) -> JointStateLayout:
    if n_known >= MOST_LAYOUTS:
        raise RecordingError(
            f"{bag.path.name}: the joints named in {topic} change all the time ({n_known} lists)"
            + advice(": choose another topic with {}", "topics=[...]", "--topic NAME"),
            code="unsteady-names",
            path=bag.path,
        )
    return bag.layout(raw)
