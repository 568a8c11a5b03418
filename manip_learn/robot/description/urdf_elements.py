"""What a URDF says about kinematics, as plain data with line numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

Vector = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)
DEGREES_OF_FREEDOM = {"fixed": 0, "revolute": 1, "continuous": 1, "prismatic": 1, "planar": 3, "floating": 6}
Matrix = Float[np.ndarray, "4 4"]


@final
@dataclass(frozen=True)
class Pose:
    """Translation [m] and roll, pitch, yaw [rad] about fixed axes."""

    xyz: Vector = ZERO
    rpy: Vector = ZERO


@final
@dataclass(frozen=True)
class UrdfInertial:
    """Mass [kg], its pose, and ixx ixy ixz iyy iyz izz [kg m^2]."""

    pose: Pose
    mass: float
    inertia: tuple[float, ...]


@final
@dataclass(frozen=True)
class UrdfLink:
    """One link."""

    name: str
    line: int
    inertial: UrdfInertial | None


@final
@dataclass(frozen=True)
class UrdfLimit:
    """The `<limit>` of one joint, None for each number that is not given [rad or m, per second, N m or N]."""

    line: int
    lower: float | None
    upper: float | None
    velocity: float | None
    effort: float | None


@final
@dataclass(frozen=True)
class UrdfMimic:
    """The `<mimic>` of one joint as written: position = multiplier * position of `leader` + offset."""

    line: int
    leader: str
    multiplier: float
    offset: float


@final
@dataclass(frozen=True)
class UrdfJoint:
    """One joint; `axis` is of unit length."""

    name: str
    line: int
    type: str
    parent: str
    child: str
    pose: Pose
    axis: Vector
    limit: UrdfLimit | None
    mimic: UrdfMimic | None

    @property
    def nv(self) -> int:
        """Degrees of freedom, those of mimic joints included."""
        return DEGREES_OF_FREEDOM[self.type]


@final
@dataclass(frozen=True)
class UrdfFile:
    """A checked robot description.

    Attributes:
        name: Name of the robot.
        links: In file order.
        joints: In file order.
        root: Name of the root link.
    """

    name: str
    links: tuple[UrdfLink, ...]
    joints: tuple[UrdfJoint, ...]
    root: str

    def joint(self, name: str) -> UrdfJoint | None:
        """The joint of that name, or None."""
        return next((j for j in self.joints if j.name == name), None)


def as_pose(T: Matrix) -> Pose:
    """xyz and roll, pitch, yaw of a homogeneous matrix."""
    x, y, z = (float(c) for c in T[:3, 3])
    R = T[:3, :3]
    # atan2 throughout: exact also where the pitch is a quarter turn
    pitch = math.atan2(-R[2, 0], math.hypot(R[0, 0], R[1, 0]))
    if math.hypot(R[0, 0], R[1, 0]) > 1e-9:
        yaw, roll = math.atan2(R[1, 0], R[0, 0]), math.atan2(R[2, 1], R[2, 2])
    else:
        yaw, roll = math.atan2(-R[0, 1], R[1, 1]), 0.0
    return Pose((x, y, z), (roll, pitch, yaw))


def as_matrix(pose: Pose) -> Matrix:
    """Homogeneous matrix of xyz and roll, pitch, yaw."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = pin.rpy.rpyToMatrix(*pose.rpy), pose.xyz
    return T
