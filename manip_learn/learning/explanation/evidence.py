"""Evidence of every sample for a hypothesis, in nats over free motion, the sequence of states with the most, and the
stretches of recordings where a state holds, without the ends that belong to the change.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from manip_learn.learning.explanation.row_motion import RowMotion
from manip_learn.learning.samples import Table
from manip_learn.recordings.trajectory import Trajectory

# [s] samples closer together than this tell the same story, and a change of what is held takes as long, over which
# velocities are smoothed: a person's motion does not change faster. Set by hand
CHANGE_SECONDS = 0.1
# share of a held phase's samples that may be far off (slips, knocks): bounds the evidence against it. Set by hand
FAR_OFF_SHARE = 0.02
# [nats] that a change between two states costs: a person changes every few seconds, a chance of exp(-16) for one of
# the ten samples of a second is that of a change in some months
SWITCH_NATS = 16.0
# the scales among which a hypothesis takes the one with the most evidence, about half a decade apart: the standard
# deviation of what breaks it over the noise's
HELD_STEADY = (1.0, 3.0, 9.0)
# the same, share of the motion
HELD_SHARES = (0.003, 0.01, 0.03, 0.1, 0.2)
# [s] a stretch shorter than this is chance; as much at either end of a longer one may have left it. Set by hand
SHORTEST_STRETCH_SECONDS = 0.3
# ratio to the usual distance, or drift, along the held rows beyond which they are not held: in 50 sets of recordings
# that all agree the largest drift was 3 times the usual one
FAR_FROM_HELD = 2.5


@final
@dataclass(frozen=True)
class HeldScale:
    """How large velocities along held rows are.

    Attributes:
        steady: Times the noise of the joint velocities: what shakes the arm however fast it moves.
        share: Ratio to the velocities along free rows: rows that are slightly off, parts that give way.
    """

    steady: float
    share: float


def evidence(
    motion: RowMotion, energy: Float[np.ndarray, "n h"], s: int, scales: Sequence[HeldScale]
) -> Float[np.ndarray, "n h k"]:
    """Log-likelihood of each sample if the rows are held over the same if they are free, weighted by its time.

    Free: the rows take their even share of the motion, variance f = u^T Phi^+ Phi u / p a row. Held: variance
    (steady sigma)^2 + (share^2) f, or free after all with probability FAR_OFF_SHARE. At a standstill the two are the
    same and the evidence is zero.

    Args:
        motion: n samples.
        energy: e = u^T A^+ A u of each sample under each hypothesis of s rows.
        s: Number of rows.
        scales: Each hypothesis is judged under each of them.
    """
    steady = np.array([x.steady for x in scales]) ** 2
    share = np.array([x.share for x in scales]) ** 2
    floor = motion.noise[:, None] * steady
    free = np.maximum(motion.free[:, None], floor)
    held = np.minimum(floor + share * free, free)
    offset, slope = 0.5 * s * np.log(free / held), 0.5 * (1.0 / held - 1.0 / free)
    exponent = np.minimum(offset[:, None] - energy[:, :, None] * slope[:, None], 50.0)
    ratio = np.log(FAR_OFF_SHARE + (1.0 - FAR_OFF_SHARE) * np.exp(exponent))
    return ratio * (motion.weight[:, None, None] / CHANGE_SECONDS)


# the scales among which a hypothesis takes the one with the most evidence, about half a decade apart
SCALES = tuple(HeldScale(steady, share) for steady in HELD_STEADY for share in HELD_SHARES)


def gains_of(
    values: Float[np.ndarray, "n h"], first: Int[np.ndarray, " m"], switch: float = SWITCH_NATS
) -> Float[np.ndarray, "g h"]:
    """Evidence of each trajectory for each hypothesis: of the best sequence of held and free stretches, or, as in a cut
    recording, of a single state throughout.

    `first` is the first sample of each trajectory, and n at the end; at an infinite price there is no change.
    """
    whole = np.maximum(np.add.reduceat(values, first[:-1], axis=0), 0.0)
    if np.isinf(switch):
        return whole
    return np.maximum(whole, np.maximum(*_two_states(_padded(values, first), 0.5 * switch)))


def held_by(
    values: Float[np.ndarray, "n h"], first: Int[np.ndarray, " m"], switch: float = SWITCH_NATS
) -> Bool[np.ndarray, "n h"]:
    """Which samples each hypothesis holds in, taken on its own: the sequences of `gains_of`."""
    lengths = np.diff(first)
    whole = np.add.reduceat(values, first[:-1], axis=0)
    throughout = np.repeat(whole > 0.0, lengths, axis=0)
    if np.isinf(switch):
        return throughout
    padded = _padded(values, first)
    entered, left = np.zeros(padded.shape, dtype=bool), np.zeros(padded.shape, dtype=bool)
    free, held = _two_states(padded, 0.5 * switch, (entered, left))
    state, best = held > free, np.maximum(free, held)
    out = np.zeros(padded.shape, dtype=bool)
    for t in range(len(padded) - 1, -1, -1):
        out[t] = state
        state = np.where(state, ~entered[t], left[t])
    parts = np.concatenate([out[: b - a, i] for i, (a, b) in enumerate(pairwise(first))])
    return np.where(np.repeat(whole > best, lengths, axis=0), throughout, parts)


def _two_states(
    steps: Float[np.ndarray, "T g h"],
    half: float,
    changes: tuple[Bool[np.ndarray, "T g h"], Bool[np.ndarray, "T g h"]] | None = None,
) -> tuple[Float[np.ndarray, "g h"], Float[np.ndarray, "g h"]]:
    """Evidence of the best sequences that end in free motion, and in a contact, each change for half its price.

    `changes`, if they are given, note which samples are best entered from free motion, and from a contact.
    """
    free = np.zeros(steps.shape[1:])
    held = np.full_like(free, -half)
    for t, step in enumerate(steps):
        from_free, from_held = free - half, held - half
        if changes is not None:
            np.greater(from_free, held, out=changes[0][t])
            np.greater(from_held, free, out=changes[1][t])
        held, free = np.maximum(held, from_free) + step, np.maximum(free, from_held)
    return free, held - half


def states_of(
    values: Float[np.ndarray, "n k"], first: Int[np.ndarray, " m"], switch: float = SWITCH_NATS
) -> Int[np.ndarray, " n"]:
    """Most likely state of each sample: 0 free motion, k the k-th hypothesis (Viterbi's algorithm); or, as in a cut
    recording, a single state throughout.
    """
    n, k = values.shape
    if k == 0:
        return np.zeros(n, dtype=np.int64)
    whole = np.add.reduceat(np.concatenate([np.zeros((n, 1)), values], axis=1), first[:-1], axis=0)
    alone = np.repeat(np.argmax(whole, axis=1), np.diff(first))
    if np.isinf(switch):
        return alone
    padded = _padded(np.concatenate([np.zeros((n, 1)), values], axis=1), first)
    # into or out of a constraint costs half a change: from one to the next a whole one
    border = 0.5 * switch * (np.arange(k + 1) > 0)
    cost = border[:, None] + border
    np.fill_diagonal(cost, 0.0)
    back = np.zeros(padded.shape, dtype=np.int64)
    value = np.broadcast_to(-border, padded.shape[1:])
    for t, step in enumerate(padded):
        arrivals = value[:, :, None] - cost
        back[t] = arrivals.argmax(axis=1)
        value = arrivals.max(axis=1) + step
    state = np.argmax(value - border, axis=1)
    best = np.max(value - border, axis=1)
    out = np.zeros(padded.shape[:2], dtype=np.int64)
    rows = np.arange(padded.shape[1])
    for t in range(len(padded) - 1, -1, -1):
        out[t] = state
        state = back[t, rows, state]
    states = np.concatenate([out[: b - a, i] for i, (a, b) in enumerate(pairwise(first))])
    return np.where(np.repeat(whole.max(axis=1) > best, np.diff(first)), alone, states)


def _padded(values: Float[np.ndarray, "n h"], first: Int[np.ndarray, " m"]) -> Float[np.ndarray, "T g h"]:
    lengths = np.diff(first)
    out = np.zeros((int(lengths.max()), len(lengths), values.shape[1]))
    for i, (a, b) in enumerate(pairwise(first)):
        out[: b - a, i] = values[a:b]
    return out


def state_runs(states: Int[np.ndarray, " n"], first: Int[np.ndarray, " m"]) -> list[tuple[int, int, int]]:
    """Stretches of one state: (state, first sample, sample after the last), free ones included."""
    cuts = np.flatnonzero(np.diff(states)) + 1
    edges = np.unique(np.concatenate([cuts, first]))
    return [(int(states[a]), int(a), int(b)) for a, b in pairwise(edges)]


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
    for found, a, b in state_runs(states, motion.first):
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
        inside = covered(motion, [s])
        time = motion.time[inside]
        inner = (time >= s.start + SHORTEST_STRETCH_SECONDS) & (time <= s.end - SHORTEST_STRETCH_SECONDS)
        if s.duration < 4.0 * SHORTEST_STRETCH_SECONDS or np.count_nonzero(inner) < 10:
            out.append(s)
            continue
        way = np.cumsum(motion.rates[inside] * motion.weight[inside, None], axis=0) @ rows.T
        away = np.linalg.norm(way - np.median(way[inner], axis=0), axis=1)
        left = time[(away > FAR_FROM_HELD * np.quantile(away[inner], 0.9)) & ~inner]
        before, after = (left[left < s.start + SHORTEST_STRETCH_SECONDS], left[left > s.end - SHORTEST_STRETCH_SECONDS])
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


def pieces_of(table: Table, stretches: Sequence[Stretch]) -> tuple[list[Stretch], Table]:
    """The stretches that are long enough to learn from, and their samples."""
    spans = [(s, cut(table.recordings[s.trajectory], s)) for s in stretches]
    long = [(s, span) for s, span in spans if span is not None]
    return [s for s, _ in long], table.pieces([(s.trajectory, span) for s, span in long])


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
        own = slice(*motion.first[s.trajectory : s.trajectory + 2])
        held[own] |= (motion.time[own] >= s.start) & (motion.time[own] <= s.end)
    return held


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
