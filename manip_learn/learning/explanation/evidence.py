"""Evidence of every sample for a hypothesis, in nats over free motion, and the sequence of states with the most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from manip_learn.learning.deciding import CHANGE_SECONDS, FAR_OFF_SHARE, HELD_SHARES, HELD_STEADY, SWITCH_NATS
from manip_learn.learning.explanation.row_motion import RowMotion


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
        energy: e = u^T A^+ A u of each sample under each hypothesis.
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

    Args:
        values: Evidence of each sample.
        first: First sample of each trajectory, and n at the end.
        switch: What a change costs [nats]; infinite: there is none.
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

    Args:
        steps: Evidence of each sample.
        half: Of what a stretch costs [nats].
        changes: Where to note which samples are best entered from free motion, and from a contact; None: nowhere.
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


def runs(states: Int[np.ndarray, " n"], first: Int[np.ndarray, " m"]) -> list[tuple[int, int, int]]:
    """Stretches of one state: (state, first sample, sample after the last), free ones included."""
    cuts = np.flatnonzero(np.diff(states)) + 1
    edges = np.unique(np.concatenate([cuts, first]))
    return [(int(states[a]), int(a), int(b)) for a, b in pairwise(edges)]
