"""Robot -> what is drawn: its own shapes and meshes, or a figure made from its kinematics; each rides on one joint."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.playback.kinematic_tree import TreeJoint
from manip_learn.playback.simple_meshes import decimated
from manip_learn.robot.description.mjcf import turn_z_to
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.figure import bones, link_radii
from manip_learn.robot.visuals.meshes import Mesh
from manip_learn.robot.visuals.visual_shapes import said_once, visual_shapes

ShapeKind = Literal["box", "sphere", "cylinder", "disc", "mesh"]
Colour = tuple[float, float, float, float]

# red, green, blue and opacity
PLAIN: Colour = (0.80, 0.83, 0.86, 1.0)
DARK: Colour = (0.27, 0.31, 0.36, 1.0)  # caps of joints, beside links in the plain colour
MAX_TRIANGLES = 60_000  # about 0.9 MB in the page
# what stands where a joint is, in radii of the bones there
JOINTS: dict[str, tuple[ShapeKind, tuple[float, ...]]] = {
    "revolute": ("disc", (1.2, 2.4)),
    "prismatic": ("box", (2.1, 2.1, 2.6)),
    "free": ("sphere", (1.3,)),
}


@final
@dataclass(frozen=True, eq=False)
class Shape:
    """One drawn body.

    Attributes:
        joint: Index in the kinematic tree of the joint that carries it; 0 is the world.
        kind: What it is.
        size: [m]: box (x, y, z); sphere (radius); cylinder and disc (radius, length); mesh: none. All are centred at
            their origin, round ones stand along z.
        pose: shape (4, 4), from the shape to the joint's frame [m].
        colour: Red, green, blue, opacity, 0 to 1.
        accent: True if it takes the colour of its rollout.
        mesh: Index in `Appearance.meshes`, or None.
    """

    joint: int
    kind: ShapeKind
    size: tuple[float, ...]
    pose: Float[np.ndarray, "4 4"]
    colour: Colour = PLAIN
    accent: bool = False
    mesh: int | None = None

    def half_extent(self) -> Float[np.ndarray, " 3"]:
        """Half the sides of a box around the shape, in its own frame [m]; zero for meshes, which bring their own."""
        s = self.size
        if self.kind == "box":
            return np.array(s) / 2.0
        if self.kind == "sphere":
            return np.full(3, s[0])
        if self.kind == "mesh":
            return np.zeros(3)
        return np.array([s[0], s[0], s[1] / 2.0])


@final
@dataclass(frozen=True, eq=False)
class Appearance:
    """How a robot looks.

    Attributes:
        shapes: All that is drawn.
        meshes: The triangle meshes that shapes refer to.
        notes: What could not be drawn as the URDF says, in sentences.
    """

    shapes: tuple[Shape, ...]
    meshes: tuple[Mesh, ...] = ()
    notes: tuple[str, ...] = ()


def figure(robot: Robot, tree: tuple[TreeJoint, ...], bare: set[int]) -> list[Shape]:
    """Rods along the bones of joints that have no shapes of their own, balls where they meet, a ring at each joint.

    Args:
        robot: The robot.
        tree: Its joints.
        bare: Joints without shapes of their own; the rings are on all.
    """
    model, shapes = robot.pinocchio_model, list[Shape]()
    radius = link_radii(model)
    for bone in (b for b in bones(model, radius) if b.joint in bare):
        along, middle = np.diff(bone.ends, axis=0)[0], bone.ends.mean(axis=0)
        length = float(np.linalg.norm(along))
        pose = pin.SE3(turn_z_to(along / length), middle).homogeneous
        shapes.append(Shape(bone.joint, "cylinder", (float(np.mean(bone.radii)), length), pose))
        for end, thick in zip(bone.ends, bone.radii, strict=True):
            shapes.append(Shape(bone.joint, "sphere", (thick,), pin.SE3(np.eye(3), end).homogeneous))
    if 0 in bare:
        shapes.append(Shape(0, "disc", (1.7 * radius[0], 0.5 * radius[0]), np.eye(4), DARK))
    for i, joint in enumerate(tree[1:], 1):
        r, turned = float(radius[i]), np.eye(3) if joint.motion == "free" else turn_z_to(joint.axis)
        kind, size = JOINTS[joint.motion]
        pose = pin.SE3(turned, np.zeros(3)).homogeneous
        shapes.append(Shape(i, kind, tuple(r * share for share in size), pose, DARK, accent=True))
    return shapes


def appearance(robot: Robot, tree: tuple[TreeJoint, ...], max_triangles: int = MAX_TRIANGLES) -> Appearance:
    """The robot's own meshes, and the shapes beside them; a figure where it has none that can be used.

    Args:
        robot: The robot.
        tree: Its joints.
        max_triangles: Meshes are simplified until they have no more than this.
    """
    visuals = visual_shapes(robot)
    own = [v for v in visuals if not v.fault]
    faults = [v for v in visuals if v.fault]
    said, links, notes = said_once(v.fault for v in faults), dict[str, dict[str, None]](), list[str]()
    for v in faults if robot.source is not None else ():
        links.setdefault(said[v.fault], {})[v.link] = None
    for reason, concerned in links.items():  # one sentence for each
        names = list(concerned)
        shown = ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
        notes.append(f"Plain shapes stand in for {shown}: {reason}.")
    shapes, meshes, known = list[Shape](), list[Mesh](), dict[int, int]()  # a finger's mesh is often used twice
    for v in own:
        match v.shape:
            case Mesh():
                if id(v.shape) not in known:
                    known[id(v.shape)] = len(meshes)
                    meshes.append(v.shape)
                shapes.append(Shape(v.joint, "mesh", (), v.placement, v.colour, mesh=known[id(v.shape)]))
            case ("capsule", (radius, length)):
                shapes.append(Shape(v.joint, "cylinder", (radius, length), v.placement, v.colour))
                for z in (-0.5 * length, 0.5 * length):
                    place = v.placement @ pin.SE3(np.eye(3), np.array([0.0, 0.0, z])).homogeneous
                    shapes.append(Shape(v.joint, "sphere", (radius,), place, v.colour))
            case ("box" | "sphere" | "cylinder" as kind, size):
                shapes.append(Shape(v.joint, kind, size, v.placement, v.colour))
    meshes, before, after = decimated(meshes, max_triangles)
    if after < before:
        notes.append(f"The meshes were simplified from {before:,} to {after:,} triangles to keep the page small.")
    drawn = {s.joint for s in shapes}
    bare = set(range(len(tree))) - drawn if not meshes else {v.joint for v in faults} - drawn
    shapes += [s for s in figure(robot, tree, bare) if not meshes or s.joint in bare]
    return Appearance(tuple(shapes), tuple(meshes), tuple(notes))
