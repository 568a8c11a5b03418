"""Free coordinates of a hand that holds a mechanism: the pose that they mean, its tangent twist, and the held error.

A mechanism displaces whatever is fixed to it by g(s) of SE(3), g(0) = 1: exponentials of its screw axes (Murray, Li and
Sastry, "A Mathematical Introduction to Robotic Manipulation", 1994), or the frame that goes along a curve. A grasp is
the pose at s = 0. With x the point of the hand that is followed (its origin; of a hand that is carried the point at the
mechanism's own point), x0 and R0 those of the grasp, g = (G, t), and C the rotation that s asks of the hand (G of one
that is carried, the exponential of its own turn where it may turn, else 1),

    e(pose, s) = [ G^T (x - t) - x0 ;  log(C^T R R0^T) ]            the pose pulled back to the grasp
    P e(pose, s) = 0   defines the free coordinates s (k),   N e   are the 6 - k held ones, P and N constant
"""

from __future__ import annotations

import math
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.curve_rows import Curve
from manip_learn.constraint.features.mechanism_rows import Place, across
from manip_learn.constraint.features.weighed_velocity import ON_AXIS
from manip_learn.errors import ConstraintError
from manip_learn.robot.rotations import left_jacobian, rotation_matrix, rotation_vector, skew

# names of free and of held coordinates of the place, and of a hand that is carried, by kind
PLACE = {
    "line": ("axial", "across-1 across-2"),
    "plane": ("across-1 across-2", "axial"),
    "space": ("x y z", ""),
    "hinge": ("tangential", "radial axial"),
    "screw": ("tangential", "radial helical"),
    "cylinder": ("tangential axial", "radial"),
    "ball": ("around-1 around-2", "spherical"),
    "curve": ("along", "across-1 across-2"),
}
CARRIED = {
    "hinge": ("turn", "turn-1 turn-2 slide-1 slide-2 slide"),
    "screw": ("turn", "turn-1 turn-2 slide-1 slide-2 screw"),
    "cylinder": ("turn slide", "turn-1 turn-2 slide-1 slide-2"),
    "ball": ("rx ry rz", "slide-1 slide-2 slide"),
}
TURNS = {"free": ("rx ry rz", ""), "about-axis": ("turn", "turn-1 turn-2")}  # of others; else the hand does not turn


def coordinate_names(kind: str, orientation: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the free coordinates and of the held ones, six together."""
    if orientation == "carried" and kind in CARRIED:
        free, held = CARRIED[kind]
    else:
        turns = TURNS.get(orientation, ("", "turn-1 turn-2 turn"))
        free, held = (f"{place} {turn}" for place, turn in zip(PLACE[kind], turns, strict=True))
    return tuple(free.split()), tuple(held.split())


@final
class Chart:
    """Free coordinates of a hand about the pose at which it took hold of a mechanism.

    They are ways [m] and angles [rad] along the mechanism, then the hand's own turn where it may turn; see
    `coordinate_names`. Of a loosely held ball, hinge, screw or cylinder the place of the hand is the angle; of a hand
    that is carried its rotation is.

    Args:
        kind: Key of `PLACE`.
        orientation: What the hand may do, as of a mechanism.
        place: Axis, point and pitch.
        curve: Of kind `"curve"`.
        pose: shape (4, 4), of the hand where it took hold, in the mechanism's frame.

    Raises:
        ConstraintError: A loosely held hand on the axis, or at the centre, about which its place turns.
    """

    def __init__(self, kind: str, orientation: str, place: Place, curve: Curve | None, pose: Float[np.ndarray, "4 4"]):
        self._kind, self._curve, self._a, self._c, self._pitch = kind, curve, place.axis, place.point, place.pitch
        self._carried = orientation == "carried"
        self._firm = self._carried and kind in CARRIED
        self.names, self.held_names = coordinate_names(kind, orientation)
        self._n_turns = {"free": 3, "about-axis": 1}.get(orientation, 0)
        self._n_places = len(self.names) - self._n_turns
        self._R0 = pose[:3, :3].copy()
        self._followed = self._R0.T @ (self._c - pose[:3, 3]) if self._firm else np.zeros(3)  # in the hand
        self._x0 = pose[:3, 3] + self._R0 @ self._followed
        self._s0 = 0.0 if self._curve is None else float(self._curve.nearest(self._x0[None])[0])
        out = self._x0 - self._c
        self._out = out if kind == "ball" else out - (out @ self._a) * self._a
        if not self._firm and kind in ("hinge", "screw", "cylinder", "ball") and np.linalg.norm(self._out) < ON_AXIS:
            raise ConstraintError(f"a hand on the axis, or at the centre, of a {kind} has no angle about it")
        self._turn_basis = {3: np.eye(3), 1: self._a[None], 0: np.zeros((0, 3))}[self._n_turns]
        self._P, self._N = (np.array([self._weights(n) for n in names]) for names in (self.names, self.held_names))
        self._P, self._N = self._P.reshape(-1, 6), self._N.reshape(-1, 6)
        self._basis = np.eye(3)
        if kind == "ball" and not self._firm:  # turns that go across the hand's lever
            self._basis = self._P[:2, :3] @ skew(self._out / np.linalg.norm(self._out)).T

    def _weights(self, name: str) -> Float[np.ndarray, " 6"]:
        """Return the constant weights of a coordinate of that name on e."""
        v, w, number = np.zeros(3), np.zeros(3), int(name[-1]) - 1 if name[-1].isdigit() else 0
        size = float(np.linalg.norm(self._out))
        x = self._out / size if size > 0.0 else self._out
        if name.startswith("turn"):
            w = self._a if name == "turn" else across(self._a)[number]
        elif name[0] == "r" and len(name) == 2:
            w = np.eye(3)["xyz".index(name[1])]
        elif self._curve is not None:
            tangent = self._curve.at(np.array([self._s0]), 1)[0]
            along = name == "along"
            v = tangent / np.linalg.norm(tangent) if along else self._curve.frame(np.array([self._s0]))[0][number]
        elif name.startswith(("across", "slide-")):
            v = across(self._a)[number]
        elif name.startswith("around"):
            v = across(x)[number]
        elif name in ("radial", "spherical"):
            v = x
        elif name == "tangential":
            v = np.cross(self._a, x)
        elif name == "helical":
            v = (size * self._a - self._pitch * np.cross(self._a, x)) / math.hypot(size, self._pitch)
        else:
            v = np.eye(3)["xyz".index(name)] if name in "xyz" else self._a
        return np.concatenate([v, w])

    def coordinates(self, pose: Float[np.ndarray, "4 4"], near: float = 0.0) -> Float[np.ndarray, " k"]:
        """Return the free coordinates of a hand [m or rad], 0 where it took hold.

        Args:
            pose: shape (4, 4), of the hand.
            near: Of angles a turn apart the first coordinate is the one next to this [rad].
        """
        Q, s = pose[:3, :3] @ self._R0.T, np.zeros(len(self.names))
        x, n = pose[:3, 3] + pose[:3, :3] @ self._followed, self._n_places
        if self._curve is not None:
            s[0] = self._curve.nearest(x[None])[0] - self._s0
        elif self._kind in ("line", "plane", "space"):
            s[:n] = self._P[:n, :3] @ (x - self._x0)
        elif self._kind == "ball":
            turn = rotation_vector(Q) if self._firm else _shortest_turn(self._out, x - self._c)
            s[:n] = self._basis @ turn
        else:
            d = x - self._c
            around = np.cross(self._a, self._out)
            angle = _turn_about(Q, self._a) if self._firm else math.atan2(float(around @ d), float(self._out @ d))
            s[0] = angle + 2.0 * math.pi * round((near - angle) / (2.0 * math.pi))
            if self._kind == "cylinder":
                s[1] = self._a @ (x - self._x0)
        if self._n_turns:
            s[n:] = rotation_vector(Q) if self._n_turns == 3 else _turn_about(Q, self._a)
        return s

    def pose(self, s: ArrayLike) -> Float[np.ndarray, "4 4"]:
        """Return the pose of the hand at free coordinates (k,) [m or rad]."""
        G, t, C = self._displacement(np.asarray(s, dtype=np.float64))
        out = np.eye(4)
        out[:3, :3] = C @ self._R0
        out[:3, 3] = G @ self._x0 + t - out[:3, :3] @ self._followed
        return out

    def twist(self, s: ArrayLike) -> Float[np.ndarray, "6 k"]:
        """Return the twist (v, w) of the hand's origin per unit of each coordinate, in the mechanism's frame."""
        s = np.asarray(s, dtype=np.float64)
        n, pose, out = self._n_places, self.pose(s), np.zeros((6, len(s)))
        lever = pose[:3, :3] @ self._followed
        x = pose[:3, 3] + lever
        w = np.zeros((3, n))  # of what the hand holds
        if self._kind in ("line", "plane", "space"):
            out[:3, :n] = self._P[:n, :3].T
        elif self._curve is not None:
            c, c1, c2 = (self._curve.at(np.array([self._s0 + s[0]]), order)[0] for order in range(3))
            w[:, 0] = np.cross(c1, c2) / (c1 @ c1)
            out[:3, 0] = c1 + np.cross(w[:, 0], x - c)
        elif self._kind == "ball":
            w = left_jacobian(s[:n] @ self._basis) @ self._basis.T
            out[:3, :n] = -skew(x - self._c) @ w
        else:
            w[:, 0] = self._a
            out[:3, 0] = np.cross(self._a, x - self._c) + (self._kind == "screw") * self._pitch * self._a
            out[:3, 1:n] = self._a[:, None]
        if self._carried:
            out[3:, :n] = w
        elif self._n_turns:
            out[3:, n:] = left_jacobian(s[n:] @ self._turn_basis) @ self._turn_basis.T
        out[:3] += skew(lever) @ out[3:]  # of the origin, from that of the point that is followed
        return out

    def held_error(self, pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " h"]:
        """Return how far the 6 - k held coordinates are from where the hand took hold [m or rad]."""
        G, t, C = self._displacement(self.coordinates(pose))
        R = pose[:3, :3]
        moved = G.T @ (pose[:3, 3] + R @ self._followed - t) - self._x0
        return self._N @ np.concatenate([moved, rotation_vector(C.T @ R @ self._R0.T)])

    def _displacement(self, s: Float[np.ndarray, " k"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return G and t of g(s), and C."""
        G, n, travel = np.eye(3), self._n_places, np.zeros(3)
        if self._kind in ("line", "plane", "space"):
            t = s[:n] @ self._P[:n, :3]
        elif self._curve is not None:
            places = np.array([self._s0, self._s0 + s[0]])
            before, after = (self._frame(at) for at in places)
            c0, c1 = self._curve.at(places)
            G = after @ before.T
            t = c1 - G @ c0
        else:
            G = rotation_matrix(s[:n] @ self._basis if self._kind == "ball" else s[0] * self._a)
            if self._kind == "cylinder":
                travel = s[1] * self._a
            elif self._kind == "screw":
                travel = self._pitch * s[0] * self._a
            t = self._c - G @ self._c + travel
        turned = rotation_matrix(s[n:] @ self._turn_basis) if self._n_turns else np.eye(3)
        return G, t, G if self._carried else turned

    def _frame(self, s: float) -> Float[np.ndarray, "3 3"]:
        """Return the frame that goes along the curve: its tangent, and a direction that does not turn about it."""
        curve: Curve = self._curve  # type: ignore[assignment]  # of a curve alone
        tangent, normal = curve.at(np.array([s]), 1)[0], curve.frame(np.array([s]))[0][0]
        tangent = tangent / np.linalg.norm(tangent)
        normal = normal - (normal @ tangent) * tangent
        normal /= np.linalg.norm(normal)
        return np.column_stack([tangent, normal, np.cross(tangent, normal)])


def _shortest_turn(before: Float[np.ndarray, " 3"], after: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """Return the rotation vector that takes one direction to another on the shortest way [rad]."""
    normal = np.cross(before, after)
    size = float(np.linalg.norm(normal))
    return normal * (math.atan2(size, float(before @ after)) / size) if size > 0.0 else normal


def _turn_about(Q: Float[np.ndarray, "3 3"], axis: Float[np.ndarray, " 3"]) -> float:
    """Return the part of a rotation that is about an axis [rad]."""
    r = rotation_vector(Q)
    angle = math.sqrt(r @ r)
    along = math.sin(0.5 * angle) * float(axis @ r) / angle if angle > 0.0 else 0.0
    return 2.0 * math.atan2(along, math.cos(0.5 * angle))
