"""Shapes of a robot's links: the `<visual>` or `<collision>` elements of its URDF.

Meshes become checked triangles. What is wrong here costs a shape, never the robot: the others count, and plain shapes
stand in for a link that loses all of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Literal, NamedTuple, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.errors import RobotError, few
from manip_learn.robot.description.text import XmlNode, parse_xml, said_once, shortened
from manip_learn.robot.description.urdf import ZERO, Pose, Vector, as_matrix
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.meshes import GREY, Colour, Mesh, find_mesh, mesh_roots, read_meshes

Tag = Literal["visual", "collision"]
# times the length of all links together, beyond which a mesh is in millimetres; and the least such length [m]
LONGEST_LINK, SHORTEST_REACH = 20.0, 0.2
LARGEST_SIZE = 1e4  # [m] of a shape and its distance: more is a wrong unit
SHEET = 1e-3  # [m] thickness of a shape that has none
MAX_VISUALS = 2_000  # of a robot, so that its page can be drawn


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
        shape: What it is, a mesh with its scale applied; None where the file asks for what cannot be used.
        colour: Red, green, blue, opacity in 0 ... 1, of a shape that has no colours of its own.
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
    pose: Pose
    geometry: Solid | MeshElement | None
    colour: Colour | None
    fault: str
    name: str = ""


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
            material, own = node.first("material"), node.attributes.get("name", "")
            colour = material and (_colour(material) or colours.get(material.attributes.get("name", "")))
            found.append(VisualElement(name, pose, geometry, colour, fault, own))
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
        case "box" as kind:
            given: Sequence[float | None] = shape.vector("size", 3) or (None,)
        case "sphere" as kind:
            given = (shape.number("radius"),)
        case "cylinder" | "capsule" as kind:
            given = (shape.number("radius"), shape.number("length"))
        case _:
            raise _unusable(shape, f"the shape <{shortened(shape.tag)}> is not known")
    sizes = tuple(size or SHEET for size in given if size is not None and 0.0 <= size <= LARGEST_SIZE)
    if len(sizes) < len(given) or not any(given):
        raise _unusable(shape, f"a size of its {shape.tag} is {next(size for size in given if size not in sizes)}")
    return Solid(kind, sizes)


def _colour(material: XmlNode) -> Colour | None:
    node = material.first("color")
    with suppress(RobotError):
        if node is not None and (rgba := node.vector("rgba", 4)) is not None:
            r, g, b, a = (min(max(c, 0.0), 1.0) for c in rgba)
            return (r, g, b, a)
    return None


def _unusable(node: XmlNode, seen: str) -> RobotError:
    return node.refusal("visual", f"{seen}; a usable shape is expected")


def losses(shapes: Sequence[Visual]) -> tuple[str, ...]:
    """Say in one sentence for each reason which links lose a shape.

    Args:
        shapes: All of a robot, see `visual_shapes`.
    """
    said, bare = said_once(v.fault for v in shapes if v.fault), bare_links(shapes)
    links = dict[tuple[str, str], dict[str, None]]()
    for v in shapes:
        if v.fault:
            head = "Plain shapes stand in for" if v.link in bare else "A shape is missing of"
            links.setdefault((head, said[v.fault]), {})[v.link] = None
    return tuple(f"{head} {few(list(names), 4)}: {reason}." for (head, reason), names in links.items())


def shape_faults(robot: Robot, *tags: Tag) -> tuple[str, ...]:
    """Return a sentence for each reason for which a link loses a shape; none for elements that there are not.

    Args:
        robot: The robot.
        tags: Which of its elements are looked at.
    """
    sentences = (losses(visual_shapes(robot, tag)) for tag in tags if _elements(robot, tag))
    return tuple(dict.fromkeys(sentence for one in sentences for sentence in one))


def bare_links(shapes: Sequence[Visual]) -> dict[str, int]:
    """Return the links that lose all of their shapes, each with the joint that carries it."""
    kept = {v.link for v in shapes if not v.fault}
    return {v.link: v.joint for v in shapes if v.link not in kept}


def resolve_meshes(robot: Robot, tag: Tag = "visual") -> tuple[dict[str, Path], dict[str, str]]:
    """Look up the meshes of a robot without opening them.

    Args:
        robot: The robot.
        tag: Whether they are those of its drawn shapes or of those for collisions.

    Returns:
        Address in the URDF -> file; and of the others, address -> why it cannot be used.
    """
    found, missing = dict[str, Path](), dict[str, str]()
    roots = mesh_roots(robot.source or Path(robot.name), robot.package_dirs)
    for uri in dict.fromkeys(e.geometry.uri for e in _elements(robot, tag) if isinstance(e.geometry, MeshElement)):
        try:
            found[uri] = find_mesh(uri, roots)
        except RobotError as error:
            missing[uri] = str(error)
    return found, missing


@lru_cache(maxsize=16)
def visual_shapes(robot: Robot, tag: Tag = "visual") -> tuple[Visual, ...]:
    """Return the shapes of a robot's links, each placed on the moving joint that carries it.

    A mesh that is missing, unsafe or broken is a fault of its link, told once; without visuals every link has one. A
    mesh that is used twice at one scale is one object.

    Args:
        robot: The robot.
        tag: Whether they are the shapes to draw or those for collisions.
    """
    elements, model, shapes = _elements(robot, tag), robot.pinocchio_model, list[Visual]()
    if not elements and tag == "visual":
        bodies = {f.name for f in model.frames if f.type == pin.FrameType.BODY}
        links, why = sorted(bodies & set(robot.frame_names)), "the robot has no visuals"
        elements = tuple(VisualElement(link, Pose(), None, None, why) for link in links)
    found, missing = resolve_meshes(robot, tag)
    parsed = read_meshes(list(found.values()))
    reach = max(float(sum(np.linalg.norm(p.translation) for p in model.jointPlacements)), SHORTEST_REACH)

    @cache
    def made(uri: str, scale: Vector, is_painted: bool) -> tuple[Mesh | None, str]:
        mesh = parsed[found[uri]] if uri in found else missing[uri]
        if not isinstance(mesh, Mesh):
            return None, str(mesh)
        length = float(np.ptp(mesh.vertices * scale, axis=0).max())
        if length > LONGEST_LINK * reach:
            why = f"mesh {uri!r} is {length:.3g} m long, {length / reach:.0f} times the arm's reach: its unit may be "
            return None, why + 'millimetres; scale="0.001 0.001 0.001" in its <mesh> says so'
        # a mirror image turns every triangle inside out
        faces = mesh.faces[:, ::-1] if np.prod(scale) < 0 else mesh.faces
        return Mesh(mesh.vertices * scale, faces, None if is_painted else mesh.colours), ""

    for e in elements:
        shape, fault = e.geometry, e.fault
        if isinstance(shape, MeshElement):
            shape, fault = made(*shape, is_painted=e.colour is not None)
        if fault and any((v.link, v.fault) == (e.link, fault) for v in shapes):
            continue
        frame = model.frames[robot.frame(e.link).index]
        placement = np.asarray(frame.placement.homogeneous @ as_matrix(e.pose))
        shapes.append(Visual(e.link, int(frame.parentJoint), placement, shape, e.colour or GREY, fault))
    return tuple(shapes)


@lru_cache(maxsize=16)
def _elements(robot: Robot, tag: Tag) -> tuple[VisualElement, ...]:
    if robot.description is None:
        return ()
    return tuple(visual_elements(robot.description, robot.source or Path(robot.name), tag))
