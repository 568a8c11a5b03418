"""MJCF files -> the links and joints that a URDF would have.

Pinocchio's own reader garbles some files in silence, and MuJoCo's needs the meshes; here a file is read without them,
and refused with the line of its fault.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import final
from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.errors import RobotError
from manip_learn.robot.description.text import XmlNode, parse_xml, shortened
from manip_learn.robot.description.urdf import (
    Matrix4,
    Pose,
    UrdfInertial,
    UrdfJoint,
    UrdfLimit,
    UrdfLink,
    UrdfMimic,
    X,
    as_matrix,
    as_pose,
    kinematic_urdf,
    near_vector,
    origin_text,
    read_name,
    spaced,
    unit_axis,
)
from manip_learn.robot.description.validation import ValidatedRobot, robot_name, validate_parts

WORLD, MAIN = "world", "main"
DEFAULTED = ("joint", "geom", "site", "mesh")
ORIENTATIONS = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}  # how many numbers each has
COLLISION_GROUPS = ("3", "4", "5")
PLANE = 20.0  # [m] edge of the box that stands for a plane in a scene
TYPES = {"hinge": "revolute", "slide": "prismatic"}
UNREADABLE = ("include", "attach", "replicate", "composite", "flexcomp", "frame")
Attributes = dict[str, dict[str, str]]


def read_defaults(root: XmlNode) -> dict[str, Attributes]:
    """Default attributes of each class, inheritance done: class -> tag -> attributes; the outermost is `main`."""
    classes: dict[str, Attributes] = {MAIN: {}}

    def read(node: XmlNode, inherited: Attributes, name: str) -> None:
        own = {tag: dict(values) for tag, values in inherited.items()}
        for child in node.children:
            if child.tag in DEFAULTED:
                own[child.tag] = own.get(child.tag, {}) | child.attributes
        classes[name] = own
        for inner in node.all("default"):
            read(inner, own, inner.attributes.get("class", ""))

    for top in root.all("default"):
        name = top.attributes.get("class", MAIN)
        read(top, classes[MAIN], name)
        classes[MAIN] = classes[name]
    return classes


@final
@dataclass(frozen=True)
class MjcfUnits:
    """Settings of the `<compiler>`.

    Attributes:
        angle: Factor from the file's angles to rad.
        eulerseq: Axes of Euler angles; small letters turn with the body, capitals do not.
        autolimits: Whether a range alone makes a limit.
        meshdir: Folder of mesh files, relative to the file.
    """

    angle: float
    eulerseq: str
    autolimits: bool
    meshdir: str


def read_units(root: XmlNode) -> MjcfUnits:
    """The `<compiler>` settings that matter for kinematics.

    Raises:
        RobotError: Code `mjcf-compiler`.
    """
    settings: dict[str, str] = {}
    for node in root.all("compiler"):
        settings |= node.attributes
    angle, eulerseq = settings.get("angle", "degree"), settings.get("eulerseq", "xyz")
    sentence = ""
    if angle not in ("degree", "radian") or len(eulerseq) != 3 or set(eulerseq) - set("xyzXYZ"):
        sentence = f"angle={angle!r}, eulerseq={eulerseq!r}; degree or radian, and three axes; correct them"
    elif settings.get("coordinate", "local") != "local":
        sentence = "coordinate is global; local is read; save the file by MuJoCo"
    if sentence:
        raise root.log.refusal("mjcf-compiler", root.all("compiler")[0].line, f"<compiler>: {sentence}")
    meshdir = settings.get("meshdir", settings.get("assetdir", ""))
    factor = math.pi / 180.0 if angle == "degree" else 1.0
    return MjcfUnits(factor, eulerseq, settings.get("autolimits", "true") != "false", meshdir)


def pose_of(node: XmlNode, units: MjcfUnits) -> Matrix4:
    """Pose of an element relative to the body around it [m].

    Raises:
        RobotError: Codes `number`, `not-finite`, `vector-size`, `far-away`, `mjcf-orientation`.
    """
    T = np.eye(4)
    T[:3, 3] = near_vector(node, "pos")
    given = [key for key in ORIENTATIONS if key in node.attributes]
    if len(given) > 1:
        seen = f"its orientation is given by {' and '.join(given)}"
        raise node.refusal("mjcf-orientation", f"{seen}; one way is expected; delete the others")
    if given:
        T[:3, :3] = _rotation(given[0], np.array(node.vector(given[0], ORIENTATIONS[given[0]])), units, node)
    return T


def _rotation(kind: str, numbers: np.ndarray, units: MjcfUnits, node: XmlNode) -> Float[np.ndarray, "3 3"]:
    if kind == "euler":
        R = np.eye(3)
        for letter, angle in zip(units.eulerseq, numbers * units.angle, strict=True):
            turn = pin.exp3(angle * np.eye(3)["xyz".index(letter.lower())])
            R = R @ turn if letter.islower() else turn @ R
        return R
    direction = numbers[:3] if kind == "axisangle" else numbers
    if kind == "xyaxes":
        direction = np.cross(numbers[:3], numbers[3:])
    length = float(np.linalg.norm(direction))
    if length < 1e-9:
        seen = f"{kind} {numbers.tolist()} gives no direction"
        raise node.refusal("mjcf-orientation", f"{seen}; a direction is expected; correct it")
    if kind == "quat":
        w, x, y, z = numbers / length
        return pin.Quaternion(w, x, y, z).toRotationMatrix()
    if kind == "axisangle":
        return pin.exp3(numbers[3] * units.angle * direction / length)
    if kind == "zaxis":
        return turn_z_to(direction / length)
    x = numbers[:3] / np.linalg.norm(numbers[:3])
    y = numbers[3:] - x.dot(numbers[3:]) * x
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])


def turn_z_to(direction: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that turns the z axis into a direction."""
    return pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), direction).toRotationMatrix()


class _Reader:
    """Reads bodies, joints and sites in file order; the world comes first.

    Attributes:
        links: What has been read so far.
        joints: In file order.
        visuals: Link -> `<visual>` elements of a URDF.
        ref: Joint -> value in the pose that the file describes [rad or m].
        has_mass: Whether any body states its mass.
    """

    def __init__(self, root: XmlNode, scene: bool = False):
        self.scene = scene
        self.classes, self.units = read_defaults(root), read_units(root)
        # without a name a mesh has that of its file
        self.meshes = {
            m.attributes.get("name") or Path(m.attributes.get("file", "").replace("\\", "/")).stem: m
            for asset in root.all("asset")
            for m in asset.all("mesh")
        }
        self.links = [UrdfLink(WORLD, root.line, None)]
        self.joints: list[UrdfJoint] = []
        self.visuals: dict[str, list[str]] = {}
        self.ref: dict[str, float] = {}
        self.has_mass = False
        for world in root.all("worldbody"):
            self._read_inside(world, WORLD, MAIN)

    def _full(self, node: XmlNode, childclass: str) -> XmlNode:
        """The element with the attributes of its class filled in; `childclass` is that of the body around it."""
        name = node.attributes.get("class", childclass)
        if name not in self.classes:
            seen = f"<{node.tag}> has the class {shortened(name)!r}, which no <default> defines"
            raise node.refusal("mjcf-class", f"{seen}; a defined class is expected; correct the name")
        return replace(node, attributes=self.classes[name].get(node.tag, {}) | node.attributes)

    def _read_inside(self, node: XmlNode, link: str, childclass: str) -> None:
        """Sites, shapes and bodies of one body; nested ones too."""
        pending = [(node, link, childclass)]
        while pending:
            node, link, childclass = pending.pop(0)
            for site in node.all("site"):
                self._site(self._full(site, childclass), link)
            for geom in node.all("geom") if link != WORLD or self.scene else []:
                visual = self._visual(self._full(geom, childclass))
                self.visuals.setdefault(link, []).extend([visual] if visual else [])
            for body in node.all("body"):
                inner = body.attributes.get("childclass", childclass)
                name = read_name(body) if body.attributes.get("name") else f"body_{body.line}"
                self._body(body, name, link, inner)
                pending.append((body, name, inner))

    def _body(self, body: XmlNode, name: str, parent: str, childclass: str) -> None:
        T = pose_of(body, self.units)
        nodes = [c for c in body.children if c.tag in ("joint", "freejoint")]
        link = UrdfLink(name, body.line, None)
        if (inertial := body.first("inertial")) is not None:
            pose, mass = as_pose(pose_of(inertial, self.units)), inertial.number("mass", 0.0)
            if mass < 0.0:
                raise inertial.refusal("mass", f"its mass is {mass} kg; 0 or more is expected; write the true mass")
            diagonal = inertial.vector("diaginertia", 3) or (0.0,) * 3
            xx, yy, zz, xy, xz, yz = inertial.vector("fullinertia", 6) or (*diagonal, 0.0, 0.0, 0.0)
            link, self.has_mass = replace(link, inertial=UrdfInertial(pose, mass, (xx, xy, xz, yy, yz, zz))), True
        if not nodes:
            self._fixed(f"{name}_fixed", parent, name, T, body.line)
        for i, node in enumerate(nodes):
            unnamed = f"{name}_joint" if len(nodes) == 1 else f"{name}_joint{i}"
            joint_name = read_name(node) if node.attributes.get("name") else unnamed
            full = self._full(node, childclass) if node.tag == "joint" else node
            anchor = full.vector("pos", 3) or (0.0, 0.0, 0.0)
            is_last = i == len(nodes) - 1
            child = name if is_last and not any(anchor) else f"{name}__after_{joint_name}"
            T = self._joint(full, joint_name, parent, child, T, anchor)
            if child != name:
                self.links.append(UrdfLink(child, body.line, None))
                if is_last:
                    self._fixed(f"{name}__from_{joint_name}", child, name, T, body.line)
            parent = child
        self.links.append(link)

    def _joint(
        self, node: XmlNode, name: str, parent: str, child: str, T: Matrix4, anchor: tuple[float, ...]
    ) -> Matrix4:
        """Add a joint; returns the pose of what follows relative to its child."""
        kind = node.attributes.get("type", "hinge")
        if node.tag == "freejoint" or kind == "free":
            # its coordinates are those of the body in the world
            self.joints.append(UrdfJoint(name, node.line, "floating", parent, child, Pose(), X, None, None))
            return np.eye(4)
        if kind not in TYPES:
            fix = "replace it by three hinges" if kind == "ball" else "correct the type"
            sentence = f"its type is {shortened(kind)!r}; hinge, slide or free is expected; {fix}"
            raise node.refusal("joint-type", sentence)
        axis = unit_axis(node.vector("axis", 3) or (0.0, 0.0, 1.0), node)
        scale = self.units.angle if kind == "hinge" else 1.0
        ref = node.number("ref", 0.0) * scale
        to_anchor, back, zero = np.eye(4), np.eye(4), np.eye(4)
        to_anchor[:3, 3], back[:3, 3] = anchor, [-c for c in anchor]
        if kind == "slide":
            zero[:3, 3] = [-ref * c for c in axis]
        elif ref:
            zero[:3, :3] = pin.exp3(-ref * np.array(axis))
        given, limited = node.vector("range", 2), node.attributes.get("limited", "auto")
        lower, upper = -math.inf, math.inf
        if given is not None and (limited == "true" or (limited != "false" and self.units.autolimits)):
            lower, upper = given[0] * scale, given[1] * scale
        limit = UrdfLimit(node.line, lower, upper, math.inf, None)
        pose = as_pose(T @ to_anchor @ zero)
        self.joints.append(UrdfJoint(name, node.line, TYPES[kind], parent, child, pose, axis, limit, None))
        self.ref[name] = ref
        return back

    def _fixed(self, name: str, parent: str, child: str, T: Matrix4, line: int) -> None:
        self.joints.append(UrdfJoint(name, line, "fixed", parent, child, as_pose(T), X, None, None))

    def _site(self, site: XmlNode, link: str) -> None:
        if not site.attributes.get("name") or "fromto" in site.attributes:
            return
        name = read_name(site)
        frame = f"{name}_site" if name in {entry.name for entry in self.links} else name
        self.links.append(UrdfLink(frame, site.line, None))
        self._fixed(f"{frame}__fixed", link, frame, pose_of(site, self.units), site.line)

    def _visual(self, geom: XmlNode) -> str:
        """The shape as URDF text; empty for what is not drawn (planes, fields, collision groups) or not readable.

        Of a scene it is what can be touched.
        """
        name, untouched = geom.attributes.get("name", ""), (geom.attributes.get(c) for c in ("contype", "conaffinity"))
        if all(c == "0" for c in untouched) if self.scene else geom.attributes.get("group", "0") in COLLISION_GROUPS:
            return ""
        try:
            shape, T = self._shape(geom)
            colour = geom.vector("rgba", 4)
        except RobotError:
            if self.scene:
                raise
            return ""
        if not shape and self.scene:
            seen = f"its shape {shortened(geom.attributes.get('type', 'mesh'))!r} is not read"
            raise geom.refusal("mjcf-element", f"{seen}; a plain body or a mesh file is expected; replace it")
        if not shape:
            return ""
        rgba = "" if colour is None else f'<material name=""><color rgba="{spaced(colour)}"/></material>'
        return f"<visual name={quoteattr(name)}>{origin_text(as_pose(T))}<geometry>{shape}</geometry>{rgba}</visual>"

    def _shape(self, geom: XmlNode) -> tuple[str, Matrix4]:
        T = pose_of(geom, self.units)
        kind = geom.attributes.get("type", "mesh" if "mesh" in geom.attributes else "sphere")
        if kind == "mesh":
            asset = self.meshes.get(geom.attributes.get("mesh", ""))
            if asset is None or "file" not in asset.attributes:
                return "", T
            folder = f"{self.units.meshdir.rstrip('/')}/" if self.units.meshdir else ""
            scale = spaced(asset.vector("scale", 3) or (1.0, 1.0, 1.0))
            return f'<mesh filename={quoteattr(folder + asset.attributes["file"])} scale="{scale}"/>', T
        words = geom.attributes.get("size", "").split()
        a, b, c = (*(geom.vector("size", len(words)) or ()), 0.0, 0.0, 0.0)[:3]
        half = b
        if "fromto" in geom.attributes:
            ends = np.array(geom.vector("fromto", 6))
            along = ends[3:] - ends[:3]
            half = c = 0.5 * float(np.linalg.norm(along))
            T[:3, :3], T[:3, 3] = turn_z_to(along), 0.5 * (ends[:3] + ends[3:])
        if kind == "plane" and self.scene:
            T = T @ as_matrix(Pose((0.0, 0.0, -0.5 * PLANE)))
        shapes = {
            "plane": f'<box size="{PLANE!r} {PLANE!r} {PLANE!r}"/>' if self.scene else "",
            "sphere": f'<sphere radius="{a!r}"/>',
            "capsule": f'<capsule radius="{a!r}" length="{2 * half!r}"/>',
            "cylinder": f'<cylinder radius="{a!r}" length="{2 * half!r}"/>',
            "box": f'<box size="{2 * a!r} {2 * b!r} {2 * c!r}"/>',
            "ellipsoid": f'<box size="{2 * a!r} {2 * b!r} {2 * c!r}"/>',
        }
        return shapes.get(kind, ""), T


def couplings(root: XmlNode, ref: dict[str, float]) -> dict[str, UrdfMimic]:
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
            sentence = f"<equality><{shortened(node.tag)}> is ignored: closed chains are not supported"
            root.log.warn(node.line, sentence)
            continue
        words = (node.attributes.get("polycoef", "0 1 0 0 0").split() + ["0"] * 5)[:5]
        node = replace(node, attributes={"polycoef": " ".join(words)}, where=f"joint {first!r}")
        c = node.vector("polycoef", 5) or (0.0,) * 5
        if not second or any(c[2:]) or first in out or first not in ref:
            seen = "its coupling is no straight line" if any(c[2:]) else "it is coupled to nothing, twice, or unknown"
            fix = "make it linear, or remove it and lock the joint"
            raise node.refusal("mjcf-coupling", f"{seen}; one other joint is expected; {fix}")
        out[first] = UrdfMimic(node.line, second, c[1], ref[first] + c[0] - c[1] * ref.get(second, 0.0))
    return out


def validate_mjcf(
    content: bytes, path: Path, locked: Collection[str] = (), *, scene: bool = False
) -> tuple[ValidatedRobot, bytes]:
    """Read and check an MJCF file.

    Joints coupled by a linear `<equality><joint>` become mimic joints; sites become frames.

    Args:
        content: The file.
        path: Where it came from, for the messages.
        locked: Joints that will not move.
        scene: Whether the shapes wanted are those that can be touched, with the world's own; a plane becomes a box.

    Returns:
        The validated description, and the URDF of that robot, with its shapes.

    Raises:
        RobotError: As for a URDF, and codes `mjcf-element`, `mjcf-class`, `mjcf-compiler`, `mjcf-orientation`,
            `mjcf-coupling`.
    """
    root = parse_xml(content, path)
    pending = [root]
    while pending:
        node = pending.pop()
        if node.tag in UNREADABLE:
            fix = "plain bodies are expected; let MuJoCo write the file out: mj_saveLastXML"
            raise node.refusal("mjcf-element", f"<{node.tag}> is not read; {fix}")
        pending += node.children
    reader = _Reader(root, scene)
    follows = couplings(root, reader.ref)
    joints = tuple(replace(j, mimic=follows.get(j.name)) for j in reader.joints)
    if any(j.nv == 1 for j in joints):
        root.log.warn(None, "an MJCF file has no velocity limits; they are taken as unlimited")
    if not reader.has_mass:
        sentence = "no body states its mass; masses of shapes are not computed, so there is no centre of mass"
        root.log.warn(None, sentence)
    validated = validate_parts(robot_name(root, "model"), tuple(reader.links), joints, locked, root.log)
    return validated, kinematic_urdf(validated.urdf, reader.visuals, with_mimics=True).encode()
