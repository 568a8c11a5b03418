"""Parts of recordings: where a state holds, without the ends that belong to the change."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from manip_learn.learning.deciding import CHANGE_SECONDS, FAR_FROM_HELD, SHORTEST_STRETCH_SECONDS
from manip_learn.learning.explanation.evidence import runs
from manip_learn.learning.explanation.row_motion import RowMotion
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.trajectory import Trajectory


@final
@dataclass(frozen=True)
class Stretch:
    """A part of a recording.

    Attributes:
        trajectory: Number of the trajectory, counted from 0.
        start, end: On the recording's own clock [s].
    """

    trajectory: int
    start: float
    end: float

    @property
    def duration(self) -> float:
        """From start to end [s]."""
        return self.end - self.start

    def shared(self, other: Stretch) -> float:
        """Time that both cover [s]."""
        common = min(self.end, other.end) - max(self.start, other.start)
        return max(0.0, common) if self.trajectory == other.trajectory else 0.0


def stretches_of(motion: RowMotion, states: Int[np.ndarray, " n"], state: int) -> tuple[Stretch, ...]:
    """Stretches of one state, from the first to the last sample that moves, or to the recording's ends if it has none
    but this state there.
    """
    moving, out = motion.moving, list[Stretch]()
    for found, a, b in runs(states, motion.first):
        inside = np.flatnonzero(moving[a:b]) if found == state else np.zeros(0, dtype=np.int64)
        if not len(inside):
            continue
        number = int(motion.trajectory[a])
        start, end = float(motion.time[a + inside[0]]), float(motion.time[a + inside[-1]])
        long = end - start >= SHORTEST_STRETCH_SECONDS
        if state:
            start = float(motion.ends[number, 0]) if a == motion.first[number] else start
            end = float(motion.ends[number, 1]) if b == motion.first[number + 1] else end
        if long or not state or (start, end) == tuple(motion.ends[number]):
            out.append(Stretch(number, start, end))
    return tuple(out)


def sharpened(motion: RowMotion, rows: Float[np.ndarray, "s r"], stretches: Sequence[Stretch]) -> tuple[Stretch, ...]:
    """Stretches without their ends where these have left what the inner part holds still; not at a recording's ends.

    A hand that leaves a surface at a flat angle has moved along the held rows before its velocity shows it.
    """
    out = []
    for s in stretches:
        inside = (motion.trajectory == s.trajectory) & (motion.time >= s.start) & (motion.time <= s.end)
        time = motion.time[inside]
        inner = (time >= s.start + SHORTEST_STRETCH_SECONDS) & (time <= s.end - SHORTEST_STRETCH_SECONDS)
        if s.duration < 4.0 * SHORTEST_STRETCH_SECONDS or np.count_nonzero(inner) < 10:
            out.append(s)
            continue
        way = np.cumsum(motion.rates[inside] * motion.weight[inside, None], axis=0) @ rows.T
        away = np.linalg.norm(way - np.median(way[inner], axis=0), axis=1)
        left = time[(away > FAR_FROM_HELD * np.quantile(away[inner], 0.9)) & ~inner]
        before, after = left[left < s.start + SHORTEST_STRETCH_SECONDS], left[left > s.end - SHORTEST_STRETCH_SECONDS]
        first, last = motion.ends[s.trajectory]
        start = float(time[time > before[-1]][0]) if len(before) and s.start > first else s.start
        end = float(time[time < after[0]][-1]) if len(after) and s.end < last else s.end
        out.append(Stretch(s.trajectory, start, end))
    return tuple(out)


def cut(trajectory: Trajectory, stretch: Stretch) -> slice | None:
    """The samples of a stretch, without its ends where these are no ends of the recording; None if fewer than
    three are left, which are no motion.
    """
    time = trajectory.time
    start = stretch.start if stretch.start <= time[0] else stretch.start + CHANGE_SECONDS
    end = stretch.end if stretch.end >= time[-1] else stretch.end - CHANGE_SECONDS
    inside = np.flatnonzero((time >= start) & (time <= end))
    return slice(int(inside[0]), int(inside[-1]) + 1) if len(inside) > 2 else None


def pieces_of(
    trajectories: Sequence[Trajectory], stretches: Sequence[Stretch]
) -> tuple[list[Stretch], list[Trajectory]]:
    """The stretches that are long enough to learn from, and their samples."""
    spans = [(s, cut(trajectories[s.trajectory], s)) for s in stretches]
    long = [(s, trajectories[s.trajectory].part(span)) for s, span in spans if span is not None]
    return [s for s, _ in long], [piece for _, piece in long]


def uncovered(motion: RowMotion, taken: Sequence[Stretch]) -> list[Stretch]:
    """What moves beside these stretches, from the first to the last sample that moves."""
    held = covered(motion, taken)
    out = []
    for i, (a, b) in enumerate(pairwise(motion.first)):
        edges = np.flatnonzero(np.diff(held[a:b].astype(int), prepend=1, append=1))
        for low, high in zip(edges[::2], edges[1::2], strict=True):
            inside = np.flatnonzero(motion.moving[a + low : a + high])
            if len(inside):
                start, end = motion.time[a + low + inside[0]], motion.time[a + low + inside[-1]]
                out.append(Stretch(i, float(start), float(end)))
    return out


def covered(motion: RowMotion, stretches: Sequence[Stretch]) -> Bool[np.ndarray, " n"]:
    """Which samples lie in one of these stretches."""
    held = np.zeros(len(motion), dtype=bool)
    for s in stretches:
        held |= (motion.trajectory == s.trajectory) & (motion.time >= s.start) & (motion.time <= s.end)
    return held


@final
@dataclass(frozen=True, eq=False)
class BeforeSmoothing:
    """Recordings before and after velocities were derived.

    Attributes:
        derived: With velocities; smoothing cuts off the ends.
        recorded: The same, as they were.
    """

    derived: Demonstrations
    recorded: Demonstrations

    def of(self, stretches: Sequence[Stretch], parts: Sequence[Trajectory]) -> list[Trajectory]:
        """The recorded samples of parts of the derived trajectories.

        A part that begins or ends with the derived trajectory begins or ends with the recorded one.

        Args:
            stretches: Which trajectory each part is of.
            parts: With velocities.
        """
        return [self._of(s.trajectory, part) for s, part in zip(stretches, parts, strict=True)]

    def _of(self, number: int, part: Trajectory) -> Trajectory:
        derived, recorded = self.derived[number], self.recorded[number]
        if derived is recorded:
            return part
        start = None if part.time[0] == derived.time[0] else float(part.time[0])
        end = None if part.time[-1] == derived.time[-1] else float(part.time[-1])
        return recorded[start:end]


def ways_to_choose(motion: RowMotion, stretches: Sequence[Stretch]) -> float:
    """In how many ways as many stretches, as long as these, could have been chosen from as many recordings.

    A recording has as many places for a stretch as parts of that length. Whoever looks for what is still finds the
    best of them, and must pay for the choice.
    """
    moving = motion.weight * motion.moving
    whole = np.bincount(motion.trajectory, moving)
    recordings = {s.trajectory for s in stretches}
    ways = math.comb(len(whole), len(recordings))
    for i in recordings:
        spans = [float(np.sum(moving[covered(motion, [s])])) for s in stretches if s.trajectory == i]
        ways *= math.prod(whole[i] / span for span in spans if span > 0.0) / math.factorial(len(spans))
    return max(ways, 1.0)
