"""Shapes of a robot's links: the `<visual>` or `<collision>` elements of its URDF.

Meshes become checked triangles. A faulty element is left out with a warning, and the other shapes are used; a link
without any usable shape gets simple substitutes.
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
from manip_learn.robot.description.text import XmlNode, merge_similar, parse_xml, shorten
from manip_learn.robot.description.urdf import ZERO, Pose, Vector, as_matrix
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.meshes import GREY, Colour, Mesh, find_mesh, mesh_roots, read_meshes

Tag = Literal["visual", "collision"]
LARGEST_SIZE = 1e4  # [m] largest size and distance of a shape: more is a wrong unit
SHEET = 1e-3  # [m] thickness of a flat shape


@final
class Solid(NamedTuple):
    """Simple geometric body, centred at its origin.

    Attributes:
        kind: Type of the body.
        size: Dimensions [m]: (x, y, z) of a box; (radius,) of a sphere; (radius, length) of a cylinder or capsule along
            z. The length of a capsule is without its half spheres.
    """

    kind: Literal["box", "sphere", "cylinder", "capsule"]
    size: tuple[float, ...]


@final
@dataclass(frozen=True, eq=False)
class Visual:
    """Shape of a link.

    Attributes:
        link: Name of the link.
        joint: Pinocchio id of the moving joint that carries it; 0 is the fixed world.
        placement: Pose (4, 4) of the shape in the frame of that joint [m].
        shape: Simple body, or mesh with its scale applied; None if the shape cannot be used.
        colour: Red, green, blue, opacity, each 0 to 1, for a shape without colours of its own.
        fault: Reason why the shape cannot be used; empty if it can.
    """

    link: str
    joint: int
    placement: Float[np.ndarray, "4 4"]
    shape: Solid | Mesh | None
    colour: Colour
    fault: str = ""


@final
class MeshElement(NamedTuple):
    """Mesh as given in a URDF: file name or `package://` address, and scale along x, y, z."""

    uri: str
    scale: Vector


@final
@dataclass(frozen=True)
class VisualElement:
    """Element `<visual>` or `<collision>` of a URDF.

    Attributes:
        link: Name of the link.
        pose: Pose in the link's frame.
        geometry: Simple body or mesh; None if the element cannot be used.
        colour: Red, green, blue, opacity, each 0 to 1; None if it has no colour.
        fault: Reason why it cannot be used; empty if it can.
        name: Name of the element; empty if it has none.
    """

    link: str
    pose: Pose
    geometry: Solid | MeshElement | None
    colour: Colour | None
    fault: str
    name: str = ""


def visual_elements(content: bytes, path: Path, tag: Tag = "visual") -> list[VisualElement]:
    """Read all `<visual>` or all `<collision>` elements of a validated URDF.

    Args:
        content: Text of the URDF.
        path: Its file, for error messages.
        tag: `"visual"` or `"collision"`.

    Returns:
        One element per shape, in file order.
    """
    root = parse_xml(content, path)
    colours = {m.attributes.get("name", ""): c for m in root.all("material") if (c := _colour(m)) is not None}
    out: list[VisualElement] = []
    most = 2_000  # elements of a robot, so that its page can be drawn
    for link in root.all("link"):
        name = link.attributes.get("name", "")
        for node in link.all(tag)[: most - len(out)]:
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
            material, own_name = node.first("material"), node.attributes.get("name", "")
            colour = material and (_colour(material) or colours.get(material.attributes.get("name", "")))
            out.append(VisualElement(name, pose, geometry, colour, fault, own_name))
    return out


def _geometry(node: XmlNode) -> Solid | MeshElement:
    """Return the body or the mesh of an element, or refuse it."""
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
            dimensions: Sequence[float | None] = shape.vector("size", 3) or (None,)
        case "sphere" as kind:
            dimensions = (shape.number("radius"),)
        case "cylinder" | "capsule" as kind:
            dimensions = (shape.number("radius"), shape.number("length"))
        case _:
            raise _unusable(shape, f"the shape <{shorten(shape.tag)}> is unknown")
    sizes = tuple(size or SHEET for size in dimensions if size is not None and 0.0 <= size <= LARGEST_SIZE)
    if len(sizes) < len(dimensions) or not any(dimensions):
        raise _unusable(shape, f"a size of its {shape.tag} is {next(size for size in dimensions if size not in sizes)}")
    return Solid(kind, sizes)


def _colour(material: XmlNode) -> Colour | None:
    """Return the colour of a material; None without a valid one."""
    node = material.first("color")
    with suppress(RobotError):
        if node is not None and (rgba := node.vector("rgba", 4)) is not None:
            r, g, b, a = (min(max(c, 0.0), 1.0) for c in rgba)
            return (r, g, b, a)
    return None


def _unusable(node: XmlNode, seen: str) -> RobotError:
    """Return the error for an unusable shape."""
    return node.refusal("visual", f"{seen}; a usable shape is expected")


def losses(shapes: Sequence[Visual]) -> tuple[str, ...]:
    """Return one sentence per reason for which shapes cannot be used, with the names of their links.

    Args:
        shapes: All shapes of a robot, from `visual_shapes`.
    """
    reasons, bare = merge_similar(v.fault for v in shapes if v.fault), bare_links(shapes)
    links = dict[tuple[str, str], dict[str, None]]()
    for v in shapes:
        if v.fault:
            head = "Plain shapes stand in for" if v.link in bare else "A shape is missing from"
            links.setdefault((head, reasons[v.fault]), {})[v.link] = None
    return tuple(f"{head} {few(list(names), 4)}: {reason}." for (head, reason), names in links.items())


def shape_faults(robot: Robot, *tags: Tag) -> tuple[str, ...]:
    """Return one sentence per reason for which shapes of a robot cannot be used.

    Args:
        robot: The robot.
        *tags: Elements to check, `"visual"` or `"collision"`. A tag that the description does not use gives no
            sentence.
    """
    sentences = (losses(visual_shapes(robot, tag)) for tag in tags if _elements(robot, tag))
    return tuple(dict.fromkeys(sentence for one in sentences for sentence in one))


def bare_links(shapes: Sequence[Visual]) -> dict[str, int]:
    """Return the links none of whose shapes can be used.

    Args:
        shapes: All shapes of a robot, from `visual_shapes`.

    Returns:
        Dictionary from the name of a link to the Pinocchio id of the joint that carries it.
    """
    covered = {v.link for v in shapes if not v.fault}
    return {v.link: v.joint for v in shapes if v.link not in covered}


def resolve_meshes(robot: Robot, tag: Tag = "visual") -> tuple[dict[str, Path], dict[str, str]]:
    """Find the mesh files of a robot without opening them.

    Args:
        robot: The robot.
        tag: `"visual"` for its visual shapes, `"collision"` for its collision shapes.

    Returns:
        Dictionary from the address in the URDF to the file; and, for meshes that were not found, from the address to
        the reason.
    """
    files, missing = dict[str, Path](), dict[str, str]()
    roots = mesh_roots(robot.source or Path(robot.name), robot.package_dirs)
    for uri in dict.fromkeys(e.geometry.uri for e in _elements(robot, tag) if isinstance(e.geometry, MeshElement)):
        try:
            files[uri] = find_mesh(uri, roots)
        except RobotError as error:
            missing[uri] = str(error)
    return files, missing


@lru_cache(maxsize=16)
def visual_shapes(robot: Robot, tag: Tag = "visual") -> tuple[Visual, ...]:
    """Return the shapes of a robot's links, each with its pose on the moving joint that carries it.

    A shape with a missing, unsafe or broken mesh has a `fault` instead of a shape; so has every link of a robot without
    visuals. A mesh that is used twice at one scale is one object.

    Args:
        robot: The robot.
        tag: `"visual"` for its visual shapes, `"collision"` for its collision shapes.
    """
    elements, model, shapes = _elements(robot, tag), robot.pinocchio_model, list[Visual]()
    if not elements and tag == "visual":
        bodies = {f.name for f in model.frames if f.type == pin.FrameType.BODY}
        links, why = sorted(bodies & set(robot.frame_names)), "the robot has no visuals"
        elements = tuple(VisualElement(link, Pose(), None, None, why) for link in links)
    files, missing = resolve_meshes(robot, tag)
    parsed = read_meshes(list(files.values()))
    reach = max(float(sum(np.linalg.norm(p.translation) for p in model.jointPlacements)), 0.2)  # [m] at least

    @cache
    def scaled_mesh(uri: str, scale: Vector, is_painted: bool) -> tuple[Mesh | None, str]:
        mesh = parsed[files[uri]] if uri in files else missing[uri]
        if not isinstance(mesh, Mesh):
            return None, str(mesh)
        length = float(np.ptp(mesh.vertices * scale, axis=0).max())
        if length > 20.0 * reach:  # longer meshes are probably in millimetres
            why = f"mesh {uri!r} is {length:.3g} m long, {length / reach:.0f} times the arm's reach: its unit may be "
            return None, why + 'millimetres; scale="0.001 0.001 0.001" in its <mesh> says so'
        # a mirror image turns every triangle inside out
        faces = mesh.faces[:, ::-1] if np.prod(scale) < 0 else mesh.faces
        return Mesh(mesh.vertices * scale, faces, None if is_painted else mesh.colours), ""

    for e in elements:
        shape, fault = e.geometry, e.fault
        if isinstance(shape, MeshElement):
            shape, fault = scaled_mesh(*shape, is_painted=e.colour is not None)
        if fault and any((v.link, v.fault) == (e.link, fault) for v in shapes):
            continue
        frame = model.frames[robot.frame(e.link).index]
        placement = np.asarray(frame.placement.homogeneous @ as_matrix(e.pose))
        shapes.append(Visual(e.link, int(frame.parentJoint), placement, shape, e.colour or GREY, fault))
    return tuple(shapes)


@lru_cache(maxsize=16)
def _elements(robot: Robot, tag: Tag) -> tuple[VisualElement, ...]:
    """Read the elements of a robot; empty without a description."""
    if robot.description is None:
        return ()
    return tuple(visual_elements(robot.description, robot.source or Path(robot.name), tag))
