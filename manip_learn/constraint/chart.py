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

from manip_learn.constraint.curve import Curve
from manip_learn.robot.rotations import left_jacobian, rotation_matrix, rotation_vector, rotation_vectors, skew


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
        centre: shape (3,), a point that stays where it is while only the angles change [m]; of one screw it is known.
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
        self.turn, self.spin, self._carried = turn, spin, is_carried
        self._curve, self._rows = curve, rows
        self._at = 0.0 if curve is None else float(curve.nearest(self._p[None])[0])
        by_itself = ~turn.any(axis=1) & (np.sum(spin**2, axis=1) > np.sum(travel**2, axis=1))
        self.n_ways = len(spin) - int(np.count_nonzero(by_itself))
        self._turns, self._spins = int(np.count_nonzero(turn.any(axis=1))), bool(spin.any())
        self._size = math.sqrt(turn[0] @ turn[0]) if self._turns == 1 else 1.0
        self._axis = turn[0] / self._size
        if centre is None:  # the point of the axis next to the origin
            centre = skew(self._axis).dot(travel[0]) / self._size if self._turns == 1 else np.zeros(3)
        self._centre, self._slide = centre, travel - np.cross(centre, turn)
        out = self._p - centre
        self._held = -self._R.T @ out  # the point of a carried hand that is at the centre, in its axes
        self._out = out - (out @ self._axis) * self._axis if self._turns == 1 else out
        self._around = skew(self._axis).dot(self._out)

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
            turns = round((near * self._size - float(angle.flat[0])) / (2.0 * math.pi))
            s[..., 0] = ((angle if angle.ndim == 0 else np.unwrap(angle)) + 2.0 * math.pi * turns) / self._size
            if n > 1:
                s[..., 1] = (p - self._p) @ self._slide[1]
        elif n:
            s[..., :n] = (p - self._p) @ self._slide[:n].T / np.sum(self._slide[:n] ** 2, axis=1)
        if own := len(self.spin) - n:
            c = self.spin[n:]
            s[..., n:] = _vectors(Q) @ c.T if own == 3 else _turn_about(Q, c[0])[..., None]
        return s

    def pose(self, s: ArrayLike) -> Float[np.ndarray, "4 4"]:
        """Return the pose of the hand at free coordinates (k,) [m or rad]; those left out at the end are 0."""
        s, out, place = self._whole(s), self.grasp.copy(), self._p
        if self._curve is not None:
            at = np.array([self._at, self._at + s[0]])
            (before, after), (c0, c1) = self._curve.frames(at), self._curve.at(at)
            G = after @ before.T
            out[:3, 3] = c1 + G @ (place - c0)
        elif self._turns:
            G = rotation_matrix(s @ self.turn)
            out[:3, 3] = self._centre + G.dot(place - self._centre) + s @ self._slide
        else:
            G = None
            out[:3, 3] = place + s @ self._slide
        if self._carried and G is not None:
            out[:3, :3] = G.dot(self._R)
        elif self._spins:
            out[:3, :3] = rotation_matrix(s @ self.spin).dot(self._R)
        return out

    def twist(self, s: ArrayLike, pose: Float[np.ndarray, "4 4"] | None = None) -> Float[np.ndarray, "6 k"]:
        """Return the twist (v, w) of the hand's origin per unit of each coordinate.

        Args:
            s: shape (k,), free coordinates [m or rad].
            pose: shape (4, 4), of a hand that goes on from elsewhere; None for one that is on the mechanism.
        """
        s, K = self._whole(s), np.zeros((6, len(self.spin)))
        p = (self.pose(s) if pose is None else pose)[:3, 3]
        turning, K[:3] = self.turn.T, self._slide.T
        if self._curve is not None:
            c, c1, c2 = (self._curve.at(np.array([self._at + s[0]]), order)[0] for order in range(3))
            turning = (np.cross(c1, c2) / (c1 @ c1))[:, None]
            K[:3, 0] = c1 + np.cross(turning[:, 0], p - c)
        elif self._turns:
            turning = left_jacobian(s @ self.turn) @ turning if self._turns > 1 else turning
            K[:3] -= skew(p - self._centre).dot(turning)
        if self._carried:
            K[3:, : turning.shape[1]] = turning
        elif self._spins:
            K[3:] = left_jacobian(s @ self.spin) @ self.spin.T
        return K

    def _whole(self, s: ArrayLike) -> Float[np.ndarray, " k"]:
        s = np.asarray(s, dtype=np.float64)
        return s if len(s) == len(self.spin) else np.append(s, np.zeros(len(self.spin) - len(s)))

    def error(self, pose: Float[np.ndarray, "4 4"], s: ArrayLike) -> Float[np.ndarray, " 6"]:
        """Return the twist that takes the pose meant by free coordinates to that of the hand [m, rad].

        Of a hand that is carried, the point that it holds at the centre moves as far as the twist says.
        """
        meant, out = self.pose(s), np.empty(6)
        turned = pose[:3, :3] @ meant[:3, :3].T
        out[:3], out[3:] = pose[:3, 3] - meant[:3, 3], rotation_vector(turned)
        if self._carried and self._turns:
            lever = meant[:3, :3] @ self._held
            out[:3] += turned.dot(lever) - lever - skew(out[3:]).dot(lever)
        return out

    def heading(self, pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 6"]:
        """Return the way of a hand along the first coordinate, and how what it holds turns meanwhile [m, rad]."""
        return np.append(self.twist([], pose)[:3, 0], self.turn[0] + self.spin[0])

    def held_error(self, pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " h"]:
        """Return how far a hand is off the mechanism along the held rows, 6 - k of them [m or rad].

        Counted from the pose on the mechanism that has the same free coordinates.
        """
        return self._rows(pose[None, :3, 3])[0] @ self.error(pose, self.coordinates(pose))  # type: ignore[misc]


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
