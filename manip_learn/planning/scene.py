"""What stands around an arm: a floor, boxes, spheres, cylinders and meshes in its base frame."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.errors import RobotError, SceneError, UnknownNameError, counted
from manip_learn.linalg import finite
from manip_learn.robot.collision import Obstacle, obstacles_of
from manip_learn.robot.description.urdf import Pose, as_matrix
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals import meshes
from manip_learn.robot.visuals.visual_shapes import Solid

FORMAT = "manip_learn.scene"
LARGEST = 20.0  # [m] of a thing, and of its place along an axis: a hall; what is larger is in millimetres
LARGEST_REACHES = 10.0  # reaches of the robot: a thing in a file that is larger may be in another unit
ROUNDING = 1e-6  # of the entries of a rotation: files have seven digits
CLOSE = 0.01  # [m] from the origin of the base: what the arm is screwed to


@final
@dataclass(frozen=True, eq=False)
class Box:
    """A box that stands in the world.

    Args:
        size: shape (3,), edge lengths along its own x, y, z [m].
        pose: shape (4, 4), of its middle in the robot's base frame [m]; or its place, shape (3,); or x, y, z, roll,
            pitch, yaw [m, rad].
        name: What it is called.

    Raises:
        SceneError: Numbers that make no box, or no pose.
    """

    size: ArrayLike
    pose: ArrayLike
    name: str

    def __post_init__(self) -> None:
        _set(self, "size", _lengths(self, "size", 3))
        _set(self, "pose", _pose(self, self.pose))

    @property
    def shape(self) -> Solid:
        """What it is, in its own frame."""
        x, y, z = np.asarray(self.size).tolist()
        return Solid("box", (x, y, z))


@final
@dataclass(frozen=True, eq=False)
class Sphere:
    """A ball that stands in the world.

    Args:
        radius: [m].
        centre: shape (3,), in the robot's base frame [m].
        name: What it is called.

    Raises:
        SceneError: Numbers that make no ball.
    """

    radius: float
    centre: ArrayLike
    name: str

    def __post_init__(self) -> None:
        _set(self, "radius", float(_lengths(self, "radius", 1)[0]))
        _set(self, "centre", _pose(self, self.centre)[:3, 3])

    @property
    def pose(self) -> Float[np.ndarray, "4 4"]:
        """Where it is, in the robot's base frame [m]."""
        return _pose(self, self.centre)

    @property
    def shape(self) -> Solid:
        """What it is, in its own frame."""
        return Solid("sphere", (self.radius,))


@final
@dataclass(frozen=True, eq=False)
class Cylinder:
    """A cylinder along its own z axis that stands in the world.

    Args:
        radius: [m].
        length: [m].
        pose: Of its middle, as for a `Box`.
        name: What it is called.

    Raises:
        SceneError: Numbers that make no cylinder, or no pose.
    """

    radius: float
    length: float
    pose: ArrayLike
    name: str

    def __post_init__(self) -> None:
        for size in ("radius", "length"):
            _set(self, size, float(_lengths(self, size, 1)[0]))
        _set(self, "pose", _pose(self, self.pose))

    @property
    def shape(self) -> Solid:
        """What it is, in its own frame."""
        return Solid("cylinder", (self.radius, self.length))


@final
@dataclass(frozen=True, eq=False)
class Mesh:
    """A body of triangles that stands in the world.

    A part that is closed and convex counts as a solid, another closed one by its surface and what is within, and one
    that is open by its surface alone: it has no inside (`Scene.notes` says so).

    Args:
        source: An STL, OBJ or COLLADA file; or vertices, shape (n, 3), and triangles, shape (m, 3), counted from 0.
        pose: Of its own frame, as for a `Box`.
        name: What it is called.
        scale: Its size over the numbers in the source, one number or one for each axis: 0.001 for millimetres.

    Raises:
        SceneError: No such file, one that cannot be read, or numbers that make no mesh.
    """

    source: str | os.PathLike[str] | tuple[ArrayLike, ArrayLike]
    pose: ArrayLike
    name: str
    scale: ArrayLike = 1.0

    def __post_init__(self) -> None:
        _set(self, "pose", _pose(self, self.pose))
        scale = finite(self.scale, 3) if np.ndim(self.scale) else finite(self.scale)
        if scale is None or not np.all(scale):
            raise SceneError(f"{_of(self)}: its scale is {self.scale!r}; a number that is not 0 is expected")
        _set(self, "scale", scale)
        largest = float(np.ptp(self.shape.vertices, axis=0).max())
        if largest > LARGEST:
            raise _millimetres(self, f"it is {largest:g} m large", f"scale={0.001 * float(np.max(scale)):g}")

    @cached_property
    def shape(self) -> meshes.Mesh:
        """What it is, in its own frame.

        Raises:
            SceneError: As for the mesh itself, which looks at it.
        """
        if isinstance(self.source, str | os.PathLike):
            path = Path(self.source).expanduser()
            mesh = meshes.read_meshes([path])[path]
            if isinstance(mesh, RobotError):
                raise SceneError(f"{_of(self)}: {mesh}; a mesh file is expected; check the path") from mesh
            vertices, faces = mesh.vertices, mesh.faces
        else:
            vertices, faces = (np.asarray(part) for part in self.source)
            fits = vertices.ndim == faces.ndim == 2 and vertices.shape[1] == faces.shape[1] == 3 and len(faces)
            if not fits or faces.dtype.kind not in "iu" or faces.min() < 0 or faces.max() >= len(vertices):
                sentence = "vertices (n, 3) and triangles (m, 3) of their numbers are expected"
                raise SceneError(f"{_of(self)}: its arrays have shapes {vertices.shape} and {faces.shape}; {sentence}")
            if finite(vertices, *vertices.shape) is None:
                raise SceneError(f"{_of(self)}: a vertex is not finite; finite numbers are expected [m]")
        # a mirror image turns every triangle inside out
        mirrored = np.prod(np.broadcast_to(self.scale, 3)) < 0.0
        return meshes.Mesh(vertices * self.scale, faces[:, ::-1] if mirrored else faces)


Thing = Box | Sphere | Cylinder | Mesh
KINDS: dict[str, type[Thing]] = {"boxes": Box, "spheres": Sphere, "cylinders": Cylinder, "meshes": Mesh}


@final
@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """What stands around an arm, in its base frame.

    Args:
        floor: Height of the floor [m]; None for no floor.
        boxes: Boxes.
        spheres: Balls.
        cylinders: Cylinders.
        meshes: Bodies of triangles.
        handled: Names of what the hand takes hold of or opens: its links may touch these.

    Raises:
        SceneError: A floor that is no height, or two things of one name.
        UnknownNameError: `handled` names nothing that stands there.

    Example:
        >>> import manip_learn as ml
        >>> ml.Scene(floor=0.0, boxes=[ml.Box((1.0, 0.6, 0.04), (0.6, 0.0, 0.3), "table")])
        Scene: floor at 0 m, 1 box (table)
    """

    floor: float | None = None
    boxes: Sequence[Box] = ()
    spheres: Sequence[Sphere] = ()
    cylinders: Sequence[Cylinder] = ()
    meshes: Sequence[Mesh] = ()
    handled: Sequence[str] = ()

    def __post_init__(self) -> None:
        if self.floor is not None and (finite(self.floor) is None or abs(self.floor) > LARGEST):
            raise SceneError(f"the floor is at {self.floor!r}; a height of at most {LARGEST:g} m is expected")
        for field, kind in KINDS.items():
            _set(self, field, tuple(getattr(self, field)))
            other = next((thing for thing in getattr(self, field) if type(thing) is not kind), None)
            if other is not None:
                raise SceneError(f"{field} hold {other!r}; each must be a {kind.__name__}")
        _set(self, "handled", (self.handled,) if isinstance(self.handled, str) else tuple(self.handled))
        names = [thing.name for thing in self.solids] + ["floor"] * (self.floor is not None)
        twice = next((name for i, name in enumerate(names) if name in names[:i]), None)
        if twice is not None:
            raise SceneError(f"two things of the scene are called {twice!r}; rename one of them")
        for name in self.handled:
            if name not in names:
                raise UnknownNameError("thing", name, names, "the scene")

    @property
    def solids(self) -> tuple[Thing, ...]:
        """All that stands there but the floor; each has a `name`, a `pose` (4, 4) [m] and a `shape`."""
        return (*self.boxes, *self.spheres, *self.cylinders, *self.meshes)

    def obstacles(self, robot: Robot, hand: frozenset[str] = frozenset()) -> tuple[Obstacle, ...]:
        """The scene as what a robot's links keep clear of; the floor is a large box below.

        The links that its first joint carries may touch the floor, and a plain solid that its base stands on.

        Args:
            robot: The robot.
            hand: Names of the links of its hand, which may touch what is handled.
        """
        parents = robot.pinocchio_model.parents
        low = frozenset(name for name in robot.frame_names if parents[robot.frame(name).parent_joint] == 0)
        out: list[Obstacle] = []
        if self.floor is not None:
            below = Box((LARGEST,) * 3, (0.0, 0.0, self.floor - 0.5 * LARGEST), "floor")
            out += obstacles_of(below.name, below.pose, below.shape, low)
        for thing in self.solids:
            pose = np.asarray(thing.pose)
            made = obstacles_of(thing.name, pose, thing.shape, hand if thing.name in self.handled else frozenset())
            inside = np.all(np.abs(pose[:3, 3] @ pose[:3, :3]) <= made[0].half + CLOSE)
            if inside and isinstance(thing.shape, Solid):
                made = obstacles_of(thing.name, pose, thing.shape, made[0].may_touch | low)
            out += made
        return tuple(out)

    def to_dict(self) -> dict[str, Any]:
        """What a scene file holds, see `load`."""
        described: dict[str, Any] = {"format": FORMAT, "floor": self.floor}
        for field in KINDS:
            described[field] = [{f.name: _plain(getattr(t, f.name)) for f in fields(t)} for t in getattr(self, field)]
        return {key: value for key, value in described.items() if value} | {"handled": list(self.handled)}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Scene) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash((self.floor, self.handled, *(thing.name for thing in self.solids)))

    def __repr__(self) -> str:
        parts = [] if self.floor is None else [f"floor at {self.floor:g} m"]
        for field, kind in KINDS.items():
            names = ", ".join(thing.name for thing in getattr(self, field))
            parts += [f"{counted(len(getattr(self, field)), kind.__name__.lower())} ({names})"] if names else []
        return f"Scene: {', '.join(parts) or 'nothing'}"


def _set(thing: object, name: str, value: object) -> None:
    object.__setattr__(thing, name, value)


def _of(thing: Thing) -> str:
    """A thing as messages name it: `"box 'table'"`."""
    return f"{type(thing).__name__.lower()} {thing.name!r}"


def _lengths(thing: Thing, field: str, n: int) -> Float[np.ndarray, " n"]:
    given = getattr(thing, field)
    values = finite(given, n) if n > 1 else finite([given], 1)
    if values is None or np.any(values <= 0.0):
        wanted = "a positive number is" if n == 1 else f"{n} positive numbers are"
        raise SceneError(f"{_of(thing)}: its {field} is {given!r}; {wanted} expected [m]")
    if np.any(values > LARGEST):
        raise _millimetres(thing, f"its {field} is {given!r} m", "1000")
    return values


def _millimetres(thing: Thing, seen: str, remedy: str) -> SceneError:
    fix = f"are these millimetres? give {remedy}" if "=" in remedy else "are these millimetres? divide them by 1000"
    return SceneError(f"{_of(thing)}: {seen}; at most {LARGEST:g} m is expected; {fix}")


def _pose(thing: Thing, given: ArrayLike) -> Float[np.ndarray, "4 4"]:
    if not isinstance(thing.name, str) or not thing.name.strip() or not thing.name.isprintable():
        raise SceneError(f"a {type(thing).__name__.lower()} is called {thing.name!r}; a name is expected")
    T = np.eye(4)
    if (place := finite(given, 3)) is not None:
        T[:3, 3] = place
    elif (numbers := finite(given, 6)) is not None:
        x, y, z, roll, pitch, yaw = numbers.tolist()
        T = as_matrix(Pose((x, y, z), (roll, pitch, yaw)))
    elif (matrix := finite(given, 4, 4)) is not None:
        T = matrix
    else:
        wanted = "three numbers, six with roll, pitch and yaw, or a 4 x 4 matrix are expected [m, rad]"
        raise SceneError(f"{_of(thing)}: its pose is {given!r}; {wanted}")
    R = T[:3, :3]
    off = float(max(np.abs(R.T @ R - np.eye(3)).max(), np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max()))
    if off > ROUNDING or np.linalg.det(R) < 0.0:
        seen = "its pose mirrors" if off <= ROUNDING else f"its pose is not rigid, by {off:.2g}"
        raise SceneError(f"{_of(thing)}: {seen}; a rotation and a place are expected; give a scale apart from it")
    if np.abs(T[:3, 3]).max() > LARGEST:
        raise _millimetres(thing, f"it stands at {T[:3, 3].tolist()} m", "1000")
    return T


def _plain(value: Any) -> Any:
    """A field as JSON holds it; a pose without rotation as a place."""
    if isinstance(value, tuple):
        return [np.asarray(part).tolist() for part in value]
    if isinstance(value, np.ndarray) and value.shape == (4, 4) and np.array_equal(value[:3, :3], np.eye(3)):
        return value[:3, 3].tolist()
    if isinstance(value, np.ndarray):
        return value.tolist()
    return os.fspath(value) if isinstance(value, os.PathLike) else value
