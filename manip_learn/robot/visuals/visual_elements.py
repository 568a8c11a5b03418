"""The `<visual>` or `<collision>` elements of a URDF. What is wrong here costs a shape, never the robot."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.errors import RobotError
from manip_learn.robot.description.diagnostics import Diagnostics, shortened
from manip_learn.robot.description.urdf_elements import ZERO, Pose
from manip_learn.robot.description.xml_node import XmlNode, number, parse_xml, vector

Colour = tuple[float, float, float, float]
Tag = Literal["visual", "collision"]
LARGEST = 1e4  # [m]
MAX_VISUALS = 2_000


@final
@dataclass(frozen=True)
class Box:
    """A box around its origin; edge lengths x, y, z [m]."""

    size: tuple[float, float, float]


@final
@dataclass(frozen=True)
class Sphere:
    """A sphere around its origin [m]."""

    radius: float


@final
@dataclass(frozen=True)
class Cylinder:
    """A cylinder along z, its middle at the origin [m]."""

    radius: float
    length: float


@final
@dataclass(frozen=True)
class Capsule:
    """A cylinder along z with half spheres on both ends; `length` is that of the cylinder [m]."""

    radius: float
    length: float


@final
@dataclass(frozen=True, eq=False)
class Triangles:
    """A checked mesh: finite vertices, indices in range, scale applied.

    Attributes:
        vertices: shape (n, 3) [m].
        faces: shape (m, 3), counted from 0.
        source: File it was read from.
    """

    vertices: Float[np.ndarray, "n 3"]
    faces: Int[np.ndarray, "m 3"]
    source: Path

    def __post_init__(self) -> None:
        self.vertices.setflags(write=False)
        self.faces.setflags(write=False)


Shape = Box | Sphere | Cylinder | Capsule | Triangles


@final
@dataclass(frozen=True, eq=False)
class Visual:
    """One shape on one link.

    Attributes:
        link: Name of the link.
        joint: Pinocchio id of the moving joint that carries it; 0 is the fixed world.
        placement: shape (4, 4), from the shape to that joint [m].
        shape: What to draw.
        colour: Red, green, blue, opacity in 0 ... 1.
        stand_in: Empty, or why a plain shape is drawn in place of what the file asks for.
    """

    link: str
    joint: int
    placement: Float[np.ndarray, "4 4"]
    shape: Shape
    colour: Colour
    stand_in: str = ""

    def __post_init__(self) -> None:
        self.placement.setflags(write=False)


@final
@dataclass(frozen=True)
class MeshElement:
    """A mesh as the URDF names it.

    Attributes:
        uri: File name or package:// address.
        scale: Along x, y, z.
    """

    uri: str
    scale: tuple[float, float, float]


@final
@dataclass(frozen=True)
class VisualElement:
    """One `<visual>` or `<collision>`; `geometry` is None where it cannot be used, and `fault` says why.

    Without a colour, `colour` is None.
    """

    link: str
    line: int
    pose: Pose
    geometry: Shape | MeshElement | None
    colour: Colour | None
    fault: str


def visual_elements(content: bytes, path: Path, tag: Tag = "visual") -> list[VisualElement]:
    """All visuals of a validated URDF, or all its collision shapes, which have the same form.

    Raises:
        RobotError: The text is not XML.
    """
    root = parse_xml(content, path)
    log = Diagnostics(path)
    colours = {m.attributes.get("name", ""): c for m in root.all("material") if (c := _colour(m, log)) is not None}
    found: list[VisualElement] = []
    for link in root.all("link"):
        for visual in link.all(tag)[: MAX_VISUALS - len(found)]:
            found.append(_element(link.attributes.get("name", ""), visual, colours, log))
    return found


def _element(link: str, node: XmlNode, colours: dict[str, Colour], log: Diagnostics) -> VisualElement:
    pose, geometry, fault = Pose(), None, ""
    where = f"link {link!r}"
    try:
        pose = _pose(node, where, log)
        geometry = _geometry(node, where, log)
    except RobotError as error:
        fault = str(error)
    material = node.first("material")
    colour = None
    if material is not None:
        colour = _colour(material, log) or colours.get(material.attributes.get("name", ""))
    return VisualElement(link, node.line, pose, geometry, colour, fault)


def _pose(node: XmlNode, where: str, log: Diagnostics) -> Pose:
    origin = node.first("origin")
    if origin is None:
        return Pose()
    x, y, z = vector(origin, "xyz", 3, where, log) or ZERO
    roll, pitch, yaw = vector(origin, "rpy", 3, where, log) or ZERO
    if max(abs(x), abs(y), abs(z)) > LARGEST:
        raise _unusable(origin, where, f"its {node.tag} is {max(abs(x), abs(y), abs(z)):g} m away", log)
    return Pose((x, y, z), (roll, pitch, yaw))


def _geometry(node: XmlNode, where: str, log: Diagnostics) -> Shape | MeshElement:
    geometry = node.first("geometry")
    if geometry is None or not geometry.children:
        raise _unusable(node, where, f"its <{node.tag}> has no geometry", log)
    shape = geometry.children[0]
    if shape.tag == "mesh":
        uri = shape.attributes.get("filename", "")
        scale = vector(shape, "scale", 3, where, log) or (1.0, 1.0, 1.0)
        if not uri:
            raise _unusable(shape, where, "its <mesh> has no filename", log)
        if not all(1e-9 <= abs(s) <= LARGEST for s in scale):
            raise _unusable(shape, where, f"its mesh scale is {scale}", log)
        return MeshElement(uri, (scale[0], scale[1], scale[2]))
    if shape.tag == "box":
        x, y, z = (_size(s, shape, where, log) for s in vector(shape, "size", 3, where, log) or (None,) * 3)
        return Box((x, y, z))
    if shape.tag in ("sphere", "cylinder", "capsule"):
        radius = _size(number(shape, "radius", where, log), shape, where, log)
        if shape.tag == "sphere":
            return Sphere(radius)
        length = _size(number(shape, "length", where, log), shape, where, log)
        return Cylinder(radius, length) if shape.tag == "cylinder" else Capsule(radius, length)
    raise _unusable(shape, where, f"the shape <{shortened(shape.tag)}> is not known", log)


def _size(value: float | None, node: XmlNode, where: str, log: Diagnostics) -> float:
    if value is None or not 0.0 < value <= LARGEST:
        raise _unusable(node, where, f"a size of its {node.tag} is {value}", log)
    return value


def _colour(material: XmlNode, log: Diagnostics) -> Colour | None:
    node = material.first("color")
    if node is None:
        return None
    try:
        rgba = vector(node, "rgba", 4, "material", log)
    except RobotError:
        return None
    if rgba is None:
        return None
    r, g, b, a = (min(max(c, 0.0), 1.0) for c in rgba)
    return (r, g, b, a)


def _unusable(node: XmlNode, where: str, seen: str, log: Diagnostics) -> RobotError:
    return log.refusal("visual", node.line, where, seen, "a usable shape is expected", "a plain shape is drawn")
