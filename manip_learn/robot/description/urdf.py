"""Kinematics of a URDF as plain data with line numbers: read with every number checked, and written."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import final
from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.errors import closest_names
from manip_learn.robot.description.text import XmlNode, quoted, shortened

Vector = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)
X: Vector = (1.0, 0.0, 0.0)
# of each type of joint
DEGREES_OF_FREEDOM = {"fixed": 0, "revolute": 1, "continuous": 1, "prismatic": 1, "planar": 3, "floating": 6}
Matrix4 = Float[np.ndarray, "4 4"]
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
LONGEST_NAME = 200  # [characters] longer ones make no readable sentence
RESERVED = ("universe",)
FARTHEST_PLACE = 1e6  # [m] beyond it poses keep less than 1e-9 m
FULL_TURN = 2.0 * math.pi + 1e-3  # [rad] files round
AXIS_NORMS = (1e-3, 1e3)  # of lengths outside the direction may be noise
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


def read_link(node: XmlNode) -> UrdfLink:
    """A link and its inertia.

    Raises:
        RobotError: Codes `name-*`, `number`, `not-finite`, `vector-size`, `mass`, `element-twice`.
    """
    name = read_name(node)
    _warn_unknown_children(node, LINK_CHILDREN)
    inertial = _only(node, "inertial")
    if inertial is None:
        return UrdfLink(name, node.line, None)
    _warn_unknown_children(inertial, INERTIAL_CHILDREN)
    mass_node, inertia = _only(inertial, "mass"), _only(inertial, "inertia")
    mass = None if mass_node is None else mass_node.number("value")
    if mass is None:
        inertial.warn("its <inertial> gives no mass; 0 kg is taken")
    elif mass < 0.0:
        where = mass_node or inertial
        raise where.refusal("mass", f"its mass is {mass} kg; 0 or more is expected; write the true mass")
    entries = [0.0 if inertia is None else inertia.number(key, 0.0) for key in INERTIA]
    xx, xy, xz, yy, yz, zz = entries
    smallest = float(np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])[0])
    if inertia is not None and smallest < -1e-9 * max(1.0, *map(abs, entries)):
        inertia.warn(f"its inertia is not positive ({smallest:.3g} kg m^2); unused here")
    return UrdfLink(name, node.line, UrdfInertial(_pose(inertial), mass or 0.0, tuple(entries)))


def read_joint(node: XmlNode) -> UrdfJoint:
    """A joint with its pose, unit axis, limit and mimic.

    Raises:
        RobotError: Codes `name-*`, `joint-type`, `joint-link`, `axis-*`, `planar-axis`, `number`, `not-finite`, ...
    """
    name = read_name(node)
    _warn_unknown_children(node, JOINT_CHILDREN)
    kind = node.attributes.get("type", "")
    if kind not in DEGREES_OF_FREEDOM:
        seen = f"its type is {shortened(kind)!r}" if kind else "it has no type"
        near = closest_names(kind.strip().lower(), DEGREES_OF_FREEDOM)
        fix = f"did you mean {near[0]!r}?" if near else "correct the type"
        raise node.refusal("joint-type", f"{seen}; one of {', '.join(DEGREES_OF_FREEDOM)} is expected; {fix}")
    limits, limit = _only(node, "limit"), None
    follows, mimic = _only(node, "mimic"), None
    if limits is not None:
        limit = UrdfLimit(limits.line, *(limits.number(key) for key in ("lower", "upper", "velocity", "effort")))
    parent, child, pose = _link_of(node, "parent"), _link_of(node, "child"), _pose(node)
    axis, xyz = _only(node, "axis"), X
    given = None if axis is None else axis.vector("xyz", 3)
    if kind == "planar":
        xyz = (0.0, 0.0, 1.0)
        if given is None or not np.allclose(given, xyz, rtol=0.0, atol=1e-9):
            seen = "it has no axis, which means 1 0 0" if given is None else f"its axis is {given}"
            sentence = f"{seen}; a planar joint needs 0 0 1; turn the joint's origin instead"
            raise (axis or node).refusal("planar-axis", sentence)
    elif kind not in ("fixed", "floating"):
        if axis is None or given is None:
            node.warn("it has no axis; 1 0 0 is taken, which is the default of URDF")
        else:
            xyz = unit_axis(given, axis)
    if limit is not None:
        limit = _narrowed(node, limit)
    if follows is not None:
        leader = follows.attributes.get("joint", "")
        if not leader:
            fix = 'add joint="..." to <mimic>, or delete it'
            raise follows.refusal("mimic-leader", f"its <mimic> names no joint; one is expected; {fix}")
        mimic = UrdfMimic(follows.line, leader, follows.number("multiplier", 1.0), follows.number("offset", 0.0))
    return UrdfJoint(name, node.line, kind, parent, child, pose, xyz, limit, mimic)


def _narrowed(node: XmlNode, limit: UrdfLimit) -> UrdfLimit:
    """The limit, or the narrower one at which the safety controller of the arm's driver stops a joint."""
    safety = _only(node, "safety_controller")
    low, high = (None if safety is None else safety.number(f"soft_{n}_limit") for n in ("lower", "upper"))
    if low is None or high is None or limit.lower is None or limit.upper is None or not low < high:
        return limit  # URDF's own default is 0 for both, which means none
    lower, upper = max(low, limit.lower), min(high, limit.upper)
    if (lower, upper) == (limit.lower, limit.upper) or not lower < upper:
        return limit
    node.warn(
        f"its safety_controller allows {lower:g} ... {upper:g} of the limits {limit.lower:g} ... {limit.upper:g}: "
        "the narrower ones are used"
    )
    return replace(limit, lower=lower, upper=upper)


def read_name(node: XmlNode) -> str:
    """The name of an element.

    Raises:
        RobotError: Codes `name-missing`, `name-long`, `name-unprintable`, `name-reserved`.
    """
    name, place = node.attributes.get("name", ""), f"<{node.tag}>"
    code = sentence = None
    if not name.strip():
        code, sentence = "missing", 'it has no name; a name is expected; add name="..."'
    elif len(name) > LONGEST_NAME:
        code, sentence = (
            "long",
            f"its name has {len(name)} characters; at most {LONGEST_NAME} are expected; shorten it",
        )
    elif not name.isprintable():
        code, sentence = "unprintable", f"its name {name!r} holds unprintable characters; rename it"
    elif name in RESERVED:
        code, sentence = "reserved", f"the name {name!r} is kept for the fixed world; rename it, e.g. 'world'"
    if code is not None:
        raise node.log.refusal(f"name-{code}", node.line, f"{place}: {sentence}")
    if name != name.strip():
        node.log.warn(node.line, f"{node.tag} {name!r} has spaces around its name, they count")
    return name


def _link_of(node: XmlNode, tag: str) -> str:
    child = _only(node, tag)
    link = child.attributes.get("link", "") if child is not None else ""
    if not link:
        raise node.refusal("joint-link", f'it names no {tag} link; one is expected; add <{tag} link="..."/>')
    return link


def near_vector(node: XmlNode, attribute: str) -> Vector:
    """A position [m] in an attribute, zero if there is none.

    Raises:
        RobotError: Codes `number`, `not-finite`, `vector-size`, `far-away`.
    """
    x, y, z = node.vector(attribute, 3) or ZERO
    if max(abs(x), abs(y), abs(z)) > FARTHEST_PLACE:
        seen = f"its {node.tag} {attribute} is {(x, y, z)} m"
        raise node.refusal("far-away", f"{seen}; at most {FARTHEST_PLACE:g} m is expected; check the unit")
    return (x, y, z)


def _pose(node: XmlNode) -> Pose:
    origin = _only(node, "origin")
    if origin is None:
        return Pose()
    roll, pitch, yaw = origin.vector("rpy", 3) or ZERO
    if max(abs(roll), abs(pitch), abs(yaw)) > FULL_TURN:
        origin.warn(f"origin rpy is {(roll, pitch, yaw)}, more than a full turn: degrees in place of radians?")
    return Pose(near_vector(origin, "xyz"), (roll, pitch, yaw))


def unit_axis(xyz: tuple[float, ...], axis: XmlNode) -> Vector:
    """The direction of an axis.

    Raises:
        RobotError: Codes `axis-zero`, `axis-norm`.
    """
    norm = math.hypot(*xyz)
    if norm == 0.0:
        fix = 'write the direction, or type="fixed" for a joint that never moves'
        raise axis.refusal("axis-zero", f"its axis is 0 0 0; a direction is expected; {fix}")
    if not AXIS_NORMS[0] <= norm <= AXIS_NORMS[1]:
        seen = f"its axis {xyz} has length {norm:.3g}"
        raise axis.refusal("axis-norm", f"{seen}; length 1 is expected; write a unit vector")
    if abs(norm - 1.0) > 1e-3:
        axis.warn(f"its axis {xyz} has length {norm:.4g}; only the direction is used")
    x, y, z = (c / norm + 0.0 for c in xyz)
    return (x, y, z)


def _only(node: XmlNode, tag: str) -> XmlNode | None:
    """The child with that tag, its attributes looked through; None if there is none."""
    found = node.all(tag)
    if len(found) > 1:
        raise found[1].refusal("element-twice", f"it has more than one <{tag}>; one is expected; delete all but one")
    if not found:
        return None
    known = KNOWN_ATTRIBUTES.get(tag)
    unknown = [k for k in found[0].attributes if known is not None and k not in known]
    if tag == "origin" and any("quat" in k for k in unknown):
        raise found[0].refusal("origin-attribute", f"its origin has {quoted(unknown)}; xyz and rpy are read; write rpy")
    if unknown:
        found[0].warn(f"<{tag}> has {quoted(unknown)}, which is ignored")
    return found[0]


def _warn_unknown_children(node: XmlNode, known: set[str]) -> None:
    for child in node.children:
        if child.tag not in known:
            near = [] if node.log.is_full else closest_names(shortened(child.tag).lower(), known, n=1)
            hint = f"; did you mean <{near[0]}>?" if near else ""
            child.warn(f"<{shortened(child.tag)}> is ignored{hint}")


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
    for link in urdf.links:
        inside, inertial = "".join((visuals or {}).get(link.name, ())), link.inertial
        if inertial is not None:
            entries = " ".join(f'{key}="{value!r}"' for key, value in zip(INERTIA, inertial.inertia, strict=True))
            pose = f'{origin_text(inertial.pose)}<mass value="{inertial.mass!r}"/>'
            inside = f"<inertial>{pose}<inertia {entries}/></inertial>{inside}"
        parts.append(f"<link name={quoteattr(link.name)}>{inside}</link>")
    for joint in urdf.joints:
        mimic = ""
        if with_mimics and (m := joint.mimic) is not None:
            mimic = f'<mimic joint={quoteattr(m.leader)} multiplier="{m.multiplier!r}" offset="{m.offset!r}"/>'
        parts.append(
            f'<joint name={quoteattr(joint.name)} type="{joint.type}">{origin_text(joint.pose)}'
            f"<parent link={quoteattr(joint.parent)}/><child link={quoteattr(joint.child)}/>"
            f'<axis xyz="{spaced(joint.axis)}"/>{_limit_text(joint)}{mimic}</joint>'
        )
    return "\n".join([*parts, "</robot>"])


def spaced(numbers: Iterable[float]) -> str:
    """Numbers as an attribute holds them, to the last bit."""
    return " ".join(map(repr, numbers))


def origin_text(pose: Pose) -> str:
    """The `<origin>` of a pose."""
    return f'<origin xyz="{spaced(pose.xyz)}" rpy="{spaced(pose.rpy)}"/>'


def _limit_text(joint: UrdfJoint) -> str:
    if joint.type not in ("revolute", "prismatic", "continuous"):
        return ""
    limit = joint.limit or UrdfLimit(joint.line, None, None, None, None)
    lower = -HUGE if limit.lower is None or abs(limit.lower) > UNLIMITED else limit.lower
    upper = HUGE if limit.upper is None or abs(limit.upper) > UNLIMITED else limit.upper
    if lower >= upper:  # of a locked joint, else validation would have refused it
        lower, upper = -HUGE, HUGE
    velocity = HUGE if limit.velocity is None or limit.velocity <= 0.0 else min(limit.velocity, HUGE)
    effort = HUGE if limit.effort is None or limit.effort < 0.0 else limit.effort
    return f'<limit lower="{lower!r}" upper="{upper!r}" velocity="{velocity!r}" effort="{effort!r}"/>'
