"""Velocity of one frame as seen from another that moves as well: two arms on one object, or a tool on a moving part."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import (
    AXES,
    carried_goal,
    coordinate_rates,
    error_rates,
    goal_rotation,
    parse_axes,
    pose_coordinates,
    pose_error,
)
from manip_learn.errors import FeatureError, TargetError
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import rotation_matrix, rotation_vector


@final
class RelativeFrameJacobian(FeatureMap):
    """Twist of one frame relative to another, along the axes of the other.

    With the frames A (`frame`) and B (`relative_to`), d = p_A - p_B and R = R_B, all from Jacobians J = (Jv, Jw) in the
    base axes, the rows are

        linear    R^T (Jv_A - Jv_B + [d]x Jw_B)      the rate of R^T d [m/s]
        rotation  R^T (Jw_A - Jw_B)                  the angular velocity of A relative to B [rad/s]

    so that a tool which keeps still on a part that itself is being carried has zero velocity here. Two arms that carry
    one object are one robot with two tips. An object whose pose was recorded is a floating joint of the robot: see
    `objects` of `load_robot`.

    Args:
        robot: The robot; both frames are its own.
        frame: Name of the frame that moves, e.g. the left tool's tip.
        relative_to: Name of the frame from which it is seen; its axes are the axes of the rows.
        axes: `"xyz"`, `"pose"` (all six), `"planar"`, `"rotation"`, or any of `x y z rx ry rz`.

    Raises:
        UnknownNameError: No such frame; lists near matches.
        FeatureError: Unknown axes, or twice the same frame.
    """

    def __init__(self, robot: Robot, frame: str, relative_to: str, axes: str | Sequence[str] = "pose"):
        self.robot = robot
        self.frame = robot.frame(frame)
        self.relative_to = robot.frame(relative_to)
        if self.frame.index == self.relative_to.index:
            raise FeatureError(f"frame {frame!r} does not move relative to itself: name two frames")
        self.row_names = parse_axes(axes)
        self.row_units = tuple("rad/s" if n.startswith("r") else "m/s" for n in self.row_names)
        self.nv = robot.nv
        self._rows = [AXES.index(n) for n in self.row_names]
        self.only_linear = max(self._rows) < 3

    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "p nv"]:
        """Phi(q) [m/s or rad/s per unit joint velocity].

        Raises:
            ConfigurationError: Wrong size or not finite.
        """
        return self._every_row(q)[self._rows]

    def derivative(self, q: ArrayLike) -> Float[np.ndarray, "p nv nv"]:
        """dPhi/dq, exact; entry [i, j, k] = d Phi_ij / d q_k along tangent coordinate k.

        Raises:
            ConfigurationError: Wrong size or not finite.
        """
        return self.value_and_derivative(q)[1]

    def value_and_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "p nv"], Float[np.ndarray, "p nv nv"]]:
        """Phi(q) and dPhi/dq from one Hessian per frame."""
        A, B = self.robot.pose(q, self.frame), self.robot.pose(q, self.relative_to)
        J_A, H_A = self.robot.jacobian_and_derivative(q, self.frame)
        J_B, H_B = self.robot.jacobian_and_derivative(q, self.relative_to)
        R, d = B[None, :3, :3], (A[:3, 3] - B[:3, 3])[None]
        Phi = _relative(R, d, J_A[None], J_B[None])[0]
        dPhi = _relative_derivative(R, d, J_A[None], J_B[None], H_A[None], H_B[None])[0]
        return Phi[self._rows], dPhi[self._rows]

    def batch(self, q: ArrayLike) -> Float[np.ndarray, "n p nv"]:
        """Phi at n configurations (nq) or joint positions (nv), the rows of q.

        Raises:
            ConfigurationError: Wrong size or not finite; names the first bad row and joint.
        """
        A, B = (batch_kinematics(self.robot, f) for f in (self.frame, self.relative_to))
        pose_A, pose_B = A.pose(q), B.pose(q)
        d = pose_A[:, :3, 3] - pose_B[:, :3, 3]
        return _relative(pose_B[:, :3, :3], d, A.jacobian(q), B.jacobian(q))[:, self._rows]

    def batch_with_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "n p nv"], Float[np.ndarray, "n p nv nv"]]:
        """Phi and dPhi/dq at n configurations; errors as for `batch`."""
        A, B = (batch_kinematics(self.robot, f) for f in (self.frame, self.relative_to))
        pose_A, pose_B = A.pose(q), B.pose(q)
        R, d = pose_B[:, :3, :3], pose_A[:, :3, 3] - pose_B[:, :3, 3]
        (J_A, H_A), (J_B, H_B) = A.jacobian_and_derivative(q), B.jacobian_and_derivative(q)
        Phi, dPhi = _relative(R, d, J_A, J_B), _relative_derivative(R, d, J_A, J_B, H_A, H_B)
        return Phi[:, self._rows], dPhi[:, self._rows]

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Position of the frame in the other one [m] and its rotation vector there [rad], the chosen rows."""
        return pose_coordinates(self.pose(q))[self._rows]

    def error_to(self, target: ArrayLike, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Displacement to a target in the axes of the other frame.

        Args:
            target: p numbers in the order of the rows: position in the other frame [m], rotation vector [rad]; or the
                4 x 4 pose of the frame in the other one. Coordinates that are not among the rows count as reached.
            q: Configuration.

        Raises:
            TargetError: Wrong size or not finite.
        """
        here = self.pose(q)
        return pose_error(here, self._goal(np.asarray(target, dtype=np.float64), here)[0], False)[self._rows]

    def coordinates_jacobian(self, q: ArrayLike) -> Float[np.ndarray, "p nv"] | None:
        """Rate of the coordinates per unit joint velocity, exact (see `FeatureMap`)."""
        if self.only_linear:
            return None
        return coordinate_rates(self.pose(q))[self._rows] @ self._every_row(q)

    def error_jacobian(self, target: ArrayLike, q: ArrayLike) -> Float[np.ndarray, "p nv"] | None:
        """E with d/dt `error_to(target, q)` = -E u, exact; None where E = Phi(q), as for positions.

        Raises:
            TargetError: Wrong size or not finite.
        """
        if self.only_linear:
            return None
        here = self.pose(q)
        goal, numbers = self._goal(np.asarray(target, dtype=np.float64), here)
        error = pose_error(here, goal, False)
        M = error_rates(error, False)
        given = [i - 3 for i in self._rows if i >= 3]
        if numbers is not None and 0 < len(given) < 3:
            M[3:, 3:] -= carried_goal(rotation_vector(here[:3, :3]), numbers[3:], given, error[3:])
        return M[self._rows] @ self._every_row(q)

    def _goal(self, goal: np.ndarray, here: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """The target as a pose in the other frame, and its six numbers where it was given as numbers."""
        out, numbers = np.eye(4), None
        if goal.shape == (4, 4) and np.all(np.isfinite(goal)):
            out[:3, :3], out[:3, 3] = goal_rotation(goal[:3, :3]), goal[:3, 3]
        elif goal.shape == (self.n_rows,) and np.all(np.isfinite(goal)):
            numbers = pose_coordinates(here)
            numbers[self._rows] = goal
            out[:3, :3], out[:3, 3] = rotation_matrix(numbers[3:]), numbers[:3]
        else:
            raise TargetError(
                f"the target must be {self.n_rows} finite numbers ({', '.join(self.row_names)}) or a 4 x 4 pose in "
                f"frame {self.relative_to.name!r}, got shape {goal.shape}"
            )
        return out, numbers

    def describe(self) -> dict[str, Any]:
        """Frames and axes, as saved in a constraint file."""
        return {
            "kind": "relative-frame-jacobian",
            "frame": self.frame.name,
            "relative_to": self.relative_to.name,
            "axes": list(self.row_names),
            "units": list(self.row_units),
        }

    def _every_row(self, q: ArrayLike) -> Float[np.ndarray, "6 nv"]:
        A, B = self.robot.pose(q, self.frame), self.robot.pose(q, self.relative_to)
        J_A, J_B = self.robot.jacobian(q, self.frame), self.robot.jacobian(q, self.relative_to)
        d = A[:3, 3] - B[:3, 3]
        return _relative(B[None, :3, :3], d[None], J_A[None], J_B[None])[0]

    def pose(self, q: ArrayLike) -> Float[np.ndarray, "4 4"]:
        """Pose of the frame in the other one."""
        A, B = self.robot.pose(q, self.frame), self.robot.pose(q, self.relative_to)
        out = np.eye(4)
        out[:3, :3] = B[:3, :3].T @ A[:3, :3]
        out[:3, 3] = B[:3, :3].T @ (A[:3, 3] - B[:3, 3])
        return out

    def __repr__(self) -> str:
        return (
            f"RelativeFrameJacobian({self.robot.name!r}, frame={self.frame.name!r}, "
            f"relative_to={self.relative_to.name!r}, axes={' '.join(self.row_names)!r})"
        )


def _relative(
    R: Float[np.ndarray, "n 3 3"],
    d: Float[np.ndarray, "n 3"],
    J_A: Float[np.ndarray, "n 6 nv"],
    J_B: Float[np.ndarray, "n 6 nv"],
) -> Float[np.ndarray, "n 6 nv"]:
    """All six rows, from Jacobians in the base axes."""
    return _turned(R, _difference(d, J_A, J_B))


def _difference(d: np.ndarray, J_A: np.ndarray, J_B: np.ndarray) -> Float[np.ndarray, "n 6 nv"]:
    """The relative twist in the base axes: the origin of A seen by an observer who turns with B."""
    V = J_A - J_B
    V[:, :3] += np.cross(d[:, :, None], J_B[:, 3:], axis=1)
    return V


def _turned(R: np.ndarray, V: np.ndarray) -> np.ndarray:
    """Linear and rotation rows along the axes of B."""
    return np.concatenate([np.einsum("nji,nj...->ni...", R, part) for part in (V[:, :3], V[:, 3:])], axis=1)


def _relative_derivative(
    R: Float[np.ndarray, "n 3 3"],
    d: Float[np.ndarray, "n 3"],
    J_A: Float[np.ndarray, "n 6 nv"],
    J_B: Float[np.ndarray, "n 6 nv"],
    H_A: Float[np.ndarray, "n 6 nv nv"],
    H_B: Float[np.ndarray, "n 6 nv nv"],
) -> Float[np.ndarray, "n 6 nv nv"]:
    """d/dq_k of R^T V: R^T (dV/dq_k - w_k x V), where w_k is the angular velocity of B per unit velocity of joint k."""
    V = _difference(d, J_A, J_B)
    dV = H_A - H_B
    slope = J_A[:, :3] - J_B[:, :3]  # of d
    dV[:, :3] += np.cross(slope[:, :, None, :], J_B[:, 3:, :, None], axis=1)
    dV[:, :3] += np.cross(d[:, :, None, None], H_B[:, 3:], axis=1)
    w = J_B[:, 3:, None, :]
    for part in (slice(0, 3), slice(3, 6)):
        dV[:, part] -= np.cross(w, V[:, part, :, None], axis=1)
    return _turned(R, dV)
