"""Trajectories aligned in phase: where along its way each was, and how far each joint had come by then."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.recordings.trajectory import Trajectory

# a joint that moves less than this share of the liveliest one does not set the phase: its noise would
STILL_SHARE = 0.3
# time that one bin should cover [s], and the numbers of bins that are allowed
BIN_SECONDS, FEWEST_BINS, MOST_BINS = 0.25, 4, 24
# points of a trajectory at which Phi is evaluated, at most
MOST_POINTS = 240
NODES_PER_BIN = 4


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

    def reverse(self) -> PhasePath:
        """The same way from its end to its start; displacements keep their sign."""
        return PhasePath(
            self.q[::-1],
            1.0 - self.edges[::-1],
            self.n_bins - 1 - self.bins[::-1],
            self.weight[::-1],
            self.steps[::-1],
        )

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

    Args:
        trajectories: With velocities; those of fewer than three samples or without motion are left out.
    """
    moving = [t for t in trajectories if len(t) > 2 and t.u is not None and np.any(t.u != 0.0)]
    if not moving:
        return []
    size = np.sqrt(np.mean([np.mean(np.square(t.u), axis=0) for t in moving], axis=0))  # type: ignore[arg-type]
    scale = np.maximum(size, STILL_SHARE * np.max(size))
    seconds = float(np.median([t.duration for t in moving]))
    most = int(min(MOST_BINS, max(np.median([len(t) for t in moving]) // 2, 1)))
    n_bins = int(np.clip(round(seconds / BIN_SECONDS), min(FEWEST_BINS, most), most))
    return _turned([_path(t, scale, n_bins) for t in moving], scale)


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
    chosen = np.unique(np.linspace(0, len(time) - 1, min(len(time), MOST_POINTS)).round().astype(np.int64))
    at = phase[chosen]
    edges = np.concatenate([[0.0], 0.5 * (at[1:] + at[:-1]), [1.0]])
    bins = np.minimum((at * n_bins).astype(np.int64), n_bins - 1)
    return PhasePath(trajectory.q[chosen], edges, bins, length**2 * weight / np.mean(weight), steps)


def _turned(paths: list[PhasePath], scale: Float[np.ndarray, " nv"]) -> list[PhasePath]:
    """The same with backward strokes turned round, and trajectories that are backward as a whole run in reverse."""
    by_bin = np.stack([path.bin_steps() for path in paths]) / scale
    common = np.linalg.svd(by_bin.reshape(-1, by_bin.shape[2]), full_matrices=False)[2][0]
    turned = []
    for path, moved in zip(paths, by_bin, strict=True):
        own = np.linalg.svd(moved, full_matrices=False)[2][0]
        along = moved @ (own if own @ common >= 0.0 else -own)
        steps = path.steps * np.repeat(np.where(along < 0.0, -1.0, 1.0), NODES_PER_BIN)[:, None]
        path = PhasePath(path.q, path.edges, path.bins, path.weight, steps)
        turned.append(path.reverse() if np.sum(along) < -0.5 * np.sum(np.abs(along)) else path)
    return turned
