"""The shapes of a robot's links that must not touch: convex ones, meshes as their convex hulls."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import coal
import numpy as np
import pinocchio as pin
from jaxtyping import Float, Int

from manip_learn.errors import RobotError
from manip_learn.robot.description.urdf_elements import as_matrix
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.mesh_paths import find_mesh, mesh_roots
from manip_learn.robot.visuals.mesh_reader import Mesh, read_meshes
from manip_learn.robot.visuals.visual_elements import (
    Box,
    Capsule,
    Cylinder,
    MeshElement,
    Shape,
    Sphere,
    Tag,
    VisualElement,
    visual_elements,
)

TRIANGLE = 3


@final
@dataclass(frozen=True, eq=False)
class CollisionShape:
    """One convex shape on one link.

    Attributes:
        link: Name of the link.
        joint: Pinocchio id of the moving joint that carries it; 0 is the fixed world.
        placement: shape (4, 4), from the shape to that joint [m].
        geometry: The shape for the distance computation.
        centre: Centre of a ball that contains the shape, in the joint's frame [m].
        radius: Radius of that ball [m].
    """

    link: str
    joint: int
    placement: Float[np.ndarray, "4 4"]
    geometry: Any
    centre: Float[np.ndarray, " 3"]
    radius: float


def collision_shapes(robot: Robot, tag: Tag = "collision") -> tuple[CollisionShape, ...]:
    """All collision shapes of a robot.

    Args:
        robot: A loaded robot.
        tag: `"visual"` takes the shapes that are drawn in their place.

    Raises:
        RobotError: The robot has none, or one of them cannot be used; codes `no-collision-shapes`, `collision-shape`
            and those of meshes.
    """
    path = robot.source or Path(robot.name)
    elements = visual_elements(robot.description, path, tag) if robot.description is not None else []
    if not elements:
        instead = ": the shapes of its <visual> elements can take their place (shapes='visual')"
        has_visuals = tag == "collision" and robot.description is not None and visual_elements(robot.description, path)
        raise RobotError(
            f"robot {robot.name!r} has no <{tag}> elements, whose distances could be computed"
            f"{instead if has_visuals else ''}",
            code="no-collision-shapes",
            path=robot.source,
        )
    meshes = _meshes(robot, elements)
    return tuple(_shape(robot, element, meshes) for element in elements)


def _meshes(robot: Robot, elements: list[VisualElement]) -> dict[str, Mesh]:
    """Address in the URDF -> vertices and faces."""
    addresses = dict.fromkeys(e.geometry.uri for e in elements if isinstance(e.geometry, MeshElement))
    if not addresses:
        return {}
    roots = mesh_roots(robot.source or Path(), robot.package_dirs)
    files = {uri: find_mesh(uri, roots) for uri in addresses}
    parsed = read_meshes(list(files.values()))
    meshes = {}
    for uri, file in files.items():
        mesh = parsed[file]
        if isinstance(mesh, RobotError):
            raise mesh
        meshes[uri] = mesh
    return meshes


def _shape(robot: Robot, element: VisualElement, meshes: dict[str, Mesh]) -> CollisionShape:
    frame = robot.pinocchio_model.frames[robot.frame(element.link).index]
    placement = np.asarray(frame.placement.homogeneous @ as_matrix(element.pose))
    if element.geometry is None:
        raise RobotError(element.fault, code="collision-shape", path=robot.source, line=element.line)
    if isinstance(element.geometry, MeshElement):
        vertices = meshes[element.geometry.uri][0] * np.array(element.geometry.scale)
        points, faces = _hull(vertices, element, robot)
        geometry, middle = _convex(points, faces), 0.5 * (points.min(axis=0) + points.max(axis=0))
        radius = float(np.linalg.norm(points - middle, axis=1).max())
    else:
        geometry, radius = _primitive(element.geometry)
        middle = np.zeros(3)
    centre = placement[:3, :3] @ middle + placement[:3, 3]
    return CollisionShape(element.link, int(frame.parentJoint), placement, geometry, centre, radius)


def _hull(
    vertices: Float[np.ndarray, "n 3"], element: VisualElement, robot: Robot
) -> tuple[Float[np.ndarray, "k 3"], Int[np.ndarray, "m 3"]]:
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(vertices)
    except (QhullError, ValueError) as error:
        raise RobotError(
            f"link {element.link!r}: its collision mesh has no volume, so that distances to it are not defined",
            code="collision-shape",
            path=robot.source,
            line=element.line,
        ) from error
    number = np.full(len(vertices), -1)
    number[hull.vertices] = np.arange(len(hull.vertices))
    faces = number[hull.simplices]
    # SciPy leaves the sense of rotation open: outward is away from a point within
    a, b, c = (hull.points[hull.simplices[:, i]] for i in range(TRIANGLE))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return hull.points[hull.vertices], faces


def _convex(points: Float[np.ndarray, "k 3"], faces: Int[np.ndarray, "m 3"]) -> Any:
    vertices, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for point in points:
        vertices.append(point)
    for i, j, k in faces.tolist():
        triangles.append(coal.Triangle(i, j, k))
    return coal.Convex(vertices, triangles)


def _primitive(shape: Shape) -> tuple[Any, float]:
    """The shape and the radius of the ball around it."""
    if isinstance(shape, Box):
        return coal.Box(*shape.size), 0.5 * float(np.linalg.norm(shape.size))
    if isinstance(shape, Sphere):
        return coal.Sphere(shape.radius), shape.radius
    if isinstance(shape, Cylinder):
        return coal.Cylinder(shape.radius, shape.length), float(np.hypot(shape.radius, 0.5 * shape.length))
    if isinstance(shape, Capsule):
        return coal.Capsule(shape.radius, shape.length), shape.radius + 0.5 * shape.length
    return _convex(shape.vertices, shape.faces), float(np.linalg.norm(shape.vertices, axis=1).max())


def geometry_object(shape: CollisionShape, number: int) -> pin.GeometryObject:
    """The shape as Pinocchio keeps it."""
    placement = pin.SE3(shape.placement[:3, :3], shape.placement[:3, 3])
    return pin.GeometryObject(f"{shape.link}_{number}", shape.joint, placement, shape.geometry)
