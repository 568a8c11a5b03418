"""Write a robot and solids around it as a URDF with simple names, for programs that read only such files.

The joint with the Pinocchio id 7 is called j007 and carries the link l007, whatever its name in the robot's file; each
solid has a link of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from jaxtyping import Float
from scipy.spatial import ConvexHull

from manip_learn.robot.collision import CollisionShape
from manip_learn.robot.joints import joint_motions
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.visual_shapes import Solid

# corners of a polyhedron that contains the ball of radius 1: with corners at 1 its faces would be at 0.8866
BALL_CORNERS = np.array([np.divide(d, 0.8866 * np.linalg.norm(d)) for d in product((-1, 0, 1), repeat=3) if any(d)])


def joint_name(index: int) -> str:
    """Return the name of a joint in the written URDF, e.g. `j007`.

    Args:
        index: Pinocchio id of the joint.
    """
    return f"j{index:03}"


def plain_urdf(
    robot: Robot,
    lower: Float[np.ndarray, " nv"],
    upper: Float[np.ndarray, " nv"],
    solids: Mapping[str, tuple[CollisionShape, float]],
    folder: Path,
) -> str:
    """Return the text of a URDF of a robot with solids; meshes are written to files.

    Args:
        robot: The robot.
        lower: Lower position limits (nv,) to write [rad or m].
        upper: Upper position limits (nv,) to write [rad or m].
        solids: Mapping from a name to a shape on a joint of this robot, and the margin by which it is inflated on all
            sides [m]. Corners of convex meshes grow by up to an eighth more.
        folder: Folder for the mesh files.

    Returns:
        Text of the URDF.

    Raises:
        ValueError: A joint is neither revolute nor prismatic.
    """
    model, out = robot.pinocchio_model, ["<robot name='copy'><link name='l000'/>"]
    mimics, motions = {m.joint: m for m in robot.mimics}, joint_motions(model)
    ends = {b.name: (lower[b.v][0], upper[b.v][0]) for b in robot.blocks}
    for j, name in list(enumerate(model.names))[1:]:
        if (along := motions[j]) is None:
            raise ValueError(f"joint {name!r} does more than turn or slide")
        least, most = ends.get(name, (-1e3, 1e3))  # limits of a mimic joint come from its leader
        inside = f"<axis xyz='{_words(along[1])}'/><limit lower='{least}' upper='{most}' velocity='1' effort='1'/>"
        if (m := mimics.get(name)) is not None:
            leader = joint_name(model.getJointId(m.leader))
            inside += f"<mimic joint='{leader}' multiplier='{m.multiplier}' offset='{m.offset}'/>"
        fields = joint_name(j), "revolute" if along[0] == "R" else "prismatic", model.parents[j], f"l{j:03}"
        out.append(f"<link name='l{j:03}'/>{_joint(*fields, model.jointPlacements[j], inside)}")
    out += [_link(name, solid, larger, folder) for name, (solid, larger) in solids.items()]
    return "".join([*out, "</robot>"])


def _words(values: Any) -> str:
    """Return numbers separated by spaces, to the last bit."""
    return " ".join(map(repr, np.asarray(values, dtype=np.float64).tolist()))


def _joint(name: str, kind: str, parent: int, child: str, place: pin.SE3, inside: str = "") -> str:
    """Return a joint element."""
    inside += f"<origin xyz='{_words(place.translation)}' rpy='{_words(pin.rpy.matrixToRpy(place.rotation))}'/>"
    return f"<joint name='{name}' type='{kind}'><parent link='l{parent:03}'/><child link='{child}'/>{inside}</joint>"


def _link(name: str, thing: CollisionShape, larger: float, folder: Path) -> str:
    """Return a link with one shape, enlarged on all sides by a margin [m], on a joint of its own."""
    mark = ""
    match thing.shape:
        case Solid("box", size):
            form = f"<box size='{_words(2.0 * (0.5 * np.array(size) + larger))}'/>"
        case Solid("cylinder", (radius, length)):
            form = f"<cylinder radius='{radius + larger}' length='{2.0 * (0.5 * length + larger)}'/>"
        case Solid(_, (radius, *length)):  # URDF has no capsules: Pinocchio has a mark for them
            form, mark = f"<cylinder radius='{radius + larger}' length='{sum(length, 0.0)}'/>", "capsule"
        case mesh:
            mark = "convex" if isinstance(thing.geometry, coal.ConvexBase) else ""
            points, faces = _enlarge(mesh, larger, bool(mark))
            lines = [f"v {_words(p)}\n" for p in points] + [f"f {a} {b} {c}\n" for a, b, c in (faces + 1).tolist()]
            (folder / f"{name}.obj").write_text("".join(lines))
            form = f"<mesh filename='{folder / name}.obj'/>"
    marked = f"<collision_checking><{mark} name='{name}'/></collision_checking>" if mark else ""
    link = f"<link name='{name}'><collision name='{name}'><geometry>{form}</geometry></collision>{marked}</link>"
    return link + _joint(f"{name}_fixed", "fixed", thing.joint, name, pin.SE3(thing.placement))


def _enlarge(mesh: Any, larger: float, is_convex: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return corners and triangles of a mesh of trimesh, enlarged on all sides by a margin [m]."""
    points, faces = np.array(mesh.vertices), np.array(mesh.faces)
    if is_convex:
        hull = ConvexHull((points[:, None] + larger * BALL_CORNERS[: 26 if larger else 1]).reshape(-1, 3))
        return hull.points[hull.vertices], np.searchsorted(hull.vertices, hull.simplices)
    a, b, c = np.moveaxis(points[faces], 1, 0)
    normals = np.zeros_like(points)
    np.add.at(normals, faces, np.cross(b - a, c - a)[:, None])
    return points + larger * normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12), faces
