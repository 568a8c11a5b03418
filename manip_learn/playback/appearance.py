"""Robot -> what is drawn: its own shapes and meshes, or shells made from its kinematics; each rides on one joint."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Literal, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.playback.kinematic_tree import TreeJoint
from manip_learn.playback.shells import Body, barrel, rod, shell
from manip_learn.playback.simple_meshes import decimated
from manip_learn.robot.description.mjcf import turn_z_to
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.figure import Bone, bones, link_radii
from manip_learn.robot.visuals.meshes import Colour, Mesh, by_colour
from manip_learn.robot.visuals.visual_shapes import Visual, bare_links, losses, visual_shapes

ShapeKind = Literal["box", "sphere", "cylinder", "disc", "mesh"]
# red, green, blue and opacity
PLAIN: Colour = (0.80, 0.83, 0.86, 1.0)
DARK: Colour = (0.27, 0.31, 0.36, 1.0)  # caps of joints, beside links in the plain colour
MAX_TRIANGLES = 50_000  # about 0.8 MB in the page; two such arms and their shadows are drawn at 60 frames a second


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
        """Return half the sides of a box around the shape, in its frame [m]; zero for meshes, which bring theirs."""
        match self.size:
            case (radius,):
                return np.full(3, radius)
            case (radius, length):
                return np.array([radius, radius, length / 2.0])
        return np.array(self.size or (0.0, 0.0, 0.0)) / 2.0


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


def shells(
    robot: Robot, tree: tuple[TreeJoint, ...], own: Sequence[Shape], joints: Collection[int], meshes: list[Mesh]
) -> list[Shape]:
    """Return shells around the bones of links, with rings where they turn, and own shapes that no shell stands for.

    A shell takes the place of own shapes that a bone goes through, as long as they are no fatter than links are; it
    takes their thickness and their colour.

    Args:
        robot: The robot.
        tree: Its joints.
        own: Plain shapes of its description.
        joints: Those whose shapes are made.
        meshes: To which those of the shells are added.
    """
    model, usual = robot.pinocchio_model, link_radii(robot.pinocchio_model)
    radius, colours, kept, hands = usual.copy(), [PLAIN] * len(tree), list(own), dict[int, np.ndarray]()
    for i, limb in groupby(bones(model, usual), key=lambda bone: bone.joint):
        line = np.concatenate([np.linspace(b.ends[0], b.ends[1], 9) for b in limb])
        # a body of twice the radius is none of a link's
        stood_for = [s for s in own if s.joint == i and _is_limb(s, line, 2.0 * usual[i])]
        if stood_for:
            # a shell's grid finds a thin shape that counts as a third of what the kinematics gives
            radius[i] = max(np.mean([np.sort(s.half_extent())[1] for s in stood_for]), usual[i] / 3.0)
            colours[i] = stood_for[0].colour
            kept = [s for s in kept if s not in stood_for]
            hands[i] = max((s.pose[:3, 3] for s in stood_for), key=lambda at: float(np.linalg.norm(at)))
    drawn = bones(model, radius)
    shapes = list[Shape]()
    for i, joint in enumerate(tree):
        limb = [b for b in drawn if b.joint == i]
        if len(limb) == 1 and not limb[0].child and i in hands and any(s.joint == i for s in kept):
            limb = [limb[0]._replace(ends=np.array([limb[0].ends[0], hands[i]]))]  # what is kept goes on from there
        # a little slimmer at its end, where the next link begins: of two surfaces in one place both would be seen
        bodies = [rod(b.ends, (b.radii[0], 0.98 * b.radii[1])) for b in limb]
        if i:
            hub, rings = _hub(i, joint, float(radius[i]), [b for b in drawn if b.child == i], limb)
            bodies += hub
            shapes += rings
        elif not any(s.joint == 0 for s in kept):
            shapes.append(Shape(0, "disc", (1.7 * radius[0], 0.5 * radius[0]), np.eye(4), DARK))
        if bodies and i in joints:
            shapes.append(Shape(i, "mesh", (), np.eye(4), colours[i], mesh=len(meshes)))
            meshes.append(shell(bodies))
    return [s for s in (*shapes, *kept) if s.joint in joints]


def _is_limb(shape: Shape, line: Float[np.ndarray, "P 3"], fattest: float) -> bool:
    """Return whether a shape is slender enough and some of these points are in the box around it."""
    half, local = shape.half_extent(), (line - shape.pose[:3, 3]) @ shape.pose[:3, :3]
    return bool(np.sort(half)[1] <= fattest and (np.abs(local) <= half).all(axis=1).any())


def _hub(
    i: int, joint: TreeJoint, r: float, coming: Sequence[Bone], going: Sequence[Bone]
) -> tuple[list[Body], list[Shape]]:
    """Return what is drawn where a joint is: bodies of its shell, and other shapes."""
    if joint.motion not in ("revolute", "prismatic"):
        return [], [Shape(i, "sphere", (1.3 * r,), np.eye(4), DARK, accent=True)]
    pose = pin.SE3(turn_z_to(joint.axis), np.zeros(3)).homogeneous
    if joint.motion == "prismatic":
        return [], [Shape(i, "box", (2.1 * r, 2.1 * r, 2.6 * r), pose, DARK, accent=True)]
    # how far bones run along the axis on either side: that of the parent below, its own above
    before = joint.placement[:3, :3].T @ np.diff(coming[-1].ends, axis=0)[0] if coming else np.zeros(3)
    after = np.diff(going[0].ends, axis=0)[0] if going else np.zeros(3)
    below, above = (x if abs(x := float(v @ joint.axis)) > 0.9 * np.linalg.norm(v) else 0.0 for v in (before, after))
    if not below and not above:  # bones run across it
        # in radii: a drum, and out of its ends a ring and a cap
        ends = ((1.08, 1.37, True), (0.9, 1.45, False))
        drum = [Shape(i, "disc", (a * r, 2.0 * b * r), pose, DARK, accent=is_ring) for a, b, is_ring in ends]
        return [barrel(pose, 1.2 * r, 1.25 * r)], drum
    along = 0.0 if below and above else above or -below
    # a ring around the bone that goes on, beside the corner
    pose[:3, 3] = np.sign(along) * min(1.15 * r, abs(along)) * joint.axis
    return [], [Shape(i, "disc", (1.12 * r, 0.34 * r), pose, DARK, accent=True)]


def appearance(robot: Robot, tree: tuple[TreeJoint, ...], max_triangles: int = MAX_TRIANGLES) -> Appearance:
    """The robot's own meshes, and the shapes beside them; shells where it has none that can be used.

    Args:
        robot: The robot.
        tree: Its joints.
        max_triangles: Meshes are simplified until they have no more than this.
    """
    visuals = visual_shapes(robot)
    notes = [] if robot.source is None else list(losses(visuals))
    shapes, meshes, mesh_notes = _own_shapes(visuals, max_triangles)
    if not meshes:
        shapes = shells(robot, tree, shapes, range(len(tree)), meshes)
    elif bare := set(bare_links(visuals).values()):
        shapes += shells(robot, tree, (), bare, meshes)
    return Appearance(tuple(shapes), tuple(meshes), tuple(notes + mesh_notes))


def _own_shapes(visuals: Sequence[Visual], max_triangles: int) -> tuple[list[Shape], list[Mesh], list[str]]:
    """Return the shapes of the description, each mesh in a part for each of its colours."""
    shapes = list[Shape]()
    whole = {id(v.shape): v.shape for v in visuals if isinstance(v.shape, Mesh)}  # a finger's is often used twice
    # by colour first: where simple surfaces of two colours lie on each other, one must not swallow the other
    parts = [(key, colour, part) for key, mesh in whole.items() for colour, part in by_colour(mesh)]
    small, before, after = decimated([part for *_, part in parts], max_triangles)
    drawn = [(key, colour, mesh) for (key, colour, _), mesh in zip(parts, small, strict=True) if len(mesh.faces)]
    for v in visuals:
        match v.shape:
            case Mesh():
                own = ((k, colour or v.colour) for k, (key, colour, _) in enumerate(drawn) if key == id(v.shape))
                shapes += [Shape(v.joint, "mesh", (), v.placement, colour, mesh=k) for k, colour in own]
            case ("capsule", (radius, length)):
                shapes.append(Shape(v.joint, "cylinder", (radius, length), v.placement, v.colour))
                for z in (-0.5 * length, 0.5 * length):
                    place = v.placement @ pin.SE3(np.eye(3), np.array([0.0, 0.0, z])).homogeneous
                    shapes.append(Shape(v.joint, "sphere", (radius,), place, v.colour))
            case ("box" | "sphere" | "cylinder" as kind, size):
                shapes.append(Shape(v.joint, kind, size, v.placement, v.colour))
    note = f"The meshes were simplified from {before:,} to {after:,} triangles to keep the page small."
    return shapes, [mesh for *_, mesh in drawn], [note] if after < before else []
