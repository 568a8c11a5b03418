"""Rows of a frame's Jacobian as features, relative to the base or to another frame; the error of its pose.

With the pose (p, R) and the goal (p*, R*) the error is, along the axes of the base and along the axes of the frame,

    e = (p* - p,  log(R* R^T))        and        R^T e = (R^T (p* - p),  log(R^T R*))

The rate of a rotation vector is not the angular velocity. With a twist (v, w) along the same axes and a fixed goal

    base    d/dt e = -( v,  Jr^-1(e_rot) w )
    frame   d/dt e = -( v - e_lin x w,  Jl^-1(e_rot) w )

Jl and Jr are the left and the right Jacobian of SO(3), see `robot.rotations`. At the goal both maps are the identity.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.feature_map import ErrorAndRate, FeatureMap, Match, Selected, Selection, parse_axes
from manip_learn.constraint.mechanism import (
    Mechanism,
    embed_rows,
    hinge_or_screw,
    mechanism_of,
    read_point_rows,
    read_twists,
)
from manip_learn.constraint.place import AXES, AXIS_UNITS
from manip_learn.errors import FeatureError, TargetError, an
from manip_learn.linalg import null_basis, orthonormal_rows
from manip_learn.robot import rotations as so3
from manip_learn.robot.robot import Reference, Robot


def goal_rotation(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Check the rotation matrix of a goal pose, and make it orthonormal if it has rounding errors.

    Args:
        R: Rotation matrix (3, 3), orthonormal to 1e-3 (e.g. printed with few digits).

    Returns:
        Rotation matrix (3, 3).

    Raises:
        TargetError: The matrix is not a rotation.
    """
    error = float(np.max(np.abs(R @ R.T - np.eye(3))))
    if not error < 1e-3 or np.linalg.det(R) < 0.0:  # tolerate a matrix printed with few digits
        raise TargetError(f"the upper left 3 x 3 part of the pose is not a rotation matrix: {R.tolist()}")
    return R if error < 1e-12 else orthonormal_rows(R)


class PoseRows(FeatureMap):
    """Base class of features that are components of a frame's twist, with the error of its pose.

    Every child class has these attributes:

    Attributes:
        frame: The frame.
        relative_to: The reference frame; None for the robot's base.
        seen_from: Keyword argument `relative_to` for the constructor of other features with the same reference frame;
            empty for the base.
        only_linear: True if all rows are linear velocities along axes that do not turn with the frame.
        own_axes: True if the rows are along axes that turn with the frame.
    """

    own_axes: bool

    def __init__(self, robot: Robot, frame: str, axes: str | Sequence[str], relative_to: str | None, own_axes: bool):
        self.robot, self.nv = robot, robot.nv
        self.row_names = parse_axes(axes)
        self.row_units = tuple(AXIS_UNITS[n] for n in self.row_names)
        rows = [AXES.index(n) for n in self.row_names]
        self._row_numbers = tuple(rows)
        # a slice makes views where fancy indexing would copy
        span = range(rows[0], rows[0] + len(rows))
        self._rows: Any = slice(span.start, span.stop) if rows == list(span) else np.array(rows)
        self.frame = robot.frame(frame)
        self.relative_to = None if relative_to is None else robot.frame(relative_to)
        self.seen_from: dict[str, Any] = {} if relative_to is None else {"relative_to": relative_to}
        self.own_axes, self.only_linear = own_axes, not own_axes and max(rows) < 3

    def _with_turns(self) -> PoseRows:
        """Return all six rows of the frame."""
        return self.changed(axes=AXES)

    def kind_of(self, selection: Selection, immovable: Selection, places: Float[np.ndarray, "n 3"]) -> Match | None:
        """Identify the mechanism that holds Lambda Phi(q) u at zero: a line, a plane, or a held orientation.

        Args:
            selection: Lambda (s, p) with orthonormal rows.
            immovable: Orthonormal combinations (m, p) of the rows along which this arm cannot move at all.
            places: Positions (n, 3) of the hand [m]; the point of the mechanism is their mean.

        Returns:
            Kind of mechanism, and its axis and point; None if no known mechanism has these rows, or if the rows are
            along axes that turn with the frame.
        """
        zero, blind = (embed_rows(self.row_names, rows, distance=True) for rows in (selection, immovable))
        return None if self.own_axes else read_point_rows(zero, blind, places.mean(axis=0))

    def mechanism(self, selection: Selection, learnt: Mapping[str, Any]) -> Mechanism | None:
        """Return the mechanism that constrains the rows selected by Lambda; its point is not known from these rows.

        Args:
            selection: Lambda (s, p) with orthonormal rows.
            learnt: Provenance of the constraint, with the uncertainty of Lambda; empty if it was not learnt.

        Returns:
            The mechanism, whose point is None; None if no known mechanism has these rows.
        """
        hand, rows = np.zeros(3), embed_rows(self.row_names, selection, distance=True)
        if is_firm := self.own_axes and len(selection) == 5 and self.n_rows == len(AXES):
            match = read_twists(null_basis(np.delete(rows, 3, axis=1)).T, hand)
        else:
            match = read_point_rows(rows, rows[:0], hand, aligned=False)
        if match is None:
            return None
        kind, place = hinge_or_screw(match, hand, learnt)
        if kind.kind != "space" and not is_firm:
            # directions in the axes of a turning hand define no line or plane
            if not set(AXES[:3]) <= set(self.row_names) or (self.own_axes and kind.orientation != "fixed"):
                return None
        extra: dict[str, Any] = {"point": None, **self.seen_from, **({"axis": None} if self.own_axes else {})}
        if is_firm:
            extra |= {"grip": "firm", "radius": None if kind.kind == "line" else float(np.linalg.norm(place.point))}
        return mechanism_of(kind, place.canonical(), **{"radius": None} | extra)

    @cached_property
    def twist(self) -> PoseRows:  # type: ignore[override]
        """Features of all six components of the frame's twist, along axes that do not turn with the frame."""
        return type(self)(self.robot, self.frame.name, axes=AXES, **self.seen_from)  # type: ignore[call-arg]

    def weights_at(self, poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n p 6"]:
        """Return at each pose the matrix that turns the six rows of `twist` into these rows.

        Args:
            poses: Poses (n, 4, 4) of the frame, in the base frame or in `relative_to` [m].

        Returns:
            shape (n, p, 6).
        """
        weights = np.zeros((len(poses), 6, 6))
        weights[:, :3, :3] = weights[:, 3:, 3:] = poses[:, :3, :3].transpose(0, 2, 1) if self.own_axes else np.eye(3)
        return weights[:, self._rows]

    def pose(self, q: ArrayLike) -> Float[np.ndarray, "4 4"]:
        """Return the pose of the frame in the robot's base, or in the frame `relative_to`.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (4, 4) [m].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        pose = self.robot.pose(q, self.frame)
        return pose if self.relative_to is None else np.linalg.inv(self.robot.pose(q, self.relative_to)) @ pose

    def poses(self, q: ArrayLike) -> Float[np.ndarray, "n 4 4"]:
        """Return the poses of the frame at n configurations, in the base frame or in `relative_to`.

        Args:
            q: Joint configurations (n, nq) or positions (n, nv) [rad or m].

        Returns:
            shape (n, 4, 4) [m].
        """
        poses = self.robot.frame_kinematics(self.frame).poses(q)
        if self.relative_to is None:
            return poses
        return np.linalg.inv(self.robot.frame_kinematics(self.relative_to).poses(q)) @ poses

    def placement(self, q: ArrayLike) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
        """Return position and rotation of the frame, in the base frame or in `relative_to`.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            Position (3,) [m] and rotation matrix (3, 3).
        """
        pose = self.pose(q)
        return pose[:3, 3], pose[:3, :3]

    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "p nv"]:
        """Return Phi(q) [m/s or rad/s per unit joint velocity].

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return self.twist_rows(q, self.own_axes)[self._rows]

    @abstractmethod
    def twist_rows(self, q: ArrayLike, own_axes: bool) -> Float[np.ndarray, "6 nv"]:
        """Return the Jacobian of all six components of the frame's twist, as a new array.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].
            own_axes: True for components along the axes of the frame, False for the axes of the reference frame.

        Returns:
            shape (6, nv) [m/s or rad/s per unit joint velocity].
        """

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Return the components of the frame's position and rotation vector that belong to the rows.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p,) [m or rad], in the base frame or in the frame `relative_to`.
        """
        return so3.pose_coordinates(self.pose(q))[self._rows]

    def coordinates_jacobian(self, q: ArrayLike) -> Float[np.ndarray, "p nv"] | None:
        """Return the exact derivative dr/dq of `coordinates`; their rate is this matrix times u.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            shape (p, nv). None if `only_linear` is True, because the derivative is then Phi(q).
        """
        if self.only_linear:
            return None
        C = np.eye(6)  # d/dt coordinates = C (v, w), along the axes of the base
        C[3:, 3:] = so3.left_jacobian_inverse(so3.rotation_vector(self.pose(q)[:3, :3]))
        return C[self._rows] @ self.twist_rows(q, False)

    def error_and_jacobian(self, target: ArrayLike, q: ArrayLike) -> ErrorAndRate:
        """Return the displacement e to a target, along the axes of the rows, and the matrix E of its rate.

        For a fixed target and the joint velocity u, the rate of e is -E u.

        Args:
            target: Target (p,) in the order of the rows: components of the position of the frame's origin [m] and of
                its rotation vector [rad], in the base frame or in `relative_to`. Or a pose (4, 4). Coordinates that are
                not among the rows are assumed to be reached.
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            e (p,) [m or rad] and E (p, nv). None instead of E if `only_linear` is True, because E is then Phi(q).

        Raises:
            TargetError: The target has the wrong size or is not finite; or the rows are along axes that turn with the
                frame, and the target lacks some of x y z (or of rx ry rz).
        """
        goal = np.asarray(target, dtype=np.float64)
        if self.only_linear and goal.shape == (self.n_rows,) and math.isfinite(goal.sum()):
            return goal - self.placement(q)[0][self._rows], None  # fast path: no orientation is needed
        pose = self.pose(q)
        goal_pose, numbers = self._goal_pose(goal, pose)
        error = so3.pose_error(pose, goal_pose, self.own_axes)
        if self.only_linear:
            return error[self._rows], None
        J = self.twist_rows(q, self.own_axes)
        # M J, with d/dt error = -M (v, w): the rotation rows turn by Jl^-1 or Jr^-1
        M = so3.left_jacobian_inverse(error[3:] if self.own_axes else -error[3:])
        rotations = [i - 3 for i in self._row_numbers if i >= 3]
        if numbers is not None and 0 < len(rotations) < 3:
            # the goal takes its other numbers from the frame and turns with it: dr/dt = Jl^-1(r) w changes the
            # unspecified part of the goal's vector by F, and thus e_rot by Jl^-1(e_rot) Jl(r*) F Jl^-1(r) w
            F = np.eye(3)
            F[rotations] = 0.0
            carried = so3.left_jacobian_inverse(error[3:]) @ so3.left_jacobian(numbers[3:]) @ F
            M -= carried @ so3.left_jacobian_inverse(so3.rotation_vector(pose[:3, :3]))
        if self.own_axes:
            J[:3] -= so3.skew(error[:3]).dot(J[3:])
        J[3:] = M.dot(J[3:])
        return error[self._rows], J[self._rows]

    def _goal_pose(
        self, goal: np.ndarray, pose: Float[np.ndarray, "4 4"]
    ) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, " 6"] | None]:
        """Return the goal pose of a target, and its six numbers if the target was given as numbers."""
        pose_of_goal = np.eye(4)
        if goal.shape == (4, 4) and np.all(np.isfinite(goal)):
            pose_of_goal[:3, :3], pose_of_goal[:3, 3] = goal_rotation(goal[:3, :3]), goal[:3, 3]
            return pose_of_goal, None
        if goal.shape != (self.n_rows,) or not np.all(np.isfinite(goal)):
            target = f"shape {goal.shape}" if goal.size > 6 else goal.tolist()
            expected = f"{self.n_rows} finite numbers ({', '.join(self.row_names)}) or a 4 x 4 pose"
            expected += "" if self.relative_to is None else f" in frame {self.relative_to.name!r}"
            raise TargetError(f"the target must be {expected}, got {target}")
        for triple in (AXES[:3], AXES[3:]) if self.own_axes else ():
            if 0 < len(set(triple) & set(self.row_names)) < 3:
                rows, remedy = " ".join(self.row_names), f"use all of {' '.join(triple)}, or pass a 4 x 4 pose"
                raise TargetError(f"a target for the rows {rows} in the frame's own axes is ambiguous: {remedy}")
        numbers = so3.pose_coordinates(pose)
        numbers[self._rows] = goal
        pose_of_goal[:3, :3], pose_of_goal[:3, 3] = so3.rotation_matrix(numbers[3:]), numbers[:3]
        return pose_of_goal, numbers


@final
class FrameJacobian(PoseRows):
    r"""Rows of the Jacobian of one frame, e.g. of the tool's tip.

    .. math::

        \Phi(q) \, u = \text{selected components of } \begin{pmatrix} v \\ \omega \end{pmatrix} = J(q) \, u

    The linear components v are the velocity of the frame's origin [m/s], the angular components :math:`\omega` its
    angular velocity [rad/s], along the axes of the robot's base (`reference="world"`) or of the frame itself
    (`reference="local"`).

    Args:
        robot: The robot.
        frame: Name of the frame, e.g. the tool's tip.
        axes: `"xyz"`, `"pose"` (all six), `"planar"` (x, y and rotation about z), `"rotation"`, or any of
            `x y z rx ry rz`, e.g. `"x y rz"`.
        reference: `"world"` or `"local"`.

    Raises:
        UnknownNameError: The frame does not exist; lists near matches.
        FeatureError: The axes or the reference are unknown, or the arguments are in the wrong order.

    Example:
        >>> import manip_learn as ml
        >>> features = ml.FrameJacobian(ml.load_robot("planar3"), "tip", axes="x y")
        >>> features([0.3, 0.8, 0.4]).round(2)  # one row per axis, one column per joint [m]
        array([[-2.18, -1.89, -1.  ],
               [ 1.48,  0.52,  0.07]])
    """

    kind, saved = "frame-jacobian", {"frame": "frame.name", "axes": "row_names", "reference": "reference"}

    def __init__(self, robot: Robot, frame: str, axes: str | Sequence[str] = "xyz", reference: Reference = "world"):
        if not isinstance(robot, Robot):
            raise FeatureError(f"expected FrameJacobian(robot, frame), got {an(robot)} and {an(frame)} in this order")
        if reference not in ("world", "local"):
            raise FeatureError(f"reference must be 'world' or 'local', not {reference!r}")
        super().__init__(robot, frame, axes, None, reference == "local")
        self.reference: Reference = reference
        self._kinematics = robot.frame_kinematics(self.frame)

    def value_and_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "p nv"], Float[np.ndarray, "p nv nv"]]:
        """Return Phi(q) and dPhi/dq, at the cost of the derivative alone.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            Phi (p, nv), in the units of `row_units` per unit of joint velocity, and dPhi/dq (p, nv, nv) with the
            entry [i, j, k] = d Phi_ij / d q_k.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        J, H = self.robot.jacobian_and_derivative(q, self.frame, self.reference)
        return J[self._rows], H[self._rows]

    def moved(self, transform: Float[np.ndarray, "4 4"], selection: Selection) -> Selected:
        """Return Phi and Lambda after a rigid motion of the mechanism, p' = R p + t, which rotates the directions.

        Args:
            transform: Homogeneous matrix (4, 4) of R and t, in the base frame [m].
            selection: Lambda (s, p).

        Returns:
            Phi with the rows x y z, and rx ry rz if there are angular rows, and Lambda for these rows. These features
            and `selection` if the rows are along axes that turn with the frame.
        """
        if self.own_axes:
            return self, selection
        rotated = embed_rows(self.row_names, selection).reshape(-1, 2, 3) @ transform[:3, :3].T
        axes = AXES if "rad/s" in self.row_units else AXES[:3]
        return self.changed(axes=axes), rotated.reshape(-1, 6)[:, : len(axes)]

    def batch(self, q: ArrayLike) -> Float[np.ndarray, "n p nv"]:
        """Return Phi at n configurations, in bulk.

        Args:
            q: Joint configurations (n, nq) or positions (n, nv) [rad or m].

        Returns:
            shape (n, p, nv).

        Raises:
            ConfigurationError: q has the wrong size or is not finite; names the first bad row and joint.
        """
        return self._kinematics.jacobians(q, self.reference, self._row_numbers)

    def batch_with_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "n p nv"], Float[np.ndarray, "n p nv nv"]]:
        """Return Phi and dPhi/dq at n configurations, in bulk.

        Args:
            q: Joint configurations (n, nq) or positions (n, nv) [rad or m].

        Returns:
            Phi (n, p, nv) and dPhi/dq (n, p, nv, nv).

        Raises:
            ConfigurationError: q has the wrong size or is not finite; names the first bad row and joint.
        """
        return self._kinematics.jacobians_and_derivatives(q, self.reference, self._row_numbers)

    def placement(self, q: ArrayLike) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
        """Return position and rotation of the frame in the robot's base.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            Position (3,) [m] and rotation matrix (3, 3).

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return self._kinematics.placement(q)

    def twist_rows(self, q: ArrayLike, own_axes: bool) -> Float[np.ndarray, "6 nv"]:
        """Return the Jacobian of the frame, along the axes of the base or of the frame.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].
            own_axes: True for components along the axes of the frame, False for the axes of the base.

        Returns:
            shape (6, nv) [m/s or rad/s per unit joint velocity].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return self._kinematics.jacobian(q, "local" if own_axes else "world")


@final
class RelativeFrameJacobian(PoseRows):
    r"""Twist of one frame relative to a reference frame, along the axes of the reference frame.

    A tool that does not move relative to a moving part has zero velocity in these rows. Two arms that carry one object
    are one robot with two tips. An object whose pose was recorded is a floating joint of the robot, see `objects` of
    `load_robot`.

    With the frames A (`frame`) and B (`relative_to`), :math:`d = p_A - p_B`, the rotation matrix :math:`R_B` of B, and
    the linear and angular Jacobians :math:`J_v` and :math:`J_\omega` along the axes of the base, the rows are the rate
    of :math:`R_B^T d` [m/s] and the angular velocity of A relative to B [rad/s]:

    .. math::

        \Phi_\mathrm{linear} = R_B^T (J_{v,A} - J_{v,B} + [d]_\times J_{\omega,B}), \qquad
        \Phi_\mathrm{angular} = R_B^T (J_{\omega,A} - J_{\omega,B})

    Args:
        robot: The robot with both frames.
        frame: Name of the frame that moves, e.g. the left tool's tip.
        relative_to: Name of the reference frame; its axes are the axes of the rows.
        axes: `"xyz"`, `"pose"` (all six), `"planar"`, `"rotation"`, or any of `x y z rx ry rz`.

    Raises:
        UnknownNameError: The frame does not exist; lists near matches.
        FeatureError: The axes are unknown, or `frame` and `relative_to` are the same frame.
    """

    kind = "relative-frame-jacobian"
    saved = {"frame": "frame.name", "relative_to": "relative_to.name", "axes": "row_names"}

    def __init__(self, robot: Robot, frame: str, relative_to: str, axes: str | Sequence[str] = "pose"):
        super().__init__(robot, frame, axes, relative_to, False)
        if self.frame.index == self.relative_to.index:
            raise FeatureError(f"frame {frame!r} does not move relative to itself: pass two frames")

    def value_and_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "p nv"], Float[np.ndarray, "p nv nv"]]:
        """Return Phi(q) and dPhi/dq.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].

        Returns:
            Phi (p, nv), in the units of `row_units` per unit of joint velocity, and dPhi/dq (p, nv, nv) with the
            entry [i, j, k] = d Phi_ij / d q_k.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        Phi, dPhi = self.batch_with_derivative(self.robot.checked_posture(q)[None])
        return Phi[0], dPhi[0]

    def batch(self, q: ArrayLike) -> Float[np.ndarray, "n p nv"]:
        """Return Phi at n configurations.

        Args:
            q: Joint configurations (n, nq) or positions (n, nv) [rad or m].

        Returns:
            shape (n, p, nv).

        Raises:
            ConfigurationError: q has the wrong size or is not finite; names the first bad row and joint.
        """
        both = (self.robot.frame_kinematics(frame) for frame in (self.frame, self.relative_to))
        return _relative_rows(*[(each.poses(q), each.jacobians(q)) for each in both])[0][:, self._rows]

    def batch_with_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "n p nv"], Float[np.ndarray, "n p nv nv"]]:
        """Return Phi and dPhi/dq at n configurations.

        Args:
            q: Joint configurations (n, nq) or positions (n, nv) [rad or m].

        Returns:
            Phi (n, p, nv) and dPhi/dq (n, p, nv, nv).

        Raises:
            ConfigurationError: q has the wrong size or is not finite; names the first bad row and joint.
        """
        both = (self.robot.frame_kinematics(frame) for frame in (self.frame, self.relative_to))
        Phi, dPhi = _relative_rows(*[(each.poses(q), *each.jacobians_and_derivatives(q)) for each in both])
        return Phi[:, self._rows], dPhi[:, self._rows]

    def twist_rows(self, q: ArrayLike, own_axes: bool) -> Float[np.ndarray, "6 nv"]:
        """Return the Jacobian of all six components of the relative twist, along the axes of the reference frame.

        Args:
            q: Joint configuration (nq,) or positions (nv,) [rad or m].
            own_axes: Not used: these features are always along the axes of the reference frame.

        Returns:
            shape (6, nv) [m/s or rad/s per unit joint velocity].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        both, robot = (self.frame, self.relative_to), self.robot
        return _relative_rows(*[(robot.pose(q, frame)[None], robot.jacobian(q, frame)[None]) for frame in both])[0][0]


def _relative_rows(A: Sequence[np.ndarray], B: Sequence[np.ndarray]) -> tuple[Float[np.ndarray, "n 6 nv"], Any]:
    """Return all six rows R^T V of frame A relative to B, and d/dq_k of them, R^T (dV/dq_k - w_k x V).

    w_k is the angular velocity of B per unit velocity of joint k.

    Args:
        A: Poses (n, 4, 4), Jacobians (n, 6, nv) and, for the derivative, Hessians (n, 6, nv, nv) of the frame, all in
            the base axes.
        B: The same for the reference frame.
    """
    (pose_A, J_A, *H_A), (pose_B, J_B, *H_B) = A, B
    R, d = pose_B[:, :3, :3], pose_A[:, :3, 3] - pose_B[:, :3, 3]
    V = J_A - J_B
    slope = V[:, :3].copy()  # of d
    V[:, :3] += np.cross(d[:, :, None], J_B[:, 3:], axis=1)  # velocity of the origin of A in axes that turn with B
    if not H_A:
        return _in_axes(R, V), None
    dV = H_A[0] - H_B[0]
    dV[:, :3] += np.cross(slope[:, :, None, :], J_B[:, 3:, :, None], axis=1)
    dV[:, :3] += np.cross(d[:, :, None, None], H_B[0][:, 3:], axis=1)
    for part in (slice(0, 3), slice(3, 6)):
        dV[:, part] -= np.cross(J_B[:, 3:, None, :], V[:, part, :, None], axis=1)
    return _in_axes(R, V), _in_axes(R, dV)


def _in_axes(R: Float[np.ndarray, "n 3 3"], V: np.ndarray) -> np.ndarray:
    """Return linear and rotation rows along the axes of B."""
    return np.concatenate([np.einsum("nji,nj...->ni...", R, part) for part in (V[:, :3], V[:, 3:])], axis=1)
