"""Distances between the links of a robot and to obstacles, and their gradients with respect to the joints.

The mesh of a link is represented by its convex hull, and near another object by its triangles, because e.g. the hulls
of a forearm and a wrist can touch although the links do not.
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
LARGE_BLOCK = 10.0  # [m] smallest half edge of a block whose face is a floor or a front: no arm reaches around it


@final
@dataclass(frozen=True, eq=False)
class CollisionShape:
    """Convex collision shape of a link.

    Attributes:
        link: Name of the link.
        joint: Pinocchio id of the moving joint that carries it; 0 is the fixed world.
        placement: Pose (4, 4) of the shape in the frame of that joint [m].
        geometry: The shape as a Coal object.
        radius: Radius of the bounding ball about the shape's origin [m].
        shape: The shape as a `Solid` or as a trimesh mesh.
        mesh: Trimesh mesh whose convex hull is the shape; None for other shapes.
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
        """The triangle mesh itself instead of its convex hull; the same shape if it has no mesh."""
        return self if self.mesh is None else replace(self, geometry=_coal(self.mesh, False), shape=self.mesh)


@final
@dataclass(frozen=True, eq=False)
class Obstacle:
    """Obstacle for collision checks.

    Attributes:
        name: Name of the obstacle.
        placement: Pose (4, 4) in the robot's base frame [m].
        geometry: Coal object: a convex shape, or a triangle mesh of which only the surface is used.
        half: Half extents (3,) of its bounding box, centred at its origin and along its axes [m].
        shape: The obstacle as a `Solid` or as a trimesh mesh.
        may_touch: Names of the links that may touch it.
        is_closed: True for a mesh that is closed and not convex, so that a link inside it is in collision, too.
    """

    name: str
    placement: Float[np.ndarray, "4 4"]
    geometry: Any
    half: Float[np.ndarray, " 3"]
    shape: Any
    may_touch: frozenset[str] = frozenset()
    is_closed: bool = False

    def to_dict(self, most: int) -> dict[str, Any]:
        """Return the obstacle as a dictionary of JSON values, for drawing: name, pose, kind and dimensions [m].

        Of a huge block, e.g. a floor, only the face across its z axis is returned.

        Args:
            most: Largest number of triangles; a larger mesh is replaced by its bounding box.
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
    """Return all collision shapes of a robot; a link without any usable shape gets capsules or a ball instead.

    Args:
        robot: A loaded robot.
        tag: `"collision"` for its collision shapes; `"visual"` for its visual shapes; `"links"` for capsules from joint
            to joint, as thick as the tubes that the replay draws for a robot without shapes.

    Raises:
        RobotError: The robot has no usable shapes; codes `no-collision-shapes`, `collision-shape`.
    """
    if tag == "links":
        bodies = [f for f in robot.pinocchio_model.frames if f.type == pin.FrameType.BODY]
        return _convert(_capsules(robot, {f.parentJoint: f.name for f in reversed(bodies)}))
    shapes = visual_shapes(robot, tag)
    if all(v.fault for v in shapes):
        reasons = shape_faults(robot, tag)
        why = f" that can be used: {' '.join(reasons)}" if reasons else " for which distances could be computed"
        if tag == "collision" and known_shapes(robot) == "visual":
            why += ": the shapes of its <visual> elements can take their place (shapes='visual')"
        code = "collision-shape" if reasons else "no-collision-shapes"
        raise RobotError(f"robot {robot.name!r} has no <{tag}> elements{why}", code=code, path=robot.source)
    bare = {joint: link for link, joint in reversed(bare_links(shapes).items())}
    plain, radii = _capsules(robot, bare), link_radii(robot.pinocchio_model)
    short = bare.keys() - {v.joint for v in plain}  # links too short for a bone get a ball at the joint
    plain += [Visual(bare[j], j, np.eye(4), Solid("sphere", (float(radii[j]),)), GREY) for j in sorted(short)]
    return _convert((*shapes, *plain))


def _convert(shapes: Iterable[Visual]) -> tuple[CollisionShape, ...]:
    """Return the collision shapes of usable visual shapes."""
    return tuple(_shape(v, v.shape) for v in shapes if v.shape)


def _capsules(robot: Robot, links: Mapping[int, str]) -> list[Visual]:
    """Return capsules along the bones of some joints, as shapes of the links given for these joints."""
    model, out = robot.pinocchio_model, list[Visual]()
    for bone in (b for b in bones(model, link_radii(model)) if b.joint in links):
        (start, end), radius = bone.ends, max(bone.radii)
        length = float(np.linalg.norm(end - start))
        placement = pin.SE3(turn_z_to((end - start) / length), 0.5 * (start + end)).homogeneous
        out.append(Visual(links[bone.joint], bone.joint, placement, Solid("capsule", (radius, length)), GREY))
    return out


def missing_meshes(robot: Robot) -> tuple[str, ...]:
    """Return one sentence per reason for which collision shapes cannot be used, e.g. missing meshes.

    Args:
        robot: A loaded robot.
    """
    tag = known_shapes(robot)
    return shape_faults(robot, *(("collision", "visual") if tag == "links" else (tag,)))


def describe_shapes(robot: Robot) -> str:
    """Describe in one sentence the shapes used for collision checks: number, origin, and substitutes.

    Args:
        robot: A loaded robot.
    """
    if (tag := known_shapes(robot)) == "links":
        return (
            "the robot has no usable shapes: self-collision is not checked, capsules along its links keep clear of "
            "obstacles"
        )
    shapes = visual_shapes(robot, tag)
    plain = f"; plain shapes stand in for {few(list(bare), 4)}" if (bare := bare_links(shapes)) else ""
    number = sum(not v.fault for v in shapes)
    return f"collision checks use {counted(number, 'shape')} of <{tag}> elements{plain}"


@lru_cache(maxsize=16)
def known_shapes(robot: Robot) -> Shapes:
    """Return the kind of shapes used for collision checks, the argument `tag` of `collision_shapes`.

    It is `"collision"`, or `"visual"` if there are no collision shapes, or `"links"` if there are no visual shapes
    either.

    Args:
        robot: A loaded robot.
    """
    tags: tuple[Shapes, ...] = ("collision", "visual")
    usable: list[Shapes] = [tag for tag in tags if not all(v.fault for v in visual_shapes(robot, tag))]
    return usable[0] if usable else "links"


def obstacles_of(
    name: str, placement: Float[np.ndarray, "4 4"], shape: Solid | Mesh, may_touch: frozenset[str] = frozenset()
) -> tuple[Obstacle, ...]:
    """Return the obstacles that represent an object; each connected part of a mesh is one obstacle.

    Args:
        name: Name of the object.
        placement: Pose (4, 4) in the robot's base frame [m].
        shape: Its shape, in its own frame.
        may_touch: Names of the links that may touch it.
    """
    import trimesh

    if isinstance(shape, Solid):
        geometry, half, _ = _solid(shape)
        return (Obstacle(name, placement, geometry, half, shape, may_touch),)
    whole, out = trimesh.Trimesh(shape.vertices, shape.faces), list[Obstacle]()  # trimesh merges equal corners
    parts = whole.split(only_watertight=False, repair=False)
    # at most 30 parts, enough for a cabinet with doors and handles, else the mesh as a whole
    for part in parts if 0 < len(parts) <= 30 else [whole]:
        is_closed = part.is_watertight and not _is_flat(part.vertices)
        is_convex, half = is_closed and part.is_convex, np.abs(part.vertices).max(axis=0)
        solid = part.convex_hull if is_convex else part
        geometry = _coal(solid, is_convex)
        out.append(Obstacle(name, placement, geometry, half, solid, may_touch, is_closed and not is_convex))
    return tuple(out)


def _coal(mesh: Any, is_convex: bool) -> Any:
    """Return a mesh of trimesh for Coal: as a convex body, or as its triangles."""
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
    """Return a plain body for Coal, the half extents of its bounding box, and the radius of its bounding ball [m]."""
    geometry = getattr(coal, solid.kind.capitalize())(*solid.size)
    if solid.kind == "box":
        return geometry, 0.5 * np.array(solid.size), 0.5 * float(np.linalg.norm(solid.size))
    radius, far = solid.size[0], 0.5 * sum(solid.size[1:])
    if solid.kind == "cylinder":
        return geometry, np.array([radius, radius, far]), float(np.hypot(radius, far))
    return geometry, np.array([radius, radius, radius + far]), radius + far


def _is_flat(points: Float[np.ndarray, "n 3"]) -> bool:
    """Return True if points lie in a plane, to 1e-5 of their extent: their rounding is a hundredth of that."""
    return int(np.linalg.matrix_rank(points - points.mean(axis=0), rtol=1e-5)) < 3


def _shape(v: Visual, shape: Solid | Mesh) -> CollisionShape:
    """Return a visual shape as a collision shape, a mesh by its convex hull."""
    import trimesh

    if isinstance(shape, Solid):
        geometry, _, radius = _solid(shape)
        return CollisionShape(v.link, v.joint, v.placement, geometry, radius, shape)
    whole = trimesh.Trimesh(shape.vertices, shape.faces)
    corners = np.asarray(whole.vertices)
    if _is_flat(corners):  # a sticker, for example, gets a thickness
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
        distance: Distance [m]; if the shapes overlap, minus the penetration depth.
        gradient: Gradient of the distance with respect to the joint positions, shape (nv,) [m/rad or 1].
        normal: Unit vector (3,) in the base frame along which the second shape moves away from the first.
        number: Index of the pair in `SelfCollision.pairs`.
    """

    links: tuple[str, str]
    distance: float
    gradient: Float[np.ndarray, " nv"]
    normal: Float[np.ndarray, " 3"]
    number: int


@final
class SelfCollision:
    r"""Collision model of a robot: distances of its links from each other and from obstacles, computed by Coal.

    With the nearest points :math:`p_a, p_b` of two shapes (witness points), the unit vector n from the first to the
    second, and the Jacobian :math:`J_a(p)` of the point of link a that is at p, the distance and its gradient are

    .. math::

        d = n^T (p_b - p_a), \qquad \frac{\partial d}{\partial q} = n^T (J_b(p_b) - J_a(p_a))

    because d does not change to first order when a witness point moves on its surface. Where the nearest points jump,
    as between parallel faces, the distance has a kink, and the gradient is one of its one-sided gradients. For
    overlapping round shapes, the direction belongs to an approximate penetration depth.

    Some pairs of links are not checked: links joined by one joint or rigidly; links that touch in the configuration
    `free`; and links joined by two joints that overlap at none of 1,000 random configurations by more than 0.01 m (a
    depth that convex hulls may cause), because such links are always near each other. A moving link is checked against
    every obstacle that it may not touch. One instance can be used from many threads.

    Args:
        robot: The robot, with its meshes if its shapes are meshes.
        shapes: `"collision"`, `"visual"` or `"links"` (capsules along the links), see `collision_shapes`.
        free: Configuration (nq,) or joint positions (nv,) in which no link touches another; default `Robot.neutral()`.
        obstacles: Obstacles; obstacles with the same name move together.
        hulls: True to represent a link's mesh by its convex hull only, which takes a tenth of the time. False to use
            its triangles near another object.

    Attributes:
        link_pairs: Pairs of names of the links that are checked against each other.
        obstacles: The obstacles.
        geometry: Pinocchio's geometry model of the shapes, obstacles last, and of the checked pairs.
        pairs: Checked pairs, as indices in `geometry`; the first one is of a link.
        faces: Indices in `geometry` of large faces, e.g. a floor, for which the hull of a mesh is exact.

    Raises:
        RobotError: The robot has no usable collision shapes.
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
        self.robot, self._arguments = robot, dict[str, Any](shapes=shapes, free=free, hulls=hulls)
        self._shapes = collision_shapes(robot, shapes)
        self._model, self._hulls = robot.pinocchio_model, hulls
        supports = [set(self._model.supports[shape.joint]) for shape in self._shapes]
        between = {(a, b): len(supports[a] ^ supports[b]) for a, b in combinations(range(len(supports)), 2)}
        self._set_pairs([pair for pair, joints in between.items() if joints > 1])
        touching = {p.links for p in self.closer_than(robot.neutral() if free is None else free, 0.0)}
        remaining = [pair for pair in self.pairs if self.links_of(*pair) not in touching]
        # as many postures as every 0.2 rad of two joints that turn once; [m] depth that convex hulls may cause
        n_postures, hull_slack = 1000, 0.01
        # links with two joints between them that touch at none of the sampled postures
        self._set_pairs([pair for pair in remaining if between[pair] == 2])
        apart = {self.links_of(*pair) for pair in self.pairs}
        rng = np.random.default_rng(0)  # the same pairs every time
        for _ in range(n_postures):
            _, geometry_data, far = self._place_shapes(robot.random_configuration(rng))
            for k in np.flatnonzero(far <= -hull_slack).tolist():
                links = self.links_of(*self.pairs[k])
                if links in apart and pin.computeDistance(self.geometry, geometry_data, k).min_distance <= -hull_slack:
                    apart.discard(links)
        remaining = [pair for pair in remaining if self.links_of(*pair) not in apart]
        self.link_pairs = tuple(dict.fromkeys(self.links_of(*pair) for pair in remaining))
        self._set_pairs(remaining, obstacles)

    def with_obstacles(self, obstacles: Sequence[Obstacle], own: bool = True) -> SelfCollision:
        """Return a model of the same robot among other obstacles, in about a millisecond because shapes are shared.

        Args:
            obstacles: The new obstacles.
            own: True to check the links also against each other.
        """
        other = object.__new__(SelfCollision)
        vars(other).update(vars(self))
        vars(other).pop("levers", None)
        n = len(self._shapes)
        other._set_pairs([pair for pair in self.pairs if own and pair[1] < n], obstacles)
        return other

    @cached_property
    def levers(self) -> Float[np.ndarray, "pairs nv"]:
        """Upper bound of the change of each pair's distance per unit joint motion (pairs, nv) [m/rad or 1]."""
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
        # a joint that carries both shapes does not change their distance
        levers = np.where((out[a] > 0.0) & (out[b] > 0.0), 0.0, out[a] + out[b])
        return levers if robot.coupling is None else levers @ np.abs(robot.coupling.lift)

    def solid(self, number: int, hull: bool = False) -> CollisionShape:
        """Return a shape in the form in which it is checked near another object.

        Args:
            number: Index of the shape in `geometry`.
            hull: True for the convex hull of a mesh, also if its triangles are used for checks.
        """
        return self._solids[number] if self._hulls or hull else self._solids[number].surface

    def is_clear(self, q: ArrayLike, distance: float) -> bool:
        """Return True if all pairs are farther apart than a distance; this takes a fifth of the time of `closer_than`.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            distance: Distance that every pair must exceed [m].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        data, geometry_data = self._own_data()
        if getattr(self._local, "margin", None) != distance:
            for request in geometry_data.collisionRequests:
                request.security_margin = distance
            self._local.margin = distance
        posture = self.robot.pinocchio_configuration(q)
        pin.updateGeometryPlacements(self._model, data, self.geometry, geometry_data, posture)
        if pin.computeCollisions(self.geometry, geometry_data, self._hulls):
            for k in (k for k, result in enumerate(geometry_data.collisionResults) if result.isCollision()):
                meshes = self._meshes(k, geometry_data)
                # a check whether triangles intersect is much faster than their distance
                if not meshes or coal.collide(*meshes, coal.CollisionRequest(), coal.CollisionResult()):
                    return False
                if coal.distance(*meshes, coal.DistanceRequest(), coal.DistanceResult()) <= distance:
                    return False
        # a link inside a mesh touches none of its triangles
        return not (self._closed and self.closer_than(q, distance))

    def closer_than(self, q: ArrayLike, distance: float, only: Sequence[int] | None = None) -> list[Proximity]:
        """Return all pairs of shapes within a distance, with the gradients of their distances.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            distance: Largest distance of a returned pair [m].
            only: Indices in `pairs` to check; None for all.

        Returns:
            One `Proximity` per near pair, in the order of `only` or of `pairs`, not sorted by distance.

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        data, geometry_data, far = self._place_shapes(q, only is None)
        near = list[Proximity]()
        for k in np.flatnonzero(far <= distance).tolist() if only is None else only:
            result, exact = self._distance(k, geometry_data, float(far[k]), distance)
            if exact <= distance:
                near.append(self._proximity(k, result, exact, data))
        return near

    def distances(self, q: ArrayLike, only: Sequence[int]) -> list[float]:
        """Return the distances of some pairs [m], negative for shapes that overlap.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].
            only: Indices of the pairs in `pairs`.

        Returns:
            One distance per entry of `only`, in its order [m].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        _, geometry_data, far = self._place_shapes(q, bounded=False)
        return [self._distance(k, geometry_data, float(far[k]), np.inf)[1] for k in only]

    def nearest(self, q: ArrayLike) -> Proximity | None:
        """Return the pair of shapes at the smallest distance; None if there are no pairs. See `closer_than`.

        Args:
            q: Configuration (nq,) or joint positions (nv,) [rad or m].

        Raises:
            ConfigurationError: q has the wrong size or is not finite.
        """
        data, geometry_data, far = self._place_shapes(q)
        best, pair, least = None, -1, np.inf
        for k in np.argsort(far).tolist():
            if far[k] >= least:
                break
            result, exact = self._distance(k, geometry_data, float(far[k]), least)
            if exact < least:
                best, pair, least = result, k, exact
        return None if best is None else self._proximity(pair, best, least, data)

    def _distance(self, k: int, geometry_data: Any, bound: float, most: float) -> tuple[Any, float]:
        """Return Coal's result for a pair, and its distance [m], negative where a link is inside a closed surface.

        Pairs whose hulls are nearer than `most` are checked by their triangles.
        """
        result, pair = pin.computeDistance(self.geometry, geometry_data, k), self.pairs[k]
        # if its iterations fail for overlapping shapes, Coal returns the lowest float and no direction
        distance = max(float(result.min_distance), bound)
        if distance > 0.0 and (mesh := self._closed.get(pair[1])) is not None:
            point = geometry_data.oMg[pair[1]].actInv(result.getNearestPoint1())
            return result, -distance if mesh.contains([point])[0] else distance
        if distance <= most and (meshes := self._meshes(k, geometry_data)):
            coal.distance(*meshes, coal.DistanceRequest(), result := coal.DistanceResult())
            return result, float(result.min_distance)
        return result, distance

    def _meshes(self, k: int, geometry_data: Any) -> list[Any]:
        """Return the triangles and places of a pair for Coal; empty if only hulls count."""
        pair, out = self.pairs[k], list[Any]()
        if self._hulls or pair[1] in self.faces or all(self._solids[i].mesh is None for i in pair):
            return out
        for place, i in ((geometry_data.oMg[i], i) for i in pair):
            out += [self._solids[i].surface.geometry, coal.Transform3s(place.rotation, place.translation)]
        return out

    def _place_shapes(self, q: ArrayLike, bounded: bool = True) -> tuple[pin.Data, Any, Float[np.ndarray, " pairs"]]:
        """Return data with Jacobians, placed shapes, and, if `bounded`, a lower bound of each distance [m]."""
        data, geometry_data = self._own_data()
        pin.computeJointJacobians(self._model, data, self.robot.pinocchio_configuration(q))
        pin.updateGeometryPlacements(self._model, data, self.geometry, geometry_data)
        if not bounded:
            return data, geometry_data, np.full(len(self.pairs), -np.inf)
        centres = np.array([place.translation for place in geometry_data.oMg]).reshape(-1, 3)
        # distance of a link's ball from the other link's ball or the obstacle's box, negative inside the box
        first, second = self._pair_table
        beyond = np.abs(np.einsum("kj,kji->ki", centres[first] - centres[second], self._turns)) - self._halves
        far = np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)
        return data, geometry_data, far - self._radii

    def _proximity(self, k: int, result: Any, distance: float, data: pin.Data) -> Proximity:
        """Return a pair as a `Proximity`, with the gradient of its distance."""
        a, b = self.pairs[k]
        nx, ny, nz = np.asarray(result.normal).tolist()
        x, y, z = result.getNearestPoint1().tolist()
        # n . (v + w x p) = n . v + (p x n) . w, equal at both points, since n connects them; NumPy's cross takes 20 us
        wrench = np.array([nx, ny, nz, y * nz - z * ny, z * nx - x * nz, x * ny - y * nx])
        J = np.asarray(data.J).reshape(6, self._model.nv)  # columns are twists at the base's origin
        gradient = (self._is_moved_by[b] - self._is_moved_by[a]) * wrench.dot(J)
        if distance < 0.0 < result.min_distance:  # inside a closed surface
            gradient, nx, ny, nz = -gradient, -nx, -ny, -nz
        if not np.all(np.isfinite(gradient)):
            gradient, nx, ny, nz = np.zeros(self._model.nv), 0.0, 0.0, 0.0
        coupling = self.robot.coupling
        lifted = gradient if coupling is None else gradient @ coupling.lift
        return Proximity(self.links_of(a, b), distance, lifted, np.array([nx, ny, nz]), k)

    def links_of(self, a: int, b: int) -> tuple[str, str]:
        """Return the names of the links or obstacles to which two shapes belong.

        Args:
            a: Index of the first shape in `geometry`.
            b: Index of the second shape in `geometry`.
        """
        return self._solids[a].link, self._solids[b].link

    def _set_pairs(self, pairs: list[tuple[int, int]], obstacles: Sequence[Obstacle] = ()) -> None:
        """Set these pairs of shapes, and a pair of each obstacle and each moving link that must not touch it."""
        self.obstacles, self._local, n = tuple(obstacles), threading.local(), len(self._shapes)
        around = list(enumerate(self.obstacles, n))
        obstacle_pairs = [
            (a, b) for a, s in enumerate(self._shapes) if s.joint for b, o in around if s.link not in o.may_touch
        ]
        self.pairs = [*pairs, *obstacle_pairs]
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
        # half extents and axes of the box about each pair's second shape: zero for a link
        self._halves = np.array([*np.zeros((n, 3)), *(o.half for o in self.obstacles)]).reshape(-1, 3)[second]
        turns = [*n * [np.eye(3)], *(o.placement[:3, :3] for o in self.obstacles)]
        self._turns = np.array(turns).reshape(-1, 3, 3)[second]
        # 1 for each velocity of Pinocchio's model that moves the solid, else 0
        self._is_moved_by = np.zeros((len(self._solids), self._model.nv))
        for k, shape in enumerate(self._shapes):
            for block in (self._model.joints[j] for j in self._model.supports[shape.joint] if j):
                self._is_moved_by[k, block.idx_v : block.idx_v + block.nv] = 1.0

    def _own_data(self) -> tuple[pin.Data, Any]:
        """Return Pinocchio's data of this thread."""
        try:
            return self._local.data
        except AttributeError:
            geometry_data = pin.GeometryData(self.geometry)
            for request in geometry_data.distanceRequests:
                # with Coal's tolerance of 1e-6 m, gradients between cylinders and boxes are 0.1 off; the iterations
                # converge before the 1,000th
                request.gjk_tolerance, request.gjk_max_iterations = 1e-12, 1000
            self._local.data = self._model.createData(), geometry_data
            return self._local.data

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(SelfCollision, obstacles=self.obstacles, **self._arguments), (self.robot,)
