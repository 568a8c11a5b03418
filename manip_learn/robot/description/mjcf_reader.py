"""MJCF bodies -> the links and joints that a URDF would have."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pinocchio as pin

from manip_learn.robot.description.diagnostics import Diagnostics, shortened
from manip_learn.robot.description.kinematic_urdf import kinematic_urdf
from manip_learn.robot.description.mjcf_elements import (
    MAIN,
    MjcfDefaults,
    MjcfUnits,
    geom_visual,
    mesh_files,
    pose_of,
    read_defaults,
    read_units,
)
from manip_learn.robot.description.urdf_elements import (
    Matrix,
    UrdfInertial,
    UrdfJoint,
    UrdfLimit,
    UrdfLink,
    UrdfMimic,
    Vector,
    as_pose,
)
from manip_learn.robot.description.urdf_reader import read_name, unit_axis
from manip_learn.robot.description.validation import ValidatedRobot, validate_parts
from manip_learn.robot.description.xml_node import XmlNode, number, parse_xml, vector

WORLD = "world"
TYPES = {"hinge": "revolute", "slide": "prismatic"}
UNREADABLE = ("include", "attach", "replicate", "composite", "flexcomp", "frame")
X: Vector = (1.0, 0.0, 0.0)


@dataclass
class MjcfParts:
    """What has been read so far.

    Attributes:
        links: In file order, the world first.
        joints: In file order.
        visuals: Link -> `<visual>` elements of a URDF.
        ref: Joint -> value in the pose that the file describes [rad or m].
        has_mass: Whether any body states its mass.
    """

    links: list[UrdfLink] = field(default_factory=list)
    joints: list[UrdfJoint] = field(default_factory=list)
    visuals: dict[str, list[str]] = field(default_factory=dict)
    ref: dict[str, float] = field(default_factory=dict)
    has_mass: bool = False


def read_bodies(root: XmlNode, log: Diagnostics) -> MjcfParts:
    """All bodies, joints and sites of an MJCF file.

    Raises:
        RobotError: Codes `mjcf-*`, `joint-type`, `axis-*`, `number`, `not-finite`, `vector-size`, ...
    """
    reader = _Reader(log, read_defaults(root), read_units(root, log), mesh_files(root))
    reader.parts.links.append(UrdfLink(WORLD, root.line, None))
    for world in root.all("worldbody"):
        reader.read_inside(world, WORLD, MAIN)
    return reader.parts


def unreadable(root: XmlNode, log: Diagnostics) -> None:
    """Refuse elements that stand for other files or for copies.

    Raises:
        RobotError: Code `mjcf-element`.
    """
    pending = [root]
    while pending:
        node = pending.pop()
        if node.tag in UNREADABLE:
            seen, fix = f"<{node.tag}> is not read", "let MuJoCo write the file out: mj_saveLastXML"
            raise log.refusal("mjcf-element", node.line, "the file", seen, "plain bodies are expected", fix)
        pending += node.children


class _Reader:
    def __init__(self, log: Diagnostics, defaults: MjcfDefaults, units: MjcfUnits, meshes: dict[str, XmlNode]):
        self.log, self.defaults, self.units, self.meshes = log, defaults, units, meshes
        self.parts = MjcfParts()

    def read_inside(self, node: XmlNode, link: str, childclass: str) -> None:
        """Sites, shapes and bodies of one body; nested ones too."""
        pending = [(node, link, childclass)]
        while pending:
            node, link, childclass = pending.pop(0)
            for site in node.all("site"):
                self._site(self.defaults.of(site, childclass, self.log), link)
            for geom in node.all("geom") if link != WORLD else []:
                full = self.defaults.of(geom, childclass, self.log)
                visual = geom_visual(full, self.units, self.meshes, self.log)
                self.parts.visuals.setdefault(link, []).extend([visual] if visual else [])
            for body in node.all("body"):
                inner = body.attributes.get("childclass", childclass)
                name = read_name(body, self.log) if body.attributes.get("name") else f"body_{body.line}"
                self._body(body, name, link, inner)
                pending.append((body, name, inner))

    def _body(self, body: XmlNode, name: str, parent: str, childclass: str) -> None:
        where = f"body {name!r}"
        T = pose_of(body, self.units, where, self.log)
        nodes = [c for c in body.children if c.tag in ("joint", "freejoint")]
        inertial = body.first("inertial")
        link = UrdfLink(name, body.line, None if inertial is None else self._inertial(inertial, where))
        if not nodes:
            self._fixed(f"{name}_fixed", parent, name, T, body.line)
        for i, node in enumerate(nodes):
            unnamed = f"{name}_joint" if len(nodes) == 1 else f"{name}_joint{i}"
            joint_name = read_name(node, self.log) if node.attributes.get("name") else unnamed
            is_last = i == len(nodes) - 1
            full = self.defaults.of(node, childclass, self.log) if node.tag == "joint" else node
            anchor = vector(full, "pos", 3, f"joint {joint_name!r}", self.log) or (0.0, 0.0, 0.0)
            child = name if is_last and not any(anchor) else f"{name}__after_{joint_name}"
            T = self._joint(full, joint_name, parent, child, T, anchor)
            if child != name:
                self.parts.links.append(UrdfLink(child, body.line, None))
                if is_last:
                    self._fixed(f"{name}__from_{joint_name}", child, name, T, body.line)
            parent = child
        self.parts.links.append(link)

    def _joint(self, node: XmlNode, name: str, parent: str, child: str, T: Matrix, anchor: tuple[float, ...]) -> Matrix:
        """Add a joint; returns the pose of what follows relative to its child."""
        where, kind = f"joint {name!r}", node.attributes.get("type", "hinge")
        if node.tag == "freejoint" or kind == "free":
            # its coordinates are those of the body in the world
            self.parts.joints.append(
                UrdfJoint(name, node.line, "floating", parent, child, as_pose(np.eye(4)), X, None, None)
            )
            return np.eye(4)
        if kind not in TYPES:
            seen = f"its type is {shortened(kind)!r}"
            fix = "replace it by three hinges" if kind == "ball" else "correct the type"
            raise self.log.refusal("joint-type", node.line, where, seen, "hinge, slide or free is expected", fix)
        axis = unit_axis(vector(node, "axis", 3, where, self.log) or (0.0, 0.0, 1.0), node, where, self.log)
        scale = self.units.angle if kind == "hinge" else 1.0
        ref = (number(node, "ref", where, self.log) or 0.0) * scale
        to_anchor, back, zero = np.eye(4), np.eye(4), np.eye(4)
        to_anchor[:3, 3], back[:3, 3] = anchor, [-c for c in anchor]
        if kind == "slide":
            zero[:3, 3] = [-ref * c for c in axis]
        elif ref:
            zero[:3, :3] = pin.exp3(-ref * np.array(axis))
        limit = self._limit(node, scale, where)
        pose = as_pose(T @ to_anchor @ zero)
        self.parts.joints.append(UrdfJoint(name, node.line, TYPES[kind], parent, child, pose, axis, limit, None))
        self.parts.ref[name] = ref
        return back

    def _limit(self, node: XmlNode, scale: float, where: str) -> UrdfLimit:
        given = vector(node, "range", 2, where, self.log)
        limited = node.attributes.get("limited", "auto")
        if given is None or limited == "false" or (limited != "true" and not self.units.autolimits):
            return UrdfLimit(node.line, -math.inf, math.inf, math.inf, None)
        return UrdfLimit(node.line, given[0] * scale, given[1] * scale, math.inf, None)

    def _fixed(self, name: str, parent: str, child: str, T: Matrix, line: int) -> None:
        self.parts.joints.append(UrdfJoint(name, line, "fixed", parent, child, as_pose(T), X, None, None))

    def _site(self, site: XmlNode, link: str) -> None:
        if not site.attributes.get("name") or "fromto" in site.attributes:
            return
        name = read_name(site, self.log)
        taken = {entry.name for entry in self.parts.links}
        frame = f"{name}_site" if name in taken else name
        self.parts.links.append(UrdfLink(frame, site.line, None))
        T = pose_of(site, self.units, f"site {name!r}", self.log)
        self._fixed(f"{frame}__fixed", link, frame, T, site.line)

    def _inertial(self, node: XmlNode, where: str) -> UrdfInertial:
        pose = as_pose(pose_of(node, self.units, where, self.log))
        mass = number(node, "mass", where, self.log) or 0.0
        if mass < 0.0:
            fix = "write the true mass"
            raise self.log.refusal("mass", node.line, where, f"its mass is {mass} kg", "0 or more is expected", fix)
        self.parts.has_mass = True
        full = vector(node, "fullinertia", 6, where, self.log)
        if full is not None:
            xx, yy, zz, xy, xz, yz = full
            return UrdfInertial(pose, mass, (xx, xy, xz, yy, yz, zz))
        xx, yy, zz = vector(node, "diaginertia", 3, where, self.log) or (0.0, 0.0, 0.0)
        return UrdfInertial(pose, mass, (xx, 0.0, 0.0, yy, 0.0, zz))


def couplings(root: XmlNode, parts: MjcfParts, log: Diagnostics) -> dict[str, UrdfMimic]:
    """Joint -> the joint it follows, from the linear `<equality><joint>`; offsets count from the reference pose.

    Raises:
        RobotError: Code `mjcf-coupling`.
    """
    out: dict[str, UrdfMimic] = {}
    for node in (e for group in root.all("equality") for e in group.children):
        first, second = node.attributes.get("joint1", ""), node.attributes.get("joint2", "")
        if node.attributes.get("active") == "false":
            continue
        if node.tag != "joint":
            log.warn(node.line, f"<equality><{shortened(node.tag)}> is ignored: closed chains are not supported")
            continue
        where = f"joint {first!r}"
        words = (node.attributes.get("polycoef", "0 1 0 0 0").split() + ["0"] * 5)[:5]
        c = vector(XmlNode(node.tag, {"polycoef": " ".join(words)}, node.line), "polycoef", 5, where, log) or (0.0,) * 5
        if not second or any(c[2:]) or first in out or first not in parts.ref:
            seen = "its coupling is no straight line" if any(c[2:]) else "it is coupled to nothing, twice, or unknown"
            fix = "make it linear, or remove it and lock the joint"
            raise log.refusal("mjcf-coupling", node.line, where, seen, "one other joint is expected", fix)
        offset = parts.ref[first] + c[0] - c[1] * parts.ref.get(second, 0.0)
        out[first] = UrdfMimic(node.line, second, c[1], offset)
    return out


def validate_mjcf(content: bytes, path: Path, locked: Collection[str] = ()) -> tuple[ValidatedRobot, bytes]:
    """Read and check an MJCF file.

    Joints coupled by a linear `<equality><joint>` become mimic joints; sites become frames.

    Returns:
        The validated description, and the same robot as a URDF with its shapes.

    Raises:
        RobotError: As for a URDF, and codes `mjcf-element`, `mjcf-class`, `mjcf-compiler`, `mjcf-orientation`,
            `mjcf-coupling`.
    """
    log = Diagnostics(path)
    root = parse_xml(content, path)
    unreadable(root, log)
    parts = read_bodies(root, log)
    follows = couplings(root, parts, log)
    joints = tuple(replace(j, mimic=follows.get(j.name)) for j in parts.joints)
    if any(j.nv == 1 for j in joints):
        log.warn(None, "an MJCF file has no velocity limits; they are taken as unlimited")
    if not parts.has_mass:
        log.warn(None, "no body states its mass; masses of shapes are not computed, so there is no centre of mass")
    name = root.attributes.get("model", "").strip() or path.stem
    validated = validate_parts(name, tuple(parts.links), joints, locked, log)
    return validated, kinematic_urdf(validated.urdf, parts.visuals, with_mimics=True).encode()
