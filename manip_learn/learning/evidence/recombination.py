"""Recombination test: whether a row is held by the world, or the motion merely does not use it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import RecordingError
from manip_learn.learning.evidence.aligned_paths import PhasePath, phase_paths
from manip_learn.learning.evidence.row_evidence import FEWEST_TRAJECTORIES, RowEvidence
from manip_learn.learning.whitening import whitening
from manip_learn.recordings.trajectory import Trajectory

RECOMBINATIONS = 199
# more trajectories than this add nothing to the evidence but time
MOST_TRAJECTORIES = 16
# shifts of a trajectory against itself, where there are too few to exchange joints between
SHIFTS = 8
# levels below this may be what interpolation between samples leaves
LEVEL_FLOOR = 1e-5


def recombination_test(
    features: FeatureMap,
    trajectories: Sequence[Trajectory],
    rng: np.random.Generator,
    n_recombinations: int = RECOMBINATIONS,
    choices: int = 1,
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
        rng: Of the recombinations.
        n_recombinations: How many; 99 is the least for a p-value of 0.01.
        choices: In how many ways as many recordings could have been chosen from all there were.

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
    if not Phi:
        return RowEvidence((), (), (), (), np.zeros((0, features.n_rows)), 0, 0)
    W = whitening(np.mean([np.einsum("niv,njv->ij", P, P) / len(P) for P in Phi], axis=0), features.row_units)
    if not len(W):
        return RowEvidence((), (), (), (), np.zeros((0, features.n_rows)), len(paths), 0)
    donors = [(a, 0.0) for a in range(len(paths))]
    if len(paths) < FEWEST_TRAJECTORIES:
        donors += [(a, k / SHIFTS) for k in range(1, SHIFTS) for a in range(len(paths))]
    parts = np.stack([_parts(path, W @ P, paths, donors) for path, P in zip(paths, Phi, strict=True)])
    order = _arrangements(rng, n_recombinations, features.nv, len(paths), len(donors))
    each = _moments(parts, order)
    squares, directions = _squared_levels(each.mean(axis=1))
    energy = np.mean([np.mean(p.weight[:, None] * p.bin_steps() ** 2) for p in paths])
    levels = np.maximum(np.sqrt(squares / energy), LEVEL_FLOOR)
    held_out = np.maximum(np.sqrt(_held_out_squares(each[0]) / energy), levels[0])
    ratios = levels[1:] / held_out
    p_values = (1.0 + np.count_nonzero(levels[1:] <= levels[0], axis=0)) / (1.0 + len(ratios))
    return RowEvidence(
        tuple(np.median(ratios, axis=0).tolist()),
        tuple(np.min(ratios, axis=0).tolist()),
        tuple(p_values.tolist()),
        tuple(levels[0].tolist()),
        np.linalg.qr((directions @ W).T)[0].T,
        len(paths),
        len(ratios),
        tuple(np.std(np.log(np.maximum(ratios, LEVEL_FLOOR)), axis=0).tolist()),
        choices,
    )


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


def _arrangements(
    rng: np.random.Generator, n: int, nv: int, n_paths: int, n_donors: int
) -> Int[np.ndarray, "n_and_one nv d"]:
    """The donor of each joint of each trajectory; the first arrangement is the recorded one."""
    if n_donors == n_paths:
        order = np.argsort(rng.random((n, nv, n_paths)), axis=2)
    else:
        order = rng.integers(0, n_donors, (n, nv, n_paths))
    own = np.broadcast_to(np.arange(n_paths), (1, nv, n_paths))
    return np.concatenate([own, order])


def _moments(parts: Float[np.ndarray, "d b nv a r"], order: Int[np.ndarray, "m nv d"]) -> Float[np.ndarray, "m d r r"]:
    """Mean of r r^T over the bins of each trajectory, for each arrangement of the joints."""
    n_paths, n_bins, nv, _, r = parts.shape
    moments = np.empty((len(order), n_paths, r, r))
    each = np.arange(n_paths)
    for i, arrangement in enumerate(order):
        motion = parts[each, :, 0, arrangement[0]]
        for v in range(1, nv):
            motion = motion + parts[each, :, v, arrangement[v]]
        moments[i] = motion.transpose(0, 2, 1) @ motion
    return moments / n_bins


def _squared_levels(moments: Float[np.ndarray, "m r r"]) -> tuple[Float[np.ndarray, "m r"], Float[np.ndarray, "r r"]]:
    """Squared level of each row in the recorded (first) and the recombined motions, and the rows of the recorded one.

    Row s is looked for outside rows 1 .. s-1 of the recorded motion, in all motions alike. The s-th smallest level of
    a recombined motion would not do: once row 1 has grown, the next free row takes its place and seems to grow as well.
    """
    rows = np.linalg.eigh(moments[0])[1].T
    turned = rows @ moments @ rows.T
    squares = np.stack([np.linalg.eigvalsh(turned[:, s:, s:])[:, 0] for s in range(len(rows))], axis=1)
    return np.maximum(squares, 0.0), rows


def _held_out_squares(moments: Float[np.ndarray, "d r r"]) -> Float[np.ndarray, " r"]:
    """Squared level of each row in each trajectory, the row being that of all other trajectories: mean.

    A few strokes leave some direction unused by chance; the next stroke uses it.
    """
    n = len(moments)
    if n < 2:
        return np.zeros(moments.shape[1])
    rows = np.linalg.eigh((moments.sum(axis=0) - moments) / (n - 1))[1]
    return np.maximum(np.mean(np.einsum("dis,dij,djs->ds", rows, moments, rows), axis=0), 0.0)
