"""The gate: nothing reaches Pinocchio that has not been read, counted and checked here."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import final

from manip_learn.errors import closest_names
from manip_learn.robot.description.diagnostics import GateLog, quoted, shortened
from manip_learn.robot.description.mimic import Mimics, resolve_mimics
from manip_learn.robot.description.urdf_elements import UrdfFile, UrdfJoint, UrdfLink
from manip_learn.robot.description.urdf_limits import check_limits
from manip_learn.robot.description.urdf_reader import read_joint, read_link
from manip_learn.robot.description.urdf_tree import MAX_LINKS, root_of_tree
from manip_learn.robot.description.xml_node import XmlNode, parse_xml

KNOWN_CHILDREN = {"link", "joint", "material", "transmission", "gazebo", "sensor", "ros2_control", "group"}


@final
@dataclass(frozen=True)
class Passed:
    """A description that passed the gate.

    Attributes:
        urdf: Links and joints.
        mimics: Mimic joints, resolved.
        warnings: What is odd but harmless, in sentences.
    """

    urdf: UrdfFile
    mimics: Mimics
    warnings: tuple[str, ...]


def check_urdf(content: bytes, path: Path, locked: Collection[str] = ()) -> Passed:
    """Read and check a URDF.

    Args:
        content: The file.
        path: Where it came from, for the messages.
        locked: Joints that will not move: their limits and what they follow do not matter.

    Raises:
        RobotError: With a `code`, the file, the line, the joint or link, the value seen and the fix.
    """
    log = GateLog(path)
    root = parse_xml(content, path)
    check_root(root, log)
    links = tuple(read_link(node, log) for node in _counted(root, "link", log))
    joints = tuple(read_joint(node, log) for node in _counted(root, "joint", log))
    return pass_parts(_robot_name(root, log), links, joints, locked, log)


def pass_parts(
    name: str, links: tuple[UrdfLink, ...], joints: tuple[UrdfJoint, ...], locked: Collection[str], log: GateLog
) -> Passed:
    """Check links and joints, from whatever format, against each other.

    Raises:
        RobotError: They form no tree, follow each other in circles, or have limits that cannot be meant.
    """
    urdf = UrdfFile(name, links, joints, root_of_tree(links, joints, log))
    mimics = resolve_mimics(joints, frozenset(locked), log)
    still = {*locked, *mimics.resting, *(m.joint for m in mimics.followers if m.leader in locked)}
    for joint in joints:
        if joint.name not in still:
            check_limits(joint, log)
    if not any(j.nv for j in joints):
        log.warn(None, "no joint moves")
    return Passed(urdf, mimics, log.warnings)


def check_root(root: XmlNode, log: GateLog) -> None:
    """Refuse what is not plain URDF 1.0; warn about elements nobody reads.

    Raises:
        RobotError: Codes `not-urdf`, `xacro`, `urdf-version`.
    """
    if root.tag != "robot":
        kinds = {"sdf": "an SDF file", "mujoco": "an MJCF file", "COLLADA": "a mesh", "launch": "a ROS launch file"}
        seen = f"the root element is <{shortened(root.tag)}>" + (f", {kinds[root.tag]}" if root.tag in kinds else "")
        raise log.refusal("not-urdf", root.line, "the file", seen, "<robot> is wanted", "convert it to URDF")
    version = root.attributes.get("version", "1.0").strip()
    if version not in ("1", "1.0"):
        seen = f"it says version {shortened(version)!r}"
        raise log.refusal("urdf-version", root.line, "the robot", seen, "1.0 is read", "convert it to URDF 1.0")
    ignored: dict[str, int] = {}
    for node in root.children:
        if node.tag.startswith("xacro:") or node.tag in ("macro", "include"):
            seen = f"<{shortened(node.tag)}> is xacro, not URDF"
            fix = "expand it, or name the file *.xacro and load it with xacro=True"
            raise log.refusal("xacro", node.line, "the robot", seen, "plain URDF is wanted", fix)
        if node.tag not in KNOWN_CHILDREN:
            ignored.setdefault(node.tag, node.line)
    for tag, line in list(ignored.items())[:20]:
        near = closest_names(shortened(tag).lower(), ("link", "joint"), n=1)
        hint = f"; did you mean <{near[0]}>?" if near else ""
        log.warn(line, f"<{shortened(tag)}> is ignored{hint}")


def _counted(root: XmlNode, tag: str, log: GateLog) -> list[XmlNode]:
    nodes = root.all(tag)
    if len(nodes) > MAX_LINKS:
        seen = f"it has {len(nodes)} <{tag}> elements"
        fix = "leave out what the arm does not need"
        raise log.refusal(
            f"too-many-{tag}s", nodes[MAX_LINKS].line, "the robot", seen, f"at most {MAX_LINKS} work", fix
        )
    return nodes


def _robot_name(root: XmlNode, log: GateLog) -> str:
    name = root.attributes.get("name", "").strip()
    if not name or not name.isprintable() or len(name) > 200:
        reason = "has no name" if not name else f"has the unusable name {shortened(name)!r}"
        name = "".join(c for c in log.path.stem if c.isprintable()) or "robot"
        log.warn(root.line, f"the robot {reason}; it is called {quoted([name])} after its file")
    return name
