"""Recordings that repeat each other, or themselves: a known path is evidence only once.

Recordings are compared as paths in joint space, whatever their direction, rate, start and clock: one repeats another if
its path lies on the other's, within the noise of the encoders and the error of chords between samples. A second
demonstration by hand lies elsewhere; a robot that replays a programmed path, in another file or later in the same one,
shows the same geometry again, and a task with one direction of motion has one path only. A known path adds no evidence
about the constraint and is left out, at the price of its share in averaging the noise.

Pieces of one recording touch end to end: one continues at the position and speed where another stopped. They are joined
again, so that the answer, its uncertainty and its warnings are the same as for the uncut recording. Strokes with a gap
between them, and recordings that begin at rest where the last one ended, count separately.
"""

from __future__ import annotations

import dataclasses
from bisect import bisect_left
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from manip_learn.errors import listed
from manip_learn.learning.table import SLIGHT, Stretch, Table
from manip_learn.recordings.trajectory import OPTIONAL_ARRAYS, Demonstrations, Trajectory, distinct_names
from manip_learn.recordings.velocities import noise_variance

# largest distance of a posture on a path, over the noise and the error of chords: the noise of seven joints reaches
# twice its RMS once in 5,000 samples, the noise of two joints once in 50. Also the largest residual of a cubic at a
# seam, over the largest one elsewhere; 1.5 and 4 give the same results for 2,464 sets (at bf329fe4)
NOISE_RATIO = 2.0
# smallest share of a recording's path that lies on another's: copies are trimmed by a few samples at their ends. The
# remaining share is the smallest part of a path that counts as a repetition of the part before it in one file
REPEATED_SHARE = 0.9
POSTURES, PROBES = 200, 9  # postures of a recording that are compared, and in the first test


class IndependentRecordings(NamedTuple):
    """Recordings without repeats of each other, or of themselves.

    Attributes:
        demonstrations: Recordings to learn from.
        origins: For each recording in `demonstrations` its pieces: index of the original recording in `given`, and the
            time that was added to its time stamps [s].
        given: The original recordings.
        warnings: Sentences about recordings that repeat others or were joined.
    """

    demonstrations: Demonstrations
    origins: tuple[tuple[tuple[int, float], ...], ...]
    given: Demonstrations
    warnings: tuple[str, ...] = ()

    @staticmethod
    def of(recordings: Demonstrations) -> IndependentRecordings:
        """Drop repeated motions and join pieces of one motion.

        Of recordings that repeat each other, the longest (or else the first) is kept; of a recording that repeats
        itself, the first round. Recordings that touch end to end are joined.

        Args:
            recordings: All recordings.

        Returns:
            Independent recordings, with the originals and warnings.
        """
        if len({t.q.shape[1] for t in recordings}) > 1:  # refused where the samples are collected
            return IndependentRecordings(recordings, tuple(((i, 0.0),) for i in range(len(recordings))), recordings)
        names = distinct_names(recordings)
        renamed = [dataclasses.replace(t, name=name) for t, name in zip(recordings, names, strict=True)]
        paths = [_Path(t) for t in renamed]
        joined = [_join_pieces(renamed, chain) for chain in _find_chains(paths)]
        whole, origins = [t for t, _ in joined], tuple(origin for _, origin in joined)
        once = "are pieces of one recording, each goes on where another ends; they count once"
        warnings = [f"{t.name} {once}" for t, origin in joined if len(origin) > 1]
        paths = paths if len(whole) == len(recordings) else [_Path(t) for t in whole]
        repeated = _find_repeats(paths)
        for first in dict.fromkeys(remaining for remaining, _ in repeated.values()):
            copies = [i for i, (remaining, _) in repeated.items() if remaining == first]
            verb = "repeats" if len(copies) == 1 and len(origins[copies[0]]) == 1 else "repeat"
            text = f"{listed(whole[i].name for i in copies)} {verb} {whole[first].name}"
            warnings.append(f"{text} ({_closeness(max(repeated[i][1] for i in copies))}); they count once")
        remaining = [i for i in range(len(whole)) if i not in repeated]
        for i in remaining:
            if repetition := paths[i].known_from(alone=len(remaining) == 1):
                since = f"repeats itself from {whole[i].time[repetition[0]]:.1f} s on"
                warnings.append(f"{whole[i].name} {since} ({_closeness(repetition[1])}); it counts once")
                whole[i] = whole[i].part(slice(repetition[0]))
        if not warnings:
            return IndependentRecordings(recordings, origins, recordings)
        demonstrations = Demonstrations([whole[i] for i in remaining], recordings.notes)
        return IndependentRecordings(demonstrations, tuple(origins[i] for i in remaining), recordings, tuple(warnings))


def _closeness(within: float) -> str:
    return "the same positions " + (f"within {1e3 * within:.1g} mrad" if within > 1e-9 else "exactly")


class _Path:
    """Path of a recording.

    Attributes:
        trajectory: The recording, with postures (T, n) [rad or m].
        way: Array (T,), length of the path to each posture, from means over neighbours so that noise averages out
            [rad].
        heading: Array (T, n), direction of the path at each sample, not normalised.
        few, probes: Numbers of samples that are evenly spaced along the path, for the comparison, and for a first test.
        extent: Diagonal of its bounding box [rad].
        noise2: Variance of a posture, all joints together, at least (2e-4 rad)^2 [rad^2].
    """

    def __init__(self, trajectory: Trajectory):
        same, n_parts = 2e-4, 50
        # [rad] distance of two passes of one path: arms repeat a posture to 0.1 mm at half a metre; parts of a
        # recording whose mean postures give the length of its path, and whose length is the baseline of its direction
        self.trajectory, q = trajectory, trajectory.q
        i, edges = np.arange(len(q)), np.unique(np.linspace(0, len(q), n_parts + 1).astype(int))
        lengths = np.diff(edges)
        means = np.add.reduceat(q, edges[:-1]) / lengths[:, None]
        way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(means, axis=0), axis=1)))
        self.way = np.interp(i, edges[:-1] + 0.5 * (lengths - 1), way)
        near = max(1, round(len(q) / n_parts))
        self.heading = q[np.minimum(i + near, len(q) - 1)] - q[np.maximum(i - near, 0)]
        even = [np.linspace(0.0, self.way[-1], n) for n in (POSTURES, PROBES)]
        self.few, self.probes = (np.searchsorted(self.way, x).clip(0, len(q) - 1) for x in even)
        self.extent = float(np.linalg.norm(np.ptp(q, axis=0)))
        noise = noise_variance(trajectory.time, q) if len(q) > 5 else np.zeros(1)
        self.noise2 = same**2 + float(np.sum(noise))

    def distance_from(self, other: _Path, share: float = REPEATED_SHARE, way: int = 0) -> float | None:
        """Return the largest distance of the postures that lie on the other path [rad].

        Args:
            other: Path to compare with.
            share: Smallest share of the postures that must lie on it.
            way: 1 for motion in the same direction, -1 for the opposite one, 0 for either.

        Returns:
            Distance [rad]; None if too few postures lie on the other path.
        """
        n_nearest = 8  # samples of a path around each posture: more than one pass
        q, few = other.trajectory.q, self.few
        postures = self.trajectory.q[few]
        nearest = cKDTree(q).query(postures, k=n_nearest)[1]  # with fewer samples, the last one is repeated
        # nearest segment between two samples that the motion passes in the right direction
        a = np.concatenate([nearest, nearest - 1], axis=1).clip(0, max(len(q) - 2, 0))
        offset, along = postures[:, None] - q[a], q[np.minimum(a + 1, len(q) - 1)] - q[a]
        length2 = np.maximum(np.sum(along**2, axis=2), np.finfo(np.float64).tiny)
        part = np.clip(np.sum(offset * along, axis=2) / length2, 0.0, 1.0)
        distances = np.linalg.norm(offset - part[:, :, None] * along, axis=2)
        distances[way * np.sum(self.heading[few, None] * other.heading[a], axis=2) < 0.0] = np.inf
        best = np.arange(len(a)), np.argmin(distances, axis=1)
        distance = distances[best]
        # largest distance of the motion from the chord between them: an eighth of the second difference, doubled
        second = np.linalg.norm(np.diff(q, n=2, axis=0), axis=1) if len(q) > 2 else np.zeros(1)
        chord = 0.25 * np.max(second[np.clip(a[best] - np.array([[0], [1]]), 0, len(second) - 1)], axis=0)
        most = NOISE_RATIO * np.sqrt(self.noise2 + other.noise2 + chord**2)
        # no decision where noise or long chords are larger
        lies = distance <= np.minimum(most, SLIGHT * max(self.extent, other.extent))
        return float(np.max(distance[lies])) if np.mean(lies) >= share else None

    def known_from(self, *, alone: bool) -> tuple[int, float] | None:
        """Return the sample from which the recording repeats itself, and the largest distance [rad].

        In the presence of other recordings, motion back and forth on one path is part of the task, not a repeated
        round.

        Args:
            alone: True if there is no other recording.

        Returns:
            None if the last part of the path is new.
        """
        q, shares = self.trajectory.q, np.array([REPEATED_SHARE, 0.5 * (1.0 + REPEATED_SHARE)])
        last, inside = map(int, np.searchsorted(self.way, shares * self.way[-1]))
        step = np.linalg.norm(np.diff(q, axis=0), axis=1).max(initial=0.0)
        gap = np.linalg.norm(q[:last] - q[inside], axis=1).min(initial=np.inf)
        # first test, with one posture of the last part
        if not 0 < last < len(q) - 1 or gap > SLIGHT * self.extent + step:
            return None

        def distance(start: int, way: int) -> float | None:
            before, rest = (_Path(self.trajectory.part(part)) for part in (slice(start), slice(start, None)))
            # the noise of two joints leaves the path once in 50 samples
            return rest.distance_from(before, 1.0 - 2.0 * SLIGHT, way)

        way = 0 if alone else 1
        if distance(last, way) is None or (not alone and distance(last, -1) is not None):
            return None
        # a path that contains the rest up to an early sample contains it up to a later one, too: bisection is valid
        start = 1 + bisect_left(range(1, last), True, key=lambda k: distance(k, way) is not None)
        return start, distance(start, way) or 0.0


def drop_duplicates(table: Table, stretches: Sequence[Stretch]) -> dict[Stretch, Trajectory]:
    """Return the motions of stretches, without stretches that repeat another one of the same recording.

    Args:
        table: Samples of all recordings.
        stretches: Parts of recordings.

    Returns:
        Dictionary from each remaining stretch to its motion.
    """
    long = [(s, k - table.first[s.recording]) for s in stretches if len(k := table.samples(s)) > 2]
    pieces = {s: table.moved[s.recording].part(k) for s, k in long}
    for recording in {s.recording for s in pieces}:
        candidates = [s for s in pieces if s.recording == recording]
        for k in _find_repeats([_Path(pieces[s]) for s in candidates]) if len(candidates) > 1 else ():
            del pieces[candidates[k]]
    return pieces


def _find_repeats(paths: Sequence[_Path]) -> dict[int, tuple[int, float]]:
    """Return the number of a recording that repeats another -> number of the other, and the largest distance [rad]."""
    n_near = 6  # probes that must be near another path
    probes = cKDTree(np.concatenate([p.trajectory.q[p.probes] for p in paths]))
    pairs = list[tuple[int, int]]()
    for j, path in enumerate(paths):
        within = SLIGHT * path.extent + path.way[-1] / POSTURES
        hits = probes.query_ball_point(path.trajectory.q[path.few], within)
        near = np.bincount(np.unique(np.concatenate(hits)).astype(int) // PROBES) >= n_near
        pairs += [(int(i), j) for i in np.flatnonzero(near) if i != j]
    lies = {(i, j): d for i, j in sorted(pairs) if (d := paths[i].distance_from(paths[j])) is not None}
    repeated: dict[int, tuple[int, float]] = {}

    def original(i: int) -> tuple[int, float]:
        largest = 0.0
        while i in repeated:  # it ends: the pairs behind i lead to no recording twice
            i, distance = repeated[i]
            largest = max(largest, distance)
        return i, largest

    for (i, j), distance in lies.items():
        # keep the first of two that repeat each other, and one of several that do so in a cycle
        if i not in repeated and (j < i or (j, i) not in lies) and original(j)[0] != i:
            repeated[i] = j, distance
    return {i: original(i) for i in repeated}


def _find_chains(paths: Sequence[_Path]) -> list[list[int]]:
    """Return the numbers of recordings that continue each other smoothly, in order, the likeliest seams joined first.

    A piece with one seam in motion, or on a continuing clock, may also be joined where it is at rest.
    """
    ratio, width, share = 0.2, (3, 10), 16
    # ratio: largest residual of a cubic over the path through a seam where something moves (noise alone leaves 0.6);
    # and smallest speed over the mean speed where a motion was cut: the last 10 of 200 samples of a motion that comes
    # to rest have 0.03. width: fewest and most samples on either side of a seam to which a cubic is fitted; the fewest
    # is also the largest distance of two ends, in mean steps: one step without noise, about as often two where noise is
    # as large as a step. share: samples of a recording over the width
    long = [i for i, path in enumerate(paths) if len(path.way) > 2 * width[0]]  # one sample may be shared
    starts, extent = np.array([paths[i].trajectory.q[0] for i in long]), max(path.extent for path in paths)
    seams = []
    for before in long:
        a = paths[before].trajectory
        step = np.mean(np.linalg.norm(np.diff(a.q[-width[0] - 1 :], axis=0), axis=1))
        for after in (long[k] for k in np.flatnonzero(np.linalg.norm(starts - a.q[-1], axis=1) <= width[0] * step)):
            b = paths[after].trajectory
            half, later = int(np.clip(min(len(a), len(b)) // share, *width)), b.q[_shared_samples(a, b) :]
            seam = np.concatenate([a.q[-half:], later[:half]])
            residual = float(_cubic_residuals(seam, 2 * half)[0])
            usual = max(float(np.max(_cubic_residuals(q, 2 * half))) for q in (a.q, later))
            speed = (paths[before].way[-1] + paths[after].way[-1]) / (len(a) + len(b))
            through, pause = np.linalg.norm(seam[-1] - seam[0]), b.time[0] - a.time[-1]
            moves = residual < SLIGHT * extent and through > max(ratio * speed * 2 * half, residual / ratio)
            goes_on = 0.0 <= pause <= 2.0 * max(np.median(np.diff(a.time)), np.median(np.diff(b.time)))
            if before != after and (goes_on or residual <= NOISE_RATIO * usual + 1e-12):
                seams.append((not (goes_on or moves), after != before + 1, residual, before, after))
    cut = {i for at_rest, *_, before, after in seams if not at_rest for i in (before, after)}
    chains = {i: [i] for i in range(len(paths))}  # by their first number
    ends = dict(chains)
    for *_, before, after in sorted(seams):
        chain, further = ends.get(before), chains.get(after)
        if chain and further and chain is not further and not cut.isdisjoint((before, after)):
            del ends[before]
            chain += chains.pop(after)
            ends[chain[-1]] = chain
    return list(chains.values())


def _cubic_residuals(q: Float[np.ndarray, "T n"], width: int) -> Float[np.ndarray, " k"]:
    """Return the RMS residual of a cubic in each window of `width` samples [rad]."""
    basis = np.linalg.qr(np.linspace(-1.0, 1.0, width)[:, None] ** np.arange(4))[0]
    windows = np.lib.stride_tricks.sliding_window_view(q, width, axis=0)
    residuals = windows - (windows @ basis) @ basis.T
    return np.sqrt(np.mean(np.sum(residuals**2, axis=1), axis=1))


def _shared_samples(before: Trajectory, after: Trajectory) -> int:
    """Return 1 if the second piece begins with the last sample of the first; else 0."""
    return int(np.array_equal(before.q[-1], after.q[0]))


def _join_pieces(pieces: Sequence[Trajectory], chain: list[int]) -> tuple[Trajectory, tuple[tuple[int, float], ...]]:
    """Join the pieces of a recording, with the clock of the first; return it with its origin.

    Where the clock does not continue, a piece begins one step after the previous one.
    """
    parts, origin = [pieces[chain[0]]], [(chain[0], 0.0)]
    for i in chain[1:]:
        a, added = pieces[origin[-1][0]], origin[-1][1]
        parts.append(pieces[i].part(slice(_shared_samples(a, pieces[i]), None)))
        step, pause = float(np.median(np.diff(a.time))), float(parts[-1].time[0] - a.time[-1])
        origin.append((i, added if 0.0 < pause <= 2.0 * step else added + step - pause))
    if len(parts) == 1:
        return parts[0], tuple(origin)
    time = np.concatenate([p.time + added for p, (_, added) in zip(parts, origin, strict=True)])
    same = {"q"}.union(set.intersection(*(set(p.arrays) for p in parts)))
    arrays = {x: np.concatenate([getattr(p, x) for p in parts]) if x in same else None for x in ("q", *OPTIONAL_ARRAYS)}
    run, names = len(chain) > 2 and chain == list(range(chain[0], chain[-1] + 1)), [p.name for p in parts]
    name = f"{names[0]} to {names[-1]}" if run else listed(names)
    return dataclasses.replace(parts[0], time=time, name=name, **arrays), tuple(origin)  # with their flags
