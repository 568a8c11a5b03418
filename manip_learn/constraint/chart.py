"""Free coordinates of a hand that holds a mechanism: the pose that they mean, its twist, and the held error.

A mechanism displaces whatever is fixed to it by g(s) of SE(3), g(0) = 1: the exponential of its screws, g(s) =
exp(sum_i s_i X_i) (R. W. Brockett, "Robotic Manipulators and the Product of Exponentials Formula", 1984), or the frame
that goes along a curve. A grasp is the pose at s = 0. With g = (G, t), the hand that took hold at (p0, R0) is at

    p = G p0 + t,    R = C R0,    C = G of a hand that is carried, exp(sum_i s_i c_i) of one that turns by itself

A line is a screw that only travels, a hinge one that only turns; screws that do both, cylinders, balls and planes are
the same formula with other numbers, and so is a hand that may turn as it likes: its own turns are further coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.curve_rows import Curve
from manip_learn.robot.rotations import left_jacobian, rotation_matrix, rotation_vector, rotation_vectors


@final
class Chart:
    """Free coordinates s (k,) of a hand about the pose at which it took hold.

    The ways [m] and angles [rad] along the mechanism come first, then the angles by which the hand turns by itself.

    Args:
        grasp: shape (4, 4), pose of the hand where it took hold; s = 0 there.
        travel: shape (k, 3), and
        turn: shape (k, 3): X_i = (v_i, w_i) [m, rad per unit of s_i]: the velocity at the origin, and the angular one.
        spin: shape (k, 3), c_i, by which the hand turns by itself [rad per unit of s_i].
        is_carried: Whether the hand turns with the mechanism. Its rotation then tells the angle, otherwise its place.
        centre: shape (3,), a point that stays where it is while only the angles change [m].
        curve: Along which the hand goes, in the place of screws.
        rows: Place (1, 3) -> weights (1, h, 6) of the hand's twist in the h rows that are held.
    """

    def __init__(
        self,
        grasp: Float[np.ndarray, "4 4"],
        travel: Float[np.ndarray, "k 3"],
        turn: Float[np.ndarray, "k 3"],
        spin: Float[np.ndarray, "k 3"],
        *,
        is_carried: bool = False,
        centre: Float[np.ndarray, " 3"] | None = None,
        curve: Curve | None = None,
        rows: Callable[[Float[np.ndarray, "1 3"]], Float[np.ndarray, "1 h 6"]] | None = None,
    ):
        self.grasp, self._p, self._R = grasp, grasp[:3, 3].copy(), grasp[:3, :3].copy()
        self.travel, self.turn, self.spin, self._carried = travel, turn, spin, is_carried
        self._centre = np.zeros(3) if centre is None else centre
        self._curve, self._rows = curve, rows
        self._at = 0.0 if curve is None else float(curve.nearest(self._p[None])[0])
        by_itself = ~turn.any(axis=1) & (np.sum(spin**2, axis=1) > np.sum(travel**2, axis=1))
        self.n_ways = len(spin) - int(np.count_nonzero(by_itself))
        self._turns = int(np.count_nonzero(turn.any(axis=1)))
        self._spins = bool(spin.any())
        self._out = self._p - self._centre
        if self._turns == 1:
            size = math.sqrt(turn[0] @ turn[0])
            self._axis, self._scale = turn[0] / size, size
            self._out = self._out - (self._out @ self._axis) * self._axis
            self._around = np.cross(self._axis, self._out)

    def coordinates(self, pose: Float[np.ndarray, "*n 4 4"], near: float = 0.0) -> Float[np.ndarray, "*n k"]:
        """Return the free coordinates of a hand [m or rad], or of a hand along a motion.

        Args:
            pose: shape (4, 4) of the hand, or (T, 4, 4) of a motion, along which the angles have no jumps.
            near: Of angles a turn apart the first is the one next to this [rad].
        """
        p, Q = pose[..., :3, 3], pose[..., :3, :3] @ self._R.T
        n, s = self.n_ways, np.zeros((*p.shape[:-1], len(self.spin)))
        if self._curve is not None:
            s[..., 0] = self._curve.nearest(p.reshape(-1, 3)).reshape(p.shape[:-1]) - self._at
        elif self._turns > 1:
            turned = _vectors(Q) if self._carried else _shortest_turn(self._out, p - self._centre)
            s[..., :n] = turned @ self.turn[:n].T
        elif self._turns:
            if self._carried:
                angle = _turn_about(Q, self._axis)
            else:
                d = p - self._centre
                angle = np.arctan2(d @ self._around, d @ self._out)
            turns = np.round((near * self._scale - angle.flat[0]) / (2.0 * math.pi))
            angle = (angle if angle.ndim == 0 else np.unwrap(angle)) + 2.0 * math.pi * turns
            s[..., 0] = angle / self._scale
            if n > 1:
                s[..., 1] = (p - self._p) @ self.travel[1]
        elif n:
            s[..., :n] = (p - self._p) @ self.travel[:n].T / np.sum(self.travel[:n] ** 2, axis=1)
        if own := len(self.spin) - n:
            c = self.spin[n:]
            s[..., n:] = _vectors(Q) @ c.T if own == 3 else _turn_about(Q, c[0])[..., None]
        return s

    def displacement(self, s: ArrayLike) -> Float[np.ndarray, "4 4"]:
        """Return g(s), by which the mechanism displaces what is fixed to it."""
        s, g = np.asarray(s, dtype=np.float64), np.eye(4)
        if self._curve is not None:
            at = np.array([self._at, self._at + s[0]])
            (before, after), (c0, c1) = self._curve.frames(at), self._curve.at(at)
            g[:3, :3] = after @ before.T
            g[:3, 3] = c1 - g[:3, :3] @ c0
            return g
        g[:3, 3] = s @ self.travel
        if self._turns:
            w = s @ self.turn
            g[:3, :3], g[:3, 3] = rotation_matrix(w), left_jacobian(w) @ g[:3, 3]
        return g

    def pose(self, s: ArrayLike) -> Float[np.ndarray, "4 4"]:
        """Return the pose of the hand at free coordinates (k,) [m or rad]; those left out at the end are 0."""
        s = np.append(s, np.zeros(len(self.spin) - np.size(s)))
        out = self.displacement(s) @ self.grasp
        if not self._carried:
            out[:3, :3] = rotation_matrix(s @ self.spin) @ self._R if self._spins else self._R
        return out

    def twist(self, s: ArrayLike, pose: Float[np.ndarray, "4 4"] | None = None) -> Float[np.ndarray, "6 k"]:
        """Return the twist (v, w) of the hand's origin per unit of each coordinate.

        Args:
            s: shape (k,), free coordinates [m or rad].
            pose: shape (4, 4), of a hand that goes on from elsewhere; None for one that is on the mechanism.
        """
        s, K = np.append(s, np.zeros(len(self.spin) - np.size(s))), np.zeros((6, len(self.spin)))
        p = (self.pose(s) if pose is None else pose)[:3, 3]
        if self._curve is not None:
            c, c1, c2 = (self._curve.at(np.array([self._at + s[0]]), order)[0] for order in range(3))
            turning = (np.cross(c1, c2) / (c1 @ c1))[:, None]
            K[:3, 0] = c1 + np.cross(turning[:, 0], p - c)
        else:
            K[:3], turning = self.travel.T, self.turn.T
            if self._turns:
                turning = left_jacobian(s @ self.turn) @ turning if self._turns > 1 else turning
                K[:3] += np.cross(self._centre, turning - self.turn.T, axis=0) + np.cross(turning, p[:, None], axis=0)
        if self._carried:
            K[3:, : turning.shape[1]] = turning
        elif self._spins:
            K[3:] = left_jacobian(s @ self.spin) @ self.spin.T
        return K

    def held_error(self, pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " h"]:
        """Return how far a hand is off the mechanism along the held rows, 6 - k of them [m or rad].

        Counted from the pose on the mechanism that has the same free coordinates.
        """
        meant = self.pose(self.coordinates(pose))
        turned = rotation_vector(pose[:3, :3] @ meant[:3, :3].T)
        moved = pose[:3, 3] - meant[:3, 3]
        if self._carried and self._turns:  # of the point of the hand that is held, which a lever may take far
            lever = meant[:3, :3] @ self._R.T @ (self._centre - self._p)
            moved = moved + pose[:3, :3] @ meant[:3, :3].T @ lever - lever - np.cross(turned, lever)
        return self._rows(pose[None, :3, 3])[0] @ np.append(moved, turned)  # type: ignore[misc]


def _vectors(Q: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3"]:
    return rotation_vector(Q) if Q.ndim == 2 else rotation_vectors(Q)


def _turn_about(Q: Float[np.ndarray, "*n 3 3"], axis: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "*n"]:
    """Return the part of rotations that is about an axis [rad]; it is well determined up to half a turn."""
    vee = np.stack([Q[..., 2, 1] - Q[..., 1, 2], Q[..., 0, 2] - Q[..., 2, 0], Q[..., 1, 0] - Q[..., 0, 1]], axis=-1)
    return np.asarray(np.arctan2(vee @ axis, np.trace(Q, axis1=-2, axis2=-1) - Q @ axis @ axis))


def _shortest_turn(before: Float[np.ndarray, " 3"], after: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Return the rotation vectors that take one direction to others on the shortest way [rad]."""
    normal = np.cross(before, after)
    sine = np.linalg.norm(normal, axis=-1, keepdims=True)
    return normal * np.arctan2(sine, (after @ before)[..., None]) / np.maximum(sine, 1e-300)
