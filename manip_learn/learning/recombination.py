"""Recombination test: whether the world holds a row, or the motion merely does not use it; and what follows from it."""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Literal, NamedTuple, final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import RecordingError, counted, listed
from manip_learn.learning.estimate import Verdict
from manip_learn.learning.samples import whitening
from manip_learn.recordings.trajectory import Trajectory

# trajectories, below which nothing is clear: of two that differ one cannot say which is the odd one
FEWEST_TRAJECTORIES = 3
# chance of at least the evidence seen, were the joints independent of each other, that a row may have. Convention
ROW_CHANCE = 0.01
# growth of a row's motion by recombination, exceeded with 99 % confidence and the choice paid for, from which it is
# believed to be held, and from which it is so beyond doubt. Free motion is coordinated, too: the best of 60 sets of
# generated free motion reaches 1.6 (seeds 22000 to 22009), free motion of a real arm that replays itself 1.97; a curved
# part wiped by hand 1.97, contacts with rails, hinges and tables 15 to 500. At half of it 11 of the 60 free sets would
# be answered, at twice the curved part would not
BELIEVED_STRENGTH, CLEAR_STRENGTH = 1.8, 4.0
# least strength of a row that is ranked before one found held: noise spreads unevenly, the first row has the least.
# Set by hand
LEANING_STRENGTH = 1.3
# share of the most used direction's motion below which a direction was not tried. Set by hand
USED_SHARE = 1.0 / 6.0
# share of the liveliest joint's motion below which a joint does not set the phase: its noise would. Set by hand
PHASE_JOINT_SHARE = 0.3
# [s] that one bin of the phase should cover, and the least number of bins. Set by hand
BIN_SECONDS, FEWEST_BINS = 0.25, 4

RowState = Literal["held", "unclear", "free", "untried"]

# standard errors by which a verdict must stand off for the next draw of recombinations to give the same one: 99 %
SURE = NormalDist().inv_cdf(0.995)
MOST_BINS = 24  # of the phase
# points of a trajectory at which Phi is evaluated, at most
_MOST_POINTS = 240
NODES_PER_BIN = 4  # of a path, between which it is straight
# exchanges of joints: twice the least for a p-value of ROW_CHANCE, and the most, where fewer leave the verdict open
RECOMBINATIONS = 2 * round(1.0 / ROW_CHANCE) - 1
MOST_RECOMBINATIONS = 16 * RECOMBINATIONS  # where the share of better ones stays close to what decides
# arrangements whose motion is held in memory together: 0.5 MB of a seven-joint arm's pose, six recordings, 20 bins
MOMENTS_AT_ONCE = 64
# more trajectories than this add nothing to the evidence but time
MOST_TRAJECTORIES = 16
# shifts of a trajectory against itself, where there are too few to exchange joints between
SHIFTS = 8
# levels below this may be what interpolation between samples leaves
LEVEL_FLOOR = 1e-5


class RowSupport(NamedTuple):
    """Evidence that one row is held, from the recombination test.

    Attributes:
        strength: How much more the motion uses the row when joints are exchanged between trajectories (a ratio).
        p_value: Chance of so low a use if the joints moved independently of each other.
        state: `"held"`, `"unclear"`, `"free"` or `"untried"`.
    """

    strength: float
    p_value: float
    state: str


@final
@dataclass(frozen=True, eq=False)
class RowEvidence:
    """Evidence for each row, most firmly held first.

    Attributes:
        strengths: How much more the motion uses each row when joints are exchanged between the trajectories: median.
        p_values: Chance of a level as low as the recorded one if the joints moved independently of each other.
        levels: How much the recorded motion uses each row: 0 not at all, 1 as a motion equally strong in all joints.
        directions: The rows, in the features' own units, orthonormal, shape (r, p).
        n_trajectories: Trajectories that move.
        n_recombinations: Recombinations that the recorded motion was compared with.
        spread: Standard deviation of the logarithm of each strength over the recombinations.
        choices: Hypotheses of which this one, the best, was chosen: kinds of rows, and parts of the recordings.
        believed: Strength from which on a row counts, with 99 % confidence.
        firm: Number of rows that a second witness supports, where joints that hardly move have nothing to exchange:
            they do not move beyond the noise, and are at one place in all recordings, although the hand came from
            elsewhere.
    """

    strengths: tuple[float, ...]
    p_values: tuple[float, ...]
    levels: tuple[float, ...]
    directions: Float[np.ndarray, "r p"]
    n_trajectories: int
    n_recombinations: int
    spread: tuple[float, ...] = ()
    choices: float = 1.0
    believed: float = BELIEVED_STRENGTH
    firm: int = 0

    @property
    def _z(self) -> float:
        """Standard deviations that the chance allowed leaves out, the choice paid for."""
        return -NormalDist().inv_cdf(max(ROW_CHANCE / self.choices, sys.float_info.min))

    @property
    def lower(self) -> tuple[float, ...]:
        """What the strength of each row exceeds with 99 % confidence, the choice paid for."""
        return tuple(s * math.exp(-self._z * sd) for s, sd in zip(self.strengths, self.spread, strict=True))

    @property
    def n_rows(self) -> int:
        """Number of rows that the evidence supports, counted without a gap; the last ones may be weak."""
        supported = 0
        for i, (strength, lower, p) in enumerate(zip(self.strengths, self.lower, self.p_values, strict=True)):
            if p > ROW_CHANCE or strength < LEANING_STRENGTH:
                break
            supported = i + 1 if lower >= self.believed else supported
        return max(supported, min(self.firm, len(self.strengths)))

    @property
    def is_close(self) -> bool:
        """Whether other recombinations might change the verdict on a row: by the errors of its median and its spread,
        pi / 2 and half of the variance over their number, and by that of a count of chance.
        """
        n, z = self.n_recombinations, self._z
        error = SURE * math.sqrt((0.5 * math.pi + 0.5 * z**2) / max(n, 1))
        for strength, lower, sd, p in zip(self.strengths, self.lower, self.spread, self.p_values, strict=True):
            if abs(p - ROW_CHANCE) < SURE * math.sqrt(ROW_CHANCE / n) and p * (n + 1) > 1.5:
                return True
            if p > ROW_CHANCE or strength < LEANING_STRENGTH:
                return False
            if abs(math.log(max(lower, sys.float_info.min) / self.believed)) < error * sd:
                return True
        return False

    @property
    def enough(self) -> bool:
        """Whether there are trajectories enough to exchange joints between."""
        return self.n_trajectories >= FEWEST_TRAJECTORIES

    @property
    def verdict(self) -> Verdict:
        """How sure the rows are: as sure as the weakest of them."""
        if not self.n_rows:
            return "none"
        return "clear" if self.enough and self.clear else "weak"

    @property
    def clear(self) -> bool:
        """Whether the weakest row that is supported is so beyond doubt, however few the trajectories are."""
        return bool(self.n_rows) and self.lower[self.n_rows - 1] >= max(CLEAR_STRENGTH, self.believed)

    @property
    def states(self) -> tuple[RowState, ...]:
        """What each row is.

        Held; free, for the motion uses it; untried: neither used nor shown to be held; or unclear: softly held, held in
        a part of the way only, or in rows that turn with the place, and too little of that to be counted.
        """
        most = max(self.levels, default=0.0)
        states: list[RowState] = []
        for i, level in enumerate(self.levels):
            if i < self.n_rows:
                states.append("held")
            elif self.strengths[i] >= self.believed and self.p_values[i] <= ROW_CHANCE:
                states.append("unclear")
            else:
                states.append("free" if level >= USED_SHARE * most and level > 0.0 else "untried")
        return tuple(states)

    @property
    def rows(self) -> tuple[RowSupport, ...]:
        """The evidence for each row."""
        return tuple(map(RowSupport, self.strengths, self.p_values, self.states))

    def sentence(self) -> str:
        """The evidence in words, for reports."""
        if not self.strengths:
            return "the recordings do not move, so nothing shows which rows are held"
        n, states = self.n_rows, self.states
        held = (
            f"no row is shown to be held (best strength {self.strengths[0]:.2g}, with 99 % confidence above "
            f"{self.lower[0]:.2g}; {self.believed:g} is the least that counts)"
        )
        if n:
            softly = "held softly, or by the way of moving only" if self.enough else "held, it seems"
            softly = "held firmly at one place each time, or never tried" if n == self.firm else softly
            firmly = "held" if self.verdict == "clear" else softly
            strengths = listed(f"{s:.3g}" for s in self.strengths[:n])
            held = f"{counted(n, 'row')} {firmly} (strength {strengths}, p = {max(self.p_values[:n]):.2g})"
        rest = "nothing of the features is left free"
        if "untried" in states:
            untried = counted(states.count("untried"), "direction")
            rest = f"{untried} hardly tried, so held or free cannot be told"
        elif n < len(states):
            kind = "is free" if states[n] == "free" else "may be held softly, or only at each place by itself"
            rest = f"the next row (strength {self.strengths[n]:.2g}) {kind}"
        few = f"; too few to be sure with {counted(self.n_trajectories, 'recording')}, record 5 or more"
        return f"{held}; {rest}{'' if self.enough else few}"


@final
@dataclass(frozen=True, eq=False)
class PhasePath:
    """One trajectory over its phase, the share of its way that it has covered: 0 at the start, 1 at the end.

    The phase is way and not time, and displacements are shares of the way: neither pauses nor different speeds nor
    strokes of different lengths then separate joints that move together.

    Attributes:
        q: Postures at some samples, shape (n, nq).
        edges: Phases between which each of these postures stands for the motion, shape (n + 1,).
        bins: Bin of each posture, shape (n,).
        weight: Mean speed in each bin over that of the trajectory, times the squared length of the way, shape
            (n_bins,).
        steps: Displacement of each joint between evenly spaced phases, over the length of the way, shape
            (NODES_PER_BIN * n_bins, nv).
    """

    q: Float[np.ndarray, "n nq"]
    edges: Float[np.ndarray, " m"]
    bins: Int[np.ndarray, " n"]
    weight: Float[np.ndarray, " b"]
    steps: Float[np.ndarray, "g nv"]

    @property
    def n_bins(self) -> int:
        """Number of phase bins."""
        return len(self.weight)

    def bin_steps(self) -> Float[np.ndarray, "b nv"]:
        """Displacement of each joint in each bin."""
        return self.steps.reshape(self.n_bins, NODES_PER_BIN, -1).sum(axis=1)

    def displacements(self, steps: Float[np.ndarray, "g nv"], shift: float = 0.0) -> Float[np.ndarray, "n nv"]:
        """How far joints that move by `steps` come while this trajectory passes each of its postures.

        Args:
            steps: Displacements between evenly spaced phases, of this or another trajectory.
            shift: Phase by which they run ahead; what leaves at the end comes in at the start.
        """
        g = len(steps)
        way = np.concatenate([np.zeros((1, steps.shape[1])), np.cumsum(np.concatenate([steps, steps]), axis=0)])
        at = (self.edges + shift % 1.0) * g
        low = np.minimum(at.astype(np.int64), 2 * g - 1)
        part = (at - low)[:, None]
        return np.diff((1.0 - part) * way[low] + part * way[low + 1], axis=0)


def phase_paths(trajectories: Sequence[Trajectory]) -> list[PhasePath]:
    """The trajectories that move, aligned in phase and in direction.

    A u = 0 says the same of -u, and so backward strokes are turned round: each trajectory then runs along its own main
    direction, and all of these along a common one. Otherwise joints of one that still goes out would be put together
    with joints of one that already comes back, a motion that no free arm makes either.

    Trajectories of fewer than three samples or without motion are left out.
    """
    moving = [t for t in trajectories if len(t) > 2 and t.u is not None and np.any(t.u != 0.0)]
    if not moving:
        return []
    size = np.sqrt(np.mean([np.mean(np.square(t.u), axis=0) for t in moving], axis=0))  # type: ignore[arg-type]
    scale = np.maximum(size, PHASE_JOINT_SHARE * np.max(size))
    seconds = float(np.median([t.duration for t in moving]))
    most = int(min(MOST_BINS, max(np.median([len(t) for t in moving]) // 2, 1)))
    n_bins = int(np.clip(round(seconds / BIN_SECONDS), min(FEWEST_BINS, most), most))
    paths = [_path(t, scale, n_bins) for t in moving]
    by_bin = np.stack([path.bin_steps() for path in paths]) / scale
    common = np.linalg.svd(by_bin.reshape(-1, by_bin.shape[2]), full_matrices=False)[2][0]
    turned = []
    for path, moved in zip(paths, by_bin, strict=True):
        own = np.linalg.svd(moved, full_matrices=False)[2][0]
        along = moved @ (own if own @ common >= 0.0 else -own)
        steps = path.steps * np.repeat(np.where(along < 0.0, -1.0, 1.0), NODES_PER_BIN)[:, None]
        if np.sum(along) < -0.5 * np.sum(np.abs(along)):  # backward as a whole: run in reverse
            edges, bins = 1.0 - path.edges[::-1], path.n_bins - 1 - path.bins[::-1]
            path, steps = PhasePath(path.q[::-1], edges, bins, path.weight[::-1], steps), steps[::-1]
        turned.append(dataclasses.replace(path, steps=steps))
    return turned


def _path(trajectory: Trajectory, scale: Float[np.ndarray, " nv"], n_bins: int) -> PhasePath:
    time, u = trajectory.time, np.asarray(trajectory.u)
    half = 0.5 * np.diff(time)[:, None]
    way = np.concatenate([np.zeros((1, u.shape[1])), np.cumsum(half * (u[1:] + u[:-1]), axis=0)])
    speed = np.linalg.norm(u / scale, axis=1)
    # a little time in the phase makes it increase at rest too
    rate = speed + 1e-6 * np.mean(speed)
    phase = np.append(0.0, np.cumsum(half[:, 0] * (rate[1:] + rate[:-1])))
    length = phase[-1]
    phase /= length
    nodes = np.interp(np.linspace(0.0, 1.0, NODES_PER_BIN * n_bins + 1), phase, time)
    steps = np.diff(np.stack([np.interp(nodes, time, way[:, j]) for j in range(u.shape[1])], axis=1), axis=0) / length
    seconds = np.diff(nodes[::NODES_PER_BIN])
    weight = 1.0 / np.maximum(seconds, 1e-12 * (time[-1] - time[0]))
    chosen = np.unique(np.linspace(0, len(time) - 1, min(len(time), _MOST_POINTS)).round().astype(np.int64))
    at = phase[chosen]
    edges = np.concatenate([[0.0], 0.5 * (at[1:] + at[:-1]), [1.0]])
    bins = np.minimum((at * n_bins).astype(np.int64), n_bins - 1)
    return PhasePath(trajectory.q[chosen], edges, bins, length**2 * weight / np.mean(weight), steps)


def recombination_test(
    features: FeatureMap,
    trajectories: Sequence[Trajectory],
    rng: np.random.Generator,
    choices: float = 1.0,
    believed: float = BELIEVED_STRENGTH,
) -> RowEvidence:
    """Evidence that the world holds rows of Phi, A(q) u = Lambda Phi(q) u = 0, row by row.

    The trajectories are aligned in phase and their joints exchanged at random: in a recombined one joint 1 moves as in
    trajectory a, joint 2 as in trajectory b, and so on. Each joint keeps its own motion, only the coordination that a
    contact enforces is lost. If nothing couples the joints, the recorded motion is one more recombination, and the
    rank of its level among theirs is a p-value (a permutation test). Joints of a free reach are coordinated too, by the
    person: the strength tells this from a contact, see `RowEvidence`. For the strength the recorded level is that of
    each trajectory in the rows that the others show.

    Velocities are exchanged, postures stay: r = Phi(q_d) u' for a recombined u', so that Phi is evaluated once only.
    Phi u is summed over phase bins before it is squared: noise of the encoders averages out, what is held stays zero.

    With fewer than three trajectories the joints are also shifted in phase against each other, weaker evidence.

    Args:
        features: Phi.
        trajectories: With velocities, each one stretch of motion: whole recordings or parts of them.
        rng: Of the recombinations: quadrupled as long as their number could decide.
        choices: Hypotheses of which this one was chosen: kinds of rows, and parts of the recordings.
        believed: Strength from which on a row counts.

    Raises:
        RecordingError: A trajectory lacks velocities, or acts on another number of joints.
    """
    for t in trajectories:
        if t.u is None or t.u.shape[1] != features.nv:
            seen = "no velocities" if t.u is None else f"{t.u.shape[1]} joint velocities"
            raise RecordingError(f"{t.name} has {seen}, the features act on {features.nv}", code="shape")
    chosen = list(trajectories)
    if len(chosen) > MOST_TRAJECTORIES:
        chosen = [chosen[i] for i in np.sort(rng.choice(len(chosen), MOST_TRAJECTORIES, replace=False))]
    paths = phase_paths(chosen)
    Phi = [features.batch(path.q) for path in paths]
    nothing = RowEvidence((), (), (), np.zeros((0, features.n_rows)), len(paths), 0, believed=believed)
    if not Phi:
        return nothing
    W = whitening(np.mean([np.einsum("niv,njv->ij", P, P) / len(P) for P in Phi], axis=0), features.row_units)
    if not len(W):
        return nothing
    donors = [(a, 0.0) for a in range(len(paths))]
    if len(paths) < FEWEST_TRAJECTORIES:
        donors += [(a, k / SHIFTS) for k in range(1, SHIFTS) for a in range(len(paths))]
    parts = np.stack([_parts(path, W @ P, paths, donors) for path, P in zip(paths, Phi, strict=True)])
    energy = np.mean([np.mean(p.weight[:, None] * p.bin_steps() ** 2) for p in paths])
    (recorded,) = moments_of_motion(parts, np.broadcast_to(np.arange(len(paths)), (1, features.nv, len(paths))))
    moments, held_out, n = recorded.mean(axis=0)[None], np.zeros(recorded.shape[1]), len(recorded)
    if n > 1:  # a few strokes leave some direction unused by chance; the next stroke uses it
        others = np.linalg.eigh((recorded.sum(axis=0) - recorded) / (n - 1))[1]
        squares = np.mean(np.einsum("dis,dij,djs->ds", others, recorded, others), axis=0)
        held_out = np.sqrt(np.maximum(squares, 0.0) / energy)
    # what falls: the recombinations that are left of MOST_RECOMBINATIONS; each turn makes four times as many
    while True:
        n = max(RECOMBINATIONS, 4 * (len(moments) - 1))
        size = (n - len(moments) + 1, features.nv, len(paths))  # the donor of each joint of each trajectory
        exchanged = len(donors) == len(paths)
        order = np.argsort(rng.random(size), axis=2) if exchanged else rng.integers(0, len(donors), size)
        # a few at a time: their motion is a large array
        few = np.array_split(order, -(-len(order) // MOMENTS_AT_ONCE))
        moments = np.concatenate([moments, *(moments_of_motion(parts, some).mean(axis=1) for some in few)])
        # row s is looked for outside rows 1 .. s-1 of the recorded motion, in all motions alike: of a recombined one
        # the s-th smallest level would not do, for once row 1 has grown the next free row takes its place
        directions = np.linalg.eigh(moments[0])[1].T
        turned = directions @ moments @ directions.T
        least = [np.linalg.eigvalsh(turned[:, s:, s:])[:, 0] for s in range(len(directions))]
        squares = np.maximum(np.stack(least, axis=1), 0.0)
        levels = np.maximum(np.sqrt(squares / energy), LEVEL_FLOOR)
        ratios = levels[1:] / np.maximum(held_out, levels[0])
        evidence = RowEvidence(
            tuple(np.median(ratios, axis=0).tolist()),
            tuple(((1.0 + np.count_nonzero(levels[1:] <= levels[0], axis=0)) / (1.0 + n)).tolist()),
            tuple(levels[0].tolist()),
            np.linalg.qr((directions @ W).T)[0].T,
            len(paths),
            n,
            tuple(np.std(np.log(np.maximum(ratios, LEVEL_FLOOR)), axis=0).tolist()),
            choices,
            believed,
        )
        if n >= MOST_RECOMBINATIONS or not evidence.is_close:
            return evidence


def _parts(
    path: PhasePath, Phi: Float[np.ndarray, "n r nv"], paths: list[PhasePath], donors: list[tuple[int, float]]
) -> Float[np.ndarray, "b nv a r"]:
    """What joint v contributes to Phi u in each bin if it moves as in donor a, weighted by the speed."""
    moved = np.stack([path.displacements(paths[a].steps, shift) for a, shift in donors])  # (a, n, nv)
    parts = np.zeros((path.n_bins, Phi.shape[2], len(donors), Phi.shape[1]))
    for b in np.unique(path.bins):
        here = path.bins == b
        parts[b] = np.matmul(moved[:, here].transpose(2, 0, 1), Phi[here].transpose(2, 0, 1))
    return parts * np.sqrt(path.weight)[:, None, None, None]


def moments_of_motion(
    parts: Float[np.ndarray, "d b nv a r"], arrangements: Int[np.ndarray, "m nv d"]
) -> Float[np.ndarray, "m d r r"]:
    """Mean of r r^T over the bins of each trajectory, the joints arranged like this."""
    each = np.arange(len(parts))
    motion = parts[each, :, 0, arrangements[:, 0]]
    for v in range(1, arrangements.shape[1]):
        motion += parts[each, :, v, arrangements[:, v]]
    return motion.transpose(0, 1, 3, 2) @ motion / parts.shape[1]
