"""Recordings that repeat each other, or themselves: a known path is evidence only once.

A posture says nothing of when it was passed. So recordings are compared as paths in the space of the joints, whatever
their direction, rate, start and clock: one repeats another if its path lies on the other's, within what the encoders'
noise and the chords between samples allow. A second demonstration that somebody gives lies elsewhere; a robot that
replays a programmed path, in another file or on in the same one, shows the same geometry again, and with one way to
move there is one path only. What lies on a path that is known adds nothing to what is held and is left out, at the
price of its share in averaging the noise.

Pieces of one recording touch end to end: one goes on where and as fast as another stopped. They are put together
again, so that the answer, its uncertainty and its warnings are those of the uncut recording. Strokes between which
something was left out, and recordings that begin at rest where the last one ended, count each.
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

# [rad] two passes of one path are as near as this to each other: arms repeat a posture to 0.1 mm at half a metre
REPEATED_RAD = 2e-4
# distance over what noise and chords allow, up to which a posture lies on a path: the noise of seven joints reaches
# twice its root mean square once in 5,000 samples, that of two joints once in 50. And what a cubic leaves at a seam
# over the most that it leaves elsewhere; 1.5 and 4 tell the same of 2,464 sets (at bf329fe4)
AS_NOISE = 2.0
# least share of a recording's way that lies on another's: copies are trimmed by a few samples at their ends. The rest
# of a way is the least that is told to repeat what comes before it in one file
REPEATED_SHARE = 0.9
# of the way through a seam, what a cubic leaves of it where something moves (noise alone leaves 0.6); its speed over
# the mean one where a motion was cut rather than ended: the last 10 of 200 samples of one that comes to rest have 0.03
SEAM = 0.2

# postures of a recording that are compared, those of a first look, and how many of these must be near
POSTURES, PROBES, PROBES_NEAR = 200, 9, 6
NEAREST = 8  # samples of a path that are looked at around each of them: more than one pass
# of a recording, whose mean postures tell the length of its way; over one before and after a sample it is told where
# the path goes
WAY_PARTS = 50
# least and most samples on either side of a seam that a cubic is fitted to, and how many times less than a recording's
# samples. The end of one piece may be the least of steps from the beginning of the next: one without noise, where noise
# is as large as a step as often as not two
_SEAM, SEAM_SHARE = (3, 10), 16


class IndependentRecordings(NamedTuple):
    """Recordings without repeats of each other, or of themselves.

    Attributes:
        demonstrations: To learn from.
        origins: Of each of them the pieces that it is made of: number of the given recording, and the time that was
            added to its clock [s].
        given: The recordings as they were given.
        warnings: What repeats what, and what is put together of pieces, in sentences.
    """

    demonstrations: Demonstrations
    origins: tuple[tuple[tuple[int, float], ...], ...]
    given: Demonstrations
    warnings: tuple[str, ...] = ()

    @staticmethod
    def of(given: Demonstrations) -> IndependentRecordings:
        """Join pieces, keep the longest or first of recordings that repeat each other, and the first round of one.

        Args:
            given: All recordings.
        """
        if len({t.q.shape[1] for t in given}) > 1:  # refused where the samples are collected
            return IndependentRecordings(given, tuple(((i, 0.0),) for i in range(len(given))), given)
        named = [dataclasses.replace(t, name=name) for t, name in zip(given, distinct_names(given), strict=True)]
        paths = [_Path(t) for t in named]
        joined = [_joined(named, chain) for chain in _chains(paths)]
        whole, origins = [t for t, _ in joined], tuple(origin for _, origin in joined)
        once = "are pieces of one recording, each goes on where another ends; they count once"
        warnings = [f"{t.name} {once}" for t, origin in joined if len(origin) > 1]
        paths = paths if len(whole) == len(given) else [_Path(t) for t in whole]
        repeated = _repeats(paths)
        for first in dict.fromkeys(kept for kept, _ in repeated.values()):
            copies = [i for i, (kept, _) in repeated.items() if kept == first]
            verb = "repeats" if len(copies) == 1 and len(origins[copies[0]]) == 1 else "repeat"
            text = f"{listed(whole[i].name for i in copies)} {verb} {whole[first].name}"
            warnings.append(f"{text} ({_near(max(repeated[i][1] for i in copies))}); they count once")
        kept = [i for i in range(len(whole)) if i not in repeated]
        for i in kept:
            if known := paths[i].known_from(alone=len(kept) == 1):
                since = f"repeats itself from {whole[i].time[known[0]]:.1f} s on"
                warnings.append(f"{whole[i].name} {since} ({_near(known[1])}); it counts once")
                whole[i] = whole[i].part(slice(known[0]))
        if not warnings:
            return IndependentRecordings(given, origins, given)
        demonstrations = Demonstrations([whole[i] for i in kept], given.notes)
        return IndependentRecordings(demonstrations, tuple(origins[i] for i in kept), given, tuple(warnings))


def _near(within: float) -> str:
    return "the same positions " + (f"within {1e3 * within:.1g} mrad" if within > 1e-9 else "exactly")


class _Path:
    """Path of a recording.

    Attributes:
        trajectory: The recording, of postures with shape (T, n) [rad or m].
        way: shape (T,), length of the path to each posture, of means over neighbours so that noise averages out [rad].
        heading: shape (T, n), direction of the path at each sample, not normalised.
        few, probes: Numbers of samples that are evenly spaced along the path, to compare, and for a first look.
        extent: Diagonal of its bounding box [rad].
        noise2: Variance of a posture, all joints together, no less than `REPEATED_RAD` squared [rad^2].
    """

    def __init__(self, trajectory: Trajectory):
        self.trajectory, q = trajectory, trajectory.q
        i, edges = np.arange(len(q)), np.unique(np.linspace(0, len(q), WAY_PARTS + 1).astype(int))
        lengths = np.diff(edges)
        means = np.add.reduceat(q, edges[:-1]) / lengths[:, None]
        way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(means, axis=0), axis=1)))
        self.way = np.interp(i, edges[:-1] + 0.5 * (lengths - 1), way)
        near = max(1, round(len(q) / WAY_PARTS))
        self.heading = q[np.minimum(i + near, len(q) - 1)] - q[np.maximum(i - near, 0)]
        even = [np.linspace(0.0, self.way[-1], n) for n in (POSTURES, PROBES)]
        self.few, self.probes = (np.searchsorted(self.way, x).clip(0, len(q) - 1) for x in even)
        self.extent = float(np.linalg.norm(np.ptp(q, axis=0)))
        noise = noise_variance(trajectory.time, q) if len(q) > 5 else np.zeros(1)
        self.noise2 = REPEATED_RAD**2 + float(np.sum(noise))

    def distance_from(self, other: _Path, share: float = REPEATED_SHARE, way: int = 0) -> float | None:
        """Return the largest distance of the postures that lie on the other path [rad].

        None if these are less than a share of it, in the same direction (`way` 1), the opposite one (-1) or either (0).
        """
        q, few = other.trajectory.q, self.few
        chosen = self.trajectory.q[few]
        nearest = cKDTree(q).query(chosen, k=NEAREST)[1]  # of fewer samples the last one again
        # segments between two samples; of those that the motion passes in the right direction the nearest
        a = np.concatenate([nearest, nearest - 1], axis=1).clip(0, max(len(q) - 2, 0))
        offset, along = chosen[:, None] - q[a], q[np.minimum(a + 1, len(q) - 1)] - q[a]
        length2 = np.maximum(np.sum(along**2, axis=2), np.finfo(np.float64).tiny)
        part = np.clip(np.sum(offset * along, axis=2) / length2, 0.0, 1.0)
        distances = np.linalg.norm(offset - part[:, :, None] * along, axis=2)
        distances[way * np.sum(self.heading[few, None] * other.heading[a], axis=2) < 0.0] = np.inf
        best = np.arange(len(a)), np.argmin(distances, axis=1)
        distance = distances[best]
        # how far the motion may be from the chord between them: an eighth of the second difference, doubled
        second = np.linalg.norm(np.diff(q, n=2, axis=0), axis=1) if len(q) > 2 else np.zeros(1)
        chord = 0.25 * np.max(second[np.clip(a[best] - np.array([[0], [1]]), 0, len(second) - 1)], axis=0)
        most = AS_NOISE * np.sqrt(self.noise2 + other.noise2 + chord**2)
        # where noise or long chords exceed it nothing can be told
        lies = distance <= np.minimum(most, SLIGHT * max(self.extent, other.extent))
        return float(np.max(distance[lies])) if np.mean(lies) >= share else None

    def known_from(self, *, alone: bool) -> tuple[int, float] | None:
        """Return the sample from which on it repeats itself, and the largest distance [rad].

        None if the last part of the path is new. Among other recordings, motion back and forth on one path is a hand at
        work, not a round.
        """
        q, shares = self.trajectory.q, np.array([REPEATED_SHARE, 0.5 * (1.0 + REPEATED_SHARE)])
        last, inside = map(int, np.searchsorted(self.way, shares * self.way[-1]))
        step = np.linalg.norm(np.diff(q, axis=0), axis=1).max(initial=0.0)
        gap = np.linalg.norm(q[:last] - q[inside], axis=1).min(initial=np.inf)
        # at a first look one posture of the last part is enough
        if not 0 < last < len(q) - 1 or gap > SLIGHT * self.extent + step:
            return None

        def distance(start: int, way: int) -> float | None:
            before, rest = (_Path(self.trajectory.part(part)) for part in (slice(start), slice(start, None)))
            return rest.distance_from(
                before, 1.0 - 2.0 * SLIGHT, way
            )  # the noise of two joints leaves the path once in 50 samples

        way = 0 if alone else 1
        if distance(last, way) is None or (not alone and distance(last, -1) is not None):
            return None
        # what lies on the path before an early sample lies on the path before a later one, too
        start = 1 + bisect_left(range(1, last), True, key=lambda k: distance(k, way) is not None)
        return start, distance(start, way) or 0.0


def once_each(table: Table, stretches: Sequence[Stretch]) -> dict[Stretch, Trajectory]:
    """Return the motion of each stretch from which rows are learnt, unless it repeats another of its recording."""
    long = [(s, k - table.first[s.recording]) for s in stretches if len(k := table.samples(s)) > 2]
    pieces = {s: table.moved[s.recording].part(k) for s, k in long}
    for recording in {s.recording for s in pieces}:
        own = [s for s in pieces if s.recording == recording]
        for k in _repeats([_Path(pieces[s]) for s in own]) if len(own) > 1 else ():
            del pieces[own[k]]
    return pieces


def _repeats(paths: Sequence[_Path]) -> dict[int, tuple[int, float]]:
    """Return the recordings that repeat another -> that one, which repeats none, and the largest distance [rad]."""
    probes = cKDTree(np.concatenate([p.trajectory.q[p.probes] for p in paths]))
    pairs = list[tuple[int, int]]()
    for j, path in enumerate(paths):
        within = SLIGHT * path.extent + path.way[-1] / POSTURES
        hits = probes.query_ball_point(path.trajectory.q[path.few], within)
        near = np.bincount(np.unique(np.concatenate(hits)).astype(int) // PROBES) >= PROBES_NEAR
        pairs += [(int(i), j) for i in np.flatnonzero(near) if i != j]
    lies = {(i, j): d for i, j in sorted(pairs) if (d := paths[i].distance_from(paths[j])) is not None}
    found: dict[int, tuple[int, float]] = {}

    def kept(i: int) -> tuple[int, float]:
        further = 0.0
        while i in found:  # what falls: the pairs behind i, which lead to no recording twice
            i, distance = found[i]
            further = max(further, distance)
        return i, further

    for (i, j), distance in lies.items():
        # of two that repeat each other the first stays, and one of several that do so in a circle
        if i not in found and (j < i or (j, i) not in lies) and kept(j)[0] != i:
            found[i] = j, distance
    return {i: kept(i) for i in found}


def _chains(paths: Sequence[_Path]) -> list[list[int]]:
    """Return the numbers of recordings that continue each other smoothly, in order, the likeliest seams joined first.

    What was cut in motion at one end, or has one clock with the other, was cut at the other, too, be it at rest.
    """
    long = [i for i, path in enumerate(paths) if len(path.way) > 2 * _SEAM[0]]  # one is left after a shared sample
    starts, told = np.array([paths[i].trajectory.q[0] for i in long]), max(path.extent for path in paths)
    seams = []
    for before in long:
        a = paths[before].trajectory
        step = np.mean(np.linalg.norm(np.diff(a.q[-_SEAM[0] - 1 :], axis=0), axis=1))
        for after in (long[k] for k in np.flatnonzero(np.linalg.norm(starts - a.q[-1], axis=1) <= _SEAM[0] * step)):
            b = paths[after].trajectory
            half, later = int(np.clip(min(len(a), len(b)) // SEAM_SHARE, *_SEAM)), b.q[_shared(a, b) :]
            seam = np.concatenate([a.q[-half:], later[:half]])
            left = float(_left_by_cubics(seam, 2 * half)[0])
            usual = max(float(np.max(_left_by_cubics(q, 2 * half))) for q in (a.q, later))
            speed = (paths[before].way[-1] + paths[after].way[-1]) / (len(a) + len(b))
            way, pause = np.linalg.norm(seam[-1] - seam[0]), b.time[0] - a.time[-1]
            moves = left < SLIGHT * told and way > max(SEAM * speed * 2 * half, left / SEAM)
            goes_on = 0.0 <= pause <= 2.0 * max(np.median(np.diff(a.time)), np.median(np.diff(b.time)))
            if before != after and (goes_on or left <= AS_NOISE * usual + 1e-12):
                seams.append((not (goes_on or moves), after != before + 1, left, before, after))
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


def _left_by_cubics(q: Float[np.ndarray, "T n"], width: int) -> Float[np.ndarray, " k"]:
    """Return the RMS residual of a cubic in each window of `width` samples [rad]."""
    basis = np.linalg.qr(np.linspace(-1.0, 1.0, width)[:, None] ** np.arange(4))[0]
    windows = np.lib.stride_tricks.sliding_window_view(q, width, axis=0)
    left = windows - (windows @ basis) @ basis.T
    return np.sqrt(np.mean(np.sum(left**2, axis=1), axis=1))


def _shared(before: Trajectory, after: Trajectory) -> int:
    """Return 1 if the second piece begins with the last sample of the first; else 0."""
    return int(np.array_equal(before.q[-1], after.q[0]))


def _joined(given: Sequence[Trajectory], chain: list[int]) -> tuple[Trajectory, tuple[tuple[int, float], ...]]:
    """Return the pieces of a recording as one, named after them, on the clock of the first, and its origin.

    Where the clock does not go on, a piece begins one step after the previous one.
    """
    parts, origin = [given[chain[0]]], [(chain[0], 0.0)]
    for i in chain[1:]:
        a, added = given[origin[-1][0]], origin[-1][1]
        parts.append(given[i].part(slice(_shared(a, given[i]), None)))
        step, pause = float(np.median(np.diff(a.time))), float(parts[-1].time[0] - a.time[-1])
        origin.append((i, added if 0.0 < pause <= 2.0 * step else added + step - pause))
    if len(parts) == 1:
        return parts[0], tuple(origin)
    time = np.concatenate([p.time + added for p, (_, added) in zip(parts, origin, strict=True)])
    kept = {"q"}.union(set.intersection(*(set(p.arrays) for p in parts)))
    arrays = {x: np.concatenate([getattr(p, x) for p in parts]) if x in kept else None for x in ("q", *OPTIONAL_ARRAYS)}
    run, names = len(chain) > 2 and chain == list(range(chain[0], chain[-1] + 1)), [p.name for p in parts]
    name = f"{names[0]} to {names[-1]}" if run else listed(names)
    return dataclasses.replace(parts[0], time=time, name=name, **arrays), tuple(origin)  # with their flags
