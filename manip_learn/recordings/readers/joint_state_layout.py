"""Byte layout of `sensor_msgs/JointState`, ROS 1 and CDR: one layout found, thousands of messages read by NumPy."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

MOST_JOINTS = 10_000


@final
@dataclass(frozen=True, eq=False)
class JointStateLayout:
    """Where the numbers are in messages that have the same joints.

    Attributes:
        size: Bytes of the message.
        order: `"<"` or `">"`, byte order.
        names: Joint names in the message.
        stamp_at: Offset of the seconds; the nanoseconds follow.
        position_at: Offset of the positions, or None if the message has none.
        velocity_at: Offset of the velocities, or None.
        effort_at: Offset of the efforts, or None.
        fixed: Offsets of the bytes that every message of this layout shares.
        template: The shared bytes.
    """

    size: int
    order: str
    names: tuple[str, ...]
    stamp_at: int
    position_at: int | None
    velocity_at: int | None
    effort_at: int | None
    fixed: Int[np.ndarray, " k"]
    template: UInt8[np.ndarray, " k"]

    def matches(self, messages: UInt8[np.ndarray, "N size"]) -> Bool[np.ndarray, " N"]:
        """Messages (one per row) that have this layout."""
        return np.all(messages[:, self.fixed] == self.template, axis=1)

    def stamps(self, messages: UInt8[np.ndarray, "N size"]) -> Int[np.ndarray, " N"]:
        """Header stamps [ns]."""
        parts = np.ascontiguousarray(messages[:, self.stamp_at : self.stamp_at + 8]).view(self.order + "u4")
        return parts[:, 0].astype(np.int64) * 1_000_000_000 + parts[:, 1].astype(np.int64)

    def positions(self, messages: UInt8[np.ndarray, "N size"]) -> Float[np.ndarray, "N n"] | None:
        """Joint positions."""
        return self._numbers(messages, self.position_at)

    def velocities(self, messages: UInt8[np.ndarray, "N size"]) -> Float[np.ndarray, "N n"] | None:
        """Joint velocities; None if the messages have none."""
        return self._numbers(messages, self.velocity_at)

    def efforts(self, messages: UInt8[np.ndarray, "N size"]) -> Float[np.ndarray, "N n"] | None:
        """Joint efforts; None if the messages have none."""
        return self._numbers(messages, self.effort_at)

    def _numbers(self, messages: UInt8[np.ndarray, "N size"], at: int | None) -> Float[np.ndarray, "N n"] | None:
        if at is None:
            return None
        block = np.ascontiguousarray(messages[:, at : at + 8 * len(self.names)])
        return block.view(self.order + "f8").astype(np.float64)


@final
class _Cursor:
    """Reads one message field by field and remembers which bytes are shared by messages of the same layout."""

    def __init__(self, raw: bytes, order: str, at: int, *, cdr: bool):
        self.raw, self.order, self.at, self.cdr = raw, order, at, cdr
        self.fixed: list[int] = []

    def count(self) -> int:
        """An unsigned 32-bit number that belongs to the layout."""
        if self.cdr:  # CDR aligns numbers to their size, counted after the 4 bytes in front
            self.at += -(self.at - 4) % 4
        (value,) = struct.unpack_from(self.order + "I", self.raw, self.at)
        self.fixed += range(self.at, self.at + 4)
        self.at += 4
        return value

    def text(self, *, shared: bool) -> str:
        """A string."""
        length = self.count()
        content = self.raw[self.at : self.at + length]
        if len(content) != length:
            raise ValueError("a string ends after the message")
        if shared:
            self.fixed += range(self.at, self.at + length)
        self.at += length
        return content.rstrip(b"\x00").decode("utf-8")

    def doubles(self) -> tuple[int, int]:
        """Offset and number of the entries of an array of numbers."""
        length = self.count()
        if self.cdr and length:
            self.at += -(self.at - 4) % 8
        start = self.at
        self.at += 8 * length
        if self.at > len(self.raw):
            raise ValueError(f"an array of {length} numbers ends after the message")
        return start, length


def ros1_layout(raw: bytes) -> JointStateLayout:
    """Layout of a ROS 1 message.

    Raises:
        ValueError: Not a JointState.
        struct.error: Too short.
    """
    return _layout(_Cursor(raw, "<", 12, cdr=False), stamp_at=4)


def cdr_layout(raw: bytes) -> JointStateLayout:
    """Layout of a ROS 2 message.

    Raises:
        ValueError: Not a JointState, or an encoding other than plain CDR.
        struct.error: Too short.
    """
    if raw[:2] not in (b"\x00\x00", b"\x00\x01"):
        raise ValueError(f"the message is not plain CDR, it starts with {raw[:4]!r}")
    return _layout(_Cursor(raw, "<" if raw[1] else ">", 12, cdr=True), stamp_at=4)


def _layout(cursor: _Cursor, stamp_at: int) -> JointStateLayout:
    if cursor.cdr:
        cursor.fixed += (0, 1)
    cursor.text(shared=False)  # the header's frame
    n = cursor.count()
    if n > MOST_JOINTS:
        raise ValueError(f"the message names {n} joints")
    names = tuple(cursor.text(shared=True) for _ in range(n))
    position_at, n_positions = cursor.doubles()
    velocity_at, n_velocities = cursor.doubles()
    effort_at, n_efforts = cursor.doubles()
    fixed = np.array(cursor.fixed, dtype=np.int64)
    return JointStateLayout(
        size=len(cursor.raw),
        order=cursor.order,
        names=names,
        stamp_at=stamp_at,
        position_at=position_at if n_positions == n and n else None,
        velocity_at=velocity_at if n_velocities == n and n else None,
        effort_at=effort_at if n_efforts == n and n else None,
        fixed=fixed,
        template=np.frombuffer(cursor.raw, dtype=np.uint8)[fixed],
    )
