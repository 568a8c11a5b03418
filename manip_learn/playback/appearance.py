"""Robot -> what is drawn: its own shapes and meshes, or a plain figure of tubes and discs; each rides on one joint.

Meshes are made small enough for a page, and smooth where the surface is smooth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float, Int

from manip_learn.playback.kinematic_tree import TreeJoint
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.figure import SHORTEST, TUBE, link_ends, link_radii
from manip_learn.robot.visuals.meshes import Mesh
from manip_learn.robot.visuals.visual_shapes import Visual, said_once, visual_shapes

ShapeKind = Literal["box", "sphere", "cylinder", "cone", "disc", "mesh"]
Colour = tuple[float, float, float, float]

# red, green, blue and opacity
PLAIN: Colour = (0.80, 0.83, 0.86, 1.0)
DARK: Colour = (0.27, 0.31, 0.36, 1.0)  # joints, beside links in the plain colour
MAX_TRIANGLES = 60_000  # about 0.9 MB in the page
CREASE = np.cos(np.deg2rad(38.0))  # edges that turn by more stay sharp: twelve-sided cylinders look round
MAX_STEPS = 18  # halvings at most; ten bring the range within 1 per cent
ROD = 0.8  # share of the slimmest shape's half width


@final
@dataclass(frozen=True, eq=False)
class Shape:
    """One drawn body.

    Attributes:
        joint: Index in the kinematic tree of the joint that carries it; 0 is the world.
        kind: What it is.
        size: [m]: box (x, y, z); sphere (radius); cylinder and disc (radius, length); cone (radius at the bottom,
            radius at the top, length); mesh: none. All are centred at their origin, round ones stand along z.
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
        radius = max(s[:-1])
        return np.array([radius, radius, s[-1] / 2.0])


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


def decimated(meshes: list[Mesh], triangles: int) -> tuple[list[Mesh], int, int]:
    """Simplify meshes until all of them together have at most so many triangles.

    Large meshes give up more than small ones, and no mesh becomes so coarse that it cannot be recognised as long as
    the budget allows it.

    Returns:
        The meshes, their triangles before and after.
    """
    clean = []
    for m in meshes:  # vertices in one place become one: STL files repeat each of them six times
        span = float(np.ptp(m.vertices, axis=0).max())
        steps = np.rint((m.vertices - m.vertices.min(axis=0)) / max(span * 1e-6, 1e-12)).astype(np.int64)
        _, first, index = np.unique(steps, axis=0, return_index=True, return_inverse=True)
        clean.append(_cleaned(m.vertices[first], index.reshape(-1)[m.faces]))
    counts = np.array([len(m.faces) for m in clean], dtype=np.float64)
    before = int(counts.sum())
    if before > triangles:
        # one cap for all, such that the sum fits
        low, high = 0.0, float(counts.max())
        for _ in range(60):
            cap = 0.5 * (low + high)
            low, high = (cap, high) if np.minimum(counts, cap).sum() <= triangles else (low, cap)
        shares = np.minimum(counts, max(low, 12.0))
        clean = [m if len(m.faces) <= s else _clustered(m, int(s)) for m, s in zip(clean, shares, strict=True)]
    after = sum(len(m.faces) for m in clean)
    # vertices split along sharp edges, so that normals averaged at vertices are right on both sides
    for i, mesh in enumerate(clean):
        pairs = np.column_stack([mesh.faces.reshape(-1), _smooth_groups(mesh.vertices, mesh.faces)])
        unique, index = np.unique(pairs, axis=0, return_inverse=True)
        clean[i] = Mesh(mesh.vertices[unique[:, 0]], index.reshape(-1, 3))
    return clean, before, after


def _cleaned(vertices: np.ndarray, triangles: np.ndarray) -> Mesh:
    """Without triangles that have two corners in one place or that occur twice, and without unused vertices."""
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)
    triangles = triangles[np.sort(first)]
    used, index = np.unique(triangles, return_inverse=True)
    return Mesh(vertices[used], index.reshape(-1, 3))


def _clustered(mesh: Mesh, target: int) -> Mesh:
    """Vertices in one cell of a grid become one; the finest grid that meets the target."""
    span = float(np.ptp(mesh.vertices, axis=0).max())
    low, high = 2.0, 4096.0  # cells along the longest side, coarse enough and too fine
    best = _on_grid(mesh, span / low)
    for _ in range(MAX_STEPS):
        cells = float(np.sqrt(low * high))
        candidate = _on_grid(mesh, span / cells)
        if len(candidate.faces) <= target:
            low, best = cells, candidate
        else:
            high = cells
        if high / low < 1.01:
            break
    return best


def _on_grid(mesh: Mesh, cell: float) -> Mesh:
    steps = np.floor((mesh.vertices - mesh.vertices.min(axis=0)) / cell).astype(np.int64)
    _, index, count = np.unique(steps, axis=0, return_inverse=True, return_counts=True)
    index = index.reshape(-1)
    middle = np.column_stack([np.bincount(index, mesh.vertices[:, k], len(count)) / count for k in range(3)])
    return _cleaned(middle, index[mesh.faces])


def _smooth_groups(vertices: Float[np.ndarray, "V 3"], triangles: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, " C"]:
    """A group for each corner of each triangle: corners at one vertex share it if smooth edges lead from one to the
    other.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = vertices[triangles]
    normals = np.cross(edges[:, 1] - edges[:, 0], edges[:, 2] - edges[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    n = len(triangles)
    start, end = triangles.reshape(-1), np.roll(triangles, -1, axis=1).reshape(-1)
    face = np.repeat(np.arange(n), 3)
    here = np.arange(3 * n)  # corner where the edge starts
    there = here.reshape(-1, 3)[:, [1, 2, 0]].reshape(-1)  # corner where it ends
    order = np.lexsort((np.maximum(start, end), np.minimum(start, end)))
    low, high = np.minimum(start, end)[order], np.maximum(start, end)[order]
    same = np.flatnonzero((low[1:] == low[:-1]) & (high[1:] == high[:-1]))
    one, two = order[same], order[same + 1]
    smooth = np.einsum("ij,ij->i", normals[face[one]], normals[face[two]]) > CREASE
    one, two = one[smooth], two[smooth]
    opposite = start[one] == end[two]  # neighbours run along their edge in opposite directions, if both look outward
    joined = [
        (here[one], np.where(opposite, there[two], here[two])),
        (there[one], np.where(opposite, here[two], there[two])),
    ]
    rows, columns = np.concatenate([j[0] for j in joined]), np.concatenate([j[1] for j in joined])
    graph = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(3 * n, 3 * n))
    return connected_components(graph, directed=False)[1]


def stick_figure(robot: Robot, tree: tuple[TreeJoint, ...], only: set[int] | None = None) -> tuple[Shape, ...]:
    """Shapes made from the kinematics alone.

    Args:
        robot: The robot.
        tree: Its joints.
        only: Joints whose shapes are made; None for all.
    """
    radius, ends = link_radii(robot.pinocchio_model), link_ends(robot.pinocchio_model)
    shapes: list[Shape] = []
    for i, joint in enumerate(tree):
        if only is not None and i not in only:
            continue
        shapes.append(_hub(i, joint, float(radius[i])))
        for child in (c for c in range(1, len(tree)) if tree[c].parent == i):
            shapes += _tube(i, tree[child].placement[:3, 3], float(radius[i]), float(radius[child]))
        for point in ends.get(i, np.zeros((0, 3))):
            shapes += _tube(i, point, float(radius[i]), 0.7 * float(radius[i]))
            shapes.append(Shape(i, "sphere", (0.95 * float(radius[i]),), pin.SE3(np.eye(3), point).homogeneous, DARK))
    return tuple(shapes)


def rods(robot: Robot, tree: tuple[TreeJoint, ...], shapes: Sequence[Shape]) -> tuple[Shape, ...]:
    """Slim rods from joint to joint and to the ends, hidden where the shapes of a joint enclose them.

    Args:
        robot: The robot.
        tree: Its joints.
        shapes: What the rods connect; a rod is slimmer than the slimmest shape on its joint.
    """
    radius, ends = link_radii(robot.pinocchio_model), link_ends(robot.pinocchio_model)
    made: list[Shape] = []
    for i in range(len(tree)):
        slim = min([float(radius[i]), *(ROD * float(s.half_extent().min()) for s in shapes if s.joint == i)])
        targets = [tree[c].placement[:3, 3] for c in range(1, len(tree)) if tree[c].parent == i]
        for point in [*targets, *ends.get(i, np.zeros((0, 3)))]:
            made += _tube(i, point, slim, slim, DARK)
    return tuple(made)


def z_to(direction: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """A rotation that takes the z axis to a unit vector."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    x = np.cross(helper, direction)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(direction, x), direction])


def _hub(i: int, joint: TreeJoint, radius: float) -> Shape:
    """What is drawn where a joint is: a pedestal for the world."""
    if i == 0:
        return Shape(0, "disc", (2.1 * radius, 0.9 * radius), np.eye(4), DARK)
    if joint.motion not in ("revolute", "prismatic"):
        return Shape(i, "sphere", (1.3 * radius,), np.eye(4), DARK, accent=True)
    pose = pin.SE3(z_to(joint.axis), np.zeros(3)).homogeneous
    if joint.motion == "revolute":
        return Shape(i, "disc", (1.3 * radius, 2.5 * radius), pose, DARK, accent=True)
    return Shape(i, "box", (2.1 * radius, 2.1 * radius, 2.6 * radius), pose, DARK, accent=True)


def _tube(i: int, end: np.ndarray, bottom: float, top: float, colour: Colour = PLAIN) -> list[Shape]:
    length = float(np.linalg.norm(end))
    if length < SHORTEST * bottom:
        return []
    pose = pin.SE3(z_to(end / length), end / 2.0).homogeneous
    return [Shape(i, "cone", (TUBE * bottom, TUBE * top, length), pose, colour)]


def appearance(robot: Robot, tree: tuple[TreeJoint, ...], max_triangles: int = MAX_TRIANGLES) -> Appearance:
    """The robot's own shapes; where it has none that can be used, plain ones made from its kinematics.

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
    plain_joints = {v.joint for v in faults} - {v.joint for v in own}
    if not own:
        return Appearance(stick_figure(robot, tree), notes=tuple(notes))
    shapes, meshes, mesh_notes = _own_shapes(own, max_triangles)
    if not meshes:
        # boxes and cylinders rarely touch each other: slim rods show what holds them together
        shapes += rods(robot, tree, shapes)
    if plain_joints:
        shapes += stick_figure(robot, tree, plain_joints)
    return Appearance(tuple(shapes), tuple(meshes), tuple(notes + mesh_notes))


def _own_shapes(visuals: list[Visual], max_triangles: int) -> tuple[list[Shape], list[Mesh], list[str]]:
    shapes: list[Shape] = []
    known: dict[int, int] = {}  # a finger's mesh is often used twice
    meshes: list[Mesh] = []
    for v in visuals:
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
    notes = []
    if after < before:
        notes.append(f"The meshes were simplified from {before:,} to {after:,} triangles to keep the page small.")
    return shapes, meshes, notes
