"""Validation of a robot description: nothing reaches Pinocchio that has not been read, counted and checked here."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

from manip_learn.errors import RobotError, advice, closest_names
from manip_learn.robot.description.text import Diagnostics, XmlNode, parse_xml, quoted, shortened
from manip_learn.robot.description.urdf import (
    UNLIMITED,
    UrdfFile,
    UrdfJoint,
    UrdfLink,
    UrdfMimic,
    read_joint,
    read_link,
)
from manip_learn.robot.joints import Mimic

LARGEST_MULTIPLIER = 1e6


@final
@dataclass(frozen=True)
class Mimics:
    """Where the mimic joints of a robot lead.

    Attributes:
        followers: Each with an independent, moving leader, however long the chain was.
        resting: Position of each mimic joint whose chain ends at a fixed joint [rad or m].
    """

    followers: tuple[Mimic, ...]
    resting: dict[str, float]


def resolve_mimics(joints: tuple[UrdfJoint, ...], alone: frozenset[str], log: Diagnostics) -> Mimics:
    """Follow every chain of mimics to its end, in whatever order the joints come.

    Args:
        joints: All joints.
        alone: Joints that are locked by name: what they follow does not matter.
        log: For warnings and refusals.

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
        if j.mimic is None or j.type == "fixed" or _is_alone(j, alone, by_name):
            continue
        leader, multiplier, offset = _end_of_chain(j, alone, by_name, log)
        if leader.type == "fixed":
            resting[j.name] = offset
            log.warn(j.mimic.line, f"joint {j.name!r} follows the fixed joint {leader.name!r}; it rests at {offset:g}")
            continue
        _warn_about_turns(j, leader, multiplier, log)
        followers.append(Mimic(j.name, leader.name, multiplier, offset))
    return Mimics(tuple(followers), resting)


def _is_alone(joint: UrdfJoint, alone: frozenset[str], by_name: dict[str, UrdfJoint]) -> bool:
    # a locked follower whose leader exists still belongs to its chain: locking it alone would break the coupling
    return joint.name in alone and joint.mimic is not None and joint.mimic.leader not in by_name


def _end_of_chain(
    start: UrdfJoint, alone: frozenset[str], by_name: dict[str, UrdfJoint], log: Diagnostics
) -> tuple[UrdfJoint, float, float]:
    multiplier, offset = 1.0, 0.0
    joint, seen = start, [start.name]
    while joint.mimic is not None and joint.type != "fixed" and not _is_alone(joint, alone, by_name):
        _check_type(joint, log)
        mimic = joint.mimic
        offset += multiplier * mimic.offset
        multiplier *= mimic.multiplier
        if mimic.leader not in by_name:
            raise _unknown_leader(joint, mimic, by_name, log)
        joint = by_name[mimic.leader]
        if joint.name in seen:
            where, fix = f"joint {start.name!r}", "let one of them move by itself"
            path = " -> ".join(repr(n) for n in [*seen, joint.name][:6])
            raise log.refusal(
                "mimic-cycle",
                mimic.line,
                where,
                f"joints follow each other in a loop: {path}",
                "a leader is expected",
                fix,
            )
        seen.append(joint.name)
    _check_type(joint, log)
    if not (abs(multiplier) <= LARGEST_MULTIPLIER and math.isfinite(offset)):
        line = None if start.mimic is None else start.mimic.line
        seen_text = f"it follows {joint.name!r} by the factor {multiplier:g}"
        fix = "correct the multiplier"
        raise log.refusal(
            "mimic-multiplier", line, f"joint {start.name!r}", seen_text, f"at most {LARGEST_MULTIPLIER:g} works", fix
        )
    return joint, multiplier, offset


def _check_type(joint: UrdfJoint, log: Diagnostics) -> None:
    if joint.type in ("floating", "planar"):
        seen = f"it is {joint.type}, with {joint.nv} degrees of freedom, and takes part in a <mimic>"
        fix = "delete the <mimic>"
        raise log.refusal("mimic-type", joint.line, f"joint {joint.name!r}", seen, "one degree is expected", fix)


def _unknown_leader(joint: UrdfJoint, mimic: UrdfMimic, by_name: dict[str, UrdfJoint], log: Diagnostics) -> RobotError:
    near = closest_names(mimic.leader, by_name)
    fix = f"did you mean {quoted(near)}?" if near else "correct the name, or lock the joint"
    seen = f"it follows the joint {mimic.leader!r}, which does not exist"
    where, expected = f"joint {joint.name!r}", "a joint of this file is expected"
    return log.refusal("mimic-unknown", mimic.line, where, seen, expected, fix)


def _warn_about_turns(joint: UrdfJoint, leader: UrdfJoint, multiplier: float, log: Diagnostics) -> None:
    line = None if joint.mimic is None else joint.mimic.line
    if multiplier == 0.0:
        log.warn(line, f"joint {joint.name!r} follows {leader.name!r} by the factor 0: it never moves")
    elif leader.type == "continuous" and multiplier != round(multiplier):
        log.warn(
            line,
            f"joint {joint.name!r} follows the continuous joint {leader.name!r} by the factor {multiplier:g}: "
            "it jumps where the leader passes half a turn, unless postures are given as joint positions",
        )


KNOWN_CHILDREN = {"link", "joint", "material", "transmission", "gazebo", "sensor", "ros2_control", "group"}
MAX_LINKS = 1_000
MAX_DEPTH = 500
MAX_NV = 150
LARGEST_ANGLE = 4.0 * math.pi  # [rad]


@final
@dataclass(frozen=True)
class ValidatedRobot:
    """A robot description that has been validated.

    Attributes:
        urdf: Links and joints.
        mimics: Mimic joints, resolved.
        warnings: What is odd but harmless, in sentences.
    """

    urdf: UrdfFile
    mimics: Mimics
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
    log = Diagnostics(path)
    root = parse_xml(content, path)
    check_root(root, log)
    links = tuple(read_link(node, log) for node in _counted(root, "link", log))
    joints = tuple(read_joint(node, log) for node in _counted(root, "joint", log))
    return validate_parts(_robot_name(root, log), links, joints, locked, log)


def validate_parts(
    name: str, links: tuple[UrdfLink, ...], joints: tuple[UrdfJoint, ...], locked: Collection[str], log: Diagnostics
) -> ValidatedRobot:
    """Check links and joints, from whatever format, against each other.

    Raises:
        RobotError: They form no tree, follow each other in a loop, or have limits that cannot be intended.
    """
    urdf = UrdfFile(name, links, joints, root_of_tree(links, joints, log))
    mimics = resolve_mimics(joints, frozenset(locked), log)
    still = {*locked, *mimics.resting, *(m.joint for m in mimics.followers if m.leader in locked)}
    for joint in joints:
        if joint.name not in still:
            check_limits(joint, log)
    if not any(j.nv for j in joints):
        log.warn(None, "no joint moves")
    return ValidatedRobot(urdf, mimics, log.warnings)


def check_root(root: XmlNode, log: Diagnostics) -> None:
    """Refuse what is not plain URDF 1.0; warn about elements that are not read.

    Raises:
        RobotError: Codes `not-urdf`, `xacro`, `urdf-version`.
    """
    if root.tag != "robot":
        kinds = {"sdf": "an SDF file", "mujoco": "an MJCF file", "COLLADA": "a mesh", "launch": "a ROS launch file"}
        seen = f"the root element is <{shortened(root.tag)}>" + (f", {kinds[root.tag]}" if root.tag in kinds else "")
        raise log.refusal("not-urdf", root.line, "the file", seen, "<robot> is expected", "convert it to URDF")
    version = root.attributes.get("version", "1.0").strip()
    if version not in ("1", "1.0"):
        seen = f"it says version {shortened(version)!r}"
        raise log.refusal("urdf-version", root.line, "the robot", seen, "1.0 is read", "convert it to URDF 1.0")
    ignored: dict[str, int] = {}
    for node in root.children:
        if node.tag.startswith("xacro:") or node.tag in ("macro", "include"):
            seen = f"<{shortened(node.tag)}> is xacro, not URDF"
            fix = "expand it" + advice(", or name the file *.xacro and load it with {}", "xacro=True", "--xacro")
            raise log.refusal("xacro", node.line, "the robot", seen, "plain URDF is expected", fix)
        if node.tag not in KNOWN_CHILDREN:
            ignored.setdefault(node.tag, node.line)
    for tag, line in list(ignored.items())[:20]:
        near = closest_names(shortened(tag).lower(), ("link", "joint"), n=1)
        hint = f"; did you mean <{near[0]}>?" if near else ""
        log.warn(line, f"<{shortened(tag)}> is ignored{hint}")


def _counted(root: XmlNode, tag: str, log: Diagnostics) -> list[XmlNode]:
    nodes = root.all(tag)
    if len(nodes) > MAX_LINKS:
        seen = f"it has {len(nodes)} <{tag}> elements"
        fix = "leave out what the arm does not need"
        raise log.refusal(
            f"too-many-{tag}s", nodes[MAX_LINKS].line, "the robot", seen, f"at most {MAX_LINKS} work", fix
        )
    return nodes


def _robot_name(root: XmlNode, log: Diagnostics) -> str:
    name = root.attributes.get("name", "").strip()
    if not name or not name.isprintable() or len(name) > 200:
        reason = "has no name" if not name else f"has the unusable name {shortened(name)!r}"
        name = "".join(c for c in log.path.stem if c.isprintable()) or "robot"
        log.warn(root.line, f"the robot {reason}; it is called {quoted([name])} after its file")
    return name


def root_of_tree(links: Sequence[UrdfLink], joints: Sequence[UrdfJoint], log: Diagnostics) -> str:
    """Name of the root link.

    Raises:
        RobotError: Codes `no-links`, `duplicate-link`, `duplicate-joint`, `unknown-link`, `self-loop`, `two-parents`,
            `no-root`, `many-roots`, `detached`, `too-many-links`, `too-deep`, `too-many-dof`.
    """
    _check_counts(links, joints, log)
    _check_names(links, joints, log)
    _check_ends(links, joints, log)
    children = {j.child for j in joints}
    roots = [link for link in links if link.name not in children]
    if not roots:
        raise log.refusal(
            "no-root",
            joints[0].line,
            "the joints",
            "every link is the child of a joint, so they form a loop",
            "one link without a parent is expected",
            f"remove the joint that closes the loop, e.g. {joints[-1].name!r}",
        )
    if len(roots) > 1:
        raise log.refusal(
            "many-roots",
            roots[1].line,
            "the links",
            f"{quoted([r.name for r in roots])} have no parent",
            "one such link is expected",
            f"join {roots[1].name!r} to the rest by a joint, or delete it",
        )
    _check_reach(roots[0], links, joints, log)
    return roots[0].name


def _check_counts(links: Sequence[UrdfLink], joints: Sequence[UrdfJoint], log: Diagnostics) -> None:
    if not links:
        fix = "is it a xacro file, or cut off?"
        raise log.refusal("no-links", 1, "the robot", "it has no <link>", "at least one is expected", fix)
    if len(links) > MAX_LINKS:
        seen = f"it has {len(links)} links"
        fix = "leave out what the arm does not need"
        raise log.refusal("too-many-links", links[MAX_LINKS].line, "the robot", seen, f"at most {MAX_LINKS} work", fix)
    nv = sum(j.nv for j in joints)
    if nv > MAX_NV:
        seen = f"it has {nv} degrees of freedom"
        fix = 'make unused joints type="fixed"'
        raise log.refusal("too-many-dof", None, "the robot", seen, f"at most {MAX_NV} work", fix)


def _check_names(links: Sequence[UrdfLink], joints: Sequence[UrdfJoint], log: Diagnostics) -> None:
    for kind, elements in (("link", links), ("joint", joints)):
        first: dict[str, int] = {}
        for e in elements:
            if e.name in first:
                seen = f"the name is already used on line {first[e.name]}"
                fix = "rename one of the two"
                raise log.refusal(f"duplicate-{kind}", e.line, f"{kind} {e.name!r}", seen, "names must be unique", fix)
            first[e.name] = e.line


def _check_ends(links: Sequence[UrdfLink], joints: Sequence[UrdfJoint], log: Diagnostics) -> None:
    names = {link.name for link in links}
    parent_joint: dict[str, str] = {}
    for j in joints:
        where = f"joint {j.name!r}"
        for role, link in (("parent", j.parent), ("child", j.child)):
            if link not in names:
                near = closest_names(link, names)
                fix = f"did you mean {quoted(near)}?" if near else "add the link or correct the name"
                seen = f"its {role} link {link!r} does not exist"
                raise log.refusal("unknown-link", j.line, where, seen, "a link of this file is expected", fix)
        if j.parent == j.child:
            seen = f"its parent and its child are both {j.child!r}"
            raise log.refusal("self-loop", j.line, where, seen, "two links are expected", "correct one of them")
        if j.child in parent_joint:
            seen = f"its child {j.child!r} is already the child of joint {parent_joint[j.child]!r}"
            fix = "closed chains are not supported: remove one of the two joints"
            raise log.refusal("two-parents", j.line, where, seen, "one parent per link is expected", fix)
        parent_joint[j.child] = j.name


def _check_reach(root: UrdfLink, links: Sequence[UrdfLink], joints: Sequence[UrdfJoint], log: Diagnostics) -> None:
    below: dict[str, list[str]] = {}
    for j in joints:
        below.setdefault(j.parent, []).append(j.child)
    depth, level, reached = 0, [root.name], Counter([root.name])
    while level:
        level = [child for name in level for child in below.get(name, ())]
        reached.update(level)
        depth += bool(level)
        if depth > MAX_DEPTH:
            seen = "it is more than 500 joints deep"
            fix = "merge links that are fixed to each other"
            raise log.refusal("too-deep", None, "the tree of links", seen, f"at most {MAX_DEPTH} work", fix)
    lost = [link for link in links if link.name not in reached]
    if lost:
        seen = f"{quoted([link.name for link in lost])} form a loop that is not connected to the root"
        fix = "remove the joint that closes the loop and connect it to the rest"
        raise log.refusal("detached", lost[0].line, "the links", seen, "one tree is expected", fix)


def check_limits(joint: UrdfJoint, log: Diagnostics) -> None:
    """Refuse limits that cannot be intended, warn about those without effect.

    Raises:
        RobotError: Codes `limit-order`, `limit-degrees`.
    """
    if joint.type in ("revolute", "prismatic"):
        _check_range(joint, log)
    if joint.type in ("revolute", "prismatic", "continuous"):
        _check_velocity(joint, log)


def _check_range(joint: UrdfJoint, log: Diagnostics) -> None:
    where, unit = f"joint {joint.name!r}", "m" if joint.type == "prismatic" else "rad"
    otherwise = ', or type="continuous"' if joint.type == "revolute" else ""
    limit = joint.limit
    if limit is None or limit.lower is None or limit.upper is None:
        # a default of 0, which the specification has, would be a limit that nobody stated
        neither = limit is None or (limit.lower is None and limit.upper is None)
        missing = "limits" if neither or limit is None else "lower limit" if limit.lower is None else "upper limit"
        line = joint.line if limit is None else limit.line
        log.warn(line, f"{where}: it has no {missing}, which a {joint.type} joint should; none is taken")
        return
    if limit.lower >= limit.upper:
        seen = f"its limits are {limit.lower:g} ... {limit.upper:g} {unit}"
        fix = f'swap or correct them{otherwise}, or type="fixed", or lock the joint'
        raise log.refusal("limit-order", limit.line, where, seen, "lower below upper is expected", fix)
    largest = max(abs(limit.lower), abs(limit.upper))
    if largest == math.inf:  # said by the format, not by a number
        return
    if largest > UNLIMITED:
        log.warn(limit.line, f"{where}: its limit of {largest:.3g} {unit} is taken for no limit")
    elif joint.type == "revolute" and largest > LARGEST_ANGLE:
        raise log.refusal(
            "limit-degrees",
            limit.line,
            where,
            f"its limits are {limit.lower:g} ... {limit.upper:g} rad, more than two turns: they look like degrees",
            "radians are expected",
            f"write {math.radians(limit.lower):.4f} ... {math.radians(limit.upper):.4f}{otherwise} for many turns",
        )


def _check_velocity(joint: UrdfJoint, log: Diagnostics) -> None:
    where, limit = f"joint {joint.name!r}", joint.limit
    if limit is None or limit.velocity is None:
        if joint.type != "continuous" or limit is not None:
            log.warn(
                joint.line if limit is None else limit.line, f"{where}: no velocity limit; it is taken as unlimited"
            )
        return
    if limit.velocity <= 0.0:
        unit = "m/s" if joint.type == "prismatic" else "rad/s"
        log.warn(
            limit.line,
            f"{where}: its velocity limit of {limit.velocity:g} {unit} is taken for none stated, so its velocity is "
            "not limited",
        )
