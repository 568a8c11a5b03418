"""Elements of an MJCF file: attributes with their default classes, poses in every notation, shapes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final
from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.errors import RobotError
from manip_learn.robot.description.diagnostics import Diagnostics, shortened
from manip_learn.robot.description.urdf_elements import Matrix, as_pose
from manip_learn.robot.description.xml_node import XmlNode, vector

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
