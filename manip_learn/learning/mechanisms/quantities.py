"""Where the hand was, what each mechanism keeps constant along its path, and how that moves with place and hand.

Derivatives are taken along the seven numbers of the place, axis a (3), point c (3), pitch h (1). How errors of the
joints move a quantity follows from them: to move the hand is to move the place the other way, seen from the hand.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.constraint.features.mechanism_rows import Place
from manip_learn.recordings.trajectory import evenly
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.joints import Frame
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import left_jacobian_inverse, rotation_vectors, skew

NEAR_AXIS = 1e-4  # [m] angles about an axis are not trusted closer to it


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

    def beside(self, other: TipPaths) -> TipPaths:
        """These trajectories, then others."""
        p, R, J = (np.concatenate([getattr(self, what), getattr(other, what)]) for what in ("p", "R", "J"))
        return TipPaths(p, R, J, np.concatenate([self.starts, len(self.p) + other.starts]))

    @cached_property
    def parts(self) -> list[slice]:
        """Rows of each trajectory."""
        return [self.part(i) for i in range(len(self.starts))]

    def part(self, number: int) -> slice:
        """Rows of one trajectory."""
        return slice(int(self.starts[number]), int(self.starts[number] + self.counts[number]))


def thinned(q: Float[np.ndarray, "T n"], most: int) -> Float[np.ndarray, "t n"]:
    """At most `most` samples of a trajectory, evenly spread, ends included."""
    return q[evenly(len(q), most)]


Slopes = Float[np.ndarray, "N d 7"]
Values = tuple[Float[np.ndarray, "N d"], Slopes]


@final
@dataclass(frozen=True)
class Quantity:
    """Something that a mechanism holds constant.

    Attributes:
        evaluate: Values and derivatives along the paths.
        width: Number of values.
        rank: How many independent rows they stand for.
        unit: `"m"` or `"rad"`.
        by_twist: Derivatives along the twist of the frame in base axes, linear part first, from those by the place.
    """

    evaluate: Callable[[TipPaths, Place], Values]
    width: int
    rank: int
    unit: Literal["m", "rad"]
    by_twist: Callable[[TipPaths, Place, Slopes], Float[np.ndarray, "N d 6"]]


def _cylindrical(paths: TipPaths, place: Place) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """d = p - c, z = a.d, rho, and the unit vector away from the axis."""
    d = paths.p - place.point
    z = d @ place.axis
    x = d - z[:, None] * place.axis
    rho = np.sqrt(np.einsum("ni,ni->n", x, x))
    return d, z, rho, x / np.maximum(rho, NEAR_AXIS)[:, None]


def _across_line(paths: TipPaths, place: Place) -> Values:
    base = place.across
    d = paths.p - place.point
    J = np.zeros((len(d), 2, 7))
    J[:, :, :3], J[:, :, 3:6] = -(d @ place.axis)[:, None, None] * base, -base
    return d @ base.T, J


def _height(paths: TipPaths, place: Place) -> Values:
    d = paths.p - place.point
    J = np.zeros((len(d), 1, 7))
    J[:, 0, :3], J[:, 0, 3:6] = d, -place.axis
    return (d @ place.axis)[:, None], J


def _radius(paths: TipPaths, place: Place) -> Values:
    _, z, rho, n = _cylindrical(paths, place)
    J = np.zeros((len(z), 1, 7))
    J[:, 0, :3], J[:, 0, 3:6] = -z[:, None] * n, -n
    return rho[:, None], J


def _distance(paths: TipPaths, place: Place) -> Values:
    d = paths.p - place.point
    length = np.sqrt(np.einsum("ni,ni->n", d, d))[:, None]
    J = np.zeros((len(d), 1, 7))
    J[:, 0, 3:6] = -d / np.maximum(length, NEAR_AXIS)
    return length, J


def angles_about(paths: TipPaths, place: Place) -> Float[np.ndarray, " N"]:
    """Angle of the path about the axis, without jumps along each trajectory [rad]."""
    base = place.across
    y = (paths.p - place.point) @ base.T
    return paths.unwrapped(np.arctan2(y[:, 1], y[:, 0]))


def turn_about(paths: TipPaths, axis: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " N"]:
    """Angle by which the hand has turned about an axis since the start of each trajectory [rad]."""
    vee, trace = paths.turned
    return paths.unwrapped(np.arctan2(vee @ axis, trace - 1.0))


def _thread(paths: TipPaths, place: Place) -> Values:
    d, z, rho, n = _cylindrical(paths, place)
    phi = angles_about(paths, place)
    around = n @ skew(place.axis).T / np.maximum(rho, NEAR_AXIS)[:, None]
    h, J = place.pitch, np.zeros((len(z), 1, 7))
    J[:, 0, :3] = d + h * z[:, None] * around
    J[:, 0, 3:6] = -place.axis + h * around
    J[:, 0, 6] = -phi
    return (z - h * phi)[:, None], J


def _axis_in_hand(paths: TipPaths, place: Place) -> Values:
    J = np.zeros((len(paths.p), 3, 7))
    J[:, :, :3] = paths.R.transpose(0, 2, 1)
    return np.einsum("nji,j->ni", paths.R, place.axis), J


def _point_in_hand(paths: TipPaths, place: Place) -> Values:
    J = np.zeros((len(paths.p), 3, 7))
    J[:, :, 3:6] = paths.R.transpose(0, 2, 1)
    return np.einsum("nji,nj->ni", paths.R, place.point - paths.p), J


def _screw_in_hand(paths: TipPaths, place: Place) -> Values:
    value, J = _point_in_hand(paths, place)
    psi = turn_about(paths, place.axis)
    J[:, :, 6] = psi[:, None] * np.einsum("nji,j->ni", paths.R, place.axis)
    J[:, :, :3] = (place.pitch * psi)[:, None, None] * paths.R.transpose(0, 2, 1)
    return value + place.pitch * J[:, :, 6], J


def _axis_line_in_hand(paths: TipPaths, place: Place) -> Values:
    """The point of the axis next to the hand, seen from the hand: constant across the axis, zero along it."""
    a, e = place.axis, place.point - paths.p
    along = e @ a
    R_T = paths.R.transpose(0, 2, 1)
    J = np.zeros((len(e), 3, 7))
    J[:, :, :3] = -R_T @ (along[:, None, None] * np.eye(3) + a[:, None] * e[:, None, :])
    J[:, :, 3:6] = R_T @ (np.eye(3) - np.outer(a, a))
    return np.einsum("nij,nj->ni", R_T, e - along[:, None] * a), J


def _of_position(paths: TipPaths, place: Place, J: Slopes) -> Float[np.ndarray, "N d 6"]:
    return np.concatenate([-J[:, :, 3:6], np.zeros((*J.shape[:2], 3))], axis=2)


def _seen_from_hand(paths: TipPaths, place: Place, J: Slopes) -> Float[np.ndarray, "N d 6"]:
    lever = -np.cross((place.point - paths.p)[:, None, :], np.eye(3))  # [c - p]_x
    return np.concatenate([-J[:, :, 3:6], J[:, :, :3] @ skew(place.axis) + J[:, :, 3:6] @ lever], axis=2)


def _along_screw(paths: TipPaths, place: Place, J: Slopes) -> Float[np.ndarray, "N d 6"]:
    """The hand's turn about the axis moves it along the axis, too."""
    out = _seen_from_hand(paths, place, J)
    out[:, :, 3:] += paths.R.transpose(0, 2, 1) @ (place.pitch * np.outer(place.axis, place.axis))
    return out


def _of_turns(paths: TipPaths, place: Place, J: Slopes) -> Float[np.ndarray, "N d 6"]:
    turning = np.array([left_jacobian_inverse(v) for v in paths.turns])
    return np.concatenate([np.zeros_like(turning), turning], axis=2)


QUANTITIES: dict[str, Quantity] = {
    "across-line": Quantity(_across_line, 2, 2, "m", _of_position),
    "height": Quantity(_height, 1, 1, "m", _of_position),
    "radius": Quantity(_radius, 1, 1, "m", _of_position),
    "distance": Quantity(_distance, 1, 1, "m", _of_position),
    "thread": Quantity(_thread, 1, 1, "m", _of_position),
    "axis-in-hand": Quantity(_axis_in_hand, 3, 2, "rad", _seen_from_hand),
    "point-in-hand": Quantity(_point_in_hand, 3, 3, "m", _seen_from_hand),
    "screw-in-hand": Quantity(_screw_in_hand, 3, 3, "m", _along_screw),
    "axis-line-in-hand": Quantity(_axis_line_in_hand, 3, 2, "m", _seen_from_hand),
    "orientation": Quantity(lambda paths, _: (paths.turns, np.zeros((len(paths.p), 3, 7))), 3, 3, "rad", _of_turns),
}
