"""Kinematics of a URDF as plain data: read, check and write links and joints.

Each element is checked when it is read, then all are checked against each other. Descriptions of every format pass
these checks before they reach Pinocchio.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import NamedTuple, final
from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.errors import advice, closest_names
from manip_learn.robot.description import text
from manip_learn.robot.description.text import RULES, Diagnostics, XmlNode, quoted, shorten, suggest_name
from manip_learn.robot.joints import Mimic

Vector = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)
X: Vector = (1.0, 0.0, 0.0)
# type of joint -> degrees of freedom
DEGREES_OF_FREEDOM = {"fixed": 0, "revolute": 1, "continuous": 1, "prismatic": 1, "planar": 3, "floating": 6}
Matrix4 = Float[np.ndarray, "4 4"]
INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
UNLIMITED = 1_000.0  # [rad or m] larger limits mean "no limit" in practice
HUGE = 1e300  # a number that C++ can read and no joint reaches
KNOWN_ATTRIBUTES = {
    **{"origin": {"xyz", "rpy"}, "axis": {"xyz"}, "parent": {"link"}, "child": {"link"}},
    "limit": {"lower", "upper", "velocity", "effort", "acceleration", "deceleration", "jerk"},
    "mimic": {"joint", "multiplier", "offset"},
}
KNOWN_CHILDREN = {
    "robot": {"link", "joint", "material", "transmission", "gazebo", "sensor", "ros2_control", "group"},
    "joint": {"origin", "parent", "child", "axis", "limit", "dynamics", "mimic", "safety_controller", "calibration"},
    "link": {"inertial", "visual", "collision", "contact", "self_collision_checking", "sensor", "verbose"},
    "inertial": {"origin", "mass", "inertia"},
}
LONGEST_NAME = 200  # [characters] longer names would make messages unreadable
RESERVED = ("universe",)


@final
class Pose(NamedTuple):
    """Translation [m] and roll, pitch, yaw [rad] about fixed axes."""

    xyz: Vector = ZERO
    rpy: Vector = ZERO


@final
class UrdfLink(NamedTuple):
    """Link of a robot description.

    Attributes:
        name: Name of the link.
        node: Its XML element.
        inertia: Six numbers ixx ixy ixz iyy iyz izz [kg m^2]; None if the file has none.
        mass: Mass [kg].
        pose: Pose of the inertia's frame in the link frame.
    """

    name: str
    node: XmlNode
    inertia: tuple[float, ...] | None = None
    mass: float = 0.0  # [kg]
    pose: Pose = Pose()


@final
class UrdfLimit(NamedTuple):
    """Limits of a joint, nan if missing: positions [rad or m], velocity [rad/s or m/s] and effort [N m or N]."""

    lower: float = math.nan
    upper: float = math.nan
    velocity: float = math.nan
    effort: float = math.nan
    node: XmlNode | None = None


@final
class UrdfJoint(NamedTuple):
    """Joint of a robot description.

    Attributes:
        name: Name of the joint.
        node: Its XML element.
        type: Type as in URDF, e.g. `"revolute"`.
        parent, child: Names of the links that it connects.
        pose: Pose of the joint in the parent link's frame.
        axis: Unit vector in the joint's frame.
        limit: Limits.
        mimic: Mimic as in the file, whose leader may be a mimic joint too; None for an independent joint.
        mimic_node: XML element of the mimic; None without one.
    """

    name: str
    node: XmlNode
    type: str
    parent: str
    child: str
    pose: Pose = Pose()
    axis: Vector = X
    limit: UrdfLimit = UrdfLimit()
    mimic: Mimic | None = None
    mimic_node: XmlNode | None = None

    @property
    def nv(self) -> int:
        """Number of degrees of freedom, also for a mimic joint."""
        return DEGREES_OF_FREEDOM[self.type]


@final
class UrdfFile(NamedTuple):
    """A checked robot description.

    Attributes:
        name: Name of the robot.
        links: Links, in the order of the file.
        joints: Joints, in the order of the file.
        root: Name of the root link.
        followers: Mimic joints, each with an independent, moving leader.
        resting: Name of a mimic joint whose chain of leaders ends at a fixed joint -> its position [rad or m].
        warnings: Unusual but harmless contents, in sentences.
    """

    name: str
    links: tuple[UrdfLink, ...]
    joints: tuple[UrdfJoint, ...]
    root: str
    followers: tuple[Mimic, ...]
    resting: dict[str, float]
    warnings: tuple[str, ...]


def as_pose(T: Matrix4) -> Pose:
    """Convert a homogeneous matrix to translation and roll, pitch, yaw.

    Args:
        T: Homogeneous matrix (4, 4) [m].
    """
    x, y, z = (float(c) for c in T[:3, 3])
    R, level = T[:3, :3], math.hypot(T[0, 0], T[1, 0])
    # atan2 is exact also at a pitch of a quarter turn
    yaw, roll = math.atan2(R[1, 0], R[0, 0]), math.atan2(R[2, 1], R[2, 2])
    if level <= 1e-9:
        yaw, roll = math.atan2(-R[0, 1], R[1, 1]), 0.0
    return Pose((x, y, z), (roll, math.atan2(-R[2, 0], level), yaw))


def as_matrix(pose: Pose) -> Matrix4:
    """Convert translation and roll, pitch, yaw to a homogeneous matrix (4, 4).

    Args:
        pose: Translation [m] and angles [rad].
    """
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = pin.rpy.rpyToMatrix(*pose.rpy), pose.xyz
    return T


def motion_along(kind: str, axis: Vector, position: float) -> Matrix4:
    """Return the homogeneous matrix of a joint's motion along or about its axis.

    Args:
        kind: Type of the joint: `"prismatic"`, or another type for a rotation.
        axis: Unit vector (3,) in the frame of the joint.
        position: Joint position [rad or m].
    """
    T, step = np.eye(4), position * np.array(axis)
    if kind == "prismatic":
        T[:3, 3] = step
    else:
        T[:3, :3] = pin.exp3(step)
    return T


def validate_urdf(root: XmlNode, locked: Collection[str] = ()) -> UrdfFile:
    """Read and check a URDF.

    Args:
        root: Root element of the URDF.
        locked: Names of joints that will be locked; their limits and leaders are not checked.

    Returns:
        The validated description.

    Raises:
        RobotError: The description is invalid. The error has a `code`; the message names the file, the line, the joint
            or link, the actual value and the remedy.
    """
    if root.tag != "robot":
        kinds = {"sdf": "an SDF file", "mujoco": "an MJCF file", "COLLADA": "a mesh", "launch": "a ROS launch file"}
        finding = f"the root element is <{shorten(root.tag)}>" + (f", {kinds[root.tag]}" if root.tag in kinds else "")
        raise root.log.refusal("not-urdf", root.line, f"{finding}; <robot> is expected; convert it to URDF")
    version = root.attributes.get("version", "1.0").strip()
    root.require(version in ("1", "1.0"), "urdf-version", version=version)
    foreign = [c for c in root.children if c.tag.startswith("xacro:") or c.tag in ("macro", "include")]
    macros = [c.attributes.get("name", "") for c in foreign if c.tag.removeprefix("xacro:") == "macro"]
    if macros and root.first("link") is None:
        raise foreign[0].refusal("no-links", RULES["no-links.macros"].format(names=quoted(macros)))
    if foreign:
        fix = "expand it" + advice(", or name the file *.xacro and load it with {}", "xacro=True", "--xacro")
        finding = f"<{shorten(foreign[0].tag)}> is xacro, not URDF; plain URDF is expected"
        raise foreign[0].refusal("xacro", f"{finding}; {fix}")
    _warn_of_unread(root)
    links = [read_link(node) for node in root.all("link")]
    controls = [joint for block in root.all("ros2_control") for joint in block.all("joint")]
    joints = [read_joint(node, controls) for node in root.all("joint")]
    return validate_parts(robot_name(root), links, joints, locked, root.log)


def robot_name(root: XmlNode, attribute: str = "name") -> str:
    """Return the name of a robot; if it is missing or unprintable, warn and return the name of the file.

    Args:
        root: The root element.
        attribute: Attribute with the name: `model` in MJCF.
    """
    name = root.attributes.get(attribute, "").strip()
    if not name or not name.isprintable() or len(name) > LONGEST_NAME:
        reason = "has no name" if not name else f"has the unusable name {shorten(name)!r}"
        name = "".join(c for c in root.log.path.stem if c.isprintable()) or "robot"
        root.log.warn(root.line, f"the robot {reason}; it is called {quoted([name])} after its file")
    return name


def read_link(node: XmlNode) -> UrdfLink:
    """Read a link and its inertia.

    Args:
        node: XML element of the link.

    Returns:
        The link.

    Raises:
        RobotError: The link is invalid; codes `name-*`, `number`, `not-finite`, `vector-size`, `mass`, `element-twice`.
    """
    name = read_name(node)
    inertial = _only(_warn_of_unread(node), "inertial")
    if inertial is None:
        return UrdfLink(name, node)
    mass_node, inertia = _only(inertial, "mass"), _only(inertial, "inertia")
    mass = math.nan if mass_node is None else mass_node.number("value")
    if math.isnan(mass):
        inertial.warn("its <inertial> has no mass; 0 kg is used")
        mass = 0.0
    (mass_node or inertial).require(mass >= 0.0, "mass", mass=mass)
    entries = [0.0 if inertia is None else inertia.number(key, 0.0) for key in INERTIA]
    xx, xy, xz, yy, yz, zz = entries
    smallest = float(np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])[0])
    if inertia is not None and smallest < -1e-9 * max(1.0, *map(abs, entries)):
        inertia.warn(f"its inertia is not positive semidefinite ({smallest:.3g} kg m^2); unused here")
    return UrdfLink(name, node, tuple(entries), mass, _pose(inertial))


def read_joint(node: XmlNode, controls: Sequence[XmlNode] = ()) -> UrdfJoint:
    """Read a joint with its pose, unit axis, limit and mimic.

    Args:
        node: XML element of the joint.
        controls: The `<joint>` elements inside `<ros2_control>`, of all joints.

    Returns:
        The joint.

    Raises:
        RobotError: The joint is invalid; codes such as `name-*`, `joint-type`, `joint-link`, `axis-*`, `planar-axis`,
            `number`, `not-finite`.
    """
    name, kind = read_name(node), node.attributes.get("type", "")
    _warn_of_unread(node)
    if kind not in DEGREES_OF_FREEDOM:
        finding = f"its type is {shorten(kind)!r}" if kind else "it has no type"
        fix = suggest_name(kind.strip().lower(), DEGREES_OF_FREEDOM, "correct the type")
        raise node.refusal("joint-type", f"{finding}; one of {', '.join(DEGREES_OF_FREEDOM)} is expected; {fix}")
    limits, limit = _only(node, "limit"), UrdfLimit()
    follows, mimic = _only(node, "mimic"), None
    if limits is not None:
        limit = UrdfLimit(*map(limits.number, ("lower", "upper", "velocity", "effort")), node=limits)
        limit = _narrow_limit(node, limit, [c for c in controls if c.attributes.get("name") == name])
    ends = []
    for tag in ("parent", "child"):
        end = _only(node, tag)
        ends.append("" if end is None else end.attributes.get("link", ""))
        node.require(ends[-1] != "", "joint-link", tag=tag)
    pose, axis, direction = _pose(node), _only(node, "axis"), X
    xyz = None if axis is None else axis.vector("xyz", 3)
    if kind == "planar":
        direction = (0.0, 0.0, 1.0)
        is_z = xyz is not None and np.allclose(xyz, direction, rtol=0.0, atol=1e-9)
        finding = "it has no axis, which means 1 0 0" if xyz is None else f"its axis is {xyz}"
        (axis or node).require(is_z, "planar-axis", seen=finding)
    elif kind not in ("fixed", "floating"):
        if axis is None or xyz is None:
            node.warn("it has no axis; 1 0 0 is used, the default of URDF")
        else:
            direction = unit_axis(xyz, axis)
    if follows is not None:
        leader = follows.attributes.get("joint", "")
        follows.require(leader != "", "mimic-leader")
        mimic = Mimic(name, leader, follows.number("multiplier", 1.0), follows.number("offset", 0.0))
    return UrdfJoint(name, node, kind, ends[0], ends[1], pose, direction, limit, mimic, follows)


def _narrow_limit(node: XmlNode, limit: UrdfLimit, controls: Sequence[XmlNode]) -> UrdfLimit:
    """Return the limit, narrowed to the range that the arm's driver allows.

    The safety controller has soft limits, whose default of 0 for both means none; ros2_control has parameters of the
    joint, or `min` and `max` of its command interfaces. A range that contradicts itself or the limit is ignored.
    """
    ranges: list[tuple[str, str, float, float]] = []
    if (safety := _only(node, "safety_controller")) is not None:
        low, high = (safety.number(f"soft_{end}_limit") for end in ("lower", "upper"))
        ranges.append(("safety_controller", "limits", low, high))
    for control in controls:
        stated: dict[str, float] = {}
        for holder in (control, *control.all("command_interface")):
            quantity = "" if holder is control else f"_{holder.attributes.get('name')}"
            for param in holder.all("param"):
                number, key = "".join(param.texts).strip(), param.attributes.get("name", "").removesuffix("_value")
                if text.NUMBER_TEXT.fullmatch(number):  # xacro may leave other texts behind
                    stated[key + quantity] = float(number)
        fastest = min(stated.get("max_velocity", math.inf), -stated.get("min_velocity", -math.inf))
        low, high = (stated.get(f"{end}_position", math.nan) for end in ("min", "max"))
        ranges += [("ros2_control", "limits", low, high), ("ros2_control", "velocities", -fastest, fastest)]
    for source, quantity, low, high in ranges:
        is_speed = quantity == "velocities"
        lower, upper = (-limit.velocity, limit.velocity) if is_speed else (limit.lower, limit.upper)
        narrow = max(low, lower), min(high, upper)
        if low < high and lower < upper and narrow != (lower, upper) and narrow[0] < narrow[1]:  # False for nan
            finding = f"its {source} allows {narrow[0]:g} ... {narrow[1]:g} of the {quantity} {lower:g} ... {upper:g}"
            node.warn(f"{finding}: the narrower range is used")
            changed = {"velocity": narrow[1]} if is_speed else {"lower": narrow[0], "upper": narrow[1]}
            limit = limit._replace(**changed)
    return limit


def read_name(node: XmlNode) -> str:
    """Return the name of an element.

    Args:
        node: The element.

    Raises:
        RobotError: The name is missing or invalid; codes `name-missing`, `name-long`, `name-unprintable`,
            `name-reserved`.
    """
    name = node.attributes.get("name", "")
    faults = {"missing": not name.strip(), "long": len(name) > LONGEST_NAME, "unprintable": not name.isprintable()}
    for fault, is_there in (faults | {"reserved": name in RESERVED}).items():
        values = {"name": name, "length": len(name), "most": LONGEST_NAME}
        node.log.require(not is_there, f"name-{fault}", node.line, f"<{node.tag}>: ", **values)
    if name != name.strip():
        node.log.warn(node.line, f"{node.tag} {name!r} has spaces around its name; they are part of the name")
    return name


def near_vector(node: XmlNode, attribute: str) -> Vector:
    """Return the position (3 numbers) in an attribute [m], zero if there is no such attribute; refuse a huge one.

    Args:
        node: The element.
        attribute: Name of the attribute.

    Raises:
        RobotError: The position is invalid or too far away; codes `number`, `not-finite`, `vector-size`, `far-away`.
    """
    x, y, z = node.vector(attribute, 3) or ZERO
    # beyond 1e6 m poses are less accurate than 1e-9 m
    node.require(max(abs(x), abs(y), abs(z)) <= 1e6, "far-away", tag=node.tag, key=attribute, seen=(x, y, z))
    return (x, y, z)


def _pose(node: XmlNode) -> Pose:
    """Return the pose of an element's `<origin>`."""
    origin = _only(node, "origin")
    if origin is None:
        return Pose()
    roll, pitch, yaw = origin.vector("rpy", 3) or ZERO
    if max(abs(roll), abs(pitch), abs(yaw)) > 2.0 * math.pi + 1e-3:  # [rad] margin for rounded files
        origin.warn(f"origin rpy is {(roll, pitch, yaw)}, more than a full turn: degrees instead of radians?")
    return Pose(near_vector(origin, "xyz"), (roll, pitch, yaw))


def unit_axis(xyz: tuple[float, ...], axis: XmlNode) -> Vector:
    """Normalise the axis of a joint to unit length.

    Args:
        xyz: Axis (3,) as in the file.
        axis: Its XML element, for warnings and errors.

    Returns:
        Unit vector (3,).

    Raises:
        RobotError: The axis cannot be normalised; codes `axis-zero`, `axis-norm`.
    """
    norm = math.hypot(*xyz)
    axis.require(norm > 0.0, "axis-zero")
    axis.require(1e-3 <= norm <= 1e3, "axis-norm", xyz=xyz, norm=norm)  # outside, the direction may be noise
    if abs(norm - 1.0) > 1e-3:
        axis.warn(f"its axis {xyz} has length {norm:.4g}; only the direction is used")
    x, y, z = (c / norm + 0.0 for c in xyz)
    return (x, y, z)


def _only(node: XmlNode, tag: str) -> XmlNode | None:
    """Return the only child with a tag, after a warning about unread parts; None if there is none."""
    matches = node.all(tag)
    if len(matches) > 1:
        raise matches[1].refusal("element-twice", f"it has more than one <{tag}>; one is expected; delete all but one")
    return _warn_of_unread(matches[0]) if matches else None


def _warn_of_unread(node: XmlNode) -> XmlNode:
    """Warn about attributes and elements inside that are not read; return the element."""
    unknown = [k for k in node.attributes if k not in KNOWN_ATTRIBUTES.get(node.tag, node.attributes)]
    if unknown:
        is_turned = node.tag == "origin" and any("quat" in k for k in unknown)
        node.require(not is_turned, "origin-attribute", seen=quoted(unknown))
        node.warn(f"<{node.tag}> has {quoted(unknown)}, which is ignored")
    tags = KNOWN_CHILDREN.get(node.tag, ())
    for child in [c for c in node.children if tags and c.tag not in tags]:
        is_reported = len(node.log.kept) < text.MAX_WARNINGS
        near = closest_names(shorten(child.tag).lower(), tags, n=1) if is_reported else ()
        child.warn(f"<{shorten(child.tag)}> is ignored" + (f"; did you mean <{near[0]}>?" if near else ""))
    return node


def validate_parts(
    name: str, links: Sequence[UrdfLink], joints: Sequence[UrdfJoint], locked: Collection[str], log: Diagnostics
) -> UrdfFile:
    """Check links and joints of any format against each other: they form one tree; mimic joints and limits are valid.

    Args:
        name: Name of the robot.
        links: All links.
        joints: All joints.
        locked: Names of joints that will be locked; their limits and leaders are not checked.
        log: Collector of warnings, which makes the errors.

    Returns:
        The validated description.

    Raises:
        RobotError: The description is invalid; codes `no-links`, `duplicate-link`, `duplicate-joint`, `unknown-link`,
            `self-loop`, `two-parents`, `no-root`, `many-roots`, `detached`, `too-many-links`, `too-many-joints`,
            `too-deep`, `too-many-dof`, `mimic-*`, `limit-*`.
    """
    log.require(len(links) > 0, "no-links", 1)
    # largest numbers of degrees of freedom (Pinocchio's memory grows with the cube: 0.22 GB for these), of links and of
    # joints (loading takes seconds for these), and of links in a chain (Pinocchio recurses, and crashes at thousands)
    most_nv, most_elements, most_depth = 150, 1_000, 500
    nv = sum(j.nv for j in joints)
    log.require(nv <= most_nv, "too-many-dof", None, nv=nv, most=most_nv)
    for elements, tag in ((links, "link"), (joints, "joint")):
        first: dict[str, int | None] = {}
        for e in elements:
            if len(first) >= most_elements:
                fix = f"at most {most_elements} work; remove parts that the arm does not need"
                finding = f"the robot has {len(elements)} <{tag}> elements"
                raise log.refusal(f"too-many-{tag}s", e.node.line, f"{finding}; {fix}")
            if e.name in first:
                place = f" on line {first[e.name]}" if first[e.name] else ""
                finding = f"the name is already used{place}; names must be unique; rename one of the two"
                raise log.refusal(f"duplicate-{tag}", e.node.line, f"{tag} {e.name!r}: {finding}")
            first[e.name] = e.node.line
    names, above, below = {link.name for link in links}, dict[str, str](), dict[str, list[str]]()
    for j in joints:
        for role, link in (("parent", j.parent), ("child", j.child)):
            if link not in names:
                fix = suggest_name(link, names, "add the link or correct the name")
                raise j.node.refusal("unknown-link", f"its {role} link {link!r} does not exist; {fix}")
        j.node.require(j.parent != j.child, "self-loop", link=j.child)
        j.node.require(j.child not in above, "two-parents", link=j.child, other=above.get(j.child))
        above[j.child] = j.name
        below.setdefault(j.parent, []).append(j.child)
    roots = [link for link in links if link.name not in above]
    if not roots:
        fix = f"remove the joint that closes the loop, e.g. {joints[-1].name!r}"
        sentence = f"every link is the child of a joint, so they form a loop; one without a parent is expected; {fix}"
        raise log.refusal("no-root", joints[0].node.line, sentence)
    if len(roots) > 1:
        log.require(False, "many-roots", roots[1].node.line, names=quoted([r.name for r in roots]), other=roots[1].name)
    reached, depth = [roots[0].name], {roots[0].name: 0}
    for link in reached:  # the list grows during the loop
        reached += below.get(link, ())
        depth |= dict.fromkeys(below.get(link, ()), depth[link] + 1)
    log.require(max(depth.values()) <= most_depth, "too-deep", None, most=most_depth)
    if detached := [link for link in links if link.name not in depth]:
        log.require(False, "detached", detached[0].node.line, names=quoted([link.name for link in detached]))
    followers, resting = resolve_mimics(joints, locked, log)
    still = {*locked, *resting, *(m.joint for m in followers if m.leader in locked)}
    _check_limits([j for j in joints if j.nv == 1 and j.name not in still], {m.joint: m.leader for m in followers})
    if nv == 0:
        log.warn(None, "no joint moves")
    return UrdfFile(name, tuple(links), tuple(joints), roots[0].name, followers, resting, log.warnings)


def resolve_mimics(
    joints: Sequence[UrdfJoint], alone: Collection[str], log: Diagnostics
) -> tuple[tuple[Mimic, ...], dict[str, float]]:
    """Replace chains of mimic joints by direct ones: each mimic joint gets the independent joint at the chain's end.

    Args:
        joints: All joints, in any order.
        alone: Names of joints that are locked by the user; their leaders are ignored.
        log: Collector of warnings, which makes the errors.

    Returns:
        Mimic joints with independent, moving leaders; and the position of each mimic joint whose chain ends at a fixed
        joint [rad or m].

    Raises:
        RobotError: A mimic is invalid; codes `mimic-unknown`, `mimic-cycle`, `mimic-type`, `mimic-multiplier`.
    """
    by_name, followers, resting = {j.name: j for j in joints}, list[Mimic](), dict[str, float]()
    if without_effect := [j.name for j in joints if j.mimic is not None and j.type == "fixed"]:
        log.warn(None, f"<mimic> of the fixed joints {quoted(without_effect)} has no effect")
    follows = {j.name: j.mimic for j in joints if j.mimic is not None and j.type != "fixed"}
    # a locked follower whose leader exists still belongs to its chain: locking it alone would break the coupling
    follows = {name: mimic for name, mimic in follows.items() if name not in alone or mimic.leader in by_name}
    for name in follows:
        leader, multiplier, offset, chain = by_name[name], 1.0, 0.0, list[str]()
        element = leader.mimic_node or leader.node
        while True:
            chain.append(leader.name)
            leader.node.require(leader.nv <= 1, "mimic-type", type=leader.type, nv=leader.nv)
            if (mimic := follows.get(leader.name)) is None:
                break
            node = leader.mimic_node or leader.node
            offset += multiplier * mimic.offset
            multiplier *= mimic.multiplier
            if mimic.leader not in by_name:
                fix = suggest_name(mimic.leader, by_name, "correct the name, or lock the joint")
                finding = f"it follows the joint {mimic.leader!r}, which does not exist"
                raise node.refusal("mimic-unknown", f"{finding}; {fix}")
            leader = by_name[mimic.leader]
            if leader.name in chain:
                path = " -> ".join(map(repr, [*chain, leader.name][:6]))
                sentence = f"joints follow each other in a loop: {path}; let one of them move by itself"
                raise log.refusal("mimic-cycle", node.line, f"joint {name!r}: {sentence}")
        # for larger multipliers, rounding of the leader's position moves the follower
        is_usable = abs(multiplier) <= 1e6 and math.isfinite(offset)
        element.require(is_usable, "mimic-multiplier", leader=leader.name, by=multiplier)
        finding = f"joint {name!r} follows the {leader.type} joint {leader.name!r}"
        if leader.type == "fixed":
            resting[name] = offset
            log.warn(element.line, f"{finding}; it rests at {offset:g}")
            continue
        followers.append(Mimic(name, leader.name, multiplier, offset))
        if multiplier == 0.0:
            log.warn(element.line, f"{finding} by the factor 0: it never moves")
        elif leader.type == "continuous" and multiplier != round(multiplier):
            jumps = "it jumps where the leader passes half a turn, unless postures are given as joint positions"
            log.warn(element.line, f"{finding} by the factor {multiplier:g}: {jumps}")
    return tuple(followers), resting


def _limit_fault(joint: UrdfJoint) -> str:
    """Return the code of limits that cannot be intended (`limit-order`, `limit-degrees`), or an empty text."""
    (lower, upper, *_), is_angle = joint.limit, joint.type != "prismatic"
    if joint.type == "continuous" or math.isnan(lower + upper):
        return ""
    is_many = is_angle and 4.0 * math.pi < max(abs(lower), abs(upper)) <= UNLIMITED  # no arm turns twice each way
    return "limit-order" if not lower < upper else "limit-degrees" if is_many else ""


def _check_limits(joints: Sequence[UrdfJoint], leaders: Mapping[str, str]) -> None:
    """Refuse limits that cannot be intended, and warn about limits without effect.

    Args:
        joints: Joints that move, of one degree of freedom each.
        leaders: Follower -> its leader, which would be locked instead.
    """
    faults = {j.name: _limit_fault(j) for j in joints}
    for joint in joints:
        (lower, upper, velocity, _, stated), is_angle = joint.limit, joint.type != "prismatic"
        node, unit, largest = stated or joint.node, "rad" if is_angle else "m", max(abs(lower), abs(upper))
        lacking = [end for end, value in (("lower limit", lower), ("upper limit", upper)) if math.isnan(value)]
        if lacking and joint.type != "continuous":
            # the specification's default of 0 would be a limit that the file does not state
            missing = lacking[0] if len(lacking) == 1 else "limits"
            node.warn(f"it has no {missing}, which a {joint.type} joint should have; it is unlimited")
        elif joint.type != "continuous" and UNLIMITED < largest < math.inf:  # infinity already means no limit
            node.warn(f"its limit of {largest:.3g} {unit} is ignored as too large; it is unlimited")
        if code := faults[joint.name]:
            names = [name for name, fault in faults.items() if fault == code]
            facts: dict[str, object] = {"lower": lower, "upper": upper, "unit": unit}
            facts |= {"low": math.radians(lower), "high": math.radians(upper)}
            facts["likewise"] = f", and the limits of {quoted(names[1:])} are wrong too" if names[1:] else ""
            facts["locks"] = quoted(list(dict.fromkeys(leaders.get(name, name) for name in names)))
            facts["compiler"] = "" if stated else ', or angle="degree" in <compiler>'  # MJCF has no element <limit>
            facts["otherwise"] = f'type="{"continuous" if is_angle else "fixed"}"' if stated else 'limited="false"'
            node.require(False, code, **facts)
        if math.isnan(velocity) and (joint.type != "continuous" or stated is not None):
            node.warn("no velocity limit; its velocity is unlimited")
        elif velocity <= 0.0:
            node.warn(f"its velocity limit of {velocity:g} {unit}/s is ignored; its velocity is unlimited")


def kinematic_urdf(urdf: UrdfFile, visuals: Mapping[str, Sequence[str]] | None = None) -> str:
    """Return a robot description as URDF text: joints, limits and inertias.

    Args:
        urdf: A validated description.
        visuals: Link name -> texts of its `<visual>` elements; `<mimic>` elements are then written too. None: neither
            is written, so that Pinocchio loads mimic joints as independent joints.
    """
    parts = [f"<robot name={quoteattr(urdf.name)}>"]
    for link in urdf.links:
        inside = "".join((visuals or {}).get(link.name, ()))
        if link.inertia is not None:
            entries = " ".join(f'{key}="{value!r}"' for key, value in zip(INERTIA, link.inertia, strict=True))
            pose = f'{origin_text(link.pose)}<mass value="{link.mass!r}"/>'
            inside = f"<inertial>{pose}<inertia {entries}/></inertial>{inside}"
        parts.append(f"<link name={quoteattr(link.name)}>{inside}</link>")
    for joint in urdf.joints:
        limit, more = joint.limit, ""
        if joint.nv == 1:  # comparisons with nan, a missing number, are False
            lower = limit.lower if abs(limit.lower) <= UNLIMITED else -HUGE
            upper = limit.upper if abs(limit.upper) <= UNLIMITED else HUGE
            if lower >= upper:  # a locked joint: otherwise validation would have refused it
                lower, upper = -HUGE, HUGE
            velocity = min(limit.velocity, HUGE) if limit.velocity > 0.0 else HUGE
            effort = limit.effort if limit.effort >= 0.0 else HUGE
            more = f'<limit lower="{lower!r}" upper="{upper!r}" velocity="{velocity!r}" effort="{effort!r}"/>'
        if visuals is not None and (m := joint.mimic) is not None:
            more += f'<mimic joint={quoteattr(m.leader)} multiplier="{m.multiplier!r}" offset="{m.offset!r}"/>'
        parts.append(
            f'<joint name={quoteattr(joint.name)} type="{joint.type}">{origin_text(joint.pose)}'
            f"<parent link={quoteattr(joint.parent)}/><child link={quoteattr(joint.child)}/>"
            f'<axis xyz="{join_numbers(joint.axis)}"/>{more}</joint>'
        )
    return "\n".join([*parts, "</robot>"])


def join_numbers(numbers: Iterable[float]) -> str:
    """Return numbers as the text of an XML attribute, without loss of precision.

    Args:
        numbers: The numbers.
    """
    return " ".join(map(repr, numbers))


def origin_text(pose: Pose) -> str:
    """Return the `<origin>` element of a pose.

    Args:
        pose: Translation [m] and angles [rad].
    """
    return f'<origin xyz="{join_numbers(pose.xyz)}" rpy="{join_numbers(pose.rpy)}"/>'
