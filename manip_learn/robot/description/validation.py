"""Validation of a robot description: nothing reaches Pinocchio that has not been read, counted and checked here."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

from manip_learn.errors import advice, closest_names
from manip_learn.robot.description.text import Diagnostics, XmlNode, meant, parse_xml, quoted, shortened
from manip_learn.robot.description.urdf import (
    LONGEST_NAME,
    UNLIMITED,
    UrdfFile,
    UrdfJoint,
    UrdfLink,
    read_joint,
    read_link,
)
from manip_learn.robot.joints import Mimic

LARGEST_MULTIPLIER = 1e6  # above it, rounding of the leader is a motion of the follower
KNOWN_CHILDREN = {"link", "joint", "material", "transmission", "gazebo", "sensor", "ros2_control", "group"}
MAX_LINKS = 1_000  # loading takes seconds for them
MAX_DEPTH = 500  # Pinocchio recurses, and crashes at some thousands
MAX_NV = 150  # Pinocchio's memory grows with the cube: 0.22 GB for these
MAX_IGNORED = 20  # unknown elements that are named in warnings
LARGEST_LIMIT = 4.0 * math.pi  # [rad] no arm turns more than twice each way


def resolve_mimics(
    joints: tuple[UrdfJoint, ...], alone: frozenset[str], log: Diagnostics
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
    by_name = {j.name: j for j in joints}
    followers: list[Mimic] = []
    resting: dict[str, float] = {}
    without_effect = [j.name for j in joints if j.mimic is not None and j.type == "fixed"]
    if without_effect:
        log.warn(None, f"<mimic> of the fixed joints {quoted(without_effect)} has no effect")
    for j in joints:
        if j.mimic is None or _leads(j, alone, by_name):
            continue
        leader, multiplier, offset = _end_of_chain(j, alone, by_name, log)
        line, follows = j.mimic.line, f"joint {j.name!r} follows the {leader.type} joint {leader.name!r}"
        if leader.type == "fixed":
            resting[j.name] = offset
            log.warn(line, f"{follows}; it rests at {offset:g}")
            continue
        followers.append(Mimic(j.name, leader.name, multiplier, offset))
        if multiplier == 0.0:
            log.warn(line, f"{follows} by the factor 0: it never moves")
        elif leader.type == "continuous" and multiplier != round(multiplier):
            jumps = "it jumps where the leader passes half a turn, unless postures are given as joint positions"
            log.warn(line, f"{follows} by the factor {multiplier:g}: {jumps}")
    return tuple(followers), resting


def _leads(joint: UrdfJoint, alone: frozenset[str], by_name: dict[str, UrdfJoint]) -> bool:
    """Whether a joint follows no other one, so that a chain of mimics ends at it."""
    # a locked follower whose leader exists still belongs to its chain: locking it alone would break the coupling
    is_alone = joint.name in alone and joint.mimic is not None and joint.mimic.leader not in by_name
    return joint.mimic is None or joint.type == "fixed" or is_alone


def _end_of_chain(
    start: UrdfJoint, alone: frozenset[str], by_name: dict[str, UrdfJoint], log: Diagnostics
) -> tuple[UrdfJoint, float, float]:
    """The joint at the end of a chain of mimics, and the follower's multiplier and offset with respect to it."""
    multiplier, offset = 1.0, 0.0
    joint, seen, line = start, [start.name], start.line
    while not _leads(joint, alone, by_name) and (mimic := joint.mimic) is not None:
        _check_type(joint, log)
        line = mimic.line
        offset += multiplier * mimic.offset
        multiplier *= mimic.multiplier
        if mimic.leader not in by_name:
            fix = meant(mimic.leader, by_name, "correct the name, or lock the joint")
            sentence = f"joint {joint.name!r}: it follows the joint {mimic.leader!r}, which does not exist; {fix}"
            raise log.refusal("mimic-unknown", line, sentence)
        joint = by_name[mimic.leader]
        if joint.name in seen:
            path = " -> ".join(repr(n) for n in [*seen, joint.name][:6])
            sentence = (
                f"joint {start.name!r}: joints follow each other in a loop: {path}; let one of them move by itself"
            )
            raise log.refusal("mimic-cycle", line, sentence)
        seen.append(joint.name)
    _check_type(joint, log)
    if not (abs(multiplier) <= LARGEST_MULTIPLIER and math.isfinite(offset)):
        seen_text = f"joint {start.name!r}: it follows {joint.name!r} by the factor {multiplier:g}"
        fix = f"at most {LARGEST_MULTIPLIER:g} works; correct the multiplier"
        raise log.refusal("mimic-multiplier", start.mimic.line if start.mimic else line, f"{seen_text}; {fix}")
    return joint, multiplier, offset


def _check_type(joint: UrdfJoint, log: Diagnostics) -> None:
    if joint.nv > 1:
        seen = f"it is {joint.type}, with {joint.nv} degrees of freedom, and takes part in a <mimic>"
        raise log.refusal(
            "mimic-type", joint.line, f"joint {joint.name!r}: {seen}; one is expected; delete the <mimic>"
        )


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


def validate_urdf(content: bytes, path: Path, locked: Collection[str] = ()) -> ValidatedRobot:
    """Read and check a URDF.

    Args:
        content: The file.
        path: Where it came from, for the messages.
        locked: Joints that will not move: their limits and what they follow do not matter.

    Raises:
        RobotError: With a `code`, the file, the line, the joint or link, the value seen and the fix.
    """
    root = parse_xml(content, path)
    check_root(root)
    links, joints = tuple(map(read_link, root.all("link"))), tuple(map(read_joint, root.all("joint")))
    return validate_parts(robot_name(root), links, joints, locked, root.log)


def validate_parts(
    name: str, links: tuple[UrdfLink, ...], joints: tuple[UrdfJoint, ...], locked: Collection[str], log: Diagnostics
) -> ValidatedRobot:
    """Check links and joints, from whatever format, against each other."""
    urdf = UrdfFile(name, links, joints, root_of_tree(links, joints, log))
    followers, resting = resolve_mimics(joints, frozenset(locked), log)
    still = {*locked, *resting, *(m.joint for m in followers if m.leader in locked)}
    for joint in joints:
        if joint.name in still or joint.type not in ("revolute", "prismatic", "continuous"):
            continue
        if joint.type != "continuous":
            _check_range(joint, log)
        where, limit = f"joint {joint.name!r}", joint.limit
        if limit is None or limit.velocity is None:
            if joint.type != "continuous" or limit is not None:
                line = joint.line if limit is None else limit.line
                log.warn(line, f"{where}: no velocity limit; it is taken as unlimited")
        elif limit.velocity <= 0.0:
            stated = f"{limit.velocity:g} {'m/s' if joint.type == 'prismatic' else 'rad/s'}"
            log.warn(limit.line, f"{where}: its velocity limit of {stated} is taken for none stated: it is not limited")
    if not any(j.nv for j in joints):
        log.warn(None, "no joint moves")
    return ValidatedRobot(urdf, followers, resting, log.warnings)


def check_root(root: XmlNode) -> None:
    """Refuse what is not plain URDF 1.0; warn about elements that are not read.

    Raises:
        RobotError: Codes `not-urdf`, `xacro`, `urdf-version`.
    """
    if root.tag != "robot":
        kinds = {"sdf": "an SDF file", "mujoco": "an MJCF file", "COLLADA": "a mesh", "launch": "a ROS launch file"}
        seen = f"the root element is <{shortened(root.tag)}>" + (f", {kinds[root.tag]}" if root.tag in kinds else "")
        raise root.log.refusal("not-urdf", root.line, f"{seen}; <robot> is expected; convert it to URDF")
    version = root.attributes.get("version", "1.0").strip()
    if version not in ("1", "1.0"):
        raise root.refusal(
            "urdf-version", f"it says version {shortened(version)!r}; 1.0 is read; convert it to URDF 1.0"
        )
    ignored: dict[str, int] = {}
    for node in root.children:
        if node.tag.startswith("xacro:") or node.tag in ("macro", "include"):
            fix = "expand it" + advice(", or name the file *.xacro and load it with {}", "xacro=True", "--xacro")
            sentence = f"<{shortened(node.tag)}> is xacro, not URDF; plain URDF is expected; {fix}"
            raise node.refusal("xacro", sentence)
        if node.tag not in KNOWN_CHILDREN:
            ignored.setdefault(node.tag, node.line)
    for tag, line in list(ignored.items())[:MAX_IGNORED]:
        near = closest_names(shortened(tag).lower(), ("link", "joint"), n=1)
        hint = f"; did you mean <{near[0]}>?" if near else ""
        root.log.warn(line, f"<{shortened(tag)}> is ignored{hint}")


def robot_name(root: XmlNode, attribute: str = "name") -> str:
    """The name of a robot, or that of its file, with a warning, where it has none that can be printed."""
    name = root.attributes.get(attribute, "").strip()
    if not name or not name.isprintable() or len(name) > LONGEST_NAME:
        reason = "has no name" if not name else f"has the unusable name {shortened(name)!r}"
        name = "".join(c for c in root.log.path.stem if c.isprintable()) or "robot"
        root.log.warn(root.line, f"the robot {reason}; it is called {quoted([name])} after its file")
    return name


def root_of_tree(links: Sequence[UrdfLink], joints: Sequence[UrdfJoint], log: Diagnostics) -> str:
    """Name of the root link.

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
            raise log.refusal(f"too-many-{tag}s", elements[MAX_LINKS].line, sentence)
    nv = sum(j.nv for j in joints)
    if nv > MAX_NV:
        sentence = f'the robot has {nv} degrees of freedom; at most {MAX_NV} work; make unused joints type="fixed"'
        raise log.refusal("too-many-dof", None, sentence)
    for kind, elements in (("link", links), ("joint", joints)):
        first: dict[str, int] = {}
        for e in elements:
            if e.name in first:
                sentence = (
                    f"the name is already used on line {first[e.name]}; names must be unique; rename one of the two"
                )
                raise log.refusal(f"duplicate-{kind}", e.line, f"{kind} {e.name!r}: {sentence}")
            first[e.name] = e.line
    names, parent_joint = {link.name for link in links}, dict[str, str]()
    for j in joints:
        for role, link in (("parent", j.parent), ("child", j.child)):
            if link not in names:
                fix = meant(link, names, "add the link or correct the name")
                sentence = f"joint {j.name!r}: its {role} link {link!r} does not exist; {fix}"
                raise log.refusal("unknown-link", j.line, sentence)
        if j.parent == j.child:
            seen = f"joint {j.name!r}: its parent and its child are both {j.child!r}"
            raise log.refusal("self-loop", j.line, f"{seen}; two links are expected; correct one of them")
        if j.child in parent_joint:
            seen = f"its child {j.child!r} is already the child of joint {parent_joint[j.child]!r}"
            fix = "closed chains are not supported: remove one of the two joints"
            sentence = f"joint {j.name!r}: {seen}; one parent per link is expected; {fix}"
            raise log.refusal("two-parents", j.line, sentence)
        parent_joint[j.child] = j.name
    roots = [link for link in links if link.name not in parent_joint]
    if not roots:
        fix = f"remove the joint that closes the loop, e.g. {joints[-1].name!r}"
        sentence = f"every link is the child of a joint, so they form a loop; one without a parent is expected; {fix}"
        raise log.refusal("no-root", joints[0].line, sentence)
    if len(roots) > 1:
        fix = f"join {roots[1].name!r} to the rest by a joint, or delete it"
        sentence = f"the links {quoted([r.name for r in roots])} have no parent; one such link is expected; {fix}"
        raise log.refusal("many-roots", roots[1].line, sentence)
    _check_reach(roots[0], links, joints, log)
    return roots[0].name


def _check_reach(root: UrdfLink, links: Sequence[UrdfLink], joints: Sequence[UrdfJoint], log: Diagnostics) -> None:
    below: dict[str, list[str]] = {}
    for j in joints:
        below.setdefault(j.parent, []).append(j.child)
    depth, level, reached = 0, [root.name], {root.name}
    while level:
        level = [child for name in level for child in below.get(name, ())]
        reached.update(level)
        depth += bool(level)
    if depth > MAX_DEPTH:
        sentence = f"the tree of links is more than {MAX_DEPTH} joints deep; merge links that are fixed to each other"
        raise log.refusal("too-deep", None, sentence)
    lost = [link for link in links if link.name not in reached]
    if lost:
        fix = "remove the joint that closes the loop and connect it to the rest"
        sentence = f"{quoted([link.name for link in lost])} form a loop that is not connected to the root; {fix}"
        raise log.refusal("detached", lost[0].line, sentence)


def _check_range(joint: UrdfJoint, log: Diagnostics) -> None:
    """Refuse limits that cannot be intended (`limit-order`, `limit-degrees`), warn about those without effect."""
    where, unit = f"joint {joint.name!r}", "m" if joint.type == "prismatic" else "rad"
    otherwise = ', or type="continuous"' if joint.type == "revolute" else ""
    limit = joint.limit
    if limit is None or limit.lower is None or limit.upper is None:
        # a default of 0, which the specification has, would be a limit that nobody stated
        missing = "limits"
        if limit is not None and (limit.lower, limit.upper) != (None, None):
            missing = "lower limit" if limit.lower is None else "upper limit"
        line = joint.line if limit is None else limit.line
        log.warn(line, f"{where}: it has no {missing}, which a {joint.type} joint should; none is taken")
        return
    stated = f"{where}: its limits are {limit.lower:g} ... {limit.upper:g} {unit}"
    if limit.lower >= limit.upper:
        fix = f'swap or correct them{otherwise}, or type="fixed", or lock the joint'
        raise log.refusal("limit-order", limit.line, f"{stated}; lower below upper is expected; {fix}")
    largest = max(abs(limit.lower), abs(limit.upper))
    if UNLIMITED < largest < math.inf:  # infinity is said by the format, not by a number
        log.warn(limit.line, f"{where}: its limit of {largest:.3g} {unit} is taken for no limit")
    elif joint.type == "revolute" and LARGEST_LIMIT < largest < math.inf:
        fix = f"write {math.radians(limit.lower):.4f} ... {math.radians(limit.upper):.4f}{otherwise} for many turns"
        seen = f"{stated}, more than two turns: they look like degrees"
        raise log.refusal("limit-degrees", limit.line, f"{seen}; radians are expected; {fix}")
