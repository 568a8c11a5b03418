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
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise
from typing import Any, final

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from manip_learn.errors import listed
from manip_learn.learning.table import Stretch
from manip_learn.recordings.trajectory import Demonstrations, Trajectory, distinct_names
from manip_learn.recordings.velocities import noise_variance

# [rad] two passes of one path are as near as this to each other: arms repeat a posture to 0.1 mm at half a metre
REPEATED_RAD = 2e-4
# distance over what noise and chords allow, up to which a posture lies on a path: the noise of seven joints reaches
# twice its root mean square once in 5,000 samples, that of two joints once in 50
LIES_ON_PATH = 2.0
# least share of a recording's way that lies on another's: copies are trimmed by a few samples at their ends. The rest
# of a way is the least that is told to repeat what comes before it in one file
REPEATED_SHARE = 0.9
# the same of a round, which is not trimmed; the noise of two joints leaves the path once in 50 samples
ROUND_SHARE = 0.98
# largest distance that may be allowed, over the extent of the path; where noise or long chords exceed it nothing can be
# told. Of 28 kinds of generated sets, whole and cut (6 recordings, 4 arms, no noise, seeds 30000 to 30003), the nearest
# two are 3.6 % of their extent apart in reaches that are repeated, 6.7 % in contacts
NEAREST_PATH_SHARE = 0.01
# steps that the end of one piece may be from the beginning of the next: one without noise, where noise is as large as a
# step as often as not two
SEAM_STEPS = 3.0
# what a cubic leaves at a seam over the most that it leaves elsewhere; 1.25 and 1.5 tell the same of 256 sets
# (benchmarks/repeated_recordings.py, seeds from 30100)
SEAM_ROUGHNESS = 2.0
# what it leaves over the way through the seam, above which nothing moves there: noise alone leaves 0.6
SEAM_LEFT = 0.25
# speed at a seam over the mean one, above which a motion was cut rather than ended: the last 10 of 200 samples of a
# motion that comes to rest have 0.03
SEAM_SPEED = 0.2

# postures of a recording that are compared, those of a first look, and how many of these must be near
POSTURES, PROBES, PROBES_NEAR = 200, 9, 6
NEAREST = 8  # samples of a path that are looked at around each of them: more than one pass
HEADING_SHARE = 0.025  # of a path, before and after a sample, over which it is told where it goes
WAY_PARTS = 50  # of a recording, whose mean postures tell the length of its way
# samples on either side of a seam that a cubic is fitted to, and how many times less than a recording's samples
_SEAM, SEAM_SHARE = (3, 10), 16


@final
@dataclass(frozen=True, eq=False)
class IndependentRecordings:
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
        paths = [_Path(t) for t in given]
        chains, names, said = _chains(paths), distinct_names(given), list[str]()
        whole = [joined_pieces(given.trajectories, chain) for chain in chains]
        for chain in chains:
            numbers = [i for i, _ in chain]
            run = len(chain) > 2 and numbers == list(range(numbers[0], numbers[-1] + 1))
            text = f"{names[numbers[0]]} to {names[numbers[-1]]}" if run else listed(names[i] for i in numbers)
            said += [text]
        warnings = [
            f"{text} are pieces of one recording, each goes on where another ends; they count once"
            for text, chain in zip(said, chains, strict=True)
            if len(chain) > 1
        ]
        paths = paths if len(chains) == len(given) else [_Path(t) for t in whole]
        repeated = _repeats(paths)
        for first in dict.fromkeys(kept for kept, _ in repeated.values()):
            copies = [i for i, (kept, _) in repeated.items() if kept == first]
            verb = "repeats" if len(copies) == 1 and len(chains[copies[0]]) == 1 else "repeat"
            near = _near(max(repeated[i][1] for i in copies))
            warnings.append(f"{listed(said[i] for i in copies)} {verb} {said[first]} ({near}); they count once")
        kept = [i for i in range(len(whole)) if i not in repeated]
        for i in kept:
            if (known := paths[i].known_from(alone=len(kept) == 1)) is not None:
                since = f"repeats itself from {whole[i].time[known[0]]:.1f} s on"
                warnings.append(f"{said[i]} {since} ({_near(known[1])}); it counts once")
                whole[i] = whole[i].part(slice(known[0]))
        if not warnings:
            return IndependentRecordings(given, chains, given)
        demonstrations = Demonstrations([dataclasses.replace(whole[i], name=said[i]) for i in kept], given.notes)
        return IndependentRecordings(demonstrations, tuple(chains[i] for i in kept), given, tuple(warnings))

    def only(self, numbers: Sequence[int]) -> IndependentRecordings:
        """Return the recordings with these numbers."""
        demonstrations = Demonstrations([self.demonstrations[i] for i in numbers], self.demonstrations.notes)
        return dataclasses.replace(self, demonstrations=demonstrations, origins=tuple(self.origins[i] for i in numbers))

    def places(self, stretch: Stretch) -> tuple[Stretch, ...]:
        """Return the stretches of the given recordings, on their own clocks, that make up one of `demonstrations`."""
        out = []
        for number, added in self.origins[stretch.recording]:
            time = self.given[number].time
            start, end = max(stretch.start - added, float(time[0])), min(stretch.end - added, float(time[-1]))
            if start < end or len(self.origins[stretch.recording]) == 1:
                out.append(Stretch(number, start, end))
        return tuple(out)


def _near(within: float) -> str:
    return "the same positions " + (f"within {1e3 * within:.1g} mrad" if within > 1e-9 else "exactly")


@final
@dataclass(frozen=True, eq=False)
class _Path:
    """Path of a recording: postures of shape (T, n) [rad or m]."""

    trajectory: Trajectory

    @cached_property
    def way(self) -> Float[np.ndarray, " T"]:
        """Length of the path to each posture, of means over neighbours so that noise averages out [rad]."""
        q = self.trajectory.q
        edges = np.unique(np.linspace(0, len(q), WAY_PARTS + 1).astype(int))
        lengths = np.diff(edges)
        means = np.add.reduceat(q, edges[:-1]) / lengths[:, None]
        way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(means, axis=0), axis=1)))
        return np.interp(np.arange(len(q)), edges[:-1] + 0.5 * (lengths - 1), way)

    @cached_property
    def extent(self) -> float:
        """Diagonal of its bounding box [rad]."""
        return float(np.linalg.norm(np.ptp(self.trajectory.q, axis=0)))

    @cached_property
    def noise2(self) -> float:
        """Variance of a posture, all joints together, no less than `REPEATED_RAD` squared [rad^2]."""
        t = self.trajectory
        return REPEATED_RAD**2 + (float(np.sum(noise_variance(t.time, t.q))) if len(t) > 5 else 0.0)

    def evenly(self, n: int) -> Int[np.ndarray, " m"]:
        """Return the numbers of n samples, evenly spaced along the path."""
        return np.searchsorted(self.way, np.linspace(0.0, self.way[-1], n)).clip(0, len(self.way) - 1)

    def near(self, probes: cKDTree) -> Int[np.ndarray, " k"]:
        """Return the numbers of paths that may pass near it, by PROBES postures of each."""
        within = NEAREST_PATH_SHARE * self.extent + self.way[-1] / POSTURES
        hits = probes.query_ball_point(self.trajectory.q[self.evenly(POSTURES)], within).tolist()
        found = np.unique(np.array([i for some in hits for i in some], dtype=np.int64))
        return np.flatnonzero(np.bincount(found // PROBES) >= PROBES_NEAR)

    def distance_from(self, other: _Path, share: float = REPEATED_SHARE, way: int = 0) -> float | None:
        """Return the largest distance of the postures that lie on the other path [rad].

        None if these are less than a share of it, in the same direction (`way` 1), the opposite one (-1) or either (0).
        """
        q, few = other.trajectory.q, self.evenly(POSTURES)
        chosen, heading, headings = self.trajectory.q[few], _heading(self.trajectory.q)[few], _heading(q)
        nearest = cKDTree(q).query(chosen, k=min(NEAREST, len(q)))[1].reshape(len(chosen), -1)
        # how far the motion may be from each chord between two samples: an eighth of the second difference, doubled
        second = np.linalg.norm(np.diff(q, n=2, axis=0), axis=1) if len(q) > 2 else np.zeros(1)
        padded = np.pad(second, 1, mode="edge")
        chords = 0.25 * np.maximum(padded[1:], padded[:-1])[: max(len(q) - 1, 1)]
        distance, chord = np.full(len(chosen), np.inf), np.zeros(len(chosen))
        for a in np.concatenate([nearest, nearest - 1], axis=1).T.clip(0, max(len(q) - 2, 0)):
            along = q[np.minimum(a + 1, len(q) - 1)] - q[a]
            length2 = np.maximum(np.sum(along**2, axis=1), np.finfo(np.float64).tiny)
            part = np.clip(np.sum((chosen - q[a]) * along, axis=1) / length2, 0.0, 1.0)
            d = np.linalg.norm(chosen - q[a] - part[:, None] * along, axis=1)
            d[way * np.sum(heading * headings[a], axis=1) < 0.0] = np.inf
            distance, chord = np.minimum(distance, d), np.where(d < distance, chords[a], chord)
        most = LIES_ON_PATH * np.sqrt(self.noise2 + other.noise2 + chord**2)
        lies = distance <= np.minimum(most, NEAREST_PATH_SHARE * max(self.extent, other.extent))
        return float(np.max(distance[lies])) if np.mean(lies) >= share else None

    def known_from(self, *, alone: bool) -> tuple[int, float] | None:
        """Return the sample from which on it repeats itself, and the largest distance [rad].

        None if the last part of the path is new. Among other recordings, motion back and forth on one path is a hand at
        work, not a round.
        """
        q, last = self.trajectory.q, int(np.searchsorted(self.way, REPEATED_SHARE * self.way[-1]))
        # at a first look one posture of the last part is enough
        inside = int(np.searchsorted(self.way, 0.5 * (1.0 + REPEATED_SHARE) * self.way[-1]))
        step = np.linalg.norm(np.diff(q, axis=0), axis=1).max(initial=0.0)
        gap = np.linalg.norm(q[:last] - q[inside], axis=1).min(initial=np.inf)
        if not 0 < last < len(q) - 1 or gap > NEAREST_PATH_SHARE * self.extent + step:
            return None

        @cache
        def distance(start: int, way: int) -> float | None:
            before, rest = (_Path(self.trajectory.part(part)) for part in (slice(start), slice(start, None)))
            return rest.distance_from(before, ROUND_SHARE, way)

        way = 0 if alone else 1
        if distance(last, way) is None or (not alone and distance(last, -1) is not None):
            return None
        # what lies on the path before an early sample lies on the path before a later one, too
        start = 1 + bisect_left(range(1, last), True, key=lambda k: distance(k, way) is not None)
        return start, distance(start, way) or 0.0


def _heading(q: Float[np.ndarray, "T n"]) -> Float[np.ndarray, "T n"]:
    """Return the direction of the path at each sample, not normalised."""
    i, w = np.arange(len(q)), max(1, round(HEADING_SHARE * len(q)))
    return q[np.minimum(i + w, len(q) - 1)] - q[np.maximum(i - w, 0)]


def once_each(stretches: Sequence[Stretch], pieces: Sequence[Trajectory]) -> list[int]:
    """Return the numbers of pieces, each of a stretch, that repeat no other one of the same recording."""
    repeated = set[int]()
    for recording in {s.recording for s in stretches}:
        own = [k for k, s in enumerate(stretches) if s.recording == recording]
        if len(own) > 1:
            repeated |= {own[k] for k in _repeats([_Path(pieces[k]) for k in own])}
    return [k for k in range(len(pieces)) if k not in repeated]


def _repeats(paths: Sequence[_Path]) -> dict[int, tuple[int, float]]:
    """Return the recordings that repeat another -> that one, which repeats none, and the largest distance [rad]."""
    probes = cKDTree(np.concatenate([p.trajectory.q[p.evenly(PROBES)] for p in paths]))
    pairs = sorted((int(i), j) for j, path in enumerate(paths) for i in path.near(probes) if i != j)
    lies = {(i, j): d for i, j in pairs if (d := paths[i].distance_from(paths[j])) is not None}
    found: dict[int, tuple[int, float]] = {}

    def stays(j: int) -> int:  # what falls: the pairs behind j, which lead to no recording twice
        while j in found:
            j = found[j][0]
        return j

    for (i, j), distance in lies.items():
        # of two that repeat each other the first stays, and one of several that do so in a circle
        if i not in found and (j < i or (j, i) not in lies) and stays(j) != i:
            found[i] = j, distance
    for i in found:  # what falls: the pairs behind the one that i lies on
        while found[i][0] in found:
            j, further = found[found[i][0]]
            found[i] = j, max(found[i][1], further)
    return found


def _chains(paths: Sequence[_Path]) -> tuple[tuple[tuple[int, float], ...], ...]:
    """Return chains of recordings that continue each other, in order: numbers, each with the offset of its clock [s].

    With the offset a recording begins one step after the previous one.
    """
    follows: dict[int, int] = {}
    seams = _seams(paths)
    cut = {i for before, after, is_cut in seams if is_cut for i in (before, after)}
    # what was cut in motion at one end was cut at the other, too, be it at rest
    for before, after, _ in (s for s in seams if not cut.isdisjoint(s[:2])):
        end = after  # what falls: the recordings that follow, which are no circle
        while end in follows:
            end = follows[end]
        if before not in follows and after not in follows.values() and end != before:
            follows[before] = after
    chains = []
    for i in sorted(set(range(len(paths))) - set(follows.values())):
        chain = [(i, 0.0)]  # what falls: the recordings that follow
        while (number := chain[-1][0]) in follows:
            a, b = paths[number].trajectory, paths[follows[number]].trajectory
            step, added, first = float(np.median(np.diff(a.time))), chain[-1][1], float(b.time[_shared(a, b)])
            goes_on = 0.0 < first - a.time[-1] <= 2.0 * step
            chain.append((follows[number], added if goes_on else float(a.time[-1]) + added + step - first))
        chains.append(tuple(chain))
    return tuple(chains)


def _seams(paths: Sequence[_Path]) -> list[tuple[int, int, bool]]:
    """Return pairs of recordings that continue each other smoothly, the likeliest first.

    Each is (number before, number after, True if a motion was cut there or one clock goes on).
    """
    long = [i for i, path in enumerate(paths) if len(path.way) > 2 * _SEAM[0]]  # one is left after a shared sample
    starts, told = np.array([paths[i].trajectory.q[0] for i in long]), max(path.extent for path in paths)
    seams = []
    for before in long:
        a = paths[before].trajectory
        step = np.mean(np.linalg.norm(np.diff(a.q[-_SEAM[0] - 1 :], axis=0), axis=1))
        for after in (long[k] for k in np.flatnonzero(np.linalg.norm(starts - a.q[-1], axis=1) <= SEAM_STEPS * step)):
            b = paths[after].trajectory
            half, later = int(np.clip(min(len(a), len(b)) // SEAM_SHARE, *_SEAM)), b.q[_shared(a, b) :]
            seam = np.concatenate([a.q[-half:], later[:half]])
            left = float(_left_by_cubics(seam, 2 * half)[0])
            usual = max(float(np.max(_left_by_cubics(q, 2 * half))) for q in (a.q, later))
            speed = (paths[before].way[-1] + paths[after].way[-1]) / (len(a) + len(b))
            way, pause = np.linalg.norm(seam[-1] - seam[0]), b.time[0] - a.time[-1]
            moves = left < NEAREST_PATH_SHARE * told and way > max(SEAM_SPEED * speed * 2 * half, left / SEAM_LEFT)
            goes_on = 0.0 <= pause <= 2.0 * max(np.median(np.diff(a.time)), np.median(np.diff(b.time)))
            if before != after and (goes_on or left <= SEAM_ROUGHNESS * usual + 1e-12):
                seams.append((not (goes_on or moves), after != before + 1, left, before, after))
    return [(before, after, not at_rest) for at_rest, _, _, before, after in sorted(seams)]


def _left_by_cubics(q: Float[np.ndarray, "T n"], width: int) -> Float[np.ndarray, " k"]:
    """Return the RMS residual of a cubic in each window of `width` samples [rad]."""
    basis = np.linalg.qr(np.linspace(-1.0, 1.0, width)[:, None] ** np.arange(4))[0]
    windows = np.lib.stride_tricks.sliding_window_view(q, width, axis=0)
    left = windows - (windows @ basis) @ basis.T
    return np.sqrt(np.mean(np.sum(left**2, axis=1), axis=1))


def _shared(before: Trajectory, after: Trajectory) -> int:
    """Return 1 if the second piece begins with the last sample of the first; else 0."""
    return int(np.array_equal(before.q[-1], after.q[0]))


def joined_pieces(trajectories: Sequence[Trajectory], origin: Sequence[tuple[int, float]]) -> Trajectory:
    """Return the pieces of a recording as one, on the clock of the first."""
    pieces = [trajectories[i] for i, _ in origin]
    if len(pieces) == 1:
        return pieces[0]
    skipped = [0, *(_shared(a, b) for a, b in pairwise(pieces))]
    time = np.concatenate([p.time[k:] + added for p, k, (_, added) in zip(pieces, skipped, origin, strict=True)])
    joined: dict[str, Any] = {"u": None, "effort": None}
    for what in {"q", *set.intersection(*(set(p.arrays) for p in pieces))}:
        joined[what] = np.concatenate([getattr(p, what)[k:] for p, k in zip(pieces, skipped, strict=True)])
    return dataclasses.replace(pieces[0], time=time, **joined)  # with their flags
