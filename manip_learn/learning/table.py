"""Table of the samples of all recordings, and views of it in feature maps."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import AXES, FrameJacobian, PoseRows
from manip_learn.constraint.features.mechanism_rows import PlaceForm, PlaceRows
from manip_learn.errors import NotIdentifiableError, RecordingError, advice, counted, named
from manip_learn.linalg import pivoted_rows, whitener
from manip_learn.recordings.clock import MOVED
from manip_learn.recordings.trajectory import Demonstrations, Trajectory
from manip_learn.recordings.velocities import FEWEST_JUDGED, position_noise
from manip_learn.robot.tips import likely_tips

# strength of a row with 99 % confidence, the choice paid for, from which it counts as held: free motion of a real arm
# that replays itself reaches 1.97, the best of 60 generated sets 1.6, contacts with rails, hinges and tables 15 to 500
BELIEVED = 1.8
SWITCH = 16.0  # [nats] a change of state: a chance of exp(-16) for each tenth of a second
CHANGE = 0.1  # [s] samples closer together tell the same story; a change of what is held takes as long
OVER_NOISE = 4.0  # standard deviations beyond which it is motion
SCAN_RATE = 25.0  # samples a second that are enough to judge a hypothesis
SHORTEST = 3.0 * CHANGE  # [s] a stretch shorter than this is chance
CUBIC = 4  # directions that a smooth motion fills of a window
LEAST_GAIN = 40.0  # [nats] of a hypothesis over others: in the search without its best supporter, less its price
# between the use of rows and of the next one: below the first nothing is told, from the second on it is clear
WEAK_GAP, CLEAR_GAP = 3.0, 10.0
# [rad or m] less is no motion that is shown by hand, no slip, and no other shape: half a millimetre at the tip
LEAST_MOTION = 1e-3
# share that is as good as none: of the free velocity, for rows that are held; of the way of a hand, for one place; of
# the extent of a path, for another one on it (of 28 kinds of generated sets the nearest two are 3.6 % apart)
SLIGHT = 0.01
NONE = 1e-6  # share below which there is nothing: of the motion, for a joint; of the largest row of Phi of a unit
# ratio to the usual speed, or distance from the middle, beyond which a sample is a fault of the recording: a hand that
# usually moves at 1 mm/s would have to move at 10 m/s, and a posture within 1 rad of the middle be 10,000 rad off
OUTLIER_FACTOR = 1e4
# [rad/s or m/s] of the fastest joint, below which it is at rest: encoder noise of 1e-4 rad at 100 Hz looks like 0.014
REST_SPEED = 0.02
# postures closer together than this share of their size are one and the same, and less of it in a second is no motion
_SAME = 1e-9


EstimatorName = Literal["auto", "joint", "null-space", "separate"]


@dataclass(frozen=True)
class ArmErrors:
    """Prior standard deviations of the errors of an arm.

    Attributes:
        zeros: Of each joint offset [rad, sliding joints m]; with 0, errors that no residual shows are taken for zero,
            of links too.
        links: Of position [m] and orientation [rad], along each axis, of each joint after the first in the frame of the
            previous link, and of the frame in that of the last link.
    """

    zeros: float = 0.0
    links: float = 0.0


@dataclass(frozen=True)
class Settings:
    """Settings of a fit; see the arguments of `ConstraintLearner`."""

    n_constraints: int | None = None
    estimator: EstimatorName = "auto"
    policy_model: str = "auto"
    phases: bool = True
    mechanism: bool = True
    strength: float = BELIEVED
    switch: float = SWITCH
    habits: bool = False
    arm: ArmErrors = ArmErrors()
    seed: int = 0
    by_rates: bool = False  # recorded velocities have the last word, not positions
    asked: tuple[FeatureMap, ...] = ()


class Stretch(NamedTuple):
    """A part of a recording, on its own clock [s]."""

    recording: int
    start: float
    end: float

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return self.end - self.start


class Table:
    """Samples of all recordings, concatenated."""

    def __init__(self, moved: Sequence[Trajectory]):
        self.moved, self.joint_names = list(moved), moved[0].joint_names
        lengths = [len(t) for t in moved]
        self.time, self.q, self.u = (np.concatenate([getattr(t, a) for t in moved]) for a in ("time", "q", "u"))
        self.first = np.concatenate([[0], np.cumsum(lengths)])
        self.recording = np.repeat(np.arange(len(lengths)), lengths)
        self.noises = [velocity_noise(t.time, np.asarray(t.u)) for t in moved]
        self.noise = np.repeat(self.noises, lengths)
        clocks = [np.cumsum(np.minimum(np.diff(t.time, prepend=t.time[0]), 0.2)) for t in moved]  # no gap is evidence
        self.weight = np.concatenate([np.gradient(x) if len(x) > 1 else np.array([0.01]) for x in clocks])
        self.seconds = float(self.weight.sum())
        self.step = step = max(1, round(len(self.time) / max(self.seconds, 1e-9) / SCAN_RATE))
        self.thin = np.concatenate([np.arange(a + min(step, b - a) // 2, b, step) for a, b in pairwise(self.first)])
        self.ends = np.stack([self.time[self.first[:-1]], self.time[self.first[1:] - 1]], axis=1)

    def __len__(self) -> int:
        return len(self.moved)

    @property
    def wholes(self) -> list[Stretch]:
        """Each recording as one stretch."""
        return [Stretch(i, *map(float, ends)) for i, ends in enumerate(self.ends)]

    def inside(self, stretches: Sequence[Stretch]) -> np.ndarray:
        """Return a mask of the samples in any of the stretches."""
        out = np.zeros(len(self.time), dtype=bool)
        for s in stretches:
            own = slice(self.first[s.recording], self.first[s.recording + 1])
            out[own] |= (self.time[own] >= s.start) & (self.time[own] <= s.end)
        return out

    def learnt_from(self, s: Stretch) -> Stretch:
        """Return the stretch without its ends, which belong to a transition, except at the ends of the recording."""
        low, high = self.ends[s.recording]
        return Stretch(s.recording, s.start + CHANGE * (s.start > low), s.end - CHANGE * (s.end < high))

    def piece(self, s: Stretch) -> Trajectory:
        """Return the samples of a stretch from which rows are learnt."""
        s = self.learnt_from(s)
        return self.moved[s.recording][s.start : s.end]


def excitation(names: Sequence[str], u: np.ndarray) -> tuple[dict[str, float], list[str]]:
    """Return the share of each joint in the energy of the motion, and the joints that hardly move, if others do."""
    energy = np.sum(u**2, axis=0)
    shares = dict(zip(names, (energy / max(float(energy.sum()), np.finfo(np.float64).tiny)).tolist(), strict=True))
    still = [name for name, share in shares.items() if share < NONE]
    return shares, still if len(still) < len(shares) else []


def velocity_noise(time: np.ndarray, u: np.ndarray) -> float:
    """Return the variance of the noise of joint velocities [(rad/s)^2].

    It is the residual of cubics in short windows, or of the four strongest directions of the joints, the smaller one.
    """
    T, nv = u.shape
    length = min(T, max(2 * nv, int(np.searchsorted(time, time[0] + 0.6))))
    windows = np.stack([u[a : a + length] for a in np.arange(0, T - length + 1, max(1, length // 2))])
    left = []
    if nv > CUBIC:
        values = np.linalg.eigvalsh(np.einsum("wti,wtj->wij", windows, windows) / length)
        left.append(np.mean(values[:, : nv - CUBIC], axis=1))
    if length > CUBIC:
        cubic = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, length), CUBIC))[0]
        left.append(np.sum((windows - cubic @ (cubic.T @ windows)) ** 2, axis=(1, 2)) / ((length - CUBIC) * nv))
    least = min((float(np.median(x)) for x in left), default=0.0)
    return max(least, 1e-10 * float(np.mean(u**2)), 1e-24)


class Samples(NamedTuple):
    """Samples in whitened rows, by which hypotheses are judged.

    Attributes:
        rates: shape (n, r), rates r = Phi u.
        gram: shape (n, r, r), Phi Phi^T.
        free: shape (n,), energy of u in one row if the joints moved independently [(rad/s)^2].
        noise: shape (n,), variance of the noise of velocities [(rad/s)^2].
        weight: shape (n,), time that each sample represents [s].
        time: shape (n,), on the clock of each recording [s].
        first: shape (g + 1,), first sample of each of g recordings, and n.
        recording: shape (n,), number of the recording.
    """

    rates: np.ndarray
    gram: np.ndarray
    free: np.ndarray
    noise: np.ndarray
    weight: np.ndarray
    time: np.ndarray
    first: np.ndarray
    recording: np.ndarray

    def at(self, k: np.ndarray, first: np.ndarray, **other: np.ndarray) -> Samples:
        """Return the samples k, with their first ones and other fields."""
        return Samples(**{n: x[k] for n, x in self._asdict().items() if n != "first"} | {"first": first} | other)

    def moving(self) -> np.ndarray:
        """Return a mask of the samples that move beyond the noise."""
        return self.free > OVER_NOISE**2 * self.noise


def whitening(Phi: np.ndarray, units: Sequence[str]) -> np.ndarray:
    """Return the matrix W (r, p) with W S W^T = I of the mean S of Phi Phi^T, without rows that hardly move.

    Args:
        Phi: shape (n, p, nv).
        units: Unit of each row; rows are compared with others of their unit.
    """
    S = np.einsum("npv,nqv->pq", Phi, Phi, optimize=True) / len(Phi)
    size, names = np.sqrt(np.diag(S)), np.array(units)
    moves = np.array([size[i] > NONE * size[names == unit].max() for i, unit in enumerate(names)])
    return whitener(S * np.outer(moves, moves), NONE**2)


class View:
    """Table in one feature map, whitened so that sum Phi Phi^T / n = I.

    Attributes:
        features, table: Feature map and table.
        Phi: shape (n, p, nv), features of all samples.
        W: shape (r, p), whitening matrix; r is 0 if the frame does not move.
        largest: Largest number of rows that leave a null space.
        all, thin: All samples, and evenly spaced ones for the search.
        tried: Number of hypotheses, of all views, among which one of this view is selected.
        turns, curved: True with rows of rotation; if surfaces of second order are constant rows.
    """

    def __init__(self, features: FeatureMap, table: Table):
        self.features, self.table = features, table
        self.Phi = features.batch(table.q)
        self.W = whitening(self.Phi, features.row_units)
        self.r, self.largest, self.tried = len(self.W), 0, 1
        self.turns, self.curved = "rad/s" in features.row_units, getattr(features, "form", "") == "surface"
        if not self.r:
            return
        white = self.W @ self.Phi
        gram = white @ white.transpose(0, 2, 1)
        regular = gram + 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(self.r)
        used = np.einsum("npv,npv->nv", white, np.linalg.solve(regular, white))
        rank = int(np.median(np.linalg.matrix_rank(gram[:: max(1, len(gram) // 50)], 1e-8, hermitian=True)))
        self.largest = min(rank, features.nv) - 1
        rates = np.einsum("npv,nv->np", white, table.u)
        free = np.sum(used * table.u**2, axis=1) / max(rank, 1)
        self.all = Samples(rates, gram, free, table.noise, table.weight, table.time, table.first, table.recording)
        k = table.thin
        self.thin = self.all.at(k, np.searchsorted(k, table.first), weight=table.weight[k] * table.step)

    def of_recording(self, i: int, alone: Table) -> View:
        """Return the view of one recording alone, with its table, whitened as that of all."""
        out, each = copy.copy(self), [(m, np.arange(*m.first[i : i + 2])) for m in (self.all, self.thin)]
        out.all, out.thin = (m.at(k, np.array([0, len(k)]), recording=0 * k) for m, k in each)
        out.table = alone
        return out

    def way(self, inside: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return the integral of the velocities along whitened rows (s, r) over a mask of samples, shape (k, s)."""
        return np.cumsum(self.all.rates[inside] * self.all.weight[inside, None], axis=0) @ rows.T

    def steady(self, rows: np.ndarray, stretches: Sequence[Stretch]) -> list[Stretch]:
        """Return the stretches that rest along the rows as most do; in the others the hand slips."""
        m, moved, noise = self.all, [], []
        for inside in (self.table.inside([x]) for x in stretches):
            moved.append(np.sqrt(np.sum(np.var(self.way(inside, rows), axis=0))) if inside.any() else 0.0)
            noise.append(2.0 * OVER_NOISE * np.sqrt(len(rows) * np.sum(m.noise[inside] * m.weight[inside] ** 2)))
        usual = OVER_NOISE * np.median(moved) if moved else 0.0
        most = np.maximum(max(usual, LEAST_MOTION), np.minimum(noise, 2.0 * usual))
        kept = [x for x, way, least in zip(stretches, moved, most, strict=True) if way <= least]
        return kept if 2 * len(kept) > len(stretches) else list(stretches)

    def sharpened(self, rows: np.ndarray, s: Stretch) -> Stretch:
        """Return the stretch without ends that have moved along the rows further than its inner part.

        A hand that leaves a surface at a flat angle has moved along the rows before its velocity shows it.
        """
        inside = self.table.inside([s])
        time = self.table.time[inside]
        inner = (time >= s.start + SHORTEST) & (time <= s.end - SHORTEST)
        if s.duration < 4.0 * SHORTEST or np.count_nonzero(inner) < 10:
            return s
        way = self.way(inside, rows)
        away = np.linalg.norm(way - np.median(way[inner], axis=0), axis=1)
        left = time[(away > 2.5 * np.quantile(away[inner], 0.9)) & ~inner]
        before, after = left[left < s.start + SHORTEST], left[left > s.end - SHORTEST]
        first, last = self.table.ends[s.recording]
        start = float(time[time > before[-1]][0]) if len(before) and s.start > first else s.start
        end = float(time[time < after[0]][-1]) if len(after) and s.end < last else s.end
        return Stretch(s.recording, start, end)

    def selection(self, rows: np.ndarray) -> np.ndarray:
        """Return Lambda in the features' own rows, orthonormal, from whitened ones."""
        return pivoted_rows(rows @ self.W)


def maps_of(asked: Sequence[FeatureMap], table: Table, what: Literal["place", "whole", "surface"]) -> list[FeatureMap]:
    """Return the rows to search for any requested axes: along those axes, and where mechanisms rest.

    They are rows of the position of the hand, in which the search begins (features without any are returned as they
    are); of its whole twist, in which mechanisms are constant; or those in which surfaces of second order are constant.
    The frame is the first that was asked for, seen from where its rows see it; places are counted from its mean.
    """
    frames, others = [f for f in asked if isinstance(f, PoseRows)], list[FeatureMap]()
    if what == "place":
        frames = [f for f in frames if set(AXES[:3]) & set(f.row_names)]
        others = [f for f in asked if f not in frames]
    axes = {"place": AXES[:3], "whole": AXES, "surface": ()}[what]
    forms: dict[str, tuple[PlaceForm, ...]] = {"place": ("point",), "whole": ("point and rotation", "twist")}
    maps = [*(seen.changed(axes=axes) for f in frames if axes for seen in (f, f.twist)), *others]
    for f in frames[:1]:
        middle = f.twist.poses(table.q[:: max(1, len(table.q) // 500)])[:, :3, 3].mean(axis=0)
        maps += [PlaceRows(f.robot, f.frame.name, m, middle, **f.seen_from) for m in forms.get(what, ("surface",))]
    known: dict[str | int, FeatureMap] = {}
    for f in maps:
        known.setdefault(str(f.describe()) if isinstance(f, PoseRows) else id(f), f)
    return list(known.values())


def steps_along(features: FeatureMap, x: np.ndarray) -> np.ndarray:
    """Return the tangent vectors from each posture to the next, shape (n - 1, nv): differences, but of orientations."""
    robot = getattr(features, "robot", None)
    if robot is None or robot.positions_add_up:
        return np.diff(x, axis=0)
    return np.array([robot.difference(*pair) for pair in pairwise(x)])


def displacements(features: FeatureMap, x: np.ndarray, way: np.ndarray | None = None) -> np.ndarray:
    """Return displacements y with dy = Phi dq along positions, from the first sample, shape (n, p).

    With `way`, recorded velocities times a duration: y = Phi way of each sample on its own.
    """
    if way is not None:
        return np.einsum("npv,nv->np", features.batch(x), way)
    rates = np.einsum("npv,nv->np", features.batch(0.5 * (x[1:] + x[:-1])), steps_along(features, x))
    return np.concatenate([np.zeros((1, rates.shape[1])), np.cumsum(rates, axis=0)])


# --------------------------------------------------- recordings and samples from which nothing can be learnt


def refuse_unusable(recorded: Demonstrations, derived: Demonstrations, features: FeatureMap) -> None:
    """Refuse recordings in which nothing moves, of another hand, or with a velocity far out of line with all others.

    Args:
        recorded: Recordings as they were given.
        derived: The same with velocities.
        features: First feature map.

    Raises:
        NotIdentifiableError: No joint moves beyond the noise of its encoder, or none that moves the frame.
        RecordingError: There is an outlier.
    """
    found = []
    for t in recorded:
        if len(t) < FEWEST_JUDGED:
            break
        moved, noise = np.ptp(t.q, axis=0), np.sqrt(position_noise(t.time, t.q))
        j = int(np.argmax(moved / noise))
        if moved[j] >= 3.0 * OVER_NOISE * noise[j] and np.max(moved) >= LEAST_MOTION:
            break
        joint = t.joint_names[j] if len(t.joint_names) == t.q.shape[1] else f"column {j}"
        said = f"{joint} in {t.name}, by {moved[j]:.2g} where its noise is {noise[j]:.2g} (standard deviation)"
        found.append((moved[j] / noise[j], said))
    else:
        least = f"the noise of its positions does, and {LEAST_MOTION:g} rad or m"
        why = f"no joint moves farther than {least}: the farthest is {max(found)[1]}: record a motion"
        raise NotIdentifiableError(why, code="no-motion")
    # a velocity far out of line with all others
    u = np.concatenate([np.asarray(t.u) for t in derived])
    speed = np.linalg.norm(u, axis=1)
    sample, moving = int(np.argmax(speed)), speed > _SAME  # slopes of a rest without noise are what rounding leaves
    ratio = float(speed[sample]) / float(np.median(speed[moving])) if np.any(moving) else 0.0
    if ratio > OUTLIER_FACTOR:
        number = np.searchsorted(np.cumsum([len(t) for t in derived]), sample, side="right")
        joint = int(np.argmax(np.abs(u[sample])))
        moves = f"moves at {u[sample, joint]:.3g} in joint {derived.joint_names[joint]!r}, {ratio:.1e} times"
        text = f"sample {sample} (trajectory {number}) {moves} the median speed: remove the outlier"
        raise RecordingError(text, code="outlier")
    # joints that move, but none of those that move the frame
    if not isinstance(features, FrameJacobian) or any(t.q.shape[1] != features.nv for t in derived):
        return
    robot, frame = features.robot, features.frame.name
    span = np.max([np.ptp(t.q, axis=0) for t in derived], axis=0)
    moved = [joint for joint, s in zip(robot.joint_names, span, strict=True) if s > MOVED]
    own = np.array([robot.moves(joint, frame) for joint in robot.joint_names])
    if moved and own.any() and not np.any(span[own] > MOVED):
        hand = next((tip for tip in likely_tips(robot) if any(robot.moves(joint, tip) for joint in moved)), "")
        how = advice(": name it with {}", f"frame={hand!r}", f"--frame {hand}")
        least = f"its joints changed by {np.max(span[own]):.2g} (rad or m) at most, {MOVED:g} is a motion"
        why = f"{least}; what moved is {named('joint', moved)}{f', which move {hand!r}{how}' if hand else ''}"
        raise NotIdentifiableError(f"{frame!r} stood still: {why}", code="still-hand")


def unusable(table: Table, r: int, n_constraints: int | None) -> NotIdentifiableError | RecordingError | None:
    """Return why nothing can be learnt of r independent rows from these samples; None if something can.

    Args:
        table: The samples.
        r: Number of independent rows of the features.
        n_constraints: Number of rows to learn, if it was asked for.
    """
    if table.u.shape[1] < 2:
        return NotIdentifiableError("a constraint leaves no null space for a single joint", code="no-freedom")
    speed = np.linalg.norm(table.u, axis=1)
    if not np.any(moving := speed > _SAME):
        return NotIdentifiableError("nothing moves in these demonstrations: all velocities are zero", code="no-motion")
    middle = np.median(table.q, axis=0)
    distance = np.linalg.norm(table.q - middle, axis=1)
    farthest = int(np.argmax(distance))
    if distance[farthest] <= _SAME * (1.0 + float(np.linalg.norm(middle))):
        text = "the posture never changes though the velocities are not zero: give each sample its own posture"
        return NotIdentifiableError(text, code="constant-posture")
    # standing still at the median posture for long is no reason to call all motion far out
    usual = float(np.quantile(distance, 0.9)) or float(np.mean(np.delete(distance, farthest)))
    if 0.0 < usual * OUTLIER_FACTOR < distance[farthest]:
        where = f"the posture of sample {farthest} (trajectory {table.recording[farthest]})"
        ratio = f"{distance[farthest] / usual:.1e} times farther out"
        return RecordingError(f"{where} is {ratio} than nearly all others: remove the outlier", code="outlier")
    s = n_constraints or 1
    needed = max(r + 2, s * (r - s) + 2, 5)
    samples = np.concatenate([table.q, table.u], axis=1)[speed > _SAME * float(np.median(speed[moving]))]
    if (different := len(np.unique(samples, axis=0))) >= needed:
        return None
    few = f"{counted(different, 'different moving sample')} cannot determine a constraint on {counted(r, 'row')}"
    return NotIdentifiableError(f"record more: {few}, {needed} can and many more are better", code="too-few-samples")
