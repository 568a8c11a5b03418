"""Kinematics of a robot: from a configuration to Jacobians and their derivatives in a named reference frame."""

from __future__ import annotations

import copy
import math
import threading
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from manip_learn.errors import ConfigurationError, UnknownNameError, printable
from manip_learn.linalg import finite
from manip_learn.robot import html_card
from manip_learn.robot.frame_kinematics import DOUBLE, FrameKinematics, centre_of_mass_derivative, columns_to_joints
from manip_learn.robot.joints import (
    Frame,
    FrameLike,
    Mimic,
    full_coupling,
    joint_blocks,
    joint_limits,
)

Reference = Literal["world", "local"]


@final
class Robot:
    """Kinematics of one robot.

    `load_robot` makes it. Two vectors describe a posture of the robot, and every method accepts both: the
    *configuration* q (nq,), in which a continuous joint is (cos, sin) and a floating base has a quaternion; and the
    *joint positions* (nv,), one number per joint [rad or m] as in recordings. The two are equal for arms with limited
    joints only. Velocities are tangent vectors (nv,) [rad/s or m/s]. All moving joints are degrees of freedom, except
    mimic joints, which follow other joints.

    One robot can be used from many threads: each has its own Pinocchio data (see `FrameKinematics`).

    Attributes:
        name: Name of the robot.
        nq: Size of a configuration.
        nv: Number of degrees of freedom.
        joint_names: One name per degree of freedom, in Pinocchio's order (depth first, siblings by name).
        frame_names: Names that `FrameJacobian` accepts.
        position_lower: Lower position limits (nv,) [rad or m], -inf for a joint without one.
        position_upper: Upper position limits (nv,) [rad or m], inf for a joint without one.
        velocity_limit: Velocity limits (nv,) [rad/s or m/s], inf for a joint without one.
        mimics: Mimic joints, each with an independent leader.
        source: File from which the robot was read; None if it was not read from a file.
        package_dirs: Folders in which `package://` meshes are searched.
        fingerprint: SHA-256 of its kinematics, masses and locked joints, which identifies the robot.
        warnings: Repaired and ignored parts of the description, one sentence each.
        description: Text of the URDF as it was read, with xacro expanded; None if there was none.
        locked: Locked joint -> position [rad or m].
        pinocchio_model: The underlying Pinocchio model, in which mimic joints are ordinary joints; do not modify it.
        blocks: The independent joints, with their slices of the vectors.
        coupling: Affine map from the independent joints to all joints, in Pinocchio's order; None without mimic joints.
        objects: Names of objects outside the robot whose pose is recorded, each on a floating joint.
        payload: Mass that the hand carries [kg], see `with_payload`.

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("planar3")
        >>> robot.joint_names
        ('joint1', 'joint2', 'joint3')
        >>> tip = robot.frame("tip")
        >>> robot.pose([0.3, 0.8, 0.4], tip)[:2, 3].round(2)  # where the tip is [m]
        array([1.48, 2.18])
    """

    def __init__(
        self,
        model: pin.Model,
        *,
        name: str | None = None,
        source: Path | None = None,
        package_dirs: Sequence[Path] = (),
        fingerprint: str = "",
        mimics: Sequence[Mimic] = (),
        warnings: Sequence[str] = (),
        description: bytes | None = None,
        locked: Mapping[str, float] | None = None,
        objects: Sequence[str] = (),
    ):
        self.pinocchio_model, self._bare, self.payload = model, model, 0.0
        self.name: str = name or model.name
        self.source = source
        self.package_dirs = tuple(package_dirs)
        self.fingerprint = fingerprint
        self.mimics = tuple(mimics)
        self.description = description
        self.locked: dict[str, float] = dict(locked or {})
        self.objects: tuple[str, ...] = tuple(objects)
        self.blocks = blocks = joint_blocks(model, self.mimics)
        nq, nv = max((b.q.stop for b in blocks), default=0), max((b.v.stop for b in blocks), default=0)
        self.nq, self.nv, self._shape = nq, nv, (nv,)
        self.joint_names: tuple[str, ...] = tuple(n for b in blocks for n in b.coordinate_names)
        self._places, self._columns = (
            np.array([i for part in parts for i in range(part.start, part.stop)], dtype=np.intp)
            for parts in ([b.pin_q for b in blocks], [b.pin_v for b in blocks])
        )  # indices of the independent joints in Pinocchio's configuration and velocity
        self.coupling = full_coupling(model, blocks, self.mimics) if self.mimics else None
        joints = [model.joints[model.getJointId(m.joint)] for m in self.mimics]
        self._followers = [(joint.idx_v, slice(joint.idx_q, joint.idx_q + joint.nq)) for joint in joints]
        # a plain robot's configuration IS Pinocchio's: the hot path skips all conversions
        self._plain = nq == nv == model.nq and self.coupling is None
        self.positions_add_up = all(b.kind not in ("floating", "planar", "other") for b in blocks)
        self._unit_blocks = tuple(b for b in blocks if b.kind in ("continuous", "floating", "planar"))
        limits, narrowed = joint_limits(model, blocks, self.mimics)
        self.position_lower, self.position_upper, self.velocity_limit = limits
        self.warnings = tuple(map(printable, (*warnings, *narrowed)))
        self._frames: dict[str, Frame] = {}
        for index, f in enumerate(model.frames):
            # a link and a joint may share a name: the link counts
            if f.name != "universe" and (f.name not in self._frames or f.type == pin.FrameType.BODY):
                self._frames[f.name] = Frame(f.name, index, int(f.parentJoint))
        self.frame_names: tuple[str, ...] = tuple(self._frames)
        self._frame_kinematics: dict[int, FrameKinematics] = {}
        self._local = threading.local()

    # ---- names ----------------------------------------------------------------------------------------------------

    def frame(self, name: FrameLike) -> Frame:
        """Look up a frame by its name.

        Args:
            name: Name of a link or joint; a `Frame` is returned as it is.

        Raises:
            UnknownNameError: The frame or the reference does not exist; lists near matches.
        """
        if type(name) is Frame:
            return name
        if isinstance(name, str) and name in self._frames:
            return self._frames[name]
        raise UnknownNameError("frame", str(name), self.frame_names, f"robot {self.name!r}")

    @property
    def joint_units(self) -> tuple[str, ...]:
        """Unit of each joint position, `"rad"` or `"m"`, shape (nv,)."""
        return tuple(unit for block in self.blocks for unit in block.units)

    def joint_index(self, name: str) -> int:
        """Return the index of a joint in joint positions and velocities.

        Args:
            name: One of `joint_names`.

        Raises:
            UnknownNameError: The joint does not exist; lists near matches.
        """
        if name in self.joint_names:
            return self.joint_names.index(name)
        raise UnknownNameError("joint", name, self.joint_names, f"robot {self.name!r}")

    def reach(self, frame: FrameLike) -> float:
        """Return an upper bound of the distance between the base and a frame [m]: the sum of the link lengths.

        Args:
            frame: Name of the frame, or the frame.

        Raises:
            UnknownNameError: The frame or the reference does not exist; lists near matches.
        """
        tip, model = self.frame(frame), self.pinocchio_model
        links = [model.jointPlacements[j].translation for j in model.supports[tip.parent_joint] if j]
        links.append(model.frames[tip.index].placement.translation)
        ends = np.maximum(np.abs(self.position_lower), np.abs(self.position_upper)).tolist()
        joints = zip(self.joint_names, self.joint_units, ends, strict=True)
        slides = sum(end for name, unit, end in joints if unit == "m" and self.moves(name, tip))
        return float(np.sum(np.linalg.norm(links, axis=1)) + slides)

    def moves(self, joint: str, frame: FrameLike) -> bool:
        """Return True if a joint, or a mimic joint that follows it, moves a frame relative to the base.

        Args:
            joint: One of `joint_names`.
            frame: Name of the frame, or the frame.

        Raises:
            UnknownNameError: The joint or the frame does not exist; lists near matches.
        """
        index = self.joint_index(joint)
        block = next(b for b in self.blocks if b.v.start <= index < b.v.stop)
        movers = {block.name, *(m.joint for m in self.mimics if m.leader == block.name)}
        model = self.pinocchio_model
        return any(model.names[j] in movers for j in model.supports[self.frame(frame).parent_joint])

    # ---- configurations -------------------------------------------------------------------------------------------

    def configuration(self, q: ArrayLike) -> Float[np.ndarray, " nq"]:
        """Convert a posture to a configuration (nq,); (cos, sin) pairs and quaternions are normalised.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].

        Raises:
            ConfigurationError: q has the wrong size, NaN, infinity, or a (cos, sin) or quaternion of length zero.
        """
        vector = self.checked_posture(q)
        if self.nq == self.nv:
            return vector
        if vector.shape[0] == self.nq:
            return self._normalised(vector)
        out = np.empty(self.nq)
        for b in self.blocks:
            x = vector[b.v]
            if b.kind == "continuous":
                out[b.q] = np.cos(x[0]), np.sin(x[0])
            elif b.kind == "planar":
                out[b.q] = x[0], x[1], np.cos(x[2]), np.sin(x[2])
            elif b.kind == "floating":
                out[b.q] = np.concatenate([x[:3], pin.Quaternion(pin.exp3(x[3:])).coeffs()])
            else:
                out[b.q] = x
        return out

    def checked_posture(self, q: ArrayLike) -> Float[np.ndarray, " n"]:
        """Check that a posture has the right size and finite numbers.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].

        Returns:
            The same vector, (nq,) or (nv,), as a float64 array.

        Raises:
            ConfigurationError: q has the wrong size, NaN, infinity, or a (cos, sin) or quaternion of length zero.
        """
        if type(q) is np.ndarray and q.shape == self._shape and q.dtype is DOUBLE and q.flags.c_contiguous:
            if math.isfinite(sum(q.tolist())):
                return q  # the case of every control step
        return self._checked(q, "a posture", 1, (self.nq, self.nv))

    def checked_postures(self, q: ArrayLike) -> Float[np.ndarray, "n width"]:
        """Check that an array of postures has the right shape and finite numbers.

        Args:
            q: Configurations (n, nq) or joint positions (n, nv) [rad or m], one per row.

        Returns:
            The same array, as float64.

        Raises:
            ConfigurationError: The array has not nq or nv columns, or contains NaN or infinity; the message names the
                first bad row and joint.
        """
        return self._checked(q, "a table of postures", 2, (self.nq, self.nv))

    def _checked(self, values: ArrayLike, what: str, n_axes: int, sizes: tuple[int, ...]) -> np.ndarray:
        """Return values as a contiguous float64 array, or refuse them with the first fault."""
        try:
            out = np.ascontiguousarray(values, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ConfigurationError(f"{what} must be numbers, not {type(values).__name__}: {error}") from error
        if out.ndim != n_axes or out.shape[-1] not in sizes:
            both = f"{self.nq} (configuration) or {self.nv} (joint positions)"
            raise ConfigurationError(
                f"{what} of {self.name!r} has {both if len(set(sizes)) > 1 else sizes[0]} "
                f"{'numbers' if n_axes == 1 else 'columns'}, this one has shape {out.shape}; joints in order: "
                f"{', '.join(self.joint_names)}"
            )
        is_configuration, table, fault = out.shape[-1] != self.nv, out.reshape(-1, out.shape[-1]), None
        if not np.isfinite(out).all():
            row, entry = (int(i) for i in np.argwhere(~np.isfinite(table))[0])
            names = [b.name for b in self.blocks for _ in range(b.q.start, b.q.stop)]
            joint = f"{names[entry]!r} (entry {entry})" if is_configuration else f"{self.joint_names[entry]!r}"
            fault = row, f"joint {joint} is {table[row, entry]}, a finite number is needed"
        for b in self._unit_blocks if is_configuration else ():
            if fault is not None:
                break
            short = np.flatnonzero(np.linalg.norm(table[:, b.direction], axis=1) < 1e-6)  # too short for a direction
            if short.size:
                part = "quaternion" if b.kind == "floating" else "(cos, sin)"
                fault = int(short[0]), f"joint {b.name!r}: its {part} is {table[short[0], b.direction]}, without length"
        if fault is not None:
            where = f"row {fault[0]}, " if n_axes == 2 else ""
            raise ConfigurationError(f"{what} of {self.name!r}: {where}{fault[1]}")
        return out

    def _normalised(self, q: np.ndarray) -> np.ndarray:
        """Return a configuration with unit parts of length 1."""
        q = q.copy()
        for b in self._unit_blocks:
            q[b.direction] /= np.linalg.norm(q[b.direction])
        return q

    def positions(self, q: ArrayLike) -> Float[np.ndarray, " nv"]:
        """Convert a posture to joint positions.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].

        Returns:
            Joint positions (nv,) [rad or m]. From a configuration, continuous joints are in (-pi, pi] and orientations
            are rotation vectors; joint positions are returned unchanged, with their full turns.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        vector = self.checked_posture(q)
        if vector.shape[0] == self.nv:
            return vector
        vector = self._normalised(vector)
        out = np.empty(self.nv)
        for b in self.blocks:
            x = vector[b.q]
            if b.kind == "continuous":
                out[b.v] = np.arctan2(x[1], x[0])
            elif b.kind == "planar":
                out[b.v] = x[0], x[1], np.arctan2(x[3], x[2])
            elif b.kind == "floating":
                out[b.v] = np.concatenate([x[:3], pin.log3(pin.Quaternion(x[3:]).matrix())])
            else:
                out[b.v] = x
        return out

    def unwrapped(self, q: ArrayLike) -> Float[np.ndarray, "n nv"]:
        """Convert a motion to joint positions without jumps by full turns.

        Args:
            q: Configurations (n, nq) or joint positions (n, nv) [rad or m], one per row, in order of time.

        Returns:
            Joint positions (n, nv) [rad or m]. Configurations are converted and their angles unwrapped; joint positions
            are returned unchanged.

        Raises:
            ConfigurationError: q has the wrong size or is not finite; names the first bad row and joint.
        """
        table = self.checked_postures(q)
        if table.shape[1] == self.nv:
            return table
        return np.unwrap(np.array([self.positions(row) for row in table]).reshape(-1, self.nv), axis=0)

    def neutral(self) -> Float[np.ndarray, " nq"]:
        """Return a configuration (nq,) within the limits.

        Each joint is at zero if that is allowed; otherwise in the middle of its range, or at its limit if it has only
        one.
        """
        positions = np.zeros(self.nv)
        outside = (self.position_lower > 0.0) | (self.position_upper < 0.0)
        lower, upper = self.position_lower[outside], self.position_upper[outside]
        middle = 0.5 * (lower + upper)
        nearest = np.where(lower > 0.0, lower, upper)  # with a limit on one side only, take that limit
        positions[outside] = np.where(np.isfinite(middle), middle, nearest)
        return self.configuration(positions)

    def random_configuration(self, rng: np.random.Generator) -> Float[np.ndarray, " nq"]:
        """Sample a random configuration, uniformly within the limits.

        A joint without limits is within -pi .. pi, a joint with one limit within 2 pi of it [rad or m]; the coordinates
        of floating and planar joints are within -1 .. 1 [m or rad].

        Args:
            rng: Source of random numbers.

        Returns:
            The configuration (nq,).
        """
        below, above = np.isfinite(self.position_lower), np.isfinite(self.position_upper)
        ends = np.where(above, self.position_upper - 2 * np.pi, -np.pi)  # with one limit: within a full turn of it
        lower = np.where(below, self.position_lower, ends)
        positions = rng.uniform(lower, np.where(above, self.position_upper, lower + 2 * np.pi))
        for b in self.blocks:
            if b.kind in ("floating", "planar"):
                positions[b.v] = rng.uniform(-1.0, 1.0, b.v.stop - b.v.start)
        return self.configuration(positions)

    def integrate(self, q: ArrayLike, v: ArrayLike) -> Float[np.ndarray, " n"]:
        """Return the posture after a displacement in the tangent space.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            v: Displacement (nv,) [rad or m].

        Returns:
            Configuration or joint positions, whichever `q` is [rad or m].

        Raises:
            ConfigurationError: q or v has the wrong size or is not finite.
        """
        vector = self.checked_posture(q)
        step = self.velocity(v)
        if vector.shape[0] == self.nv and self.positions_add_up:
            return vector + step
        lifted = step if self.coupling is None else self.coupling.lift @ step
        out = pin.integrate(self.pinocchio_model, self._expanded(self.configuration(vector)), lifted)[self._places]
        return self.positions(out) if vector.shape[0] == self.nv else out

    def difference(self, q0: ArrayLike, q1: ArrayLike) -> Float[np.ndarray, " nv"]:
        """Return the tangent vector (nv,) from one posture to another along the shortest path [rad or m].

        Args:
            q0: Configuration (nq,) or joint positions (nv,) at the start.
            q1: Configuration (nq,) or joint positions (nv,) at the end.

        Raises:
            ConfigurationError: q0 or q1 has the wrong size or is not finite.
        """
        both = (self._expanded(self.configuration(q)) for q in (q0, q1))
        return pin.difference(self.pinocchio_model, *both)[self._columns]

    def velocity(self, v: ArrayLike) -> Float[np.ndarray, " nv"]:
        """Check that joint velocities have the right size and finite numbers.

        Args:
            v: Joint velocities (nv,) [rad/s or m/s].

        Returns:
            The same velocities (nv,), as a float64 array.

        Raises:
            ConfigurationError: v has the wrong size or is not finite.
        """
        return self._checked(v, "a velocity", 1, (self.nv,))

    def pinocchio_configuration(self, q: ArrayLike) -> Float[np.ndarray, " n"]:
        """Convert a posture to the configuration of the underlying Pinocchio model, including mimic joints.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].

        Returns:
            Configuration of `pinocchio_model`, shape (pinocchio_model.nq,).

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        vector = self.checked_posture(q)
        if self._plain:
            return vector
        # full turns of joint positions count: a follower with multiplier 0.5 is half a turn further after one
        return self._expanded(self.configuration(vector), vector if vector.shape[0] == self.nv else None)

    def _expanded(self, q: np.ndarray, positions: np.ndarray | None = None) -> np.ndarray:
        """Return Pinocchio's configuration for a configuration of the independent joints."""
        if self.coupling is None:
            return q
        full = np.empty(self.pinocchio_model.nq)
        full[self._places] = q
        everything = self.coupling.lift @ (self.positions(q) if positions is None else positions)
        everything += self.coupling.offset
        for row, place in self._followers:
            x = everything[row]
            full[place] = (np.cos(x), np.sin(x)) if place.stop - place.start == 2 else x
        return full

    # ---- kinematics -----------------------------------------------------------------------------------------------

    def frame_kinematics(self, frame: FrameLike) -> FrameKinematics:
        """Return an object that computes pose and Jacobian of one frame, without looking up the frame in each call.

        Args:
            frame: Name of the frame, or the frame.

        Raises:
            UnknownNameError: The frame or the reference does not exist; lists near matches.
        """
        if type(frame) is not Frame:
            frame = self.frame(frame)
        kinematics = self._frame_kinematics.get(frame.index)
        return kinematics or self._frame_kinematics.setdefault(frame.index, FrameKinematics(self, frame))

    def pose(self, q: ArrayLike, frame: FrameLike) -> Float[np.ndarray, "4 4"]:
        """Return the pose of a frame in the robot's base frame, as a homogeneous matrix (4, 4) [m].

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            frame: Name of the frame, or the frame.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
            UnknownNameError: The frame or the reference does not exist; lists near matches.
        """
        return self.frame_kinematics(frame).pose(q)

    forward_kinematics = pose  # its common name in other libraries

    def position(self, q: ArrayLike, frame: FrameLike) -> Float[np.ndarray, " 3"]:
        """Return the position (3,) of a frame's origin in the robot's base frame [m].

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            frame: Name of the frame, or the frame.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
            UnknownNameError: The frame or the reference does not exist; lists near matches.
        """
        return self.frame_kinematics(frame).position(q)

    def jacobian(self, q: ArrayLike, frame: FrameLike, reference: Reference = "world") -> Float[np.ndarray, "6 nv"]:
        """Return the frame Jacobian, linear rows first.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            frame: Name of the frame, or the frame.
            reference: Along the base axes (`"world"`) or along the frame's own axes (`"local"`).

        Returns:
            Jacobian (6, nv): velocity of the frame's origin [m/s], then angular velocity [rad/s], per unit joint
            velocity.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
            UnknownNameError: The frame or the reference does not exist; lists near matches.
        """
        return self.frame_kinematics(frame).jacobian(q, reference)

    def jacobian_and_derivative(
        self, q: ArrayLike, frame: FrameLike, reference: Reference = "world"
    ) -> tuple[Float[np.ndarray, "6 nv"], Float[np.ndarray, "6 nv nv"]]:
        """Return the frame Jacobian J and its exact derivative dJ/dq.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            frame: Name of the frame, or the frame.
            reference: Along the base axes (`"world"`) or along the frame's own axes (`"local"`).

        Returns:
            J (6, nv), and dJ/dq (6, nv, nv) with the entry [i, j, k] = d J_ij / d q_k along tangent coordinate k.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
            UnknownNameError: The frame or the reference does not exist; lists near matches.
        """
        return self.frame_kinematics(frame).jacobian_and_derivative(q, reference)

    @property
    def _data(self) -> pin.Data:
        """Pinocchio's data of this thread."""
        try:
            return self._local.data
        except AttributeError:
            self._local.data = self.pinocchio_model.createData()
            return self._local.data

    @cached_property
    def _columns_to_joints(self) -> Int[np.ndarray, " n"]:
        return columns_to_joints(self.pinocchio_model)

    @property
    def mass(self) -> float:
        """Mass of the moving links [kg], without links that are fixed to the base."""
        return float(pin.computeTotalMass(self.pinocchio_model))

    def centre_of_mass(self, q: ArrayLike) -> Float[np.ndarray, " 3"]:
        """Return the centre of mass (3,) of the moving links in the base frame [m].

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        return pin.centerOfMass(self.pinocchio_model, self._data, self.pinocchio_configuration(q)).copy()

    def centre_of_mass_jacobian_and_derivative(
        self, q: ArrayLike
    ) -> tuple[Float[np.ndarray, "3 nv"], Float[np.ndarray, "3 nv nv"]]:
        """Return the Jacobian of the centre of mass and its exact derivative.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].

        Returns:
            Jacobian J (3, nv) along the base axes [m/s per unit joint velocity], and its derivative (3, nv, nv) with
            the entry [i, j, k] = d J_ij / d q_k along tangent coordinate k.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        model, data = self.pinocchio_model, self._data
        Jc = np.array(pin.jacobianCenterOfMass(model, data, self.pinocchio_configuration(q))).reshape(3, model.nv)
        w = np.array(data.J).reshape(6, model.nv)[3:].T
        H = centre_of_mass_derivative(model, Jc, w, self._columns_to_joints)
        if self.coupling is not None:
            lift = self.coupling.lift
            return Jc @ lift, lift.T @ (H @ lift)
        return Jc, H

    def inertial_effort(self, q: ArrayLike, acceleration: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
        """Return the joint efforts that accelerate the robot from rest, without gravity.

        They are the product of the joint-space inertia matrix M(q) and the acceleration.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            acceleration: Joint accelerations (nv,) [rad/s^2 or m/s^2].

        Returns:
            Efforts (nv,) [N m or N]; zero for a description without masses.

        Raises:
            ConfigurationError: q or the acceleration has the wrong size or is not finite.
        """
        model, data = self.pinocchio_model, self._data
        x, a = self.pinocchio_configuration(q), self.velocity(acceleration)
        lift = None if self.coupling is None else self.coupling.lift
        effort = pin.rnea(model, data, x, np.zeros(model.nv), a if lift is None else lift @ a)
        effort = effort - pin.computeGeneralizedGravity(model, data, x)
        return effort if lift is None else lift.T @ effort

    def with_payload(self, mass: float, frame: FrameLike, centre: ArrayLike = (0.0, 0.0, 0.0)) -> Robot:
        """Return a copy of this robot with a mass in its hand, which adds to its inertia and its weight.

        Args:
            mass: Mass that the hand carries [kg]; it replaces a previous payload.
            frame: Frame of the hand.
            centre: shape (3,), centre of the mass in that frame [m].

        Raises:
            ConfigurationError: The mass is negative or not finite, or the centre is not three finite numbers.
            UnknownNameError: The frame or the reference does not exist; lists near matches.
        """
        place = finite(centre, 3)
        if not 0.0 <= mass < math.inf or place is None:
            raise ConfigurationError(
                f"a payload has a mass of 0 kg or more, and a centre of three numbers [m]; got {mass!r} and {centre!r}"
            )
        other = copy.copy(self)
        other.pinocchio_model, other.payload, other._bare = self._bare.copy(), float(mass), self._bare
        hand = self._bare.frames[self.frame(frame).index]
        load = pin.Inertia(float(mass), hand.placement.act(place), np.zeros((3, 3)))
        other.pinocchio_model.inertias[hand.parentJoint] = other.pinocchio_model.inertias[hand.parentJoint] + load
        return other

    def weight_effort(self, q: ArrayLike) -> Float[np.ndarray, " nv"]:
        """Return the joint efforts that compensate gravity, for a base whose z axis points up.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].

        Returns:
            Efforts (nv,) [N m or N]; zero for a description without masses.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        effort = pin.computeGeneralizedGravity(self.pinocchio_model, self._data, self.pinocchio_configuration(q))
        return effort.copy() if self.coupling is None else self.coupling.lift.T @ effort

    def hand_inertia(self, q: ArrayLike, frame: FrameLike) -> Float[np.ndarray, "6 6"] | None:
        r"""Return the inertia of a frame in operational space, for forces and moments along the base axes.

        O. Khatib, "A unified approach for motion and force control of robot manipulators", 1987. With the frame's
        Jacobian J and the joint-space inertia matrix M(q) it is

        .. math::

            (J \, M(q)^{-1} J^T)^{-1}

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            frame: Name of the frame, or the frame.

        Returns:
            Inertia matrix (6, 6), linear rows first [kg, kg m, kg m^2]; None if a moving link has no mass.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
            UnknownNameError: The frame or the reference does not exist; lists near matches.
        """
        if not all(inertia.mass > 0.0 for inertia in list(self.pinocchio_model.inertias)[1:]):
            return None
        M = np.array([self.inertial_effort(q, a) for a in np.eye(self.nv)])
        J = self.jacobian(q, frame)
        most = 1e3  # [kg or kg m^2] inertia in directions in which the arm cannot move: more than any arm weighs
        return np.linalg.inv(J @ np.linalg.solve(M, J.T) + np.eye(6) / most)

    # ---- internals -------------------------------------------------------------------------------------------------

    def __repr__(self) -> str:
        most = 14  # number of joint names to show
        names = printable(", ".join(self.joint_names[:most]))
        more = f" and {self.nv - most} more" if self.nv > most else ""
        return f"Robot({self.name!r}, nq={self.nq}, nv={self.nv}, joints={names}{more})"

    def _repr_html_(self) -> str:
        kinds = [block.kind for block in self.blocks for _ in block.units]
        limits = (self.position_lower, self.position_upper, self.velocity_limit)
        joints = zip(self.joint_names, kinds, self.joint_units, *limits, strict=True)
        rows = [
            (n, kind, f"{low:.4g} to {high:.4g} {u}", f"{fast:.4g} {u}/s") for n, kind, u, low, high, fast in joints
        ]
        locked_joints = "; ".join(f"{name} at {value:.4g}" for name, value in self.locked.items())
        return html_card.card(
            f"Robot {self.name}",
            html_card.sentence(f"{self.nv} joints move" + (f"; locked: {locked_joints}" if locked_joints else "")),
            html_card.warnings(self.warnings),
            html_card.table(("joint", "kind", "position", "velocity"), rows),
            html_card.folded(f"Frames ({len(self.frame_names)})", html_card.sentence(", ".join(self.frame_names))),
        )

    def __getstate__(self) -> dict[str, Any]:
        state = {**self.__dict__, "_frame_kinematics": {}}
        del state["_local"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._local = threading.local()
