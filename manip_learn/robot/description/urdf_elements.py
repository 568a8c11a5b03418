"""What a URDF says about kinematics, as plain data with line numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

Vector = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)


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


DEGREES_OF_FREEDOM = {"fixed": 0, "revolute": 1, "continuous": 1, "prismatic": 1, "planar": 3, "floating": 6}


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
