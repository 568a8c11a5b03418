"""What a URDF says about kinematics: plain data with line numbers, read with every number checked, and written."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import final
from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.errors import RobotError, closest_names
from manip_learn.robot.description.text import Diagnostics, XmlNode, number, quoted, shortened, vector

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


KNOWN_ATTRIBUTES = {
    "origin": {"xyz", "rpy"},
    "axis": {"xyz"},
    "limit": {"lower", "upper", "velocity", "effort", "acceleration", "deceleration", "jerk"},
    "mimic": {"joint", "multiplier", "offset"},
    "parent": {"link"},
    "child": {"link"},
}
JOINT_CHILDREN = {"origin", "parent", "child", "axis", "limit", "dynamics", "mimic", "safety_controller", "calibration"}
LINK_CHILDREN = {"inertial", "visual", "collision", "contact", "self_collision_checking", "sensor", "verbose"}
INERTIAL_CHILDREN = {"origin", "mass", "inertia"}
MAX_NAME = 200  # [characters]
RESERVED = ("universe",)
FARTHEST = 1e6  # [m]
FULL_TURN = 2.0 * math.pi + 1e-3  # [rad]
AXIS_NORMS = (1e-3, 1e3)
INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def read_link(node: XmlNode, log: Diagnostics) -> UrdfLink:
    """A link and its inertia.

    Raises:
        RobotError: Codes `name-*`, `number`, `not-finite`, `vector-size`, `mass`, `element-twice`.
    """
    name = read_name(node, log)
    where = f"link {name!r}"
    _warn_unknown_children(node, LINK_CHILDREN, where, log)
    inertial = _only(node, "inertial", where, log)
    return UrdfLink(name, node.line, None if inertial is None else _inertial(inertial, where, log))


def read_joint(node: XmlNode, log: Diagnostics) -> UrdfJoint:
    """A joint with its pose, unit axis, limit and mimic.

    Raises:
        RobotError: Codes `name-*`, `joint-type`, `joint-link`, `axis-*`, `planar-axis`, `number`, `not-finite`, ...
    """
    name = read_name(node, log)
    where = f"joint {name!r}"
    _warn_unknown_children(node, JOINT_CHILDREN, where, log)
    joint_type = _type(node, where, log)
    limit, mimic = _only(node, "limit", where, log), _only(node, "mimic", where, log)
    return UrdfJoint(
        name=name,
        line=node.line,
        type=joint_type,
        parent=_link_of(node, "parent", where, log),
        child=_link_of(node, "child", where, log),
        pose=_pose(node, where, log),
        axis=_axis(node, joint_type, where, log),
        limit=None if limit is None else _limit(limit, where, log),
        mimic=None if mimic is None else _mimic(mimic, where, log),
    )


def read_name(node: XmlNode, log: Diagnostics) -> str:
    """The name of an element.

    Raises:
        RobotError: Codes `name-missing`, `name-long`, `name-unprintable`, `name-reserved`.
    """
    where = f"<{node.tag}>"
    name = node.attributes.get("name", "")
    if not name.strip():
        raise log.refusal("name-missing", node.line, where, "it has no name", "a name is expected", 'add name="..."')
    if len(name) > MAX_NAME:
        seen = f"its name has {len(name)} characters"
        raise log.refusal("name-long", node.line, where, seen, f"at most {MAX_NAME} are expected", "shorten it")
    if not name.isprintable():
        seen = f"its name {name!r} holds unprintable characters"
        raise log.refusal("name-unprintable", node.line, where, seen, "printable ones are expected", "rename it")
    if name in RESERVED:
        seen = f"the name {name!r} is kept for the fixed world"
        raise log.refusal(
            "name-reserved", node.line, where, seen, "another name is expected", "rename it, e.g. 'world'"
        )
    if name != name.strip():
        log.warn(node.line, f"{node.tag} {name!r} has spaces around its name, they count")
    return name


def _type(node: XmlNode, where: str, log: Diagnostics) -> str:
    joint_type = node.attributes.get("type", "")
    if joint_type in DEGREES_OF_FREEDOM:
        return joint_type
    near = closest_names(joint_type.strip().lower(), DEGREES_OF_FREEDOM)
    raise log.refusal(
        "joint-type",
        node.line,
        where,
        f"its type is {shortened(joint_type)!r}" if joint_type else "it has no type",
        f"one of {', '.join(DEGREES_OF_FREEDOM)} is expected",
        f"did you mean {near[0]!r}?" if near else "correct the type",
    )


def _link_of(node: XmlNode, tag: str, where: str, log: Diagnostics) -> str:
    child = _only(node, tag, where, log)
    link = child.attributes.get("link", "") if child is not None else ""
    if not link:
        fix = f'add <{tag} link="..."/>'
        raise log.refusal("joint-link", node.line, where, f"it names no {tag} link", "one is expected", fix)
    return link


def _pose(node: XmlNode, where: str, log: Diagnostics) -> Pose:
    origin = _only(node, "origin", where, log)
    if origin is None:
        return Pose()
    xyz = vector(origin, "xyz", 3, where, log) or ZERO
    rpy = vector(origin, "rpy", 3, where, log) or ZERO
    if max(map(abs, xyz)) > FARTHEST:
        seen = f"its origin xyz is {xyz} m"
        raise log.refusal("far-away", origin.line, where, seen, f"at most {FARTHEST:g} m is expected", "check the unit")
    if max(map(abs, rpy)) > FULL_TURN:
        log.warn(origin.line, f"{where}: origin rpy is {rpy}, more than a full turn: degrees in place of radians?")
    return Pose((xyz[0], xyz[1], xyz[2]), (rpy[0], rpy[1], rpy[2]))


def _axis(node: XmlNode, joint_type: str, where: str, log: Diagnostics) -> Vector:
    axis = _only(node, "axis", where, log)
    xyz = None if axis is None else vector(axis, "xyz", 3, where, log)
    if joint_type in ("fixed", "floating"):
        return (1.0, 0.0, 0.0)
    if joint_type == "planar":
        if xyz is None or not np.allclose(xyz, (0.0, 0.0, 1.0), rtol=0.0, atol=1e-9):
            seen = "it has no axis, which means 1 0 0" if xyz is None else f"its axis is {xyz}"
            line = node.line if axis is None else axis.line
            fix = "turn the joint's origin instead"
            raise log.refusal("planar-axis", line, where, seen, "a planar joint needs 0 0 1", fix)
        return (0.0, 0.0, 1.0)
    if axis is None or xyz is None:
        log.warn(node.line, f"{where}: it has no axis; 1 0 0 is taken, which is the default of URDF")
        return (1.0, 0.0, 0.0)
    return unit_axis(xyz, axis, where, log)


def unit_axis(xyz: tuple[float, ...], axis: XmlNode, where: str, log: Diagnostics) -> Vector:
    """The direction of an axis.

    Raises:
        RobotError: Codes `axis-zero`, `axis-norm`.
    """
    norm = math.hypot(*xyz)
    if norm == 0.0:
        fix = 'write the direction, or type="fixed" for a joint that never moves'
        raise log.refusal("axis-zero", axis.line, where, "its axis is 0 0 0", "a direction is expected", fix)
    if not AXIS_NORMS[0] <= norm <= AXIS_NORMS[1]:
        seen = f"its axis {xyz} has length {norm:.3g}"
        raise log.refusal("axis-norm", axis.line, where, seen, "length 1 is expected", "write a unit vector")
    if abs(norm - 1.0) > 1e-3:
        log.warn(axis.line, f"{where}: its axis {xyz} has length {norm:.4g}; only the direction is used")
    x, y, z = (c / norm + 0.0 for c in xyz)
    return (x, y, z)


def _limit(node: XmlNode, where: str, log: Diagnostics) -> UrdfLimit:
    lower, upper, velocity, effort = (number(node, key, where, log) for key in ("lower", "upper", "velocity", "effort"))
    return UrdfLimit(node.line, lower, upper, velocity, effort)


def _mimic(node: XmlNode, where: str, log: Diagnostics) -> UrdfMimic:
    leader = node.attributes.get("joint", "")
    if not leader:
        fix = 'add joint="..." to <mimic>, or delete it'
        raise log.refusal("mimic-leader", node.line, where, "its <mimic> names no joint", "one is expected", fix)
    multiplier, offset = number(node, "multiplier", where, log), number(node, "offset", where, log)
    return UrdfMimic(node.line, leader, 1.0 if multiplier is None else multiplier, 0.0 if offset is None else offset)


def _inertial(node: XmlNode, where: str, log: Diagnostics) -> UrdfInertial:
    _warn_unknown_children(node, INERTIAL_CHILDREN, where, log)
    mass_node, inertia_node = _only(node, "mass", where, log), _only(node, "inertia", where, log)
    mass = number(mass_node, "value", where, log) if mass_node is not None else None
    if mass is None:
        log.warn(node.line, f"{where}: its <inertial> gives no mass; 0 kg is taken")
    elif mass < 0.0:
        line = node.line if mass_node is None else mass_node.line
        raise log.refusal("mass", line, where, f"its mass is {mass} kg", "0 or more is expected", "write the true mass")
    entries = [0.0] * 6
    if inertia_node is not None:
        entries = [number(inertia_node, key, where, log) or 0.0 for key in INERTIA]
        xx, xy, xz, yy, yz, zz = entries
        smallest = float(np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])[0])
        if smallest < -1e-9 * max(1.0, *map(abs, entries)):
            log.warn(inertia_node.line, f"{where}: its inertia is not positive ({smallest:.3g} kg m^2); unused here")
    return UrdfInertial(_pose(node, where, log), mass or 0.0, tuple(entries))


def _only(node: XmlNode, tag: str, where: str, log: Diagnostics) -> XmlNode | None:
    """The child with that tag, its attributes looked through; None if there is none."""
    found = node.all(tag)
    if len(found) > 1:
        raise _twice(found[1], where, log)
    if not found:
        return None
    known = KNOWN_ATTRIBUTES.get(tag)
    unknown = [k for k in found[0].attributes if known is not None and k not in known]
    if unknown:
        if tag == "origin" and any("quat" in k for k in unknown):
            seen = f"its origin has {quoted(unknown)}"
            raise log.refusal("origin-attribute", found[0].line, where, seen, "xyz and rpy are read", "write rpy")
        log.warn(found[0].line, f"{where}: <{tag}> has {quoted(unknown)}, which is ignored")
    return found[0]


def _twice(node: XmlNode, where: str, log: Diagnostics) -> RobotError:
    seen = f"it has more than one <{node.tag}>"
    return log.refusal("element-twice", node.line, where, seen, "one is expected", "delete all but one")


def _warn_unknown_children(node: XmlNode, known: set[str], where: str, log: Diagnostics) -> None:
    for child in node.children:
        if child.tag in known:
            continue
        near = [] if log.is_full else closest_names(shortened(child.tag).lower(), known, n=1)
        hint = f"; did you mean <{near[0]}>?" if near else ""
        log.warn(child.line, f"{where}: <{shortened(child.tag)}> is ignored{hint}")


UNLIMITED = 1_000.0  # [rad or m] larger limits mean "no limit" in practice
LARGE = 1e300  # what C++ reads as a number and no joint reaches


def kinematic_urdf(
    urdf: UrdfFile, visuals: Mapping[str, Sequence[str]] | None = None, *, with_mimics: bool = False
) -> str:
    """Plain URDF of links and joints.

    Args:
        urdf: A validated description.
        visuals: Link -> `<visual>` elements to put in; Pinocchio gets none.
        with_mimics: Whether to write `<mimic>`; for Pinocchio mimic joints are joints of their own.
    """
    parts = [f"<robot name={quoteattr(urdf.name)}>"]
    parts += [_link_text(link, (visuals or {}).get(link.name, ())) for link in urdf.links]
    parts += [_joint_text(joint, with_mimics) for joint in urdf.joints]
    parts.append("</robot>")
    return "\n".join(parts)


def _link_text(link: UrdfLink, visuals: Sequence[str]) -> str:
    inside = ("" if link.inertial is None else _inertial_text(link.inertial)) + "".join(visuals)
    return f"<link name={quoteattr(link.name)}>{inside}</link>"


def _inertial_text(inertial: UrdfInertial) -> str:
    entries = " ".join(f'{key}="{value!r}"' for key, value in zip(INERTIA, inertial.inertia, strict=True))
    return f'<inertial>{_origin_text(inertial.pose)}<mass value="{inertial.mass!r}"/><inertia {entries}/></inertial>'


def _joint_text(joint: UrdfJoint, with_mimics: bool) -> str:
    x, y, z = joint.axis
    mimic = ""
    if with_mimics and joint.mimic is not None:
        m = joint.mimic
        mimic = f'<mimic joint={quoteattr(m.leader)} multiplier="{m.multiplier!r}" offset="{m.offset!r}"/>'
    return (
        f'<joint name={quoteattr(joint.name)} type="{joint.type}">{_origin_text(joint.pose)}'
        f"<parent link={quoteattr(joint.parent)}/><child link={quoteattr(joint.child)}/>"
        f'<axis xyz="{x!r} {y!r} {z!r}"/>{_limit_text(joint)}{mimic}</joint>'
    )


def _origin_text(pose: Pose) -> str:
    xyz, rpy = (" ".join(repr(c) for c in v) for v in (pose.xyz, pose.rpy))
    return f'<origin xyz="{xyz}" rpy="{rpy}"/>'


def _limit_text(joint: UrdfJoint) -> str:
    if joint.type not in ("revolute", "prismatic", "continuous"):
        return ""
    limit = joint.limit
    lower, upper, velocity, effort = (
        (None,) * 4 if limit is None else (limit.lower, limit.upper, limit.velocity, limit.effort)
    )
    lower, upper = _bound(lower, -LARGE), _bound(upper, LARGE)
    if lower >= upper:  # of a locked joint, else validation would have refused it
        lower, upper = -LARGE, LARGE
    velocity = LARGE if velocity is None or velocity <= 0.0 else min(velocity, LARGE)
    effort = LARGE if effort is None or effort < 0.0 else effort
    return f'<limit lower="{lower!r}" upper="{upper!r}" velocity="{velocity!r}" effort="{effort!r}"/>'


def _bound(value: float | None, otherwise: float) -> float:
    return otherwise if value is None or abs(value) > UNLIMITED else value
