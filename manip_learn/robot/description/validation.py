"""Reading of a URDF: each element is checked where it is read, and all of them against each other.

Nothing reaches Pinocchio, from whatever format, that has not been read, counted and checked here.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np

from manip_learn.errors import advice, closest_names
from manip_learn.robot.description.text import (
    LARGEST_READ,
    MAX_WARNINGS,
    NUMBER_TEXT,
    RULES,
    Diagnostics,
    XmlNode,
    meant,
    only_macros,
    quoted,
    shortened,
)
from manip_learn.robot.description.urdf import (
    DEGREES_OF_FREEDOM,
    INERTIA,
    UNLIMITED,
    ZERO,
    Pose,
    UrdfFile,
    UrdfInertial,
    UrdfJoint,
    UrdfLimit,
    UrdfLink,
    UrdfMimic,
    Vector,
    X,
)
from manip_learn.robot.joints import Mimic

KNOWN_ATTRIBUTES = {
    "origin": {"xyz", "rpy"},
    "axis": {"xyz"},
    "limit": {"lower", "upper", "velocity", "effort", "acceleration", "deceleration", "jerk"},
    "mimic": {"joint", "multiplier", "offset"},
    "parent": {"link"},
    "child": {"link"},
}
KNOWN_CHILDREN = {
    "robot": {"link", "joint", "material", "transmission", "gazebo", "sensor", "ros2_control", "group"},
    "joint": {"origin", "parent", "child", "axis", "limit", "dynamics", "mimic", "safety_controller", "calibration"},
    "link": {"inertial", "visual", "collision", "contact", "self_collision_checking", "sensor", "verbose"},
    "inertial": {"origin", "mass", "inertia"},
}
LONGEST_NAME = 200  # [characters] longer ones make no readable sentence
RESERVED = ("universe",)
MAX_LINKS = 1_000  # loading takes seconds for them
MAX_DEPTH = 500  # Pinocchio recurses, and crashes at some thousands
MAX_NV = 150  # Pinocchio's memory grows with the cube: 0.22 GB for these


@final
@dataclass(frozen=True)
class ValidatedRobot:
    """A robot description that has been validated.

    Attributes:
        urdf: Links and joints.
        followers: Mimic joints, each with an independent, moving leader.
        resting: Position of each mimic joint that follows a fixed joint in the end [rad or m].
        warnings: What is odd but harmless, in sentences.
    """

    urdf: UrdfFile
    followers: tuple[Mimic, ...]
    resting: dict[str, float]
    warnings: tuple[str, ...]


def validate_urdf(root: XmlNode, locked: Collection[str] = ()) -> ValidatedRobot:
    """Read and check a URDF.

    Args:
        root: Its root element.
        locked: Joints that will not move: their limits and what they follow do not matter.

    Raises:
        RobotError: With a `code`, the file, the line, the joint or link, the value seen and the fix.
    """
    if root.tag != "robot":
        kinds = {"sdf": "an SDF file", "mujoco": "an MJCF file", "COLLADA": "a mesh", "launch": "a ROS launch file"}
        seen = f"the root element is <{shortened(root.tag)}>" + (f", {kinds[root.tag]}" if root.tag in kinds else "")
        raise root.log.refusal("not-urdf", root.line, f"{seen}; <robot> is expected; convert it to URDF")
    version = root.attributes.get("version", "1.0").strip()
    root.require(version in ("1", "1.0"), "urdf-version", version=shortened(version))
    foreign = [c for c in root.children if c.tag.startswith("xacro:") or c.tag in ("macro", "include")]
    macros = [c.attributes.get("name", "") for c in foreign if c.tag.removeprefix("xacro:") == "macro"]
    if foreign and macros and root.first("link") is None:
        raise foreign[0].refusal("no-links", only_macros(macros))
    if foreign:
        fix = "expand it" + advice(", or name the file *.xacro and load it with {}", "xacro=True", "--xacro")
        seen = f"<{shortened(foreign[0].tag)}> is xacro, not URDF; plain URDF is expected"
        raise foreign[0].refusal("xacro", f"{seen}; {fix}")
    _look_through(root)
    links = tuple(map(read_link, root.all("link")))
    controls = [joint for block in root.all("ros2_control") for joint in block.all("joint")]
    joints = tuple(read_joint(node, controls) for node in root.all("joint"))
    return validate_parts(robot_name(root), links, joints, locked, root.log)


def validate_parts(
    name: str, links: tuple[UrdfLink, ...], joints: tuple[UrdfJoint, ...], locked: Collection[str], log: Diagnostics
) -> ValidatedRobot:
    """Check links and joints, from whatever format, against each other."""
    urdf = UrdfFile(name, links, joints, root_of_tree(links, joints, log))
    followers, resting = resolve_mimics(joints, locked, log)
    still = {*locked, *resting, *(m.joint for m in followers if m.leader in locked)}
    for joint in joints:
        if joint.name not in still and joint.nv == 1:
            _check_limits(joint)
    if not any(j.nv for j in joints):
        log.warn(None, "no joint moves")
    return ValidatedRobot(urdf, followers, resting, log.warnings)


def robot_name(root: XmlNode, attribute: str = "name") -> str:
    """Return the name of a robot, or the name of its file, with a warning, where it has none that can be printed."""
    name = root.attributes.get(attribute, "").strip()
    if not name or not name.isprintable() or len(name) > LONGEST_NAME:
        reason = "has no name" if not name else f"has the unusable name {shortened(name)!r}"
        name = "".join(c for c in root.log.path.stem if c.isprintable()) or "robot"
        root.log.warn(root.line, f"the robot {reason}; it is called {quoted([name])} after its file")
    return name


def read_link(node: XmlNode) -> UrdfLink:
    """Read a link and its inertia.

    Raises:
        RobotError: Codes `name-*`, `number`, `not-finite`, `vector-size`, `mass`, `element-twice`.
    """
    name = read_name(node)
    inertial = _only(_look_through(node), "inertial")
    if inertial is None:
        return UrdfLink(name, node)
    mass_node, inertia = _only(inertial, "mass"), _only(inertial, "inertia")
    mass = None if mass_node is None else mass_node.number("value")
    if mass is None:
        inertial.warn("its <inertial> gives no mass; 0 kg is taken")
    (mass_node or inertial).require((mass or 0.0) >= 0.0, "mass", mass=mass)
    entries = [0.0 if inertia is None else inertia.number(key, 0.0) for key in INERTIA]
    xx, xy, xz, yy, yz, zz = entries
    smallest = float(np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])[0])
    if inertia is not None and smallest < -1e-9 * max(1.0, *map(abs, entries)):
        inertia.warn(f"its inertia is not positive ({smallest:.3g} kg m^2); unused here")
    return UrdfLink(name, node, UrdfInertial(_pose(inertial), mass or 0.0, tuple(entries)))


def read_joint(node: XmlNode, controls: Sequence[XmlNode] = ()) -> UrdfJoint:
    """Read a joint with its pose, unit axis, limit and mimic.

    Args:
        node: Its element.
        controls: The `<joint>` elements inside `<ros2_control>`, of all joints.

    Raises:
        RobotError: Codes `name-*`, `joint-type`, `joint-link`, `axis-*`, `planar-axis`, `number`, `not-finite`, ...
    """
    name, kind = read_name(node), node.attributes.get("type", "")
    _look_through(node)
    if kind not in DEGREES_OF_FREEDOM:
        seen = f"its type is {shortened(kind)!r}" if kind else "it has no type"
        fix = meant(kind.strip().lower(), DEGREES_OF_FREEDOM, "correct the type")
        raise node.refusal("joint-type", f"{seen}; one of {', '.join(DEGREES_OF_FREEDOM)} is expected; {fix}")
    limits, limit = _only(node, "limit"), None
    follows, mimic = _only(node, "mimic"), None
    if limits is not None:
        limit = UrdfLimit(limits, *(limits.number(key) for key in ("lower", "upper", "velocity", "effort")))
    ends = []
    for tag in ("parent", "child"):
        end = _only(node, tag)
        ends.append("" if end is None else end.attributes.get("link", ""))
        node.require(ends[-1] != "", "joint-link", tag=tag)
    pose, axis, direction = _pose(node), _only(node, "axis"), X
    given = None if axis is None else axis.vector("xyz", 3)
    if kind == "planar":
        direction = (0.0, 0.0, 1.0)
        is_z = given is not None and np.allclose(given, direction, rtol=0.0, atol=1e-9)
        seen = "it has no axis, which means 1 0 0" if given is None else f"its axis is {given}"
        (axis or node).require(is_z, "planar-axis", seen=seen)
    elif kind not in ("fixed", "floating"):
        if axis is None or given is None:
            node.warn("it has no axis; 1 0 0 is taken, which is the default of URDF")
        else:
            direction = unit_axis(given, axis)
    if limit is not None:
        limit = _narrowed(node, limit, [c for c in controls if c.attributes.get("name") == name])
    if follows is not None:
        leader = follows.attributes.get("joint", "")
        follows.require(leader != "", "mimic-leader")
        mimic = UrdfMimic(follows, leader, follows.number("multiplier", 1.0), follows.number("offset", 0.0))
    return UrdfJoint(name, node, kind, ends[0], ends[1], pose, direction, limit, mimic)


def _narrowed(node: XmlNode, limit: UrdfLimit, controls: Sequence[XmlNode]) -> UrdfLimit:
    """Return the limit, narrowed to the range in which the arm's driver lets the joint move.

    The safety controller states soft limits, whose default of 0 for both means none; ros2_control parameters of the
    joint, or `min` and `max` of what it commands. A range that contradicts itself or the limit says nothing.
    """
    ranges: list[tuple[str, str, float | None, float | None]] = []
    if (safety := _only(node, "safety_controller")) is not None:
        soft = (safety.number(f"soft_{end}_limit") for end in ("lower", "upper"))
        ranges.append(("safety_controller", "limits", *soft))
    for control in controls:
        stated: dict[str, float] = {}
        for holder in (control, *control.all("command_interface")):
            quantity = "" if holder is control else f"_{holder.attributes.get('name')}"
            for param in holder.all("param"):
                text, key = "".join(param.texts).strip(), param.attributes.get("name", "").removesuffix("_value")
                if NUMBER_TEXT.fullmatch(text) and abs(float(text)) <= LARGEST_READ:  # else e.g. left over by xacro
                    stated[key + quantity] = float(text)
        fastest = min(stated.get("max_velocity", math.inf), -stated.get("min_velocity", -math.inf))
        ranges.append(("ros2_control", "limits", stated.get("min_position"), stated.get("max_position")))
        ranges.append(("ros2_control", "velocities", -fastest, fastest))
    for source, quantity, low, high in ranges:
        lower, upper = limit.lower, limit.upper
        if quantity == "velocities":
            lower, upper = None if limit.velocity is None else -limit.velocity, limit.velocity
        if low is None or high is None or lower is None or upper is None or not low < high:
            continue
        narrow = max(low, lower), min(high, upper)
        if narrow != (lower, upper) and narrow[0] < narrow[1]:
            seen = f"its {source} allows {narrow[0]:g} ... {narrow[1]:g} of the {quantity} {lower:g} ... {upper:g}"
            node.warn(f"{seen}: the narrower ones are used")
            is_velocity = quantity == "velocities"
            limit = (
                replace(limit, velocity=narrow[1]) if is_velocity else replace(limit, lower=narrow[0], upper=narrow[1])
            )
    return limit


def read_name(node: XmlNode) -> str:
    """Return the name of an element.

    Raises:
        RobotError: Codes `name-missing`, `name-long`, `name-unprintable`, `name-reserved`.
    """
    name = node.attributes.get("name", "")
    faults = {
        "name-missing": not name.strip(),
        "name-long": len(name) > LONGEST_NAME,
        "name-unprintable": not name.isprintable(),
        "name-reserved": name in RESERVED,
    }
    for code in (code for code, is_there in faults.items() if is_there):
        sentence = RULES[code].format(name=name, length=len(name), most=LONGEST_NAME)
        raise node.log.refusal(code, node.line, f"<{node.tag}>: {sentence}")
    if name != name.strip():
        node.log.warn(node.line, f"{node.tag} {name!r} has spaces around its name, they count")
    return name


def near_vector(node: XmlNode, attribute: str) -> Vector:
    """Return a position [m] in an attribute, zero if there is none.

    Raises:
        RobotError: Codes `number`, `not-finite`, `vector-size`, `far-away`.
    """
    x, y, z = node.vector(attribute, 3) or ZERO
    # [m] beyond it poses keep less than 1e-9 m
    node.require(max(abs(x), abs(y), abs(z)) <= 1e6, "far-away", tag=node.tag, key=attribute, seen=(x, y, z))
    return (x, y, z)


def _pose(node: XmlNode) -> Pose:
    origin = _only(node, "origin")
    if origin is None:
        return Pose()
    roll, pitch, yaw = origin.vector("rpy", 3) or ZERO
    if max(abs(roll), abs(pitch), abs(yaw)) > 2.0 * math.pi + 1e-3:  # [rad] files round
        origin.warn(f"origin rpy is {(roll, pitch, yaw)}, more than a full turn: degrees in place of radians?")
    return Pose(near_vector(origin, "xyz"), (roll, pitch, yaw))


def unit_axis(xyz: tuple[float, ...], axis: XmlNode) -> Vector:
    """Return the direction of an axis.

    Raises:
        RobotError: Codes `axis-zero`, `axis-norm`.
    """
    norm = math.hypot(*xyz)
    axis.require(norm > 0.0, "axis-zero")
    axis.require(1e-3 <= norm <= 1e3, "axis-norm", xyz=xyz, norm=norm)  # outside, the direction may be noise
    if abs(norm - 1.0) > 1e-3:
        axis.warn(f"its axis {xyz} has length {norm:.4g}; only the direction is used")
    x, y, z = (c / norm + 0.0 for c in xyz)
    return (x, y, z)


def _only(node: XmlNode, tag: str) -> XmlNode | None:
    """Return the child with that tag, looked through; None if there is none."""
    found = node.all(tag)
    if len(found) > 1:
        raise found[1].refusal("element-twice", f"it has more than one <{tag}>; one is expected; delete all but one")
    return _look_through(found[0]) if found else None


def _look_through(node: XmlNode) -> XmlNode:
    """Warn about attributes and elements inside that are not read."""
    unknown = [k for k in node.attributes if k not in KNOWN_ATTRIBUTES.get(node.tag, node.attributes)]
    if unknown:
        node.require(
            node.tag != "origin" or not any("quat" in k for k in unknown), "origin-attribute", seen=quoted(unknown)
        )
        node.warn(f"<{node.tag}> has {quoted(unknown)}, which is ignored")
    known = KNOWN_CHILDREN.get(node.tag)
    where = "" if node.tag == "robot" else f"{node.where}: "
    for child in node.children if known is not None else ():
        if child.tag not in known:
            near = closest_names(shortened(child.tag).lower(), known, n=1) if len(node.log.kept) < MAX_WARNINGS else ()
            hint = f"; did you mean <{near[0]}>?" if near else ""
            node.log.warn(child.line, f"{where}<{shortened(child.tag)}> is ignored{hint}")
    return node


def root_of_tree(links: Sequence[UrdfLink], joints: Sequence[UrdfJoint], log: Diagnostics) -> str:
    """Return the name of the root link.

    Raises:
        RobotError: Codes `no-links`, `duplicate-link`, `duplicate-joint`, `unknown-link`, `self-loop`, `two-parents`,
            `no-root`, `many-roots`, `detached`, `too-many-links`, `too-deep`, `too-many-dof`.
    """
    if not links:
        sentence = "the robot has no <link>; at least one is expected; is it a xacro file, or cut off?"
        raise log.refusal("no-links", 1, sentence)
    for elements, tag in ((links, "link"), (joints, "joint")):
        if len(elements) > MAX_LINKS:
            fix = f"at most {MAX_LINKS} work; leave out what the arm does not need"
            sentence = f"the robot has {len(elements)} <{tag}> elements; {fix}"
            raise log.refusal(f"too-many-{tag}s", elements[MAX_LINKS].node.line, sentence)
    nv = sum(j.nv for j in joints)
    if nv > MAX_NV:
        sentence = f'the robot has {nv} degrees of freedom; at most {MAX_NV} work; make unused joints type="fixed"'
        raise log.refusal("too-many-dof", None, sentence)
    for elements, tag in ((links, "link"), (joints, "joint")):
        first: dict[str, int] = {}
        for e in elements:
            if e.name in first:
                seen = f"{tag} {e.name!r}: the name is already used on line {first[e.name]}"
                sentence = f"{seen}; names must be unique; rename one of the two"
                raise log.refusal(f"duplicate-{tag}", e.node.line, sentence)
            first[e.name] = e.node.line
    names, above, below = {link.name for link in links}, dict[str, str](), dict[str, list[str]]()
    for j in joints:
        for role, link in (("parent", j.parent), ("child", j.child)):
            if link not in names:
                fix = meant(link, names, "add the link or correct the name")
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
        fix = f"join {roots[1].name!r} to the rest by a joint, or delete it"
        sentence = f"the links {quoted([r.name for r in roots])} have no parent; one such link is expected; {fix}"
        raise log.refusal("many-roots", roots[1].node.line, sentence)
    reached, depth = [roots[0].name], {roots[0].name: 0}
    for name in reached:  # which grows meanwhile
        reached += below.get(name, ())
        depth |= dict.fromkeys(below.get(name, ()), depth[name] + 1)
    if max(depth.values()) > MAX_DEPTH:
        sentence = f"the tree of links is more than {MAX_DEPTH} joints deep; merge links that are fixed to each other"
        raise log.refusal("too-deep", None, sentence)
    lost = [link for link in links if link.name not in depth]
    if lost:
        fix = "remove the joint that closes the loop and connect it to the rest"
        sentence = f"{quoted([link.name for link in lost])} form a loop that is not connected to the root; {fix}"
        raise log.refusal("detached", lost[0].node.line, sentence)
    return roots[0].name


def resolve_mimics(
    joints: Sequence[UrdfJoint], alone: Collection[str], log: Diagnostics
) -> tuple[tuple[Mimic, ...], dict[str, float]]:
    """Follow every chain of mimics to its end, in whatever order the joints come.

    Args:
        joints: All joints.
        alone: Joints that are locked by name: what they follow does not matter.
        log: For warnings and refusals.

    Returns:
        Mimic joints with independent, moving leaders, however long the chains were; and the position of each whose
        chain ends at a fixed joint [rad or m].

    Raises:
        RobotError: Codes `mimic-unknown`, `mimic-cycle`, `mimic-type`, `mimic-multiplier`.
    """
    by_name, mimics = {j.name: j for j in joints}, {j.name: j.mimic for j in joints if j.mimic is not None}
    if without_effect := [name for name in mimics if by_name[name].type == "fixed"]:
        log.warn(None, f"<mimic> of the fixed joints {quoted(without_effect)} has no effect")
    # a locked follower whose leader exists still belongs to its chain: locking it alone would break the coupling
    held = {*without_effect, *(name for name in alone if name in mimics and mimics[name].leader not in by_name)}
    mimics = {name: mimic for name, mimic in mimics.items() if name not in held}
    followers, resting = list[Mimic](), dict[str, float]()
    for name, own in mimics.items():
        leader, multiplier, offset, chain = by_name[name], 1.0, 0.0, [name]
        leader.node.require(leader.nv <= 1, "mimic-type", type=leader.type, nv=leader.nv)
        while (mimic := mimics.get(leader.name)) is not None:
            offset += multiplier * mimic.offset
            multiplier *= mimic.multiplier
            if mimic.leader not in by_name:
                fix = meant(mimic.leader, by_name, "correct the name, or lock the joint")
                seen = f"it follows the joint {mimic.leader!r}, which does not exist"
                raise mimic.node.refusal("mimic-unknown", f"{seen}; {fix}")
            leader = by_name[mimic.leader]
            leader.node.require(leader.nv <= 1, "mimic-type", type=leader.type, nv=leader.nv)
            if leader.name in chain:
                path = " -> ".join(map(repr, [*chain, leader.name][:6]))
                sentence = f"joints follow each other in a loop: {path}; let one of them move by itself"
                raise log.refusal("mimic-cycle", mimic.node.line, f"joint {name!r}: {sentence}")
            chain.append(leader.name)
        # above it, rounding of the leader is a motion of the follower
        is_usable = abs(multiplier) <= 1e6 and math.isfinite(offset)
        own.node.require(is_usable, "mimic-multiplier", leader=leader.name, multiplier=multiplier)
        line, follows = own.node.line, f"joint {name!r} follows the {leader.type} joint {leader.name!r}"
        if leader.type == "fixed":
            resting[name] = offset
            log.warn(line, f"{follows}; it rests at {offset:g}")
            continue
        followers.append(Mimic(name, leader.name, multiplier, offset))
        if multiplier == 0.0:
            log.warn(line, f"{follows} by the factor 0: it never moves")
        elif leader.type == "continuous" and multiplier != round(multiplier):
            jumps = "it jumps where the leader passes half a turn, unless postures are given as joint positions"
            log.warn(line, f"{follows} by the factor {multiplier:g}: {jumps}")
    return tuple(followers), resting


def _check_limits(joint: UrdfJoint) -> None:
    """Refuse limits that cannot be intended (`limit-order`, `limit-degrees`), warn about those without effect."""
    limit, unit = joint.limit or UrdfLimit(joint.node), "m" if joint.type == "prismatic" else "rad"
    node, lower, upper, velocity = limit.node, limit.lower, limit.upper, limit.velocity
    if joint.type != "continuous" and (lower is None or upper is None):
        # a default of 0, which the specification has, would be a limit that nobody stated
        missing = "limits" if lower == upper else "lower limit" if lower is None else "upper limit"
        node.warn(f"it has no {missing}, which a {joint.type} joint should; none is taken")
    elif joint.type != "continuous" and lower is not None and upper is not None:
        otherwise, largest = ', or type="continuous"' if unit == "rad" else "", max(abs(lower), abs(upper))
        said = {"lower": lower, "upper": upper, "unit": unit, "otherwise": otherwise}
        node.require(lower < upper, "limit-order", **said)
        if UNLIMITED < largest < math.inf:  # infinity is said by the format, not by a number
            node.warn(f"its limit of {largest:.3g} {unit} is taken for no limit")
        is_angle = unit == "m" or largest <= 4.0 * math.pi or largest > UNLIMITED  # no arm turns twice each way
        node.require(is_angle, "limit-degrees", **said, low=math.radians(lower), high=math.radians(upper))
    if velocity is None and (joint.type != "continuous" or joint.limit is not None):
        node.warn("no velocity limit; it is taken as unlimited")
    elif velocity is not None and velocity <= 0.0:
        node.warn(f"its velocity limit of {velocity:g} {unit}/s is taken for none stated: it is not limited")
