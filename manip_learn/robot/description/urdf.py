"""Kinematics of a robot as plain data that knows the elements it was read from, and the URDF that is written of it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import final
from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.robot.description.text import XmlNode

Vector = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)
X: Vector = (1.0, 0.0, 0.0)
# of each type of joint
DEGREES_OF_FREEDOM = {"fixed": 0, "revolute": 1, "continuous": 1, "prismatic": 1, "planar": 3, "floating": 6}
Matrix4 = Float[np.ndarray, "4 4"]
INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
UNLIMITED = 1_000.0  # [rad or m] larger limits mean "no limit" in practice
HUGE = 1e300  # what C++ reads as a number and no joint reaches


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
    node: XmlNode
    inertial: UrdfInertial | None = None


@final
@dataclass(frozen=True)
class UrdfLimit:
    """The `<limit>` of one joint, None for each number that is not given [rad or m, per second, N m or N]."""

    node: XmlNode
    lower: float | None = None
    upper: float | None = None
    velocity: float | None = None
    effort: float | None = None


@final
@dataclass(frozen=True)
class UrdfMimic:
    """The `<mimic>` of one joint as written: position = multiplier * position of `leader` + offset."""

    node: XmlNode
    leader: str
    multiplier: float
    offset: float


@final
@dataclass(frozen=True)
class UrdfJoint:
    """One joint; `axis` is of unit length."""

    name: str
    node: XmlNode
    type: str
    parent: str
    child: str
    pose: Pose = Pose()  # noqa: RUF009
    axis: Vector = X
    limit: UrdfLimit | None = None
    mimic: UrdfMimic | None = None

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


def as_pose(T: Matrix4) -> Pose:
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


def as_matrix(pose: Pose) -> Matrix4:
    """Homogeneous matrix of xyz and roll, pitch, yaw."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = pin.rpy.rpyToMatrix(*pose.rpy), pose.xyz
    return T


def kinematic_urdf(
    urdf: UrdfFile, visuals: Mapping[str, Sequence[str]] | None = None, *, with_mimics: bool = False
) -> str:
    """Return the plain URDF of links and joints.

    Args:
        urdf: A validated description.
        visuals: Link -> `<visual>` elements to put in; Pinocchio gets none.
        with_mimics: Whether to write `<mimic>`; for Pinocchio mimic joints are joints of their own.
    """
    parts = [f"<robot name={quoteattr(urdf.name)}>"]
    for link in urdf.links:
        inside, inertial = "".join((visuals or {}).get(link.name, ())), link.inertial
        if inertial is not None:
            entries = " ".join(f'{key}="{value!r}"' for key, value in zip(INERTIA, inertial.inertia, strict=True))
            pose = f'{origin_text(inertial.pose)}<mass value="{inertial.mass!r}"/>'
            inside = f"<inertial>{pose}<inertia {entries}/></inertial>{inside}"
        parts.append(f"<link name={quoteattr(link.name)}>{inside}</link>")
    for joint in urdf.joints:
        limit, more = joint.limit or UrdfLimit(joint.node), ""
        if joint.type in ("revolute", "prismatic", "continuous"):
            lower = -HUGE if limit.lower is None or abs(limit.lower) > UNLIMITED else limit.lower
            upper = HUGE if limit.upper is None or abs(limit.upper) > UNLIMITED else limit.upper
            if lower >= upper:  # of a locked joint, else validation would have refused it
                lower, upper = -HUGE, HUGE
            velocity = HUGE if limit.velocity is None or limit.velocity <= 0.0 else min(limit.velocity, HUGE)
            effort = HUGE if limit.effort is None or limit.effort < 0.0 else limit.effort
            more = f'<limit lower="{lower!r}" upper="{upper!r}" velocity="{velocity!r}" effort="{effort!r}"/>'
        if with_mimics and (m := joint.mimic) is not None:
            more += f'<mimic joint={quoteattr(m.leader)} multiplier="{m.multiplier!r}" offset="{m.offset!r}"/>'
        parts.append(
            f'<joint name={quoteattr(joint.name)} type="{joint.type}">{origin_text(joint.pose)}'
            f"<parent link={quoteattr(joint.parent)}/><child link={quoteattr(joint.child)}/>"
            f'<axis xyz="{spaced(joint.axis)}"/>{more}</joint>'
        )
    return "\n".join([*parts, "</robot>"])


def spaced(numbers: Iterable[float]) -> str:
    """Numbers as an attribute holds them, to the last bit."""
    return " ".join(map(repr, numbers))


def origin_text(pose: Pose) -> str:
    """The `<origin>` of a pose."""
    return f'<origin xyz="{spaced(pose.xyz)}" rpy="{spaced(pose.rpy)}"/>'
