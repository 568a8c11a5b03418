"""Where the hand was: poses along several trajectories, and how errors of the joints move them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.recordings.preprocessing import evenly
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.frame import Frame
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import rotation_vectors


@final
@dataclass(frozen=True, eq=False)
class TipPaths:
    """Poses of a frame along trajectories, one after the other, in the base frame.

    Attributes:
        p: shape (N, 3), origins [m].
        R: shape (N, 3, 3), orientations.
        J: shape (N, 6, nv), Jacobians along the base's axes, linear rows first; the unit matrix, where all directions
            of the frame's twist are to weigh the same.
        starts: shape (n,), first row of each trajectory.
    """

    p: Float[np.ndarray, "N 3"]
    R: Float[np.ndarray, "N 3 3"]
    J: Float[np.ndarray, "N 6 nv"]
    starts: Int[np.ndarray, " n"]

    @staticmethod
    def of(robot: Robot, frame: Frame, postures: Sequence[Float[np.ndarray, "_ n"]]) -> TipPaths:
        """The paths of a frame along trajectories given as postures."""
        q, kinematics = np.concatenate(postures), batch_kinematics(robot, frame)
        pose, lengths = kinematics.pose(q), [len(q) for q in postures]
        return TipPaths(pose[:, :3, 3], pose[:, :3, :3], kinematics.jacobian(q), np.cumsum([0, *lengths[:-1]]))

    @cached_property
    def counts(self) -> Int[np.ndarray, " n"]:
        """Number of samples of each trajectory."""
        return np.diff(np.append(self.starts, len(self.p)))

    def means(self, values: Float[np.ndarray, "N d"]) -> Float[np.ndarray, "n d"]:
        """Mean over each trajectory."""
        return np.add.reduceat(values, self.starts, axis=0) / self.counts[:, None]

    def centred(self, values: Float[np.ndarray, "N d"]) -> Float[np.ndarray, "N d"]:
        """Values less the mean of their trajectory."""
        return values - np.repeat(self.means(values), self.counts, axis=0)

    @cached_property
    def turns(self) -> Float[np.ndarray, "N 3"]:
        """Rotation vectors from the mean orientation of each trajectory, in the base frame [rad]."""
        mean = self.means(self.R.reshape(-1, 9)).reshape(-1, 3, 3)
        U, _, Vt = np.linalg.svd(mean)
        U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
        away = self.R @ np.repeat(U @ Vt, self.counts, axis=0).transpose(0, 2, 1)
        return rotation_vectors(away)

    @cached_property
    def turned(self) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
        """2 sin(angle) axis and 1 + 2 cos(angle) of the rotation since the start of each trajectory."""
        R0 = np.repeat(self.R[self.starts], self.counts, axis=0)
        M = self.R @ R0.transpose(0, 2, 1)
        vee = np.stack([M[:, 2, 1] - M[:, 1, 2], M[:, 0, 2] - M[:, 2, 0], M[:, 1, 0] - M[:, 0, 1]], axis=1)
        return vee, np.trace(M, axis1=1, axis2=2)

    def unwrapped(self, angle: Float[np.ndarray, "N ..."]) -> Float[np.ndarray, "N ..."]:
        """Angles without jumps of a turn along each trajectory [rad]."""
        jumps = np.diff(angle, axis=0, prepend=angle[:1])
        jumps = -2.0 * np.pi * np.round(jumps / (2.0 * np.pi))
        jumps[self.starts] = 0.0
        return angle + np.cumsum(jumps, axis=0)  # whole turns that a trajectory inherits do not matter

    def chosen(self, numbers: Sequence[int]) -> TipPaths:
        """Some of the trajectories, in this order."""
        rows = np.concatenate([np.arange(len(self.p))[self.part(i)] for i in numbers])
        starts = np.cumsum([0, *self.counts[list(numbers[:-1])]])
        return TipPaths(self.p[rows], self.R[rows], self.J[rows], starts)

    def part(self, number: int) -> slice:
        """Rows of one trajectory."""
        return slice(int(self.starts[number]), int(self.starts[number] + self.counts[number]))


def thinned(q: Float[np.ndarray, "T n"], most: int) -> Float[np.ndarray, "t n"]:
    """At most so many samples of a trajectory, evenly spread, ends included."""
    return q[evenly(len(q), most)]
