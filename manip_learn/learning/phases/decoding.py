"""Which constraint explains which samples, all constraints and free motion considered together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from manip_learn.learning.phases.motion import PhaseMotion
from manip_learn.learning.phases.result import Stretch
from manip_learn.learning.phases.search import Found, evidence_of, refit, scale_of
from manip_learn.learning.phases.segmentation import best_states, runs

# a stretch shorter than this is chance [s]
SHORTEST = 0.3
# left out at both ends of a stretch before rows are fitted: velocities are smoothed over the change [s]
TRIM = 0.1
REFITS = 3
KEPT = 0.9  # least share of the evidence that a fit keeps
# ends of a stretch that may have left it [s], and how many times as far from where it is held as its inner part
EDGE, FAR = 0.3, 3.0


def evidences(motion: PhaseMotion, found: Sequence[Found]) -> Float[np.ndarray, "n k"]:
    """Evidence of each sample for each constraint."""
    return np.stack([evidence_of(motion, f) for f in found], axis=1) if found else np.zeros((len(motion), 0))


def decoded(motion: PhaseMotion, found: Sequence[Found]) -> Int[np.ndarray, " n"]:
    """State of each sample: 0 free, k the k-th constraint."""
    return best_states(evidences(motion, found), motion.first)


def explained(motion: PhaseMotion, found: Sequence[Found]) -> Float[np.ndarray, " n"]:
    """Evidence of each sample for the constraint that explains it; 0 in free motion."""
    values = np.concatenate([np.zeros((len(motion), 1)), evidences(motion, found)], axis=1)
    return values[np.arange(len(motion)), decoded(motion, found)]


def supports(motion: PhaseMotion, found: Sequence[Found]) -> Float[np.ndarray, " k"]:
    """Evidence for each constraint beyond the best other explanation, without its best supporter [nats]."""
    values = evidences(motion, found)
    states = best_states(values, motion.first)
    out = np.zeros(len(found))
    for k in range(len(found)):
        others = np.maximum(np.max(np.delete(values, k, axis=1), axis=1, initial=0.0), 0.0)
        gain = np.where(states == k + 1, values[:, k] - others, 0.0)
        gains = np.bincount(motion.trajectory, gain, minlength=motion.n_trajectories)
        out[k] = gains.sum() - gains.max()
    return out


def refitted(motion: PhaseMotion, found: Sequence[Found]) -> list[Found]:
    """All constraints fitted to the samples that each explains best; those before a fit that loses evidence.

    A recording in which the hand slips can make a fit soft; a soft fit accepts free motion, and so becomes softer.
    """
    best, now, most = list(found), list(found), -np.inf
    for turn in range(REFITS + 1):
        values = evidences(motion, now)
        states = best_states(values, motion.first)
        total = float(values[np.arange(len(motion)), states - 1][states > 0].sum())
        if total < KEPT * most:
            return best
        best, most = list(now), max(most, total)
        for k, f in enumerate(now if turn < REFITS else ()):
            held = trimmed(motion, states == k + 1)
            if np.count_nonzero(held & motion.moving) >= 3 * f.rows.shape[1]:
                rows = refit(motion, held, f.n_rows, f.scale)
                now[k] = Found(rows, scale_of(motion, rows, held), f.support, f.gains)
    return best


def finally_fitted(motion: PhaseMotion, found: Found, stretches: Sequence[Stretch]) -> Found:
    """A constraint fitted to all samples of its stretches, trimmed."""
    held = np.zeros(len(motion), dtype=bool)
    for s in stretches:
        inside = (motion.time >= s.start + TRIM) & (motion.time <= s.end - TRIM)
        held |= (motion.trajectory == s.trajectory) & inside
    if np.count_nonzero(held) < 3 * found.rows.shape[1]:
        return found
    rows = refit(motion, held, found.n_rows, found.scale)
    return Found(rows, scale_of(motion, rows, held), found.support, found.gains)


def trimmed(motion: PhaseMotion, held: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """The held samples without those near the ends of their stretches."""
    out = np.zeros(len(held), dtype=bool)
    for state, a, b in runs(held.astype(np.int64), motion.first):
        if state:
            time = motion.time[a:b]
            out[a:b] = (time >= time[0] + TRIM) & (time <= time[-1] - TRIM)
    return out


def stretches_of(motion: PhaseMotion, states: Int[np.ndarray, " n"], state: int) -> tuple[Stretch, ...]:
    """Stretches of one state, from the first to the last sample that moves."""
    moving = motion.moving
    out = []
    for found, a, b in runs(states, motion.first):
        inside = np.flatnonzero(moving[a:b]) if found == state else np.zeros(0, dtype=np.int64)
        if len(inside):
            start, end = float(motion.time[a + inside[0]]), float(motion.time[a + inside[-1]])
            if end - start >= SHORTEST or state == 0:
                out.append(Stretch(int(motion.trajectory[a]), start, end))
    return tuple(out)


def sharpened(motion: PhaseMotion, found: Found, stretches: Sequence[Stretch]) -> tuple[Stretch, ...]:
    """Stretches without their ends where these have left what the inner part holds still.

    A hand that leaves a surface at a flat angle has moved along the held rows before its velocity shows it.
    """
    out = []
    for s in stretches:
        inside = (motion.trajectory == s.trajectory) & (motion.time >= s.start) & (motion.time <= s.end)
        time = motion.time[inside]
        inner = (time >= s.start + EDGE) & (time <= s.end - EDGE)
        if s.duration < 4.0 * EDGE or np.count_nonzero(inner) < 10:
            out.append(s)
            continue
        way = np.cumsum(motion.rates[inside] * motion.weight[inside, None], axis=0) @ found.rows.T
        away = np.linalg.norm(way - np.median(way[inner], axis=0), axis=1)
        left = time[(away > FAR * np.quantile(away[inner], 0.9)) & ~inner]
        before, after = left[left < s.start + EDGE], left[left > s.end - EDGE]
        start = s.start if not len(before) else float(time[time > before[-1]][0])
        end = s.end if not len(after) else float(time[time < after[0]][-1])
        out.append(Stretch(s.trajectory, start, end))
    return tuple(out)


def still_stretches(motion: PhaseMotion, taken: Sequence[Stretch]) -> tuple[Stretch, ...]:
    """What the other stretches leave over: standstill."""
    out = []
    for i in range(motion.n_trajectories):
        time = motion.time[motion.first[i] : motion.first[i + 1]]
        inside = sorted((s.start, s.end) for s in taken if s.trajectory == i)
        edges = [float(time[0]), *(x for pair in inside for x in pair), float(time[-1])]
        gaps = zip(edges[::2], edges[1::2], strict=True)
        out += [Stretch(i, a, b) for a, b in gaps if b - a >= SHORTEST]
    return tuple(out)
