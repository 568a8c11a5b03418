"""Robot -> what is drawn."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pinocchio as pin

from manip_learn.playback.decimation import decimated
from manip_learn.playback.kinematic_tree import TreeJoint
from manip_learn.playback.shapes import Appearance, Shape, TriangleMesh
from manip_learn.playback.stick_figure import rods, stick_figure
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.visual_shapes import (
    Box,
    Capsule,
    Cylinder,
    Sphere,
    Triangles,
    Visual,
    said_once,
    visual_shapes,
)

MAX_TRIANGLES = 60_000  # about 0.9 MB in the page


def appearance(robot: Robot, tree: tuple[TreeJoint, ...], max_triangles: int = MAX_TRIANGLES) -> Appearance:
    """The robot's own shapes; where it has none that can be used, plain ones made from its kinematics.

    Args:
        robot: The robot.
        tree: Its joints.
        max_triangles: Meshes are simplified until they have no more than this.
    """
    visuals = visual_shapes(robot)
    own = [v for v in visuals if not v.stand_in]
    faults = [v for v in visuals if v.stand_in]
    notes = _fault_notes(faults) if robot.source is not None else []
    plain_joints = {v.joint for v in faults} - {v.joint for v in own}
    if not own:
        return Appearance(stick_figure(tree, end_points(robot, tree)), notes=tuple(notes))
    shapes, meshes, mesh_notes = _own_shapes(own, max_triangles)
    if not meshes:
        # boxes and cylinders rarely touch each other: slim rods show what holds them together
        shapes += rods(tree, end_points(robot, tree), shapes)
    if plain_joints:
        shapes += stick_figure(tree, end_points(robot, tree), plain_joints)
    return Appearance(tuple(shapes), tuple(meshes), tuple(notes + mesh_notes))


def _own_shapes(visuals: list[Visual], max_triangles: int) -> tuple[list[Shape], list[TriangleMesh], list[str]]:
    shapes: list[Shape] = []
    files: dict[object, int] = {}  # a finger's mesh is often used twice
    meshes: list[TriangleMesh] = []
    for v in visuals:
        if isinstance(v.shape, Triangles):
            key = (v.shape.source, v.shape.vertices.tobytes())
            if key not in files:
                files[key] = len(meshes)
                meshes.append(TriangleMesh(v.shape.vertices, v.shape.faces))
            shapes.append(Shape(v.joint, "mesh", (), v.placement, v.colour, mesh=files[key]))
        else:
            shapes += _plain_shapes(v)
    meshes, before, after = decimated(meshes, max_triangles)
    notes = []
    if after < before:
        notes.append(f"The meshes were simplified from {before:,} to {after:,} triangles to keep the page small.")
    return shapes, meshes, notes


def _plain_shapes(v: Visual) -> list[Shape]:
    if isinstance(v.shape, Box):
        return [Shape(v.joint, "box", v.shape.size, v.placement, v.colour)]
    if isinstance(v.shape, Sphere):
        return [Shape(v.joint, "sphere", (v.shape.radius,), v.placement, v.colour)]
    if not isinstance(v.shape, Cylinder | Capsule):
        return []
    radius, length = v.shape.radius, v.shape.length
    shapes = [Shape(v.joint, "cylinder", (radius, length), v.placement, v.colour)]
    if isinstance(v.shape, Capsule):
        for end in (-0.5 * length, 0.5 * length):
            shift = np.eye(4)
            shift[2, 3] = end
            shapes.append(Shape(v.joint, "sphere", (radius,), v.placement @ shift, v.colour))
    return shapes


def _fault_notes(faults: Iterable[Visual]) -> list[str]:
    """One sentence per reason, with the links that it concerns."""
    faults, links = list(faults), dict[str, list[str]]()
    said = said_once(v.stand_in for v in faults)
    for v in faults:
        names = links.setdefault(said[v.stand_in], [])
        if v.link not in names:
            names.append(v.link)
    notes = []
    for reason, names in links.items():
        shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
        notes.append(f"Plain shapes stand in for {shown}: {reason}.")
    return notes


def end_points(robot: Robot, tree: tuple[TreeJoint, ...]) -> dict[int, np.ndarray]:
    """For joints that carry no other joint: the farthest fixed link on each [m], in the joint's frame."""
    model = robot.pinocchio_model
    inner = {joint.parent for joint in tree[1:]}
    ends: dict[int, np.ndarray] = {}
    for i in range(1, len(tree)):
        points = [f.placement.translation for f in model.frames if f.parentJoint == i and f.type == pin.FrameType.BODY]
        if i not in inner and points:
            ends[i] = np.array([max(points, key=lambda p: float(np.linalg.norm(p)))])
    return ends
