"""Appearance of a robot: its own shapes and meshes, or shells generated from its kinematics; each moves with one joint.

The browser computes the forward kinematics from the parent and the motion of each joint.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby
from typing import Literal, NamedTuple, final

import numpy as np
import pinocchio as pin
from jaxtyping import Float, Int

from manip_learn.robot.description.mjcf import turn_z_to
from manip_learn.robot.joints import joint_motions
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.figure import Bone, bones, link_radii
from manip_learn.robot.visuals.meshes import Colour, Mesh, by_colour, compact
from manip_learn.robot.visuals.visual_shapes import Visual, bare_links, losses, visual_shapes

Points = Float[np.ndarray, "P 3"]
Distance = Callable[[Points], Float[np.ndarray, " P"]]  # [m], negative inside
# red, green, blue and opacity
PLAIN: Colour = (0.80, 0.83, 0.86, 1.0)
DARK: Colour = (0.27, 0.31, 0.36, 1.0)  # caps of joints, next to links in the plain colour


@final
class TreeJoint(NamedTuple):
    """One moving joint, including mimic joints.

    Attributes:
        name: Name in the URDF.
        parent: Index of the parent joint; the world is 0.
        placement: Pose (4, 4) of the joint at position 0, in the frame of its parent joint [m].
        motion: `"revolute"` and `"prismatic"` joints move about or along `axis` by one number; a `"free"` joint has a
            pose of seven numbers (x, y, z, quaternion x, y, z, w); only the world is `"fixed"`.
        axis: shape (3,), unit vector in the joint's own frame; zero for `"free"` and `"fixed"`.
    """

    name: str
    parent: int
    placement: Float[np.ndarray, "4 4"]
    motion: Literal["fixed", "revolute", "prismatic", "free"]
    axis: Float[np.ndarray, " 3"]


@lru_cache(maxsize=8)  # robots do not change, and a live view needs the tree for each picture
def kinematic_tree(robot: Robot) -> tuple[TreeJoint, ...]:
    """Return the joints of a robot, parents before their children; entry 0 is the world.

    Args:
        robot: The robot.
    """
    model, tree = robot.pinocchio_model, [TreeJoint("", 0, np.eye(4), "fixed", np.zeros(3))]
    for i, along in list(enumerate(joint_motions(model)))[1:]:
        motion, axis = "free", np.zeros(3)
        if along is not None and np.isclose(np.linalg.norm(along[1]), 1.0):
            motion, axis = ("revolute" if along[0] == "R" else "prismatic"), along[1]
        placement = model.jointPlacements[i].homogeneous
        tree.append(TreeJoint(model.names[i], int(model.parents[i]), placement, motion, axis))
    return tuple(tree)


def joint_tracks(robot: Robot, postures: Float[np.ndarray, "K n"]) -> Float[np.ndarray, "K w"]:
    """Return the numbers that place each joint of the kinematic tree, for each configuration.

    `TreeJoint.motion` says how many numbers a joint has. Angles of continuous joints are unwrapped, so that the motion
    between two key frames takes the shorter direction.

    Args:
        robot: The robot.
        postures: Joint configurations (K, nq) or positions (K, nv) [rad or m].

    Returns:
        shape (K, w), with the numbers of all joints in the order of `kinematic_tree` [rad, m, or quaternions].

    Raises:
        ConfigurationError: A configuration has the wrong size or NaN.
    """
    model, columns = robot.pinocchio_model, [np.zeros((len(postures), 0))]
    full = np.array([robot.pinocchio_configuration(q) for q in postures])
    for node, joint in list(zip(kinematic_tree(robot), model.joints, strict=True))[1:]:
        part = full[:, joint.idx_q : joint.idx_q + joint.nq]
        if node.motion == "free":
            data, poses = joint.createData(), np.empty((len(full), 7))
            for k, q in enumerate(full):
                joint.calc(data, q)
                poses[k] = pin.SE3ToXYZQUAT(data.M)
                if k and poses[k, 3:] @ poses[k - 1, 3:] < 0.0:  # q and -q are one rotation: keep the signs continuous
                    poses[k, 3:] *= -1.0
            columns.append(poses)
        else:
            columns.append(part if joint.nq == 1 else np.unwrap(np.arctan2(part[:, 1:], part[:, :1]), axis=0))
    return np.concatenate(columns, axis=1)


@final
@dataclass(frozen=True, eq=False)
class Shape:
    """Shape that is drawn as part of a robot.

    Attributes:
        joint: Index of its joint in the kinematic tree; 0 is the world.
        kind: Type of geometry.
        size: Dimensions [m]: (x, y, z) of a box; (radius,) of a sphere; (radius, length) of a cylinder or disc; empty
            for a mesh. Shapes are centred at their origin; the axis of round shapes is z.
        pose: Pose (4, 4) of the shape in the joint's frame [m].
        colour: Red, green, blue, opacity, each 0 to 1.
        accent: True if it is drawn in the colour of its rollout.
        mesh: Index in `Appearance.meshes`; None for other shapes.
    """

    joint: int
    kind: Literal["box", "sphere", "cylinder", "disc", "mesh"]
    size: tuple[float, ...]
    pose: Float[np.ndarray, "4 4"]
    colour: Colour = PLAIN
    accent: bool = False
    mesh: int | None = None

    def half_extent(self) -> Float[np.ndarray, " 3"]:
        """Return half the side lengths (3,) of the shape's bounding box, in its frame [m]; zeros for a mesh."""
        width, *more = self.size or (0.0,)
        if len(self.size) == 3:
            return np.array(self.size) / 2.0
        return np.array([width, width, more[0] / 2.0 if more else width])


@final
class Appearance(NamedTuple):
    """Shapes with which a robot is drawn.

    Attributes:
        shapes: All drawn shapes.
        meshes: The triangle meshes to which shapes refer by index.
        notes: Differences from the URDF's visuals, in sentences.
    """

    shapes: tuple[Shape, ...]
    meshes: tuple[Mesh, ...] = ()
    notes: tuple[str, ...] = ()


def shells(robot: Robot, own: Sequence[Shape], joints: Collection[int], meshes: list[Mesh]) -> list[Shape]:
    """Generate smooth shells for links without meshes, with rings at the joints.

    A shell encloses the lines between the joints of a link. It replaces simple shapes (boxes, cylinders, spheres) that
    such a line passes through, unless they are too thick for a link, and has their thickness and colour. Other shapes
    are kept.

    Args:
        robot: The robot.
        own: Simple shapes of the robot's description.
        joints: Indices of the joints whose shapes are returned.
        meshes: List to which the meshes of the shells are appended.

    Returns:
        Shells, rings, and the shapes that are kept.
    """
    model, usual = robot.pinocchio_model, link_radii(robot.pinocchio_model)
    radius, colours, rest, hands = usual.copy(), [PLAIN] * model.njoints, list(own), dict[int, np.ndarray]()
    for i, limb in groupby(bones(model, usual), key=lambda bone: bone.joint):
        line = np.concatenate([np.linspace(b.ends[0], b.ends[1], 9) for b in limb])
        # a body of twice the usual radius is not part of a link
        replaced = [s for s in own if s.joint == i and _is_limb(s, line, 2.0 * usual[i])]
        if replaced:
            # at least a third of the radius from the kinematics, so that the grid of the shell resolves it
            radius[i] = max(np.mean([np.sort(s.half_extent())[1] for s in replaced]), usual[i] / 3.0)
            colours[i] = replaced[0].colour
            rest = [s for s in rest if s not in replaced]
            hands[i] = max((s.pose[:3, 3] for s in replaced), key=lambda at: float(np.linalg.norm(at)))
    drawn = bones(model, radius)
    shapes = list[Shape]()
    for i, joint in enumerate(kinematic_tree(robot)):
        limb = [b for b in drawn if b.joint == i]
        if len(limb) == 1 and not limb[0].child and i in hands and any(s.joint == i for s in rest):
            limb = [limb[0]._replace(ends=np.array([limb[0].ends[0], hands[i]]))]  # the remaining shapes continue there
        # slightly thinner at its end, where the next link begins: two coincident surfaces would both be visible
        bodies = [rod(b.ends, (b.radii[0], 0.98 * b.radii[1])) for b in limb]
        if i:
            hub, rings = _hub(i, joint, float(radius[i]), [b for b in drawn if b.child == i], limb)
            bodies += hub
            shapes += rings
        elif not any(s.joint == 0 for s in rest):
            shapes.append(Shape(0, "disc", (1.7 * radius[0], 0.5 * radius[0]), np.eye(4), DARK))
        if bodies and i in joints:
            shapes.append(Shape(i, "mesh", (), np.eye(4), colours[i], mesh=len(meshes)))
            meshes.append(shell(bodies))
    return [s for s in (*shapes, *rest) if s.joint in joints]


def _is_limb(shape: Shape, line: Float[np.ndarray, "P 3"], fattest: float) -> bool:
    """Return whether a shape is slender enough and its box contains one of these points."""
    half, local = shape.half_extent(), (line - shape.pose[:3, 3]) @ shape.pose[:3, :3]
    return bool(np.sort(half)[1] <= fattest and (np.abs(local) <= half).all(axis=1).any())


def _hub(
    i: int, joint: TreeJoint, r: float, coming: Sequence[Bone], going: Sequence[Bone]
) -> tuple[list[Body], list[Shape]]:
    """Return the bodies and the other shapes drawn at a joint."""
    if joint.motion not in ("revolute", "prismatic"):
        return [], [Shape(i, "sphere", (1.3 * r,), np.eye(4), DARK, accent=True)]
    pose = pin.SE3(turn_z_to(joint.axis), np.zeros(3)).homogeneous
    if joint.motion == "prismatic":
        return [], [Shape(i, "box", (2.1 * r, 2.1 * r, 2.6 * r), pose, DARK, accent=True)]
    # lengths of the bones along the axis on either side: the parent's below, its own above
    before = joint.placement[:3, :3].T @ np.diff(coming[-1].ends, axis=0)[0] if coming else np.zeros(3)
    after = np.diff(going[0].ends, axis=0)[0] if going else np.zeros(3)
    below, above = (x if abs(x := float(v @ joint.axis)) > 0.9 * np.linalg.norm(v) else 0.0 for v in (before, after))
    if not below and not above:  # bones run across it
        # in radii: a drum, with a ring and a cap at its ends
        ends = ((1.08, 1.37, True), (0.9, 1.45, False))
        drum = [Shape(i, "disc", (a * r, 2.0 * b * r), pose, DARK, accent=is_ring) for a, b, is_ring in ends]
        return [barrel(pose, 1.2 * r, 1.25 * r)], drum
    along = 0.0 if below and above else above or -below
    # a ring around the continuing bone, next to the corner
    pose[:3, 3] = np.sign(along) * min(1.15 * r, abs(along)) * joint.axis
    return [], [Shape(i, "disc", (1.12 * r, 0.34 * r), pose, DARK, accent=True)]


def appearance(robot: Robot, max_triangles: int = 50_000) -> Appearance:
    """Return the shapes with which a robot is drawn: its own meshes and shapes, or shells if it has no usable meshes.

    Args:
        robot: The robot.
        max_triangles: Largest number of triangles after simplification; 50,000 are about 0.8 MB in the page, and two
            such arms with shadows are drawn at 60 frames per second.

    Returns:
        The appearance.
    """
    visuals = visual_shapes(robot)
    notes = [] if robot.source is None else list(losses(visuals))
    shapes, meshes, mesh_notes = _own_shapes(visuals, max_triangles)
    if not meshes:
        shapes = shells(robot, shapes, range(robot.pinocchio_model.njoints), meshes)
    elif bare := set(bare_links(visuals).values()):
        shapes += shells(robot, (), bare, meshes)
    return Appearance(tuple(shapes), tuple(meshes), tuple(notes + mesh_notes))


def _own_shapes(visuals: Sequence[Visual], max_triangles: int) -> tuple[list[Shape], list[Mesh], list[str]]:
    """Return the shapes of the description, with each mesh split by colour."""
    shapes = list[Shape]()
    whole = {id(v.shape): v.shape for v in visuals if isinstance(v.shape, Mesh)}  # a finger's mesh is often used twice
    # split by colour first: where two simplified surfaces coincide, one must not hide the other
    parts = [(key, colour, part) for key, mesh in whole.items() for colour, part in by_colour(mesh)]
    small, before, after = decimate([part for *_, part in parts], max_triangles)
    drawn = [(key, colour, mesh) for (key, colour, _), mesh in zip(parts, small, strict=True) if len(mesh.faces)]
    for v in visuals:
        match v.shape:
            case Mesh():
                layers = ((k, colour or v.colour) for k, (key, colour, _) in enumerate(drawn) if key == id(v.shape))
                shapes += [Shape(v.joint, "mesh", (), v.placement, colour, mesh=k) for k, colour in layers]
            case ("capsule", (radius, length)):
                shapes.append(Shape(v.joint, "cylinder", (radius, length), v.placement, v.colour))
                for z in (-0.5 * length, 0.5 * length):
                    place = v.placement @ pin.SE3(np.eye(3), np.array([0.0, 0.0, z])).homogeneous
                    shapes.append(Shape(v.joint, "sphere", (radius,), place, v.colour))
            case ("box" | "sphere" | "cylinder" as kind, size):
                shapes.append(Shape(v.joint, kind, size, v.placement, v.colour))
    note = f"The meshes were simplified from {before:,} to {after:,} triangles to keep the page small."
    return shapes, [mesh for *_, mesh in drawn], [note] if after < before else []


# ---- shells: the zero level of the distance from all bodies of a link, with fillets where they meet -----------------


@final
class Body(NamedTuple):
    """Round body that a shell encloses.

    Attributes:
        distance: Function from points (P, 3) to their signed distances (P,) from the body [m].
        low, high: Opposite corners (3,) of the bounding box [m].
        radius: Smallest radius of the body [m].
    """

    distance: Distance
    low: Float[np.ndarray, " 3"]
    high: Float[np.ndarray, " 3"]
    radius: float


def rod(ends: Float[np.ndarray, "2 3"], radii: tuple[float, float]) -> Body:
    """Return a tapered rod with round ends.

    Args:
        ends: shape (2, 3), both ends [m].
        radii: Radius at each end [m].
    """
    (start, end), (first, last) = ends, radii
    along, thick = end - start, np.array([[first], [last]])

    def distance(points: Points) -> Float[np.ndarray, " P"]:
        """Return the distance of points from the rod.

        Args:
            points: shape (P, 3) [m].

        Returns:
            shape (P,) [m], negative inside.
        """
        share = np.clip((points - start) @ along / max(float(along @ along), 1e-18), 0.0, 1.0)  # a ball has no length
        return np.linalg.norm(points - start - share[:, None] * along, axis=1) - (first + share * (last - first))

    return Body(distance, (ends - thick).min(axis=0), (ends + thick).max(axis=0), min(radii))


def barrel(pose: Float[np.ndarray, "4 4"], radius: float, half: float) -> Body:
    """Return a cylinder with rounded edges, whose axis is the z axis of its pose.

    Args:
        pose: Pose (4, 4) of its centre [m].
        radius: Radius [m].
        half: Half of the length [m].
    """
    edge = 0.35 * min(radius, half)
    reach = np.abs(pose[:3, :3]) @ np.array([radius, radius, half])

    def distance(points: Points) -> Float[np.ndarray, " P"]:
        """Return the distance of points from the cylinder.

        Args:
            points: shape (P, 3) [m].

        Returns:
            shape (P,) [m], negative inside.
        """
        x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
        over = np.column_stack([np.hypot(x, y) - radius, np.abs(z) - half]) + edge
        return np.linalg.norm(np.maximum(over, 0.0), axis=1) + np.minimum(over.max(axis=1), 0.0) - edge

    return Body(distance, pose[:3, 3] - reach, pose[:3, 3] + reach, min(radius, half))


def shell(bodies: Sequence[Body]) -> Mesh:
    """Return the surface around bodies, with one vertex in each grid cell that it crosses (surface nets).

    The normals are computed from the distance itself, so that few triangles look round.

    Args:
        bodies: The bodies of a link, in its frame [m].

    Returns:
        A closed mesh with normals.
    """
    radius = min(b.radius for b in bodies)
    fillet = 0.6 * radius  # [m] reach of the fillets where bodies meet

    def distance(points: Points) -> Float[np.ndarray, " P"]:
        """Return the distance of points from all bodies, rounded where two are equally near.

        Args:
            points: shape (P, 3) [m].
        """
        least = bodies[0].distance(points)
        for body in bodies[1:]:
            other = body.distance(points)
            near = np.maximum(fillet - np.abs(least - other), 0.0)
            least = np.minimum(least, other) - near**2 / (4.0 * fillet)
        return least

    low, high = np.min([b.low for b in bodies], axis=0), np.max([b.high for b in bodies], axis=0)
    # [m] circles of about 18 corners, with the exact normals; long thin links are limited to 130 cells
    cell = max(radius / 2.8, float((high - low).max()) / 130.0)
    low, high = low - fillet - cell, high + fillet + cell
    nodes = np.moveaxis(np.indices(np.ceil((high - low) / cell).astype(int)), 0, -1)
    inside = distance((low + cell * nodes).reshape(-1, 3)).reshape(nodes.shape[:3]) < 0.0
    corners = np.lib.stride_tricks.sliding_window_view(inside, (2, 2, 2)).reshape(*np.subtract(inside.shape, 1), 8)
    crossed = corners.any(axis=-1) & ~corners.all(axis=-1)
    number = np.cumsum(crossed).reshape(crossed.shape) - 1
    faces = []
    for axis, (e, f) in enumerate(np.eye(3, dtype=int)[[[1, 2], [2, 0], [0, 1]]]):
        # each grid edge that crosses the surface has four cells around it
        edges = np.argwhere(np.diff(inside, axis=axis))
        leaves = inside[tuple(edges.T)][:, None]
        a, b, c, d = (number[tuple((edges - back).T)] for back in (e + f, f, 0 * e, e))
        quads = np.where(leaves, np.column_stack([a, b, c, d]), np.column_stack([a, d, c, b]))
        faces += [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    triangles = np.concatenate(faces)
    vertices = low + cell * (np.argwhere(crossed) + 0.5)
    for k in range(5):  # Newton steps onto the surface; vertices are spread evenly before the last two
        vertices = vertices if k < 3 else _spread(vertices, triangles)
        slope = _slope(distance, vertices, 0.05 * cell)
        # the squared slope is 1, and less at an edge
        step = distance(vertices) / np.maximum(np.einsum("ij,ij->i", slope, slope), 0.25)
        vertices = vertices - np.clip(step[:, None] * slope, -0.5 * cell, 0.5 * cell)
    normals = _slope(distance, vertices, 0.05 * cell)
    return Mesh(vertices, triangles, normals=normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9))


def _slope(distance: Distance, points: Points, step: float) -> Points:
    """Return the gradient of a distance by central differences."""
    aside = step * np.eye(3)
    return np.column_stack([distance(points + d) - distance(points - d) for d in aside]) / (2.0 * step)


def _spread(vertices: Points, triangles: Int[np.ndarray, "F 3"]) -> Points:
    """Return each vertex moved to the mean of its neighbours: evenly spaced vertices are shaded without a pattern."""
    start, end = triangles.reshape(-1), np.roll(triangles, -1, axis=1).reshape(-1)
    return _means(start, vertices[end])


def _means(groups: Int[np.ndarray, " P"], points: Points) -> Float[np.ndarray, "G 3"]:
    """Return the mean of the points of each group; groups are numbered from 0."""
    return np.column_stack([np.bincount(groups, x) for x in points.T]) / np.bincount(groups)[:, None]


# ---- mesh simplification for a page, and smooth shading of smooth surfaces ----------------------------------------


def decimate(meshes: list[Mesh], triangles: int) -> tuple[list[Mesh], int, int]:
    """Simplify meshes until their total number of triangles does not exceed a budget.

    Large meshes lose more triangles than small ones; each mesh keeps enough to be recognised if the budget allows it.

    Args:
        meshes: The meshes.
        triangles: Largest number of triangles of all meshes together.

    Returns:
        The simplified meshes, and the total number of triangles before and after.
    """
    # merge coincident vertices: STL files repeat each of them six times
    clean = [_joined(m, max(1e-6 * float(np.ptp(m.vertices, axis=0).max()), 1e-12)) for m in meshes]
    counts = [len(m.faces) for m in clean]
    before = sum(counts)
    if before > triangles:
        # one cap per mesh such that the sum fits: small meshes stay, the others share the rest
        above = bisect_right(range(triangles), triangles, key=lambda cap: np.minimum(counts, cap).sum())
        cap = max(above - 1, 12)
        clean = [m if len(m.faces) <= cap else _clustered(m, cap) for m in clean]
    after = sum(len(m.faces) for m in clean)
    return [_split_at_edges(m) for m in clean], before, after


def _clustered(mesh: Mesh, target: int) -> Mesh:
    """Return a mesh with the vertices of each grid cell merged, for the finest grid that meets the target."""
    cells = float(np.ptp(mesh.vertices, axis=0).max()) / np.geomspace(2.0, 4096.0, 767)  # [m] each 1 % finer
    finer = bisect_right(cells, target, key=lambda cell: len(_joined(mesh, cell).faces))
    return _joined(mesh, cells[max(finer - 1, 0)])


def _joined(mesh: Mesh, cell: float) -> Mesh:
    """Return a mesh with the vertices of each grid cell merged, without degenerate and duplicate triangles."""
    steps = np.rint((mesh.vertices - mesh.vertices.min(axis=0)) / cell).astype(np.int64)
    index = np.unique(steps, axis=0, return_inverse=True)[1].reshape(-1)
    faces = index[mesh.faces]
    corners, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    has_area = (np.diff(corners, axis=1) > 0).all(axis=1)
    return compact(Mesh(_means(index, mesh.vertices), faces[np.sort(first[has_area])]))


def _split_at_edges(mesh: Mesh) -> Mesh:
    """Return a mesh with vertices split along sharp edges, so that vertex normals are right on both sides.

    Corners of triangles at one vertex share it if smooth edges connect them.
    """
    from trimesh import Trimesh
    from trimesh.graph import connected_component_labels

    solid = Trimesh(mesh.vertices, mesh.faces, process=False)
    # above 30 degrees, so that twelve-sided cylinders look round; sharper edges stay sharp
    smooth = solid.face_adjacency_angles < np.deg2rad(38.0)
    pairs, ends = solid.face_adjacency[smooth], solid.face_adjacency_edges[smooth]
    # each end of an edge as a corner of both adjacent triangles
    corners = 3 * pairs[:, None] + np.argmax(mesh.faces[pairs][:, None] == ends[:, :, None, None], axis=-1)
    groups = connected_component_labels(corners.reshape(-1, 2), node_count=mesh.faces.size)
    _, first, index = np.unique(groups, return_index=True, return_inverse=True)
    return Mesh(mesh.vertices[mesh.faces.reshape(-1)[first]], index.reshape(-1, 3))
