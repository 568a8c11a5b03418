"""Recordings that repeat each other: copies, replays and pieces of one recording are evidence once.

A posture says nothing of when it was passed. So recordings are compared as paths in the space of the joints, whatever
their direction, rate, start and clock: one repeats another if its path lies on the other's, within what the encoders'
noise and the chords between samples allow. A second demonstration that somebody gives lies elsewhere; a robot that
replays a programmed path shows the same geometry again, and with one way to move there is one path only. What lies on
a path that is known adds nothing to what is held and is left out, at the price of its share in averaging the noise.

Pieces of one recording touch end to end: one goes on where and as fast as another stopped. They are put together
again, so that the answer, its uncertainty and its warnings are those of the uncut recording. Strokes between which
something was left out, and recordings that begin at rest where the last one ended, count each.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import product
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.errors import listed
from manip_learn.learning.explanation.evidence import Stretch
from manip_learn.recordings.demonstrations import Demonstrations, distinct_names
from manip_learn.recordings.local_fit import noise_variance
from manip_learn.recordings.trajectory import Trajectory, evenly

# [rad] two passes of one path are as near as this to each other: arms repeat a posture to 0.1 mm at half a metre
REPEATED_RAD = 2e-4
# distance over what noise and chords allow, up to which a posture lies on a path: the noise of seven joints reaches
# twice its root mean square once in 5,000 samples, that of two joints once in 50
LIES_ON_PATH = 2.0
# least share of a recording's way that lies on another's: copies are trimmed by a few samples at their ends
REPEATED_SHARE = 0.9
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
# mean step over the extent of a recording, above which samples are no path: it is 0.5 for postures at random, 0.1 for
# ten samples of a straight motion
PATH_STEP = 0.25

# postures of a recording that are compared, those of a first look, and how many of these must be near
POSTURES, PROBES, PROBES_NEAR = 200, 9, 6
THINNED = 400  # samples of a path in the first look, at most
# samples on either side of a seam that a cubic is fitted to, and how many times less than a recording's samples
SEAM, SEAM_SHARE = (3, 10), 16


@final
@dataclass(frozen=True, eq=False)
class IndependentRecordings:
    """Recordings of which none repeats another.

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
        """Pieces put together, and of recordings that repeat each other the longest or first one."""
        if len({t.q.shape[1] for t in given}) > 1:  # refused where the samples are collected
            return IndependentRecordings(given, tuple(((i, 0.0),) for i in range(len(given))), given)
        chains = _chains(given.trajectories)
        origins = tuple(_on_one_clock(given.trajectories, chain) for chain in chains)
        whole = [joined_pieces(given.trajectories, origin) for origin in origins]
        repeated = _repeats(whole)
        if not repeated and len(chains) == len(given):
            return IndependentRecordings(given, origins, given)
        names = distinct_names(given)
        said = [_in_words(names, chain) for chain in chains]
        pieces = [
            f"{text} are pieces of one recording, each goes on where another ends; they count once"
            for text, chain in zip(said, chains, strict=True)
            if len(chain) > 1
        ]
        copied = list[str]()
        for first in dict.fromkeys(kept for kept, _ in repeated.values()):
            copies = [i for i, (kept, _) in repeated.items() if kept == first]
            within = max(repeated[i][1] for i in copies)
            near = f"within {1e3 * within:.1g} mrad" if within > 1e-9 else "exactly"
            verb = "repeats" if len(copies) == 1 and len(chains[copies[0]]) == 1 else "repeat"
            copied.append(
                f"{listed(said[i] for i in copies)} {verb} {said[first]} (the same positions {near}); they count once"
            )
        kept = [i for i in range(len(whole)) if i not in repeated]
        demonstrations = Demonstrations([dataclasses.replace(whole[i], name=said[i]) for i in kept], given.notes)
        return IndependentRecordings(demonstrations, tuple(origins[i] for i in kept), given, (*pieces, *copied))

    def every(self, step: int) -> IndependentRecordings:
        """The first of them, and every so many after it."""
        if step == 1:
            return self
        return dataclasses.replace(self, demonstrations=self.demonstrations[::step], origins=self.origins[::step])

    def places(self, stretch: Stretch) -> tuple[Stretch, ...]:
        """Where a stretch of `demonstrations` lies in the given recordings, on their own clocks."""
        out = []
        for number, added in self.origins[stretch.trajectory]:
            time = self.given[number].time
            start, end = max(stretch.start - added, float(time[0])), min(stretch.end - added, float(time[-1]))
            if start < end or len(self.origins[stretch.trajectory]) == 1:
                out.append(Stretch(number, start, end))
        return tuple(out)


def _in_words(names: Sequence[str], chain: Sequence[int]) -> str:
    consecutive = len(chain) > 2 and list(chain) == list(range(chain[0], chain[-1] + 1))
    return f"{names[chain[0]]} to {names[chain[-1]]}" if consecutive else listed(names[i] for i in chain)


def _repeats(trajectories: Sequence[Trajectory]) -> dict[int, tuple[int, float]]:
    """Recordings whose path lies on another's -> that one, which repeats none, and the largest distance [rad]."""
    paths = [_Path.of(t) for t in trajectories]
    near = [set(numbers) for numbers in _nearby(paths)]

    @cache
    def lies(i: int, j: int) -> float | None:
        return paths[i].distance_from(paths[j]) if i in near[j] else None

    found: dict[int, tuple[int, float]] = {}
    for i, j in product(range(len(paths)), repeat=2):
        # of two that repeat each other the first stays
        if i not in found and (distance := lies(i, j)) is not None and (j < i or lies(j, i) is None):
            found[i] = j, distance
    for i in found:
        while found[i][0] in found:
            j, further = found[found[i][0]]
            found[i] = j, max(found[i][1], further)
    return found


@final
@dataclass(frozen=True, eq=False)
class _Path:
    """Where a recording has been.

    Attributes:
        trajectory: The recording, with postures q of shape (T, n) [rad or m].
        probes: Some of them, evenly over the way, shape (PROBES, n).
        thinned: Some of them, evenly over the samples, shape (k, n).
        extent: Length of the diagonal of the box that it fills [rad].
    """

    trajectory: Trajectory
    probes: Float[np.ndarray, "k n"]
    thinned: Float[np.ndarray, "m n"]
    extent: float

    @staticmethod
    def of(trajectory: Trajectory) -> _Path:
        q = trajectory.q
        thinned = q[:: -(-len(q) // THINNED)]
        way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(thinned, axis=0), axis=1)))
        probes = thinned[np.searchsorted(way, np.linspace(0.0, way[-1], PROBES)).clip(0, len(way) - 1)]
        return _Path(trajectory, probes, thinned, float(np.linalg.norm(np.ptp(thinned, axis=0))))

    @cached_property
    def noise2(self) -> float:
        """Variance of a posture, all joints together, no less than `REPEATED_RAD` squared [rad^2]."""
        t = self.trajectory
        return REPEATED_RAD**2 + (float(np.sum(noise_variance(t.time, t.q))) if len(t) > 5 else 0.0)

    def distance_from(self, other: _Path) -> float | None:
        """Largest distance of the postures that lie on the other path [rad]; None if too few of the way do."""
        from scipy.spatial import cKDTree

        q, chosen = other.trajectory.q, self.trajectory.q[evenly(len(self.trajectory), POSTURES)]
        steps = np.linalg.norm(np.diff(chosen, axis=0), axis=1)
        way = np.append(steps, 0.0) + np.append(0.0, steps) + np.finfo(np.float64).tiny
        nearest = cKDTree(q).query(chosen, k=min(3, len(q)))[1].reshape(len(chosen), -1)
        # how far the motion may be from each chord between two samples: an eighth of the second difference, doubled
        second = np.linalg.norm(np.diff(q, n=2, axis=0), axis=1) if len(q) > 2 else np.zeros(1)
        padded = np.pad(second, 1, mode="edge")
        chords = 0.25 * np.maximum(padded[1:], padded[:-1])[: max(len(q) - 1, 1)]
        distance, chord = np.full(len(chosen), np.inf), np.zeros(len(chosen))
        for first in (nearest, nearest - 1):
            for a in first.T.clip(0, max(len(q) - 2, 0)):
                along = q[np.minimum(a + 1, len(q) - 1)] - q[a]
                length2 = np.maximum(np.sum(along**2, axis=1), np.finfo(np.float64).tiny)
                share = np.clip(np.sum((chosen - q[a]) * along, axis=1) / length2, 0.0, 1.0)
                d = np.linalg.norm(chosen - q[a] - share[:, None] * along, axis=1)
                distance, chord = np.minimum(distance, d), np.where(d < distance, chords[a], chord)
        most = LIES_ON_PATH * np.sqrt(self.noise2 + other.noise2 + chord**2)
        lies = distance <= np.minimum(most, NEAREST_PATH_SHARE * max(self.extent, other.extent))
        return float(np.max(distance[lies])) if np.sum(way[lies]) >= REPEATED_SHARE * np.sum(way) else None


def _nearby(paths: Sequence[_Path]) -> list[list[int]]:
    """For each path the others of which some postures are near it."""
    probes = np.stack([p.probes.T for p in paths], axis=1)  # joint by joint
    extents = np.array([p.extent for p in paths])
    out = []
    for j, path in enumerate(paths):
        low, high = path.thinned.min(axis=0), path.thinned.max(axis=0)
        most = NEAREST_PATH_SHARE * np.maximum(extents, path.extent)
        candidates = np.flatnonzero((most > 0.0) & (np.arange(len(paths)) != j))
        for k in range(len(low)):
            column, margin = probes[k, candidates], most[candidates, None]
            inside = (column >= low[k] - margin) & (column <= high[k] + margin)
            candidates = candidates[np.count_nonzero(inside, axis=1) >= PROBES_NEAR]
        step = np.linalg.norm(np.diff(path.thinned, axis=0), axis=1).max(initial=0.0)
        near = []
        for i in candidates.tolist():
            gaps = np.linalg.norm(paths[i].probes[:, None] - path.thinned[None], axis=2).min(axis=1)
            if np.count_nonzero(gaps <= most[i] + step) >= PROBES_NEAR:
                near.append(i)
        out.append(near)
    return out


def _chains(trajectories: Sequence[Trajectory]) -> list[list[int]]:
    """Recordings that go on from each other, in order; each alone if it touches none."""
    follows: dict[int, int] = {}
    seams = _seams(trajectories)
    cut = {i for s in seams if s.is_cut for i in (s.before, s.after)}
    # what was cut in motion at one end was cut at the other, too, be it at rest
    for seam in (s for s in seams if s.before in cut or s.after in cut):
        end = seam.after
        while end in follows:
            end = follows[end]
        if seam.before not in follows and seam.after not in follows.values() and end != seam.before:
            follows[seam.before] = seam.after
    chains = []
    for i in range(len(trajectories)):
        if i not in follows.values():
            chain = [i]
            while chain[-1] in follows:
                chain.append(follows[chain[-1]])
            chains.append(chain)
    return chains


class _Seam(NamedTuple):
    """The end of one recording, where another begins; whether a motion was cut there, or one clock goes on; and what a
    cubic through both leaves [rad].
    """

    before: int
    after: int
    is_cut: bool
    left: float


def _seams(trajectories: Sequence[Trajectory]) -> list[_Seam]:
    """Where recordings touch and go on smoothly, the likeliest first."""
    long = [i for i, t in enumerate(trajectories) if len(t) > 2 * SEAM[0]]  # one is left after a shared sample
    if len(long) < 2:
        return []
    starts, ends = (np.array([trajectories[i].q[end] for i in long]) for end in (0, -1))
    first, last = (
        np.array([np.mean(np.linalg.norm(np.diff(trajectories[i].q[part], axis=0), axis=1)) for i in long])
        for part in (slice(SEAM[0] + 1), slice(-SEAM[0] - 1, None))
    )
    touching = [
        (i, long[k])
        for i, end, step in zip(long, ends, last, strict=True)
        for k in np.flatnonzero(np.linalg.norm(starts - end, axis=1) <= SEAM_STEPS * np.maximum(first, step))
        if long[k] != i
    ]
    extents = np.array([np.linalg.norm(np.ptp(trajectories[i].q, axis=0)) for i in long])
    steps = [np.mean(np.linalg.norm(np.diff(trajectories[i].q, axis=0), axis=1)) for i in long]
    if not touching or np.median([s / e if e > 0.0 else 1.0 for s, e in zip(steps, extents, strict=True)]) > PATH_STEP:
        return []
    told = NEAREST_PATH_SHARE * float(max(extents))
    seams = [s for i, k in touching if (s := _seam(trajectories, i, k, told)) is not None]
    return sorted(seams, key=lambda s: (not s.is_cut, s.after != s.before + 1, s.left))


def _seam(trajectories: Sequence[Trajectory], before: int, after: int, told: float) -> _Seam | None:
    a, b = trajectories[before], trajectories[after]
    if (a.u is None) != (b.u is None):
        return None
    half = int(np.clip(min(len(a), len(b)) // SEAM_SHARE, *SEAM))
    later = b.q[_shared(a, b) :]
    seam = np.concatenate([a.q[-half:], later[:half]])
    left = float(_left_by_cubics(seam, 2 * half)[0])
    usual = max(float(np.max(_left_by_cubics(q, 2 * half))) for q in (a.q, later))
    ways = [np.linalg.norm(q[2 * half - 1 :] - q[: 1 - 2 * half], axis=1) for q in (a.q, later)]
    way = np.linalg.norm(seam[-1] - seam[0])
    moving = left < told and way > max(SEAM_SPEED * float(np.mean(np.concatenate(ways))), left / SEAM_LEFT)
    pause = b.time[0] - a.time[-1]
    goes_on = bool(0.0 <= pause <= 2.0 * max(np.median(np.diff(a.time)), np.median(np.diff(b.time))))
    is_seam = goes_on or left <= SEAM_ROUGHNESS * usual + 1e-12
    return _Seam(before, after, goes_on or bool(moving), left) if is_seam else None


def _left_by_cubics(q: Float[np.ndarray, "T n"], width: int) -> Float[np.ndarray, " k"]:
    """Root mean square of the rest that a cubic leaves of each window of `width` samples [rad]."""
    basis = np.linalg.qr(np.linspace(-1.0, 1.0, width)[:, None] ** np.arange(4))[0]
    windows = np.lib.stride_tricks.sliding_window_view(q, width, axis=0)
    left = windows - (windows @ basis) @ basis.T
    return np.sqrt(np.mean(np.sum(left**2, axis=1), axis=1))


def _shared(before: Trajectory, after: Trajectory) -> int:
    """1 if the second piece begins with the last sample of the first; else 0."""
    return int(np.array_equal(before.q[-1], after.q[0]))


def _on_one_clock(trajectories: Sequence[Trajectory], chain: Sequence[int]) -> tuple[tuple[int, float], ...]:
    """The pieces in order, each with what is added to its clock to go on one step after the one before [s]."""
    out = [(chain[0], 0.0)]
    for before, after in zip(chain[:-1], chain[1:], strict=True):
        a, b = trajectories[before], trajectories[after]
        step = float(np.median(np.diff(a.time)))
        end, shared = float(a.time[-1]) + out[-1][1], _shared(a, b)
        pause = b.time[shared] - a.time[-1]
        added = out[-1][1] if 0.0 < pause <= 2.0 * step else end + step - float(b.time[shared])
        out.append((after, added))
    return tuple(out)


def joined_pieces(trajectories: Sequence[Trajectory], origin: Sequence[tuple[int, float]]) -> Trajectory:
    """The pieces of a recording as one, on the clock of the first."""
    pieces = [trajectories[i] for i, _ in origin]
    if len(pieces) == 1:
        return pieces[0]
    skipped = [0, *(_shared(a, b) for a, b in zip(pieces[:-1], pieces[1:], strict=True))]
    time = np.concatenate([p.time[k:] + added for p, k, (_, added) in zip(pieces, skipped, origin, strict=True)])
    q = np.concatenate([p.q[k:] for p, k in zip(pieces, skipped, strict=True)])
    of_all = set.intersection(*(set(p.beside) for p in pieces))
    beside = {
        what: np.concatenate([p.beside[what][k:] for p, k in zip(pieces, skipped, strict=True)]) for what in of_all
    }
    cut = {"u": None, "effort": None} | beside
    return dataclasses.replace(pieces[0], time=time, q=q, **cut)  # judged as its pieces are
