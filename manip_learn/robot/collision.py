"""How far the links of a robot are from each other and from what stands around, and which way the joints change that.

A link's mesh counts as its convex hull, or, where that is near something, by its triangles: the hulls of a forearm and
of a wrist touch where the links do not.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import combinations
from typing import Any, Literal, NamedTuple, final

import coal
import numpy as np
import pinocchio as pin
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.errors import RobotError, counted, few
from manip_learn.robot.description.mjcf import turn_z_to
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.figure import bones, link_radii
from manip_learn.robot.visuals.meshes import GREY, Mesh
from manip_learn.robot.visuals.visual_shapes import SHEET, Solid, Visual, bare_links, shape_faults, visual_shapes

Shapes = Literal["collision", "visual", "links"]
# postures that are looked at for links that can touch: every 0.2 rad of two joints that turn once
SAMPLED_POSTURES = 1000
# [m] depth that may come from convex hulls, which are larger than the links
HULL_SLACK = 0.01
# [m] of Coal's iterations; with its own of 1e-6, gradients between cylinders and boxes are 0.1 off
COAL_TOLERANCE = 1e-12
MOST_ITERATIONS = 1000  # of the distance of two shapes, which ends by itself before
MOST_PARTS = 30  # of a mesh that are looked at one by one: a cabinet with doors and handles
LARGE_BLOCK = 10.0  # [m] half the edge of a block whose face is a floor or a front: no arm reaches around it


@final
@dataclass(frozen=True, eq=False)
class CollisionShape:
    """One convex shape on one link.

    Attributes:
        link: Name of the link.
        joint: Pinocchio id of the moving joint that carries it; 0 is the fixed world.
        placement: shape (4, 4), from the shape to that joint [m].
        geometry: The shape for Coal.
        radius: Of a ball about the shape's origin that contains it [m].
        shape: The same in numbers, a mesh as trimesh's.
        mesh: What the shape is the convex hull of, as trimesh's; None of other shapes.
    """

    link: str
    joint: int
    placement: Float[np.ndarray, "4 4"]
    geometry: Any
    radius: float
    shape: Any
    mesh: Any = None

    @cached_property
    def surface(self) -> CollisionShape:
        """The same by its triangles, where it has any."""
        return self if self.mesh is None else replace(self, geometry=_coal(self.mesh, False), shape=self.mesh)


@final
@dataclass(frozen=True, eq=False)
class Obstacle:
    """A solid that stands in the world.

    Attributes:
        name: What it is called.
        placement: shape (4, 4), in the robot's base frame [m].
        geometry: A convex shape of Coal, or its mesh of triangles, whose surface counts.
        half: shape (3,), half extents of a box about it, centred at its origin and along its axes [m].
        shape: The same in numbers, a mesh as trimesh's.
        may_touch: Names of the links that may touch it.
        is_closed: True of a mesh that is closed and not convex: a link within it touches it, too.
    """

    name: str
    placement: Float[np.ndarray, "4 4"]
    geometry: Any
    half: Float[np.ndarray, " 3"]
    shape: Any
    may_touch: frozenset[str] = frozenset()
    is_closed: bool = False

    def to_dict(self, most: int) -> dict[str, Any]:
        """Return it as plain data: its name, pose, kind and numbers [m]; a large block is its face across z.

        Args:
            most: Triangles; a mesh of more is the box about it.
        """
        shape, half, placement = self.shape, self.half.tolist(), self.placement.copy()
        described: dict[str, Any] = {"kind": "box", "size": [2.0 * x for x in half]}
        if min(half) >= LARGE_BLOCK:
            described = {"kind": "face"}
            placement[:3, 3] += half[2] * placement[:3, 2]
        elif isinstance(shape, Solid):
            described = {"kind": shape.kind, "size": list(shape.size)}
        elif len(shape.faces) <= most:
            described = {"kind": "mesh", "vertices": shape.vertices.round(5).tolist(), "faces": shape.faces.tolist()}
        return {"name": self.name, "pose": placement.tolist()} | described


@lru_cache(maxsize=16)
def collision_shapes(robot: Robot, tag: Shapes = "collision") -> tuple[CollisionShape, ...]:
    """Return all collision shapes of a robot; capsules, or a ball, stand in for a link that loses all of its own.

    Args:
        robot: A loaded robot.
        tag: `"visual"` takes the shapes that are drawn in their place; `"links"` takes capsules from joint to joint,
            as thick as the tubes by which the replay draws a robot that has no shapes.

    Raises:
        RobotError: The robot has none that can be used; codes `no-collision-shapes`, `collision-shape`.
    """
    if tag == "links":
        bodies = [f for f in robot.pinocchio_model.frames if f.type == pin.FrameType.BODY]
        return _made(_capsules(robot, {f.parentJoint: f.name for f in reversed(bodies)}))
    shapes = visual_shapes(robot, tag)
    if all(v.fault for v in shapes):
        reasons = shape_faults(robot, tag)
        why = f" that can be used: {' '.join(reasons)}" if reasons else ", whose distances could be computed"
        if tag == "collision" and known_shapes(robot) == "visual":
            why += ": the shapes of its <visual> elements can take their place (shapes='visual')"
        code = "collision-shape" if reasons else "no-collision-shapes"
        raise RobotError(f"robot {robot.name!r} has no <{tag}> elements{why}", code=code, path=robot.source)
    bare = {joint: link for link, joint in reversed(bare_links(shapes).items())}
    plain, radii = _capsules(robot, bare), link_radii(robot.pinocchio_model)
    short = bare.keys() - {v.joint for v in plain}  # links too short for a bone: a ball where the joint is
    plain += [Visual(bare[j], j, np.eye(4), Solid("sphere", (float(radii[j]),)), GREY) for j in sorted(short)]
    return _made((*shapes, *plain))


def _made(shapes: Iterable[Visual]) -> tuple[CollisionShape, ...]:
    return tuple(_shape(v, v.shape) for v in shapes if v.shape)


def _capsules(robot: Robot, links: Mapping[int, str]) -> list[Visual]:
    """Return capsules along the bones of some joints, as shapes of the links that are named for these."""
    model, out = robot.pinocchio_model, list[Visual]()
    for bone in (b for b in bones(model, link_radii(model)) if b.joint in links):
        (start, end), radius = bone.ends, max(bone.radii)
        length = float(np.linalg.norm(end - start))
        placement = pin.SE3(turn_z_to((end - start) / length), 0.5 * (start + end)).homogeneous
        out.append(Visual(links[bone.joint], bone.joint, placement, Solid("capsule", (radius, length)), GREY))
    return out


def missing_meshes(robot: Robot) -> tuple[str, ...]:
    """Say which shapes of a robot are lost and why, of those that count: a sentence for each reason."""
    tag = known_shapes(robot)
    return shape_faults(robot, *(("collision", "visual") if tag == "links" else (tag,)))


def describe_shapes(robot: Robot) -> str:
    """Return a sentence on the shapes that count for collisions: how many, of which elements, and the stand-ins."""
    if (tag := known_shapes(robot)) == "links":
        return (
            "the robot has no shapes that can be used: self-collision is not looked at, capsules along its links keep "
            "clear of what stands around"
        )
    shapes = visual_shapes(robot, tag)
    plain = f"; plain shapes stand in for {few(list(bare), 4)}" if (bare := bare_links(shapes)) else ""
    number = sum(not v.fault for v in shapes)
    return f"collision checks use {counted(number, 'shape')} of <{tag}> elements{plain}"


@lru_cache(maxsize=16)
def known_shapes(robot: Robot) -> Shapes:
    """Return which shapes of a robot there are: those for collisions, or else the drawn ones, or else capsules."""
    tags: tuple[Shapes, ...] = ("collision", "visual")
    usable: list[Shapes] = [tag for tag in tags if not all(v.fault for v in visual_shapes(robot, tag))]
    return usable[0] if usable else "links"


def obstacles_of(
    name: str, placement: Float[np.ndarray, "4 4"], shape: Solid | Mesh, may_touch: frozenset[str] = frozenset()
) -> tuple[Obstacle, ...]:
    """Return a thing of the world as what links keep clear of; each part of a mesh that hangs together is one.

    Args:
        name: What it is called.
        placement: shape (4, 4), in the robot's base frame [m].
        shape: What it is, in its own frame.
        may_touch: Names of the links that may touch it.
    """
    import trimesh

    if isinstance(shape, Solid):
        geometry, half, _ = _solid(shape)
        return (Obstacle(name, placement, geometry, half, shape, may_touch),)
    whole, out = trimesh.Trimesh(shape.vertices, shape.faces), list[Obstacle]()  # it joins corners in one place
    parts = whole.split(only_watertight=False, repair=False)
    for part in parts if 0 < len(parts) <= MOST_PARTS else [whole]:
        is_closed = part.is_watertight and not _is_flat(part.vertices)
        is_convex, half = is_closed and part.is_convex, np.abs(part.vertices).max(axis=0)
        solid = part.convex_hull if is_convex else part
        geometry = _coal(solid, is_convex)
        out.append(Obstacle(name, placement, geometry, half, solid, may_touch, is_closed and not is_convex))
    return tuple(out)


def _coal(mesh: Any, is_convex: bool) -> Any:
    """Return a mesh of trimesh's for Coal: as a convex body, or as its triangles."""
    vertices, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for point in np.asarray(mesh.vertices):
        vertices.append(point)
    for corners in mesh.faces.tolist():
        triangles.append(coal.Triangle(*corners))
    if is_convex:
        return coal.Convex(vertices, triangles)
    geometry = coal.BVHModelOBBRSS()
    geometry.beginModel(len(triangles), len(vertices))
    geometry.addSubModel(vertices, triangles)
    geometry.endModel()
    return geometry


def _solid(solid: Solid) -> tuple[Any, Float[np.ndarray, " 3"], float]:
    """Return a plain body for Coal, half extents of the box about it, and the radius of the ball."""
    geometry = getattr(coal, solid.kind.capitalize())(*solid.size)
    if solid.kind == "box":
        return geometry, 0.5 * np.array(solid.size), 0.5 * float(np.linalg.norm(solid.size))
    radius, far = solid.size[0], 0.5 * sum(solid.size[1:])
    if solid.kind == "cylinder":
        return geometry, np.array([radius, radius, far]), float(np.hypot(radius, far))
    return geometry, np.array([radius, radius, radius + far]), radius + far


def _is_flat(points: Float[np.ndarray, "n 3"]) -> bool:
    """Whether points lie in a plane, to 1e-5 of their extent: their rounding is a hundredth of that."""
    return int(np.linalg.matrix_rank(points - points.mean(axis=0), rtol=1e-5)) < 3


def _shape(v: Visual, shape: Solid | Mesh) -> CollisionShape:
    import trimesh

    if isinstance(shape, Solid):
        geometry, _, radius = _solid(shape)
        return CollisionShape(v.link, v.joint, v.placement, geometry, radius, shape)
    whole = trimesh.Trimesh(shape.vertices, shape.faces)
    corners = np.asarray(whole.vertices)
    if _is_flat(corners):  # a sticker
        corners = (corners[:, None] + 0.5 * SHEET * np.vstack([np.eye(3), -np.eye(3)])).reshape(-1, 3)
    hull = trimesh.convex.convex_hull(corners)
    middle, placement = hull.bounds.mean(axis=0), v.placement.copy()
    hull.apply_translation(-middle)
    whole.apply_translation(-middle)
    placement[:3, 3] += placement[:3, :3] @ middle
    radius = float(np.linalg.norm(hull.vertices, axis=1).max())
    return CollisionShape(v.link, v.joint, placement, _coal(hull, True), radius, hull, whole)


@final
class Proximity(NamedTuple):
    """Two shapes that are near each other.

    Attributes:
        links: Names of the two links, or of a link and an obstacle.
        distance: [m]; negative where the shapes overlap: the depth.
        gradient: d distance / dq, shape (nv,) [m/rad or 1].
        normal: shape (3,), the way in the base frame in which the second would have to move away.
        number: Of the pair.
    """

    links: tuple[str, str]
    distance: float
    gradient: Float[np.ndarray, " nv"]
    normal: Float[np.ndarray, " 3"]
    number: int


@final
class SelfCollision:
    """Distances of one robot's links from each other and from obstacles, computed by Coal.

    A link's mesh counts as its convex hull, or by its triangles: see `hulls`.

    With the witness points p_a, p_b (the nearest points of two shapes) and the unit vector n from a to b,

        d = n . (p_b - p_a),    dd/dq = n^T (J_b(p_b) - J_a(p_a)),    J(p) the Jacobian of the link's point at p

    since d does not change to first order when a witness point moves on its surface. Where the nearest points jump from
    one place to another, as between parallel faces, d has a kink, and one of its one-sided gradients comes back. Where
    round shapes overlap, the direction is that of an approximate depth.

    Left out are links that are joined to each other by one joint or rigidly; those that touch at the posture `free`;
    and those that are joined by two joints and overlap by more than `HULL_SLACK` at none of `SAMPLED_POSTURES`
    postures: they stay near each other whatever the arm does. Of a link that a joint moves and an obstacle nothing is
    left out but what the obstacle lets touch it. One instance can be used from many threads.

    Args:
        robot: The robot, with its meshes where its shapes are meshes.
        shapes: `"visual"` takes the shapes that are drawn, `"links"` capsules along the links, see `collision_shapes`.
        free: A posture in which no link touches another; by default `Robot.neutral()`.
        obstacles: What stands around. Those of one name move together.
        hulls: Whether the convex hull of a link's mesh is all that counts, which takes a tenth of the time; otherwise
            its triangles count where that is near something.

    Attributes:
        link_pairs: Names of the links whose distances from each other count.
        obstacles: What stands around.
        geometry: Pinocchio's model of the shapes on its joints, obstacles last, and of the pairs that count.
        pairs: Numbers in `geometry` of the shapes whose distances count, a link's first.
        faces: Numbers in `geometry` of those that are large faces, as a floor: to these a hull is as near as its mesh.

    Raises:
        RobotError: The robot has no collision shapes that can be used.
        ConfigurationError: `free` has the wrong size or is not finite.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        shapes: Shapes = "collision",
        free: ArrayLike | None = None,
        obstacles: Sequence[Obstacle] = (),
        hulls: bool = True,
    ):
        self.robot, self._given = robot, dict[str, Any](shapes=shapes, free=free, hulls=hulls)
        self._shapes = collision_shapes(robot, shapes)
        self._model, self._hulls = robot.pinocchio_model, hulls
        supports = [set(self._model.supports[shape.joint]) for shape in self._shapes]
        between = {(a, b): len(supports[a] ^ supports[b]) for a, b in combinations(range(len(supports)), 2)}
        self._pair_up([pair for pair, joints in between.items() if joints > 1])
        touching = {p.links for p in self.closer_than(robot.neutral() if free is None else free, 0.0)}
        kept = [pair for pair in self.pairs if self.links_of(*pair) not in touching]
        # links with two joints between them that do not touch at any of the sampled postures
        self._pair_up([pair for pair in kept if between[pair] == 2])
        apart = {self.links_of(*pair) for pair in self.pairs}
        rng = np.random.default_rng(0)  # the same pairs every time
        for _ in range(SAMPLED_POSTURES):
            _, geometry_data, far = self._placed(robot.random_configuration(rng))
            for k in np.flatnonzero(far <= -HULL_SLACK).tolist():
                links = self.links_of(*self.pairs[k])
                if links in apart and pin.computeDistance(self.geometry, geometry_data, k).min_distance <= -HULL_SLACK:
                    apart.discard(links)
        kept = [pair for pair in kept if self.links_of(*pair) not in apart]
        self.link_pairs = tuple(dict.fromkeys(self.links_of(*pair) for pair in kept))
        self._pair_up(kept, obstacles)

    def with_obstacles(self, obstacles: Sequence[Obstacle], own: bool = True) -> SelfCollision:
        """The same links among other obstacles; their shapes and pairs are shared, so that it takes a millisecond.

        Args:
            obstacles: What stands around.
            own: Whether the links' distances from each other count.
        """
        other = object.__new__(SelfCollision)
        vars(other).update(vars(self))
        vars(other).pop("levers", None)
        n = len(self._shapes)
        other._pair_up([pair for pair in self.pairs if own and pair[1] < n], obstacles)
        return other

    @cached_property
    def levers(self) -> Float[np.ndarray, "pairs nv"]:
        """By how much a joint changes each distance at most, with links laid end to end [m/rad or 1]."""
        model, robot, out = self._model, self.robot, np.zeros((len(self._solids), self._model.nv))
        ends = np.maximum(np.abs(model.lowerPositionLimit), np.abs(model.upperPositionLimit))
        for k, shape in enumerate(self._shapes):
            length = float(np.linalg.norm(shape.placement[:3, 3])) + shape.radius
            for j in reversed([j for j in model.supports[shape.joint] if j]):
                joint = model.joints[j]
                turns, slide = joint.shortname().startswith("JointModelR"), ends[joint.idx_q : joint.idx_q + joint.nq]
                out[k, joint.idx_v : joint.idx_v + joint.nv] = length if turns else max(1.0, length)
                length += float(np.linalg.norm(model.jointPlacements[j].translation))
                length += 0.0 if turns else float(np.minimum(slide, LARGE_BLOCK).sum())
        a, b = self._pair_table
        levers = np.where((out[a] > 0.0) & (out[b] > 0.0), 0.0, out[a] + out[b])  # what carries both changes nothing
        return levers if robot.coupling is None else levers @ np.abs(robot.coupling.lift)

    def solid(self, number: int, hull: bool = False) -> CollisionShape:
        """Return a shape of `geometry` as it counts where it is near something, or its hull."""
        return self._solids[number] if self._hulls or hull else self._solids[number].surface

    def is_clear(self, q: ArrayLike, distance: float) -> bool:
        """Whether no pair is at a distance of at most `distance` [m]: not `closer_than`, in a fifth of its time.

        Args and errors as for `closer_than`.
        """
        data, geometry_data = self._own_data()
        if getattr(self._local, "margin", None) != distance:
            for request in geometry_data.collisionRequests:
                request.security_margin = distance
            self._local.margin = distance
        posture = self.robot.pinocchio_configuration(q)
        pin.updateGeometryPlacements(self._model, data, self.geometry, geometry_data, posture)
        if pin.computeCollisions(self.geometry, geometry_data, self._hulls):
            for k in (k for k, found in enumerate(geometry_data.collisionResults) if found.isCollision()):
                meshes = self._meshes(k, geometry_data)
                # that triangles cut each other is told in no time
                if not meshes or coal.collide(*meshes, coal.CollisionRequest(), coal.CollisionResult()):
                    return False
                if coal.distance(*meshes, coal.DistanceRequest(), coal.DistanceResult()) <= distance:
                    return False
        return not (self._closed and self.closer_than(q, distance))  # within a mesh nothing touches

    def closer_than(self, q: ArrayLike, distance: float, only: Sequence[int] | None = None) -> list[Proximity]:
        """All pairs of shapes at a distance of at most `distance` [m], and their gradients.

        Args:
            q: Configuration or joint positions.
            distance: [m].
            only: Numbers of the pairs that are looked at; None for all.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        data, geometry_data, far = self._placed(q, only is None)
        found = list[Proximity]()
        for k in np.flatnonzero(far <= distance).tolist() if only is None else only:
            result, exact = self._distance(k, geometry_data, float(far[k]), distance)
            if exact <= distance:
                found.append(self._proximity(k, result, exact, data))
        return found

    def distances(self, q: ArrayLike, only: Sequence[int]) -> list[float]:
        """Of some pairs by their numbers [m], negative where they overlap."""
        _, geometry_data, far = self._placed(q, bounded=False)
        return [self._distance(k, geometry_data, float(far[k]), np.inf)[1] for k in only]

    def nearest(self, q: ArrayLike) -> Proximity | None:
        """The pair of shapes at the smallest distance; None if nothing can touch. See `closer_than`."""
        data, geometry_data, far = self._placed(q)
        best, pair, least = None, -1, np.inf
        for k in np.argsort(far).tolist():
            if far[k] >= least:
                break
            result, exact = self._distance(k, geometry_data, float(far[k]), least)
            if exact < least:
                best, pair, least = result, k, exact
        return None if best is None else self._proximity(pair, best, least, data)

    def _distance(self, k: int, geometry_data: Any, bound: float, most: float) -> tuple[Any, float]:
        """What Coal says of a pair, and its distance, negative where a link is within a closed surface.

        What is nearer than `most` by its hulls is looked at on its triangles.
        """
        result, pair = pin.computeDistance(self.geometry, geometry_data, k), self.pairs[k]
        # where its iterations fail on shapes that overlap, Coal returns the lowest number and no direction
        distance = max(float(result.min_distance), bound)
        if distance > 0.0 and (mesh := self._closed.get(pair[1])) is not None:
            point = geometry_data.oMg[pair[1]].actInv(result.getNearestPoint1())
            return result, -distance if mesh.contains([point])[0] else distance
        if distance <= most and (meshes := self._meshes(k, geometry_data)):
            coal.distance(*meshes, coal.DistanceRequest(), result := coal.DistanceResult())
            return result, float(result.min_distance)
        return result, distance

    def _meshes(self, k: int, geometry_data: Any) -> list[Any]:
        """A pair and its places for Coal, by their triangles; nothing where hulls are all that counts."""
        pair, out = self.pairs[k], list[Any]()
        if self._hulls or pair[1] in self.faces or all(self._solids[i].mesh is None for i in pair):
            return out
        for place, i in ((geometry_data.oMg[i], i) for i in pair):
            out += [self._solids[i].surface.geometry, coal.Transform3s(place.rotation, place.translation)]
        return out

    def _placed(self, q: ArrayLike, bounded: bool = True) -> tuple[pin.Data, Any, Float[np.ndarray, " pairs"]]:
        """Data with Jacobians, shapes at their places, and, if `bounded`, a lower bound of each distance."""
        data, geometry_data = self._own_data()
        pin.computeJointJacobians(self._model, data, self.robot.pinocchio_configuration(q))
        pin.updateGeometryPlacements(self._model, data, self.geometry, geometry_data)
        if not bounded:
            return data, geometry_data, np.full(len(self.pairs), -np.inf)
        centres = np.array([place.translation for place in geometry_data.oMg]).reshape(-1, 3)
        # of the ball about a link from the ball about another or the box about an obstacle, negative within that
        first, second = self._pair_table
        beyond = np.abs(np.einsum("kj,kji->ki", centres[first] - centres[second], self._turns)) - self._halves
        far = np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)
        return data, geometry_data, far - self._radii

    def _proximity(self, k: int, result: Any, distance: float, data: pin.Data) -> Proximity:
        a, b = self.pairs[k]
        nx, ny, nz = np.asarray(result.normal).tolist()
        x, y, z = result.getNearestPoint1().tolist()
        # n . (v + w x p) = n . v + (p x n) . w, alike at both points, which n joins; NumPy's cross takes 20 us
        wrench = np.array([nx, ny, nz, y * nz - z * ny, z * nx - x * nz, x * ny - y * nx])
        J = np.asarray(data.J).reshape(6, self._model.nv)  # columns are twists at the base's origin
        gradient = (self._carries[b] - self._carries[a]) * wrench.dot(J)
        if distance < 0.0 < result.min_distance:  # from within
            gradient, nx, ny, nz = -gradient, -nx, -ny, -nz
        if not np.all(np.isfinite(gradient)):
            gradient, nx, ny, nz = np.zeros(self._model.nv), 0.0, 0.0, 0.0
        coupling = self.robot.coupling
        lifted = gradient if coupling is None else gradient @ coupling.lift
        return Proximity(self.links_of(a, b), distance, lifted, np.array([nx, ny, nz]), k)

    def links_of(self, a: int, b: int) -> tuple[str, str]:
        """Return the names of the links, or of link and obstacle, of two shapes of `geometry`."""
        return self._solids[a].link, self._solids[b].link

    def _pair_up(self, pairs: list[tuple[int, int]], obstacles: Sequence[Obstacle] = ()) -> None:
        """Take these pairs of shapes, and each obstacle with every link that moves and must not touch it."""
        self.obstacles, self._local, n = tuple(obstacles), threading.local(), len(self._shapes)
        around = list(enumerate(self.obstacles, n))
        met = [(a, b) for a, s in enumerate(self._shapes) if s.joint for b, o in around if s.link not in o.may_touch]
        self.pairs = [*pairs, *met]
        self.faces = {b for b, o in around if min(o.half) >= LARGE_BLOCK}
        self._closed = {b: o.shape for b, o in around if o.is_closed}
        world = [CollisionShape(o.name, 0, o.placement, o.geometry, 0.0, o.shape) for o in self.obstacles]
        self._solids = [*self._shapes, *world]
        self.geometry = pin.GeometryModel()
        for number, solid in enumerate(self._solids):
            placed = pin.GeometryObject(f"{number}", solid.joint, pin.SE3(solid.placement), solid.geometry)
            self.geometry.addGeometryObject(placed)
        for a, b in self.pairs:
            self.geometry.addCollisionPair(pin.CollisionPair(a, b))
        first, second = self._pair_table = np.array(self.pairs, dtype=np.intp).reshape(-1, 2).T
        radii = np.array([solid.radius for solid in self._solids])
        self._radii = radii[first] + radii[second]
        # of each pair's second the box about it and its axes: nothing but its middle, if it is a link
        self._halves = np.array([*np.zeros((n, 3)), *(o.half for o in self.obstacles)]).reshape(-1, 3)[second]
        turns = [*n * [np.eye(3)], *(o.placement[:3, :3] for o in self.obstacles)]
        self._turns = np.array(turns).reshape(-1, 3, 3)[second]
        # 1 for each velocity of Pinocchio's model that moves a solid, else 0
        self._carries = np.zeros((len(self._solids), self._model.nv))
        for k, shape in enumerate(self._shapes):
            for block in (self._model.joints[j] for j in self._model.supports[shape.joint] if j):
                self._carries[k, block.idx_v : block.idx_v + block.nv] = 1.0

    def _own_data(self) -> tuple[pin.Data, Any]:
        try:
            return self._local.data
        except AttributeError:
            geometry_data = pin.GeometryData(self.geometry)
            for request in geometry_data.distanceRequests:
                request.gjk_tolerance, request.gjk_max_iterations = COAL_TOLERANCE, MOST_ITERATIONS
            self._local.data = self._model.createData(), geometry_data
            return self._local.data

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(SelfCollision, obstacles=self.obstacles, **self._given), (self.robot,)
