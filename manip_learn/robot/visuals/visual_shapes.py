"""Shapes of a robot's links: the `<visual>` or `<collision>` elements of its URDF.

Meshes become checked triangles. What is wrong here costs a shape, never the robot.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.errors import RobotError
from manip_learn.robot.description.text import XmlNode, parse_xml, shortened
from manip_learn.robot.description.urdf import ZERO, Pose, Vector, as_matrix
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.meshes import Colour, Mesh, find_mesh, mesh_roots, read_meshes

Tag = Literal["visual", "collision"]
# times the length of all links together, beyond which a mesh is in millimetres; and the least such length [m]
LONGEST_LINK, SHORTEST_REACH = 20.0, 0.2
LARGEST_SIZE = 1e4  # [m] of a shape and its distance: more is a wrong unit
MAX_VISUALS = 2_000  # of a robot, so that its page can be drawn
GREY: Colour = (0.7, 0.7, 0.72, 1.0)  # red, green, blue and opacity: shapes without a colour


@final
class Solid(NamedTuple):
    """A plain body, centred at its origin.

    Attributes:
        kind: What it is.
        size: Of a box its edge lengths x, y, z; of a sphere its radius; of the others, which stand along z, radius and
            length, of a capsule without its half spheres [m].
    """

    kind: Literal["box", "sphere", "cylinder", "capsule"]
    size: tuple[float, ...]


@final
@dataclass(frozen=True, eq=False)
class Visual:
    """One shape on one link.

    Attributes:
        link: Name of the link.
        joint: Pinocchio id of the moving joint that carries it; 0 is the fixed world.
        placement: shape (4, 4), from the shape to that joint [m].
        shape: What to draw, a mesh with its scale applied; None where the file asks for what cannot be drawn.
        colour: Red, green, blue, opacity in 0 ... 1.
        fault: Empty, or why there is no shape.
    """

    link: str
    joint: int
    placement: Float[np.ndarray, "4 4"]
    shape: Solid | Mesh | None
    colour: Colour
    fault: str = ""


@final
class MeshElement(NamedTuple):
    """A mesh as the URDF names it: file name or package:// address, and the scale along x, y, z."""

    uri: str
    scale: Vector


@final
@dataclass(frozen=True)
class VisualElement:
    """One `<visual>` or `<collision>`; `geometry` is None where it cannot be used, and `fault` says why.

    Without a colour, `colour` is None; without a name of its own, `name` is empty.
    """

    link: str
    line: int | None
    pose: Pose
    geometry: Solid | MeshElement | None
    colour: Colour | None
    fault: str
    name: str


def visual_elements(content: bytes, path: Path, tag: Tag = "visual") -> list[VisualElement]:
    """All visuals of a validated URDF, or all its collision shapes, which have the same form."""
    root = parse_xml(content, path)
    colours = {m.attributes.get("name", ""): c for m in root.all("material") if (c := _colour(m)) is not None}
    found: list[VisualElement] = []
    for link in root.all("link"):
        name = link.attributes.get("name", "")
        for node in link.all(tag)[: MAX_VISUALS - len(found)]:
            pose, geometry, fault = Pose(), None, ""
            try:
                if (origin := node.first("origin")) is not None:
                    x, y, z = origin.vector("xyz", 3) or ZERO
                    roll, pitch, yaw = origin.vector("rpy", 3) or ZERO
                    if max(abs(x), abs(y), abs(z)) > LARGEST_SIZE:
                        raise _unusable(origin, f"its {origin.tag} is {max(abs(x), abs(y), abs(z)):g} m away")
                    pose = Pose((x, y, z), (roll, pitch, yaw))
                geometry = _geometry(node)
            except RobotError as error:
                fault = str(error)
            material, colour = node.first("material"), None
            if material is not None:
                colour = _colour(material) or colours.get(material.attributes.get("name", ""))
            own = node.attributes.get("name", "")
            found.append(VisualElement(name, node.line, pose, geometry, colour, fault, own))
    return found


def _geometry(node: XmlNode) -> Solid | MeshElement:
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
            return Solid("box", (x, y, z))
        case "sphere":
            return Solid("sphere", (_size(shape.number("radius"), shape),))
        case "cylinder" | "capsule" as kind:
            return Solid(kind, (_size(shape.number("radius"), shape), _size(shape.number("length"), shape)))
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


def resolve_meshes(robot: Robot) -> tuple[dict[str, Path], dict[str, str]]:
    """Look up the visual meshes of a robot without opening them.

    Returns:
        Address in the URDF -> file; and of the others, address -> why it cannot be used.
    """
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
    return found, missing


def visual_shapes(robot: Robot) -> tuple[Visual, ...]:
    """Shapes to draw, each placed on the moving joint that carries it.

    A mesh that is missing, unsafe or broken is a fault of its link, told once; without visuals every link has one. A
    mesh that is used twice at one scale is one object.
    """
    elements = _elements(robot)
    if not elements:
        bodies = {f.name for f in robot.pinocchio_model.frames if f.type == pin.FrameType.BODY}
        links, why = sorted(bodies & set(robot.frame_names)), "the robot has no visuals"
        elements = [VisualElement(link, 0, Pose(), None, None, why, "") for link in links]
    found, missing = resolve_meshes(robot)
    parsed, scaled = read_meshes(list(found.values())), dict[tuple[Path, Vector], Mesh]()
    model = robot.pinocchio_model
    reach = max(float(sum(np.linalg.norm(p.translation) for p in model.jointPlacements)), SHORTEST_REACH)
    visuals: list[Visual] = []
    for e in elements:
        shape, why, colour = e.geometry, e.fault, e.colour
        if isinstance(shape, MeshElement):
            not_found = missing.get(shape.uri, f"mesh {shape.uri!r} was not found")
            mesh = parsed[found[shape.uri]] if shape.uri in found else RobotError(not_found)
            if isinstance(mesh, RobotError):
                shape, why = None, str(mesh)
            else:
                # a mirror image turns every triangle inside out
                faces = mesh.faces[:, ::-1] if np.prod(shape.scale) < 0 else mesh.faces
                made = Mesh(mesh.vertices * np.array(shape.scale), faces, mesh.colour)
                length, why = float(np.ptp(made.vertices, axis=0).max()), e.fault
                if length > LONGEST_LINK * reach:
                    why = f"mesh {shape.uri!r} is {length:.3g} m long, {length / reach:.0f} times the arm's reach: its "
                    why += 'unit may be millimetres; scale="0.001 0.001 0.001" in its <mesh> says so'
                made = scaled.setdefault((found[shape.uri], shape.scale), made)
                shape, colour = None if why else made, colour or mesh.colour
        if shape is None and any(v.link == e.link and v.fault for v in visuals):
            continue
        frame = robot.pinocchio_model.frames[robot.frame(e.link).index]
        placement = frame.placement.homogeneous @ as_matrix(e.pose)
        visuals.append(Visual(e.link, int(frame.parentJoint), placement, shape, colour or GREY, why))
    return tuple(visuals)


def _elements(robot: Robot) -> list[VisualElement]:
    if robot.description is None:
        return []
    return visual_elements(robot.description, robot.source or Path(robot.name))
