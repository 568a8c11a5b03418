"""Samples of all recordings in one table, views of it in feature maps, and the subsampling of large data sets."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, NamedTuple, final
from zlib import crc32

import numpy as np

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import AXES, FrameJacobian, PoseRows
from manip_learn.constraint.features.mechanism_rows import PlaceForm, PlaceRows
from manip_learn.errors import (
    ManipLearnError,
    MissingExtraError,
    NotIdentifiableError,
    RecordingError,
    advice,
    counted,
    named,
)
from manip_learn.linalg import pivoted_rows, whitener
from manip_learn.recordings.clock import MOVED
from manip_learn.recordings.load import Progress, Reader
from manip_learn.recordings.options import refuse_unmatched
from manip_learn.recordings.trajectory import Demonstrations, Trajectory
from manip_learn.recordings.velocities import FEWEST_JUDGED, position_noise, positions_along
from manip_learn.robot.robot import Robot
from manip_learn.robot.tips import likely_tips

# smallest strength of a held row with 99 % confidence, net of the selection among hypotheses: free motion of a real arm
# that replays itself reaches 1.97, the best of 60 generated sets 1.6, contacts with rails, hinges and tables 15 to 500
STRENGTH = 1.8
SWITCH = 16.0  # [nats] cost of a change of state: a probability of exp(-16) for each tenth of a second
CHANGE = 0.1  # [s] duration of a change of state; samples closer together are not independent
MAX_RANGE = 3.0  # [m] largest distance at which an axis or a centre can be distinguished from a line or a plane
OVER_NOISE = 4.0  # [standard deviations of the noise] a larger change is motion
SCAN_RATE = 25.0  # [Hz] sampling rate that suffices to judge a hypothesis
MIN_TIME = 3.0 * CHANGE  # [s] shorter stretches occur by chance
# [nats] smallest gain of a hypothesis over the others, net of its price; in the search without its best recording
LEAST_GAIN = 40.0
# ratio between the motion along the next direction and along the rows: refused below the first, clear above the second
WEAK_GAP, CLEAR_GAP = 3.0, 10.0
# [rad or m] smallest hand-guided motion, slip or difference of shape: half a millimetre at the tip
LEAST_MOTION = 1e-3
# negligible share: of the free velocity for held rows; of the hand's path for one place; of the extent of a path for
# another path on it (of 28 kinds of generated sets the nearest two are 3.6 % apart)
SLIGHT = 0.01
ZERO = 1e-6  # zero for all purposes: share of a joint in the motion; size of a row of Phi over the largest of its unit
# a sample this many times faster than usual, or farther from the median posture, is a recording error: 10 m/s for a
# hand that usually moves at 1 mm/s, or 10,000 rad for postures within 1 rad of the median
OUTLIER_FACTOR = 1e4
# [rad/s or m/s] an arm whose fastest joint is slower rests: encoder noise of 1e-4 rad at 100 Hz looks like 0.014
REST_SPEED = 0.02
# postures whose distance is a smaller share of their size are equal; a smaller speed [rad/s or m/s] is rest
_SAME = 1e-9
MOST_SAMPLES = 20_000  # samples in a fit; their Phi with 6 rows and 7 joints takes 6.7 MB
STEPS = 2 ** np.arange(40)  # candidate subsampling steps: one sample of each step is kept
PATIENCE = "10s"  # timeout for a remote scheduler

EstimatorName = Literal["auto", "joint", "null-space", "separate"]


@dataclass(frozen=True)
class ArmErrors:
    """Prior standard deviations of the calibration errors of an arm.

    Attributes:
        zeros: Standard deviation of each joint offset [rad, m for prismatic joints]. With 0, joint and link errors are
            assumed to be zero unless residuals show them.
        links: Standard deviation, along each axis, of the position [m] and orientation [rad] of each joint (after the
            first) in the frame of the previous link, and of the hand in the frame of the last link.
    """

    zeros: float = 0.0
    links: float = 0.0


@dataclass(frozen=True)
class Settings:
    """Settings of a fit, from the arguments of `ConstraintLearner`.

    Attributes:
        n_constraints, estimator, policy_model, phases, mechanism, strength, seed: Arguments of the same names; `phases`
            and `mechanism` are True for `"auto"`.
        switch: Argument `switching_cost` [nats].
        habits: Argument `keep_habits`.
        arm: Arguments `joint_offset_std` and `link_error_std`.
        by_rates: True to fit held rows to velocities instead of positions.
        asked: Requested feature maps, the argument `features`.
    """

    n_constraints: int | None = None
    estimator: EstimatorName = "auto"
    policy_model: str = "auto"
    phases: bool = True
    mechanism: bool = True
    strength: float = STRENGTH
    switch: float = SWITCH
    habits: bool = False
    arm: ArmErrors = ArmErrors()
    seed: int = 0
    by_rates: bool = False  # recorded velocities have the last word, not positions
    asked: tuple[FeatureMap, ...] = ()


class Stretch(NamedTuple):
    """Part of a recording.

    Attributes:
        recording: Index of the recording.
        start, end: First and last time, on the time axis of the recording [s].
    """

    recording: int
    start: float
    end: float


class Hand:
    """Joint positions of all samples, with pose and Jacobian of the hand (the frame of some features) at each.

    All features of one frame are products of weights, which depend on its pose, and of its Jacobian. Pose and Jacobian
    are computed once for all of them.

    Args:
        features: Features of the hand.
        table: Samples of all recordings.

    Attributes:
        of: Feature map of the whole twist of the frame; None for features without a frame.
        x: Joint positions (n, nv), continuous joints unwrapped [rad or m].
        step: Tangent vectors (n, nv) to the next sample of the recording, zero at its last sample [rad or m].
        poses, J: Poses (n, 4, 4) [m] and Jacobians (n, 6, nv) of the frame; None without a frame.
    """

    poses: Any
    J: Any

    def __init__(self, features: FeatureMap, table: Table):
        robot, self.of = features.robot, features.twist
        continuous = [None if robot is None else positions_along(t, robot) for t in table.moved]
        self.x = np.concatenate([t.q if x is None else x for x, t in zip(continuous, table.moved, strict=True)])
        self.step = np.concatenate([tangents(robot, self.x), np.zeros((1, table.u.shape[1]))])
        self.step[table.first[1:] - 1] = 0.0
        self.poses, self.J = (None, None) if self.of is None else (self.of.poses(table.q), self.of.batch(table.q))

    @cached_property
    def between(self) -> Hand:
        """The same for configurations half way between each sample and the next one of its recording."""
        out, goes_on = copy.copy(self), np.any(self.step != 0.0, axis=1)[:-1, None]
        out.x = np.append(np.where(goes_on, 0.5 * (self.x[1:] + self.x[:-1]), self.x[:-1]), self.x[-1:], axis=0)
        out.poses, out.J = (None, None) if self.of is None else (self.of.poses(out.x), self.of.batch(out.x))
        return out

    def rows(self, features: Any) -> np.ndarray:
        """Evaluate features of this hand at all samples.

        Args:
            features: Feature map Phi of the same robot and frame.

        Returns:
            Phi, shape (n, p, nv).
        """
        return features.batch(self.x) if self.of is None else features.weights_at(self.poses) @ self.J


class Table:
    """Samples of all recordings, concatenated.

    Attributes:
        moved: Recordings, with velocities.
        time, q, u: Time (n,) [s], configuration (n, nq) [rad or m], velocity (n, nv) [rad/s or m/s] of each sample.
        first: Index of the first sample of each of g recordings, and n, shape (g + 1,).
        recording: Index of the recording of each sample, shape (n,).
        noises, noise: Variance of the velocity noise of each recording (g,), and of each sample (n,) [(rad/s)^2].
        weight: Time that each sample represents, shape (n,) [s].
        seconds: Sum of `weight` [s].
        thin, step: Indices of evenly spaced samples, enough for the search, and the number of samples between them.
        ends: First and last time of each recording, shape (g, 2) [s].
        wholes: Each recording as one stretch.
    """

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
        self.wholes = [Stretch(i, *map(float, ends)) for i, ends in enumerate(self.ends)]
        self._hands: dict[str, Hand] = {}

    def hand(self, features: FeatureMap) -> Hand:
        """Return poses and Jacobians of the frame of some features at all samples; they are computed once and stored.

        Args:
            features: Feature map.

        Returns:
            Poses and Jacobians, the same object for all features of this robot and frame.
        """
        twist = features.twist
        key = f"{id(features.robot)}" if twist is None else f"{id(features.robot)} {twist.describe()}"
        if key not in self._hands:
            self._hands[key] = Hand(features, self)
        return self._hands[key]

    def inside(self, stretches: Sequence[Stretch], learnt_from: bool = False) -> np.ndarray:
        """Return a mask of the samples in any of the stretches.

        Args:
            stretches: Parts of recordings.
            learnt_from: True to leave out the first and last tenth of a second of each stretch (a transition between
                contact and free motion), except at the ends of a recording.

        Returns:
            Boolean array (n,).
        """
        out = np.zeros(len(self.time), dtype=bool)
        for i, start, end in stretches:
            samples, (low, high) = slice(self.first[i], self.first[i + 1]), self.ends[i]
            start, end = start + CHANGE * learnt_from * (start > low), end - CHANGE * learnt_from * (end < high)
            out[samples] |= (self.time[samples] >= start) & (self.time[samples] <= end)
        return out

    def samples(self, s: Stretch) -> np.ndarray:
        """Return the indices of the samples of a stretch, without its transitions (see `inside`).

        Args:
            s: Part of a recording.
        """
        return np.flatnonzero(self.inside([s], learnt_from=True))


def excitation(names: Sequence[str], u: np.ndarray) -> tuple[dict[str, float], list[str]]:
    """Compute the share of each joint in the motion energy (the sum of u^2), and find joints that hardly move.

    Args:
        names: Names of the joints.
        u: Array (n, nv) of joint velocities [rad/s or m/s].

    Returns:
        Joint name -> share of the energy, and the names of joints with less than a millionth of it; no names if no
        joint moves at all.
    """
    energy = np.sum(u**2, axis=0)
    shares = dict(zip(names, (energy / max(float(energy.sum()), np.finfo(np.float64).tiny)).tolist(), strict=True))
    still = [name for name, share in shares.items() if share < ZERO]
    return shares, still if len(still) < len(shares) else []


def velocity_noise(time: np.ndarray, u: np.ndarray) -> float:
    """Estimate the variance of the noise of joint velocities.

    It is the smaller of two residuals: of cubic polynomials fitted to short windows, and of the four strongest
    principal components of the joints.

    Args:
        time: Times (T,) [s].
        u: Joint velocities (T, nv) [rad/s or m/s].

    Returns:
        Variance [(rad/s)^2].
    """
    smooth = 4  # directions that a smooth motion fills in a window, and coefficients of a cubic
    T, nv = u.shape
    length = min(T, max(2 * nv, int(np.searchsorted(time, time[0] + 0.6))))
    windows = np.stack([u[a : a + length] for a in np.arange(0, T - length + 1, max(1, length // 2))])
    residuals = []
    if nv > smooth:
        values = np.linalg.eigvalsh(np.einsum("wti,wtj->wij", windows, windows) / length)
        residuals.append(np.mean(values[:, : nv - smooth], axis=1))
    if length > smooth:
        cubic = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, length), smooth))[0]
        residuals.append(np.sum((windows - cubic @ (cubic.T @ windows)) ** 2, axis=(1, 2)) / ((length - smooth) * nv))
    least = min((float(np.median(x)) for x in residuals), default=0.0)
    return max(least, 1e-10 * float(np.mean(u**2)), 1e-24)


class Samples(NamedTuple):
    """Quantities at n samples, in whitened rows, from which the likelihood of hypotheses is computed.

    Attributes:
        rates: Velocities Phi u along the whitened rows, shape (n, r).
        gram: Phi Phi^T, shape (n, r, r).
        free: Energy of u along one row if the joints moved independently, shape (n,) [(rad/s)^2].
        noise: Variance of the velocity noise, shape (n,) [(rad/s)^2].
        weight: Time that each sample represents, shape (n,) [s].
        time: Time on the time axis of each recording, shape (n,) [s].
        first: Index of the first sample of each of g recordings, and n, shape (g + 1,).
        recording: Index of the recording, shape (n,).
        moving: shape (n,), True for samples that move beyond the noise.
    """

    rates: np.ndarray
    gram: np.ndarray
    free: np.ndarray
    noise: np.ndarray
    weight: np.ndarray
    time: np.ndarray
    first: np.ndarray
    recording: np.ndarray
    moving: np.ndarray

    def at(self, k: np.ndarray, first: np.ndarray, **other: np.ndarray) -> Samples:
        """Select some of the samples.

        Args:
            k: Indices (k,) of the samples.
            first: Field `first` of the result, shape (g + 1,).
            **other: Other fields of the result, instead of the selected values.

        Returns:
            The selected samples.
        """
        return Samples(**{n: x[k] for n, x in self._asdict().items() if n != "first"} | {"first": first} | other)


def whitening(Phi: np.ndarray, units: Sequence[str]) -> np.ndarray:
    """Return the matrix W that whitens features: the mean of (W Phi) (W Phi)^T over all samples is the identity.

    Args:
        Phi: Features (n, p, nv).
        units: Unit of each row. A row that hardly moves compared with rows of the same unit is left out.

    Returns:
        W (r, p), where r is the rank of the remaining rows.
    """
    S = np.einsum("npv,nqv->pq", Phi, Phi, optimize=True) / len(Phi)
    size, names = np.sqrt(np.diag(S)), np.array(units)
    moves = np.array([size[i] > ZERO * size[names == unit].max() for i, unit in enumerate(names)])
    return whitener(S * np.outer(moves, moves), ZERO**2)


class View:
    """Samples of a table in one feature map, whitened so that the mean of Phi Phi^T is the identity.

    Args:
        features: Feature map Phi with p rows.
        table: Samples of all recordings.

    Attributes:
        features, table: The arguments.
        hand: Poses and Jacobians of the frame of the features.
        W: Whitening matrix (r, p); r is 0 if the frame does not move.
        r: Number of whitened rows.
        Phi: Whitened features of all samples, shape (n, r, nv).
        largest: Largest number of constraint rows that leaves a null space.
        all, thin: Quantities at all samples, and at evenly spaced ones for the search.
        tried: Number of hypotheses, of all views together, among which a hypothesis of this view is selected.
        turns: True if one of the rows is an angular velocity.
        curved: True for features of the form `"surface"`, see `PlaceRows`.
    """

    def __init__(self, features: FeatureMap, table: Table):
        self.features, self.table, self.hand = features, table, table.hand(features)
        Phi = self.hand.rows(features)
        self.W = whitening(Phi, features.row_units)
        self.r, self.largest, self.tried = len(self.W), 0, 1
        self.turns, self.curved = "rad/s" in features.row_units, getattr(features, "form", "") == "surface"
        if not self.r:
            return
        self.Phi = white = self.W @ Phi
        gram = white @ white.transpose(0, 2, 1)
        regular = gram + 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(self.r)
        used = np.einsum("npv,npv->nv", white, np.linalg.solve(regular, white))
        rank = int(np.median(np.linalg.matrix_rank(gram[:: max(1, len(gram) // 50)], 1e-8, hermitian=True)))
        self.largest = min(rank, features.nv) - 1
        rates = np.einsum("npv,nv->np", white, table.u)
        free = np.sum(used * table.u**2, axis=1) / max(rank, 1)
        t, moving = table, free > OVER_NOISE**2 * table.noise
        self.all = Samples(rates, gram, free, t.noise, t.weight, t.time, t.first, t.recording, moving)
        k = table.thin
        self.thin = self.all.at(k, np.searchsorted(k, table.first), weight=table.weight[k] * table.step)

    @cached_property
    def y(self) -> np.ndarray:
        """Displacements along the whitened rows, the integral of Phi dq over the recorded positions, shape (n, r)."""
        rates = np.einsum("npv,nv->np", self.hand.between.rows(self.features), self.hand.step)
        return np.insert(np.cumsum(rates[:-1], axis=0), 0, 0.0, axis=0) @ self.W.T

    def for_recording(self, i: int, alone: Table) -> View:
        """Return the view of a single recording, with the whitening matrix of all recordings.

        Args:
            i: Index of the recording.
            alone: Table with this recording only.
        """
        out, each = copy.copy(self), [(m, np.arange(*m.first[i : i + 2])) for m in (self.all, self.thin)]
        out.all, out.thin = (m.at(k, np.array([0, len(k)]), recording=0 * k) for m, k in each)
        out.table = alone
        return out

    def way(self, inside: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Integrate the velocities along whitened rows over some samples.

        Args:
            inside: Boolean mask (n,) that selects k samples.
            rows: Whitened rows (s, r).

        Returns:
            Displacements (k, s) from before the first selected sample.
        """
        return np.cumsum(self.all.rates[inside] * self.all.weight[inside, None], axis=0) @ rows.T

    def steady_stretches(self, rows: np.ndarray, stretches: Sequence[Stretch]) -> list[Stretch]:
        """Return the stretches in which the motion along constrained rows is not unusually large, as by a slip.

        Args:
            rows: Whitened rows (s, r) that should be constrained.
            stretches: Stretches to compare.

        Returns:
            The steady stretches; all stretches if at most half of them are steady.
        """
        m, moved, noise = self.all, [], []
        for inside in (self.table.inside([x]) for x in stretches):
            moved.append(np.sqrt(np.sum(np.var(self.way(inside, rows), axis=0))) if inside.any() else 0.0)
            noise.append(2.0 * OVER_NOISE * np.sqrt(len(rows) * np.sum(m.noise[inside] * m.weight[inside] ** 2)))
        usual = OVER_NOISE * np.median(moved) if moved else 0.0
        most = np.maximum(max(usual, LEAST_MOTION), np.minimum(noise, 2.0 * usual))
        steady = [x for x, way, least in zip(stretches, moved, most, strict=True) if way <= least]
        return steady if 2 * len(steady) > len(stretches) else list(stretches)

    def trim(self, rows: np.ndarray, s: Stretch) -> Stretch:
        """Cut off the ends of a stretch that have moved along constrained rows further than the inner part.

        A hand that leaves a surface at a small angle has moved along the rows before its velocity shows it.

        Args:
            rows: Whitened rows (s, r) that should be constrained.
            s: Part of a recording.

        Returns:
            Shorter stretch; the same one if it is too short to compare.
        """
        inside = self.table.inside([s])
        time = self.table.time[inside]
        inner = (time >= s.start + MIN_TIME) & (time <= s.end - MIN_TIME)
        if s.end - s.start < 4.0 * MIN_TIME or np.count_nonzero(inner) < 10:
            return s
        way = self.way(inside, rows)
        away = np.linalg.norm(way - np.median(way[inner], axis=0), axis=1)
        times_away = time[(away > 2.5 * np.quantile(away[inner], 0.9)) & ~inner]
        before, after = times_away[times_away < s.start + MIN_TIME], times_away[times_away > s.end - MIN_TIME]
        first, last = self.table.ends[s.recording]
        start = float(time[time > before[-1]][0]) if len(before) and s.start > first else s.start
        end = float(time[time < after[0]][-1]) if len(after) and s.end < last else s.end
        return Stretch(s.recording, start, end)

    def selection(self, rows: np.ndarray) -> np.ndarray:
        """Convert whitened rows to the selection matrix Lambda of the features.

        Args:
            rows: Whitened rows (s, r).

        Returns:
            Lambda (s, p) with orthonormal rows.
        """
        return pivoted_rows(rows @ self.W)


def row_maps(asked: Sequence[FeatureMap], table: Table, what: Literal["place", "whole", "surface"]) -> list[FeatureMap]:
    """Return the feature maps in which the learner searches for constraints, for the requested feature maps.

    They are along the requested axes, and of a form in which mechanisms have one Lambda at every configuration
    (`PlaceRows`). The frame and its reference are those of the first requested map with a frame; its mean position is
    the `middle` of `PlaceRows`.

    Args:
        asked: Requested feature maps.
        table: Samples of all recordings.
        what: `"place"` for the position of the hand, with which the search begins (requested maps without such rows are
            included unchanged); `"whole"` for its whole twist; `"surface"` for the form `"surface"` of `PlaceRows`.

    Returns:
        Distinct feature maps.
    """
    frames, others = [f for f in asked if isinstance(f, PoseRows)], list[FeatureMap]()
    if what == "place":
        frames = [f for f in frames if set(AXES[:3]) & set(f.row_names)]
        others = [f for f in asked if f not in frames]
    axes = {"place": AXES[:3], "whole": AXES, "surface": ()}[what]
    forms: dict[str, tuple[PlaceForm, ...]] = {"place": ("point",), "whole": ("point and rotation", "twist")}
    maps = [*(map_.changed(axes=axes) for f in frames if axes for map_ in (f, f.twist)), *others]
    for f in frames[:1]:
        middle = table.hand(f).poses[:: max(1, len(table.q) // 500), :3, 3].mean(axis=0)
        maps += [PlaceRows(f.robot, f.frame.name, m, middle, **f.seen_from) for m in forms.get(what, ("surface",))]
    distinct: dict[str | int, FeatureMap] = {}
    for f in maps:
        distinct.setdefault(str(f.describe()) if isinstance(f, PoseRows) else id(f), f)
    return list(distinct.values())


def tangents(robot: Robot | None, x: np.ndarray) -> np.ndarray:
    """Return the tangent vector from each configuration to the next one.

    Args:
        robot: The robot; None if the configurations are plain vectors.
        x: Configurations (n, nq) [rad or m].

    Returns:
        Tangent vectors (n - 1, nv): differences, except for orientations (floating or spherical joints).
    """
    if robot is None or robot.positions_add_up:
        return np.diff(x, axis=0)
    return np.array([robot.difference(*pair) for pair in pairwise(x)])


# --------------------------------------------------- recordings and samples from which nothing can be learnt


def refuse_unusable(recorded: Demonstrations, derived: Demonstrations, features: FeatureMap) -> None:
    """Raise an error for recordings without motion, of another frame, or with a velocity outlier.

    Args:
        recorded: Recordings as the caller passed them.
        derived: The same recordings with velocities.
        features: First requested feature map.

    Raises:
        NotIdentifiableError: No joint moves beyond the noise of its encoder, or no joint that moves the frame does.
        RecordingError: One velocity is far larger than all others.
    """
    largest = []
    for t in recorded:
        if len(t) < FEWEST_JUDGED:
            break
        moved, noise = np.ptp(t.q, axis=0), np.sqrt(position_noise(t.time, t.q))
        j = int(np.argmax(moved / noise))
        if moved[j] >= 3.0 * OVER_NOISE * noise[j] and np.max(moved) >= LEAST_MOTION:
            break
        joint = t.joint_names[j] if len(t.joint_names) == t.q.shape[1] else f"column {j}"
        moves_by = f"of {joint} in {t.name}, {moved[j]:.2g} with a noise of {noise[j]:.2g} (standard deviation)"
        largest.append((moved[j] / noise[j], moves_by))
    else:
        least = f"its encoder noise and {LEAST_MOTION:g} rad or m"
        why = f"no joint moves further than {least}; the largest motion is {max(largest)[1]}: record a motion"
        raise NotIdentifiableError(why, code="no-motion")
    # outliers of the velocity
    u = np.concatenate([np.asarray(t.u) for t in derived])
    speed = np.linalg.norm(u, axis=1)
    sample, moving = int(np.argmax(speed)), speed > _SAME  # at rest without noise the slopes are rounding errors
    ratio = float(speed[sample]) / float(np.median(speed[moving])) if np.any(moving) else 0.0
    if ratio > OUTLIER_FACTOR:
        number = np.searchsorted(np.cumsum([len(t) for t in derived]), sample, side="right")
        joint = int(np.argmax(np.abs(u[sample])))
        moves = f"moves at {u[sample, joint]:.3g} in joint {derived.joint_names[joint]!r}, {ratio:.1e} times"
        text = f"sample {sample} (trajectory {number}) {moves} the median speed: remove the outlier"
        raise RecordingError(text, code="outlier")
    # joints move, but none of them moves the frame
    if not isinstance(features, FrameJacobian) or any(t.q.shape[1] != features.nv for t in derived):
        return
    robot, frame = features.robot, features.frame.name
    span = np.max([np.ptp(t.q, axis=0) for t in derived], axis=0)
    moved = [joint for joint, s in zip(robot.joint_names, span, strict=True) if s > MOVED]
    moves_hand = np.array([robot.moves(joint, frame) for joint in robot.joint_names])
    if moved and moves_hand.any() and not np.any(span[moves_hand] > MOVED):
        hand = next((tip for tip in likely_tips(robot) if any(robot.moves(joint, tip) for joint in moved)), "")
        how = advice(": name it with {}", f"frame={hand!r}", f"--frame {hand}")
        least = f"its joints changed by {np.max(span[moves_hand]):.2g} (rad or m) at most, {MOVED:g} is a motion"
        why = f"{least}; what moved is {named('joint', moved)}{f', which move {hand!r}{how}' if hand else ''}"
        raise NotIdentifiableError(f"{frame!r} stood still: {why}", code="still-hand")


def table_refusal(table: Table, r: int, n_constraints: int | None) -> NotIdentifiableError | RecordingError | None:
    """Check if constraint rows can be learnt from these samples at all.

    Args:
        table: Samples of all recordings.
        r: Number of independent rows of the features.
        n_constraints: Number of rows to learn; None to determine it from the data.

    Returns:
        The error that states why not, not raised; None if rows can be learnt.
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
    # a long rest at the median posture must not make all motion an outlier
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
    return NotIdentifiableError(f"record more: {few}, {needed} can, and many more are better", code="too-few-samples")


# ------------------------------------ even subsampling of large sets while they are read, here or by dask's workers
#
# Neighbouring samples carry the same information, so they are dropped first: every second sample of each recording is
# kept, then every fourth, and so on. Where too few samples a second would remain to see phases, recordings are dropped.
# The choice depends only on the set of all recordings, not on the order or the parts in which they are read, nor on
# the reader. Half of 16,361 samples of fifty drawers turn the answer by 0.0005 degrees, less than its uncertainty.


class KeptRecording(NamedTuple):
    """Subsampled recording.

    Attributes:
        motion: The recording with the samples kept.
        number: Index of the recording among all recordings.
        coarsest: Largest allowed `step`.
        rank: Hash of the configurations, used as a random number: if recordings must be dropped, the ones with the
            lowest ranks are kept.
        step: Every `step`-th sample was kept.
    """

    motion: Trajectory
    number: int
    coarsest: int
    rank: int  # hash of the postures, as good as a random draw: recordings with the lowest ones are kept
    step: int = 1


@final
class EvenChoice:
    """Evenly subsampled recordings of some files, to which `merge` adds those of further files.

    All samples are kept if they are not more than `most`.

    Args:
        most: Largest number of samples to keep.
        derive: Function that adds velocities to recordings; it is called before samples are dropped.
        part: Reader of recordings: function that takes a list, appends remarks to it, and yields the recordings. None
            for no recordings.

    Attributes:
        kept: The subsampled recordings.
        n_recordings: Number of all recordings read.
        notes: Remarks of the readers.

    Raises:
        RecordingError: Recordings cannot be used, or velocities cannot be derived.
    """

    def __init__(self, most: int, derive: Callable[[Demonstrations], Demonstrations], part: Reader | None = None):
        fewest = 20  # recordings kept of more, however long: evidence from fewer is thin
        self._most, self._derive, self._held = most, derive, 0
        self.kept, self.notes, self.n_recordings = list[KeptRecording](), list[str](), 0
        self._totals = np.zeros(len(STEPS), dtype=np.int64)  # samples of all recordings that each step would keep
        for t in () if part is None else part(self.notes):
            # time stamps are rounded; a recording keeps enough samples for phases, but no more than its share
            rate, share = (len(t) - 1) / max(t.duration, 1e-9) * (1.0 + 1e-6), self._most / fewest
            coarsest = int(STEPS[(rate / STEPS >= SCAN_RATE) | (2 * len(t) / STEPS > share)].max(initial=1))
            self.kept.append(KeptRecording(t, self.n_recordings, coarsest, crc32(t.q.data)))
            self._totals += -(-len(t) // np.minimum(STEPS, coarsest))
            self._held += len(t)
            self.n_recordings += 1
            if self._held > 2 * most:
                self._thin()
        self._thin()

    def merge(self, later: EvenChoice) -> None:
        """Add the recordings of further files to this choice, and subsample again if they are too many.

        Args:
            later: Choice from further files; it is not changed.
        """
        self._totals += later._totals
        self.kept += later.kept
        self.n_recordings += later.n_recordings
        self.notes += later.notes
        self._thin()

    def _thin(self) -> None:
        """Drop samples, and whole recordings if necessary, until at most `most` samples are kept."""
        steps, rest = STEPS[self._totals <= self._most], self.kept
        if not steps.size:
            order = np.argsort([k.rank for k in rest], kind="stable")
            fit = np.cumsum([-(-len(rest[i].motion) * rest[i].step // rest[i].coarsest) for i in order]) <= self._most
            rest = [rest[i] for i in np.sort(order[fit])]
        for i, k in enumerate(rest):
            step = min(k.coarsest, int(steps.min(initial=STEPS[-1])))
            if step > k.step:
                motion = k.motion if k.step > 1 else self._derive(Demonstrations([k.motion]))[0]
                rest[i] = k._replace(motion=motion.part(slice(None, None, step // k.step)), step=step)
        self.kept, self._held = rest, sum(len(k.motion) for k in rest)

    @property
    def demonstrations(self) -> Demonstrations:
        """The subsampled recordings, with the notes of the readers.

        Raises:
            RecordingError: There are no recordings.
        """
        recordings, notes = Demonstrations(k.motion for k in self.kept), dict.fromkeys(self.notes)
        if self._held < self._totals[0]:
            share = f"{counted(self._held, 'sample')} of {counted(len(recordings), 'recording')}"
            notes[f"learnt from {share}, chosen evenly out of {self._totals[0]:,} of {self.n_recordings:,}"] = None
        return Demonstrations(recordings, notes)


def read_evenly(choose: Callable[..., Any], parts: list[Reader], client: Any, progress: Progress | None) -> EvenChoice:
    """Read all parts of a data set once and subsample them evenly.

    The result does not depend on the number of workers.

    Args:
        choose: Function that reads a part and returns its `EvenChoice`; without an argument it returns an empty one.
        parts: Readers of recordings, one per part.
        client: A `dask.distributed.Client`; None to read in this process.
        progress: Function that is called with the name of a stage and its completed share, 0 to 1; None for none.

    Returns:
        Subsampled recordings of all parts.

    Raises:
        RecordingError: Recordings cannot be used, or a setting matches no part.
        ManipLearnError: The workers of the client died.
    """
    whole: EvenChoice = choose()
    for choice in map_parts(choose, parts, client, progress):
        whole.merge(choice)
    whole.notes = refuse_unmatched(whole.notes, len(parts))
    return whole


def map_parts(work: Callable[..., Any], parts: list[Reader], client: Any, progress: Progress | None) -> Iterator[Any]:
    """Yield the result of a function for each part of a data set, in order.

    Several parts are processed on the workers of a client.

    Args:
        work: Function that takes a part.
        parts: Readers of recordings, one per part.
        client: A `dask.distributed.Client`; None to process all parts in this process.
        progress: Function that is called with the name of a stage and its completed share, 0 to 1; None for none.

    Raises:
        ManipLearnError: The workers of the client died.
    """
    futures, died = list[Any](), tuple[type[Exception], ...]()
    if client is not None and len(parts) > 1:
        from dask.distributed import KilledWorker

        futures, died = client.map(work, parts, pure=False), (KilledWorker, CancelledError)
    for number, part in enumerate(parts, 1):
        try:
            result = futures.pop(0).result() if futures else work(part)  # fetched results are freed on the workers
        except died as error:
            raise ManipLearnError(f"dask's workers died ({error}): is there enough memory for each?") from error
        yield result
        if progress is not None:
            progress("reading", number / len(parts))


def dask_client(address: str | None, n_workers: int | None = None) -> AbstractContextManager[Any]:
    """Connect to a dask scheduler, or start a local cluster that is not reachable from other machines.

    Args:
        address: `"local"` to start a cluster; or the address of a scheduler, e.g. `"tcp://10.0.0.1:8786"`; None for no
            client.
        n_workers: Number of workers of a local cluster (processes with one thread); None for one per processor.

    Returns:
        Context manager that yields the client, or None if `address` is None.

    Raises:
        ManipLearnError: No scheduler answers at the address.
        MissingExtraError: dask is not installed.
    """
    if address is None:
        return nullcontext()
    try:
        from dask.distributed import Client
    except ImportError as error:
        raise MissingExtraError("learning on a dask cluster", "dask") from error
    # by default the dashboard is visible on all networks
    here: dict[str, Any] = {"n_workers": n_workers, "threads_per_worker": 1, "dashboard_address": "127.0.0.1:0"}
    try:
        return Client(timeout=PATIENCE, **(here if address == "local" else dict[str, Any](address=address)))
    except (OSError, ValueError, TypeError, AssertionError, ImportError, RuntimeError) as error:
        text = f"there is no dask scheduler at {address!r} ({error}): start one with `dask scheduler`, or use 'local'"
        raise ManipLearnError(text) from error
