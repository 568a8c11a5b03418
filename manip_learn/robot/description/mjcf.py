"""MJCF files -> the links and joints that a URDF would have."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import final
from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.errors import RobotError
from manip_learn.robot.description.text import Diagnostics, XmlNode, number, parse_xml, shortened, vector
from manip_learn.robot.description.urdf import (
    Matrix,
    UrdfInertial,
    UrdfJoint,
    UrdfLimit,
    UrdfLink,
    UrdfMimic,
    Vector,
    as_pose,
    kinematic_urdf,
    read_name,
    unit_axis,
)
from manip_learn.robot.description.validation import ValidatedRobot, validate_parts

DEFAULTED = ("joint", "geom", "site", "mesh")
MAIN = "main"
Attributes = dict[str, dict[str, str]]
ORIENTATIONS = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}
FARTHEST = 1e6  # [m]
COLLISION_GROUPS = ("3", "4", "5")


@final
@dataclass(frozen=True)
class MjcfDefaults:
    """Default attributes of each class, inheritance done: class -> tag -> attribute -> text."""

    classes: dict[str, Attributes]

    def of(self, node: XmlNode, childclass: str, log: Diagnostics) -> XmlNode:
        """The element with the attributes of its class filled in; `childclass` is that of the body around it.

        Raises:
            RobotError: Code `mjcf-class`: the class does not exist.
        """
        name = node.attributes.get("class", childclass)
        if name not in self.classes:
            seen = f"<{node.tag}> has the class {shortened(name)!r}, which no <default> defines"
            raise log.refusal(
                "mjcf-class", node.line, "the file", seen, "a defined class is expected", "correct the name"
            )
        attributes = self.classes[name].get(node.tag, {}) | node.attributes
        return XmlNode(node.tag, attributes, node.line, node.children)


def read_defaults(root: XmlNode) -> MjcfDefaults:
    """Default classes of a file; the outermost is called `main`."""
    classes: dict[str, Attributes] = {MAIN: {}}
    for top in root.all("default"):
        pending: list[tuple[XmlNode, Attributes, str]] = [(top, classes[MAIN], top.attributes.get("class", MAIN))]
        while pending:
            node, inherited, name = pending.pop()
            own = {tag: dict(values) for tag, values in inherited.items()}
            for child in node.children:
                if child.tag in DEFAULTED:
                    own[child.tag] = own.get(child.tag, {}) | child.attributes
            classes[name] = own
            if node is top:
                classes[MAIN] = own
            pending += [(c, own, c.attributes.get("class", "")) for c in node.all("default")]
    return MjcfDefaults(classes)


@final
@dataclass(frozen=True)
class MjcfUnits:
    """What the `<compiler>` says.

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


def read_units(root: XmlNode, log: Diagnostics) -> MjcfUnits:
    """The `<compiler>` settings that matter for kinematics.

    Raises:
        RobotError: Code `mjcf-compiler`.
    """
    settings: dict[str, str] = {}
    for node in root.all("compiler"):
        settings |= node.attributes
    angle, eulerseq = settings.get("angle", "degree"), settings.get("eulerseq", "xyz")
    line = root.all("compiler")[0].line if settings else None
    if angle not in ("degree", "radian") or len(eulerseq) != 3 or set(eulerseq) - set("xyzXYZ"):
        seen = f"angle={angle!r}, eulerseq={eulerseq!r}"
        fix = "correct the compiler settings"
        raise log.refusal("mjcf-compiler", line, "<compiler>", seen, "degree or radian, and three axes", fix)
    if settings.get("coordinate", "local") != "local":
        seen = "coordinate is global"
        raise log.refusal("mjcf-compiler", line, "<compiler>", seen, "local is read", "save the file by MuJoCo")
    meshdir = settings.get("meshdir", settings.get("assetdir", ""))
    factor = math.pi / 180.0 if angle == "degree" else 1.0
    return MjcfUnits(factor, eulerseq, settings.get("autolimits", "true") != "false", meshdir)


def pose_of(node: XmlNode, units: MjcfUnits, where: str, log: Diagnostics) -> Matrix:
    """Pose of an element relative to the body around it [m].

    Raises:
        RobotError: Codes `number`, `not-finite`, `vector-size`, `far-away`, `mjcf-orientation`.
    """
    T = np.eye(4)
    position = vector(node, "pos", 3, where, log) or (0.0, 0.0, 0.0)
    if max(map(abs, position)) > FARTHEST:
        seen = f"its position is {position} m"
        raise log.refusal("far-away", node.line, where, seen, f"at most {FARTHEST:g} m is expected", "check the unit")
    T[:3, 3] = position
    given = [key for key in ORIENTATIONS if key in node.attributes]
    if len(given) > 1:
        seen = f"its orientation is given by {' and '.join(given)}"
        raise log.refusal("mjcf-orientation", node.line, where, seen, "one way is expected", "delete the others")
    if given:
        numbers = np.array(vector(node, given[0], ORIENTATIONS[given[0]], where, log))
        T[:3, :3] = _rotation(given[0], numbers, units, node, where, log)
    return T


def _rotation(
    kind: str, numbers: np.ndarray, units: MjcfUnits, node: XmlNode, where: str, log: Diagnostics
) -> Float[np.ndarray, "3 3"]:
    if kind == "euler":
        R = np.eye(3)
        for letter, angle in zip(units.eulerseq, numbers * units.angle, strict=True):
            turn = pin.exp3(angle * np.eye(3)["xyz".index(letter.lower())])
            R = R @ turn if letter.islower() else turn @ R
        return R
    direction = numbers[:3] if kind == "axisangle" else numbers
    if kind == "xyaxes":
        direction = np.cross(numbers[:3], numbers[3:])
    if np.linalg.norm(direction) < 1e-9:
        seen = f"{kind} {numbers.tolist()} gives no direction"
        raise log.refusal("mjcf-orientation", node.line, where, seen, "a direction is expected", "correct it")
    if kind == "quat":
        w, x, y, z = numbers / np.linalg.norm(numbers)
        return pin.Quaternion(w, x, y, z).toRotationMatrix()
    if kind == "axisangle":
        return pin.exp3(numbers[3] * units.angle * numbers[:3] / np.linalg.norm(numbers[:3]))
    if kind == "zaxis":
        z = numbers / np.linalg.norm(numbers)
        return pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), z).toRotationMatrix()
    x = numbers[:3] / np.linalg.norm(numbers[:3])
    y = numbers[3:] - x.dot(numbers[3:]) * x
    y /= np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])


def mesh_files(root: XmlNode) -> dict[str, XmlNode]:
    """Mesh assets by name; without a name a mesh has that of its file."""
    meshes: dict[str, XmlNode] = {}
    for node in (m for asset in root.all("asset") for m in asset.all("mesh")):
        file = node.attributes.get("file", "")
        name = node.attributes.get("name") or file.replace("\\", "/").rpartition("/")[2].rpartition(".")[0]
        meshes[name] = node
    return meshes


def geom_visual(geom: XmlNode, units: MjcfUnits, meshes: dict[str, XmlNode], log: Diagnostics) -> str:
    """The shape as URDF text; empty for what is not drawn (planes, fields, collision groups) or not readable."""
    if geom.attributes.get("group", "0") in COLLISION_GROUPS:
        return ""
    try:
        shape, T = _shape(geom, units, meshes, log)
        colour = vector(geom, "rgba", 4, "geom", log)
    except RobotError:
        return ""
    if not shape:
        return ""
    pose = as_pose(T)
    xyz, rpy = (" ".join(repr(c) for c in v) for v in (pose.xyz, pose.rpy))
    rgba = "" if colour is None else f'<material name=""><color rgba="{" ".join(map(repr, colour))}"/></material>'
    return f'<visual><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{shape}</geometry>{rgba}</visual>'


def _shape(geom: XmlNode, units: MjcfUnits, meshes: dict[str, XmlNode], log: Diagnostics) -> tuple[str, Matrix]:
    kind = geom.attributes.get("type", "mesh" if "mesh" in geom.attributes else "sphere")
    if kind == "mesh":
        return _mesh(geom, units, meshes, log)
    words = geom.attributes.get("size", "").split()
    size = list(vector(geom, "size", len(words), "geom", log) or ()) + [0.0] * 3
    T = pose_of(geom, units, "geom", log)
    half = size[1]
    if "fromto" in geom.attributes:
        ends = np.array(vector(geom, "fromto", 6, "geom", log))
        along = ends[3:] - ends[:3]
        T, half = np.eye(4), 0.5 * float(np.linalg.norm(along))
        T[:3, :3] = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), along).toRotationMatrix()
        T[:3, 3] = 0.5 * (ends[:3] + ends[3:])
        size[2] = half
    shapes = {
        "sphere": f'<sphere radius="{size[0]!r}"/>',
        "capsule": f'<capsule radius="{size[0]!r}" length="{2 * half!r}"/>',
        "cylinder": f'<cylinder radius="{size[0]!r}" length="{2 * half!r}"/>',
        "box": f'<box size="{2 * size[0]!r} {2 * size[1]!r} {2 * size[2]!r}"/>',
        "ellipsoid": f'<box size="{2 * size[0]!r} {2 * size[1]!r} {2 * size[2]!r}"/>',
    }
    return shapes.get(kind, ""), T


def _mesh(geom: XmlNode, units: MjcfUnits, meshes: dict[str, XmlNode], log: Diagnostics) -> tuple[str, Matrix]:
    asset = meshes.get(geom.attributes.get("mesh", ""))
    if asset is None or "file" not in asset.attributes:
        return "", np.eye(4)
    scale = vector(asset, "scale", 3, "mesh", log) or (1.0, 1.0, 1.0)
    folder = f"{units.meshdir.rstrip('/')}/" if units.meshdir else ""
    file = quoteattr(folder + asset.attributes["file"])
    T = pose_of(geom, units, "geom", log)
    return f'<mesh filename={file} scale="{" ".join(map(repr, scale))}"/>', T


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
