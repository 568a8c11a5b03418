"""What a robot looks like: shapes on links, checked meshes as triangles, plain shapes where there is nothing better."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.errors import RobotError
from manip_learn.robot.description.urdf_elements import as_matrix
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.mesh_content import mesh_colour
from manip_learn.robot.visuals.mesh_paths import find_mesh, mesh_roots
from manip_learn.robot.visuals.mesh_reader import Mesh, read_meshes
from manip_learn.robot.visuals.visual_elements import (
    Box,
    Capsule,
    Colour,
    Cylinder,
    MeshElement,
    Shape,
    Sphere,
    Triangles,
    Visual,
    VisualElement,
    visual_elements,
)

STAND_IN: Colour = (0.55, 0.60, 0.68, 1.0)
GREY: Colour = (0.7, 0.7, 0.72, 1.0)
THIN = 0.02  # [m]
MESH_REASON = re.compile(r"mesh (?P<name>'[^']*'|\"[^\"]*\")(?P<why>.*)")

__all__ = [
    "Box",
    "Capsule",
    "Cylinder",
    "MeshReport",
    "Sphere",
    "Triangles",
    "Visual",
    "resolve_meshes",
    "visual_shapes",
]


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
        return _sticks(robot, sorted(_body_names(robot)), "the robot has no visuals")
    report = resolve_meshes(robot) if meshes else MeshReport({}, {})
    parsed = read_meshes(list(report.found.values())) if meshes else {}
    visuals: list[Visual] = []
    for e in elements:
        shape, why = e.geometry, e.fault
        if isinstance(shape, MeshElement):
            shape, why = _mesh_shape(shape, report, parsed, meshes)
        if shape is None:
            # one stick figure per link is enough, however many of its meshes are missing
            if not any(v.link == e.link and v.stand_in for v in visuals):
                visuals += _sticks(robot, [e.link], why)
            continue
        frame = robot.pinocchio_model.frames[robot.frame(e.link).index]
        placement = frame.placement.homogeneous @ as_matrix(e.pose)
        colour = e.colour or (mesh_colour(shape.source) if isinstance(shape, Triangles) else None) or GREY
        visuals.append(Visual(e.link, int(frame.parentJoint), placement, shape, colour))
    return tuple(visuals)


def _elements(robot: Robot) -> list[VisualElement]:
    if robot.description is None:
        return []
    return visual_elements(robot.description, robot.source or Path(robot.name))


def _mesh_shape(
    element: MeshElement, report: MeshReport, parsed: dict[Path, Mesh | RobotError], meshes: bool
) -> tuple[Shape | None, str]:
    if not meshes:
        return None, "meshes are switched off"
    path = report.found.get(element.uri)
    if path is None:
        return None, report.missing.get(element.uri, f"mesh {element.uri!r} was not found")
    mesh = parsed[path]
    if isinstance(mesh, RobotError):
        return None, str(mesh)
    vertices, faces = mesh
    # a mirror image turns every triangle inside out
    faces = faces[:, ::-1].copy() if np.prod(element.scale) < 0 else faces
    return Triangles(vertices * np.array(element.scale), faces, path), ""


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
            visuals.append(Visual(link, joint, _along(a, b), rod, STAND_IN, why))
        if not rods:
            visuals.append(Visual(link, joint, frame.placement.homogeneous.copy(), Sphere(THIN), STAND_IN, why))
    return tuple(visuals)


def _body_names(robot: Robot) -> set[str]:
    frames = robot.pinocchio_model.frames
    return {f.name for f in frames if f.type == pin.FrameType.BODY and f.name in robot.frame_names}


def _along(a: np.ndarray, b: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """Pose in the middle of a and b with z along b - a."""
    T = np.eye(4)
    turn = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), b - a)
    T[:3, :3], T[:3, 3] = turn.toRotationMatrix(), 0.5 * (a + b)
    return T
