"""Shapes of a robot's links: the `<visual>` or `<collision>` elements of its URDF.

Meshes become checked triangles, with plain shapes where there is nothing better. What is wrong here costs a shape,
never the robot.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float, Int

from manip_learn.errors import RobotError
from manip_learn.robot.description.text import XmlNode, parse_xml, shortened
from manip_learn.robot.description.urdf import ZERO, Pose, as_matrix
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.meshes import Colour, find_mesh, mesh_roots, read_meshes

Tag = Literal["visual", "collision"]
LARGEST_SIZE = 1e4  # [m] of a shape and its distance: more is a wrong unit
MAX_VISUALS = 2_000  # of a robot, so that its page can be drawn
STAND_IN: Colour = (0.55, 0.60, 0.68, 1.0)  # red, green, blue and opacity: links without a shape of their own
GREY: Colour = (0.7, 0.7, 0.72, 1.0)  # red, green, blue and opacity: shapes without a colour
THIN = 0.02  # [m] radius of rods and balls
MESH_REASON = re.compile(r"mesh (?P<name>'[^']*'|\"[^\"]*\")(?P<why>.*)")


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
    colours = {m.attributes.get("name", ""): c for m in root.all("material") if (c := _colour(m)) is not None}
    found: list[VisualElement] = []
    for link in root.all("link"):
        name = link.attributes.get("name", "")
        found += [_element(name, visual, colours) for visual in link.all(tag)[: MAX_VISUALS - len(found)]]
    return found


def _element(link: str, node: XmlNode, colours: dict[str, Colour]) -> VisualElement:
    pose, geometry, fault = Pose(), None, ""
    try:
        pose = _pose(node)
        geometry = _geometry(node)
    except RobotError as error:
        fault = str(error)
    material, colour = node.first("material"), None
    if material is not None:
        colour = _colour(material) or colours.get(material.attributes.get("name", ""))
    return VisualElement(link, node.line, pose, geometry, colour, fault)


def _pose(node: XmlNode) -> Pose:
    origin = node.first("origin")
    if origin is None:
        return Pose()
    x, y, z = origin.vector("xyz", 3) or ZERO
    roll, pitch, yaw = origin.vector("rpy", 3) or ZERO
    if max(abs(x), abs(y), abs(z)) > LARGEST_SIZE:
        raise _unusable(origin, f"its {node.tag} is {max(abs(x), abs(y), abs(z)):g} m away")
    return Pose((x, y, z), (roll, pitch, yaw))


def _geometry(node: XmlNode) -> Shape | MeshElement:
    geometry = node.first("geometry")
    if geometry is None or not geometry.children:
        raise _unusable(node, f"its <{node.tag}> has no geometry")
    shape = geometry.children[0]
    match shape.tag:
        case "mesh":
            uri = shape.attributes.get("filename", "")
            x, y, z = shape.vector("scale", 3) or (1.0, 1.0, 1.0)
            if not uri:
                raise _unusable(shape, "its <mesh> has no filename")
            if not all(1e-9 <= abs(s) <= LARGEST_SIZE for s in (x, y, z)):
                raise _unusable(shape, f"its mesh scale is {(x, y, z)}")
            return MeshElement(uri, (x, y, z))
        case "box":
            x, y, z = (_size(s, shape) for s in shape.vector("size", 3) or (None,) * 3)
            return Box((x, y, z))
        case "sphere":
            return Sphere(_size(shape.number("radius"), shape))
        case "cylinder" | "capsule" as kind:
            made = Cylinder if kind == "cylinder" else Capsule
            return made(_size(shape.number("radius"), shape), _size(shape.number("length"), shape))
    raise _unusable(shape, f"the shape <{shortened(shape.tag)}> is not known")


def _size(value: float | None, node: XmlNode) -> float:
    if value is None or not 0.0 < value <= LARGEST_SIZE:
        raise _unusable(node, f"a size of its {node.tag} is {value}")
    return value


def _colour(material: XmlNode) -> Colour | None:
    node = material.first("color")
    try:
        rgba = None if node is None else node.vector("rgba", 4)
    except RobotError:
        return None
    if rgba is None:
        return None
    r, g, b, a = (min(max(c, 0.0), 1.0) for c in rgba)
    return (r, g, b, a)


def _unusable(node: XmlNode, seen: str) -> RobotError:
    return node.refusal("visual", f"{seen}; a usable shape is expected; a plain shape is drawn")


@final
@dataclass(frozen=True)
class MeshReport:
    """Which mesh files of a robot are there.

    Attributes:
        found: Address in the URDF -> file.
        missing: Address in the URDF -> why it cannot be used.
    """

    found: dict[str, Path]
    missing: dict[str, str]

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence per reason why meshes cannot be used."""
        return tuple(dict.fromkeys(said_once(self.missing.values()).values()))


def said_once(reasons: Iterable[str]) -> dict[str, str]:
    """Reason -> sentence; reasons that differ in the name of the mesh only share one, with their number."""
    names: dict[str, list[str]] = {}
    found = {reason: MESH_REASON.fullmatch(reason) for reason in reasons}
    for match in filter(None, found.values()):
        names.setdefault(match["why"], []).append(match["name"])
    return {
        reason: f"mesh {same[0]} (and {len(same) - 1} more){match['why']}"
        if match and len(same := names[match["why"]]) > 1
        else reason
        for reason, match in found.items()
    }


def resolve_meshes(robot: Robot) -> MeshReport:
    """Look up the visual meshes of a robot without opening them."""
    addresses = [e.geometry.uri for e in _elements(robot) if isinstance(e.geometry, MeshElement)]
    found: dict[str, Path] = {}
    missing: dict[str, str] = {}
    if addresses and robot.source is not None:
        roots = mesh_roots(robot.source, robot.package_dirs)
        for uri in dict.fromkeys(addresses):
            try:
                found[uri] = find_mesh(uri, roots)
            except RobotError as error:
                missing[uri] = str(error)
    return MeshReport(found, missing)


def visual_shapes(robot: Robot, meshes: bool = True) -> tuple[Visual, ...]:
    """Shapes to draw, each placed on the moving joint that carries it.

    A mesh that is missing, unsafe or broken becomes a plain shape whose `stand_in` says why. A robot without visuals
    is drawn as sticks from joint to joint.

    Args:
        robot: A loaded robot.
        meshes: False to draw plain shapes in place of all meshes, without opening a file.
    """
    elements = _elements(robot)
    if not elements:
        bodies = {f.name for f in robot.pinocchio_model.frames if f.type == pin.FrameType.BODY}
        return _sticks(robot, sorted(bodies & set(robot.frame_names)), "the robot has no visuals")
    report = resolve_meshes(robot) if meshes else MeshReport({}, {})
    parsed = read_meshes(list(report.found.values())) if meshes else {}
    visuals: list[Visual] = []
    for e in elements:
        shape, why, colour = e.geometry, e.fault, e.colour
        if isinstance(shape, MeshElement):
            path = report.found.get(shape.uri, Path())
            missing = report.missing.get(shape.uri, f"mesh {shape.uri!r} was not found")
            mesh = parsed.get(path, RobotError(missing if meshes else "meshes are switched off"))
            if isinstance(mesh, RobotError):
                shape, why = None, str(mesh)
            else:
                # a mirror image turns every triangle inside out
                faces = mesh.faces[:, ::-1].copy() if np.prod(shape.scale) < 0 else mesh.faces
                shape, colour = Triangles(mesh.vertices * np.array(shape.scale), faces, path), colour or mesh.colour
        if shape is not None:
            frame = robot.pinocchio_model.frames[robot.frame(e.link).index]
            placement = frame.placement.homogeneous @ as_matrix(e.pose)
            visuals.append(Visual(e.link, int(frame.parentJoint), placement, shape, colour or GREY))
        # one stick figure per link is enough, however many of its meshes are missing
        elif not any(v.link == e.link and v.stand_in for v in visuals):
            visuals += _sticks(robot, [e.link], why)
    return tuple(visuals)


def _elements(robot: Robot) -> list[VisualElement]:
    if robot.description is None:
        return []
    return visual_elements(robot.description, robot.source or Path(robot.name))


def _sticks(robot: Robot, links: list[str], why: str) -> tuple[Visual, ...]:
    """Rods from each link's origin to its child joints, and a ball where there is none."""
    model = robot.pinocchio_model
    visuals: list[Visual] = []
    for link in links:
        index = robot.frame(link).index
        frame = model.frames[index]
        joint = int(frame.parentJoint)
        start = np.asarray(frame.placement.translation)
        ends = [
            np.asarray(
                f.placement.translation if f.parentJoint == joint else model.jointPlacements[f.parentJoint].translation
            )
            for f in model.frames
            if f.type in (pin.FrameType.JOINT, pin.FrameType.FIXED_JOINT)
            and f.parentFrame == index
            and f.name != "universe"
        ]
        rods = [(start, end) for end in ends if np.linalg.norm(end - start) > 1e-6]
        for a, b in rods:
            length = float(np.linalg.norm(b - a))
            rod = Cylinder(min(THIN, 0.15 * length), length)
            turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), b - a)  # z along b - a
            pose = pin.SE3(turn.toRotationMatrix(), 0.5 * (a + b)).homogeneous
            visuals.append(Visual(link, joint, pose, rod, STAND_IN, why))
        if not rods:
            visuals.append(Visual(link, joint, frame.placement.homogeneous.copy(), Sphere(THIN), STAND_IN, why))
    return tuple(visuals)
