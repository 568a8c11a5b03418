"""What stands around an arm: a floor, boxes, spheres, cylinders and meshes in its base frame."""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.atomic_write import write_atomically
from manip_learn.errors import RobotError, SceneError, UnknownNameError, counted, named
from manip_learn.linalg import finite
from manip_learn.robot.collision import Obstacle, obstacles_of
from manip_learn.robot.description.mjcf import validate_mjcf
from manip_learn.robot.description.text import parse_xml, parsed_json, read_description
from manip_learn.robot.description.urdf import Pose, as_matrix, validate_urdf
from manip_learn.robot.loading import robot_from_text
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals import meshes as triangles
from manip_learn.robot.visuals.visual_shapes import MeshElement, Solid, visual_elements

_FORMAT = "manip_learn.scene"
LARGEST = 20.0  # [m] of a thing, and of its place along an axis: a hall; what is larger is in millimetres
LARGEST_REACHES = 10.0  # reaches of a robot: a thing in a file for it that is larger may be in millimetres
_ROUNDING = 1e-6  # of the entries of a rotation: files have seven digits
CLOSE = 0.01  # [m] from the origin of the base: what the arm is screwed to


class Thing:
    """A solid that stands in the world; its numbers are checked when it is made.

    Attributes:
        name: What it is called.
        pose: shape (4, 4), of its own frame in the robot's base frame [m].
        shape: What it is, in its own frame [m].
        span: Its largest number, of a mesh its longest side [m].
    """

    name: str
    pose: ArrayLike
    shape: Solid | triangles.Mesh
    span: float

    def __post_init__(self) -> None:
        kind: Any = type(self).__name__.lower()
        if not isinstance(self.name, str) or not self.name.strip() or not self.name.isprintable():
            raise SceneError(f"a {kind} is called {self.name!r}; a name is expected; give it one")
        where, sizes = f"{kind} {self.name!r}", list[float]()
        for field in ("size", "radius", "length"):
            if field in vars(self):
                given, n = getattr(self, field), 3 if field == "size" else 1
                numbers = finite(np.atleast_1d(given), n)
                if numbers is None or np.any(numbers <= 0.0):
                    wanted = "three positive numbers are" if n == 3 else "a positive number is"
                    raise SceneError(f"{where}: its {field} is {given!r:.80}; {wanted} expected [m]; correct it")
                sizes += numbers.tolist()
        pose = _pose(getattr(self, "centre" if kind == "sphere" else "pose"), where)
        shape = _mesh(self, where) if isinstance(self, Mesh) else Solid(kind, tuple(sizes))
        span = np.array(sizes) if isinstance(shape, Solid) else np.ptp(shape.vertices, axis=0)
        fix = "divide by 1000" if isinstance(shape, Solid) else "give scale=0.001"
        for seen, metres, remedy in (("size", span.max(), fix), ("place", np.abs(pose[:3, 3]).max(), "divide by 1000")):
            if metres > LARGEST:
                wanted = f"at most {LARGEST:g} m is expected; if it is in millimetres, {remedy}"
                raise SceneError(f"{where}: its {seen} is {metres:g} m; {wanted}")
        for name, value in (("pose", pose), ("shape", shape), ("span", float(span.max()))):
            object.__setattr__(self, name, value)


@final
@dataclass(frozen=True, eq=False)
class Box(Thing):
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


@final
@dataclass(frozen=True, eq=False)
class Sphere(Thing):
    """A ball that stands in the world: its radius [m], its centre, shape (3,), in the robot's base frame [m]."""

    radius: float
    centre: ArrayLike
    name: str


@final
@dataclass(frozen=True, eq=False)
class Cylinder(Thing):
    """A cylinder that stands in the world: its radius, its length along its own z axis [m], its pose as for a `Box`."""

    radius: float
    length: float
    pose: ArrayLike
    name: str


@final
@dataclass(frozen=True, eq=False)
class Mesh(Thing):
    """A body of triangles that stands in the world; where it is open it is a surface, without an inside.

    Args:
        source: An STL, OBJ or COLLADA file; or vertices, shape (n, 3), and triangles, shape (m, 3), counted from 0.
        pose: Of its own frame, as for a `Box`.
        name: What it is called.
        scale: Metres per unit of the source, one number or one for each axis: 0.001 for millimetres.

    Raises:
        SceneError: No such file, one that cannot be read, or numbers that make no mesh.
    """

    source: str | os.PathLike[str] | tuple[ArrayLike, ArrayLike]
    pose: ArrayLike
    name: str
    scale: ArrayLike = 1.0


_KINDS: dict[str, type[Thing]] = {"boxes": Box, "spheres": Sphere, "cylinders": Cylinder, "meshes": Mesh}


@final
@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """What stands around an arm, in its base frame.

    Args:
        floor: Height of the floor [m]; None for no floor.
        boxes, spheres, cylinders, meshes: The things; no two have one name.
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
        if self.floor is not None and (finite(self.floor) is None or abs(self.floor) > 0.5 * LARGEST):
            wanted = f"a height of at most {0.5 * LARGEST:g} m from the base is expected; correct it"
            raise SceneError(f"floor is {self.floor!r}; {wanted}")
        for field, kind in _KINDS.items():
            object.__setattr__(self, field, tuple(getattr(self, field)))
            if other := [thing for thing in getattr(self, field) if type(thing) is not kind]:
                raise SceneError(f"{field} hold {other[0]!r}; each must be a {kind.__name__}")
        handled = (self.handled,) if isinstance(self.handled, str) else tuple(self.handled)
        object.__setattr__(self, "handled", handled)
        names = Counter([thing.name for thing in self.solids] + ["floor"] * (self.floor is not None))
        for name in (*handled, *names):
            if names[name] == 0:
                raise UnknownNameError("thing", name, names, "the scene")
            if names[name] > 1:
                raise SceneError(f"{names[name]} things are called {name!r}; a name each is expected; rename them")

    @property
    def solids(self) -> tuple[Thing, ...]:
        """All that stands there but the floor, to draw: each has a `name`, a `pose` and a `shape`, see `Thing`."""
        return (*self.boxes, *self.spheres, *self.cylinders, *self.meshes)

    def obstacles(self, robot: Robot) -> tuple[Obstacle, ...]:
        """The scene as what a robot's links keep clear of; the floor is a large box below.

        The links that its first joint carries may touch the floor, and what its base stands on or in.

        Args:
            robot: The robot.
        """
        parents, out = robot.pinocchio_model.parents, list[Obstacle]()
        low = frozenset(name for name in robot.frame_names if parents[robot.frame(name).parent_joint] == 0)
        below = [] if self.floor is None else [Box((LARGEST,) * 3, (0, 0, self.floor - 0.5 * LARGEST), "floor")]
        for thing in (*below, *self.solids):
            pose = np.asarray(thing.pose)
            stands = np.abs(pose[:3, 3] @ pose[:3, :3]) - CLOSE  # the origin of the base
            for made in obstacles_of(thing.name, pose, thing.shape):
                is_below = thing in below or np.all(stands <= made.half)
                out.append(replace(made, may_touch=low) if is_below else made)
        return tuple(out)

    @property
    def notes(self) -> tuple[str, ...]:
        """What had to be assumed, a sentence each."""
        shapes = {mesh.name: mesh.shape for mesh in self.meshes}
        edges = {name: triangles.open_edges(s) for name, s in shapes.items() if not isinstance(s, Solid)}
        said = "where it is open it counts as a surface, and what is behind it as free"
        return tuple(f"mesh {name!r} has {counted(n, 'open edge')}: {said}" for name, n in edges.items() if n)

    @staticmethod
    def load(path: str | os.PathLike[str], robot: Robot | None = None) -> Scene:
        """Read a scene file; or a URDF or MJCF in which nothing moves: the shapes that can be touched, by their names.

        A scene file is JSON with the arguments of `Scene` and of its things; mesh files are looked up beside it:

            {"floor": 0.0, "boxes": [{"name": "table", "size": [1.0, 0.6, 0.04], "pose": [0.6, 0.0, 0.3]}],
             "meshes": [{"name": "cabinet", "source": "cabinet.stl", "scale": 0.001, "pose": [0.8, 0, 0, 0, 0, 1.57]}],
             "handled": ["cabinet"]}

        Args:
            path: The file.
            robot: Whose reach says which things are too large to be in metres.

        Raises:
            SceneError: An empty file, one that is no scene, a joint that moves, a thing that is impossible.
            UnknownNameError: A key that is not known; or `handled` names nothing that stands there.
            RobotError: The file cannot be read, or its description is refused.
        """
        file = Path(path).expanduser()
        content = read_description(file)
        try:
            if not content.strip():
                raise SceneError('the file is empty; a scene is expected, e.g. {"floor": 0.0}; write one')
            is_xml = content.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")
            scene = _described(content, file) if is_xml else _made(Scene, parsed_json(content), "the scene", file)
        except (SceneError, TypeError, ValueError) as error:
            seen = error if isinstance(error, SceneError) else f"it is no scene ({error}); repair it"
            raise SceneError(f"{file}: {seen}") from error
        most = np.inf if robot is None else LARGEST_REACHES * max(map(robot.reach, robot.frame_names))
        if large := [thing for thing in scene.solids if thing.span > most]:
            wanted = (
                f"at most {most:.3g} m, {LARGEST_REACHES:g} reaches of the arm, are expected; are these millimetres?"
            )
            raise SceneError(f"{file}: {large[0].name!r} is {large[0].span:g} m large; {wanted}")
        return scene

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write a scene file, whole or not at all, see `load`.

        Raises:
            OutputError: It cannot be written.
        """
        text = json.dumps({"format": _FORMAT} | self.to_dict(), indent=2) + "\n"
        return write_atomically(path, re.sub(r"\s+(?=[^\[\]{}]*\])", " ", text))  # a row of numbers is one line

    def to_dict(self) -> dict[str, Any]:
        """What a scene file holds, see `load`, with whole paths of mesh files."""
        things = {field: [_plain(thing) for thing in getattr(self, field)] for field in _KINDS}
        floor = {} if self.floor is None else {"floor": float(self.floor)}
        return floor | {field: all_ for field, all_ in things.items() if all_} | {"handled": list(self.handled)}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Scene) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash((self.floor, *(thing.name for thing in self.solids)))

    def __repr__(self) -> str:
        said = [] if self.floor is None else [f"floor at {self.floor:g} m"]
        for field, kind in _KINDS.items():
            names = [thing.name for thing in getattr(self, field)]
            said += [f"{counted(len(names), kind.__name__.lower())} ({', '.join(names)})"] if names else []
        return f"Scene: {', '.join(said) or 'nothing'}"


def _plain(thing: Any) -> dict[str, Any]:
    """The fields of a thing as JSON holds them; a pose without a rotation as a place."""
    out: dict[str, Any] = {field.name: getattr(thing, field.name) for field in fields(thing)}
    if "pose" in out and np.array_equal(thing.pose[:3, :3], np.eye(3)):
        out["pose"] = thing.pose[:3, 3]
    if "source" in out:
        is_file = isinstance(thing.source, str | os.PathLike)
        out["source"] = os.path.abspath(thing.source) if is_file else [np.asarray(p).tolist() for p in thing.source]
    return {key: value if isinstance(value, str | list) else np.asarray(value).tolist() for key, value in out.items()}


def _made(kind: Any, given: Any, where: str, file: Path) -> Any:
    """A scene or one of its things from what a file says of it."""
    if not isinstance(given, Mapping):
        raise SceneError(f"{where} is {given!r:.80}; an object of JSON, in braces, is expected; correct it")
    known, values = {field.name: field.default is MISSING for field in fields(kind)}, dict(given)
    values.pop("format", None)
    for key in values:
        if key not in known:
            raise UnknownNameError("key", key, known, f"{where} of {file}")
    if missing := [repr(name) for name, needed in known.items() if needed and name not in values]:
        raise SceneError(f"{where} lacks {named('key', missing)}; give a value")
    for field, thing in _KINDS.items() if kind is Scene else ():
        values[field] = [_made(thing, v, f"{field}[{i}]", file) for i, v in enumerate(values.get(field, ()))]
    if isinstance(source := values.get("source"), str):
        values["source"] = file.parent / Path(source).expanduser()
    return kind(**values)


def _described(content: bytes, file: Path) -> Scene:
    """The scene of a URDF or MJCF."""
    root = parse_xml(content, file)
    if root.tag == "mujoco":
        valid, content = validate_mjcf(root, scene=True)
    else:
        valid = validate_urdf(root)
    if moving := [repr(joint.name) for joint in valid.joints if joint.nv]:
        wanted = "what stands around an arm stands still; fix each where it stands"
        raise SceneError(f"{named('joint', moving)} can move; {wanted}")
    robot = robot_from_text(content, file)
    touched, seen = (visual_elements(content, file, tag) for tag in ("collision", "visual"))
    links, names, things = {e.link for e in touched}, Counter[str](), {field: list[Any]() for field in _KINDS}
    for e in [*touched, *(e for e in seen if e.link not in links)]:
        pose = robot.pinocchio_model.frames[robot.frame(e.link).index].placement.homogeneous @ as_matrix(e.pose)
        name = e.name or e.link
        names[name] += 1
        name = name if names[name] == 1 else f"{name} {names[name]}"
        match e.geometry:
            case MeshElement(uri, scale):
                source = triangles.find_mesh(uri, triangles.mesh_roots(file, ()))
                things["meshes"].append(Mesh(source, pose, name, scale))
            case Solid("box", size):
                things["boxes"].append(Box(size, pose, name))
            case Solid("sphere", (radius,)):
                things["spheres"].append(Sphere(radius, pose[:3, 3], name))
            case Solid(kind, (radius, length)):  # a capsule with its half spheres
                length += 2.0 * radius * (kind == "capsule")
                things["cylinders"].append(Cylinder(radius, length, pose, name))
            case _:
                raise SceneError(e.fault)
    return Scene(None, **things)


def _mesh(mesh: Mesh, where: str) -> triangles.Mesh:
    scale = finite(np.broadcast_to(mesh.scale, 3), 3) if np.size(mesh.scale) in (1, 3) else None
    if scale is None or not np.all(scale):
        raise SceneError(f"{where}: its scale is {mesh.scale!r}; a number other than 0 is expected; correct it")
    if isinstance(mesh.source, str | os.PathLike):
        path = Path(mesh.source).expanduser()
        read = triangles.read_meshes([path])[path]
        if isinstance(read, RobotError):
            raise SceneError(f"{where}: {read}; an STL, OBJ or COLLADA file is expected; check the path") from read
        vertices, faces = read.vertices, read.faces
    else:
        vertices, faces = (np.asarray(part) for part in mesh.source)
        numbers = finite(vertices, len(vertices), 3)
        if numbers is None or finite(faces, len(faces), 3) is None or not np.isin(faces, range(len(numbers))).all():
            wanted = "vertices (n, 3) [m] and triangles (m, 3) of their numbers are expected; correct them"
            raise SceneError(f"{where}: arrays of shape {vertices.shape} and {faces.shape} make no mesh; {wanted}")
    # a mirror image turns every triangle inside out
    return triangles.Mesh(vertices * scale, faces[:, ::-1] if np.prod(scale) < 0.0 else faces)


def _pose(given: ArrayLike, where: str) -> Float[np.ndarray, "4 4"]:
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
        raise SceneError(f"{where}: its place is {given!r}; {wanted}; correct it")
    R = T[:3, :3]
    off = float(max(np.abs(R.T @ R - np.eye(3)).max(), np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max()))
    if off > _ROUNDING or np.linalg.det(R) < 0.0:
        seen = "mirrors" if off <= _ROUNDING else f"is not rigid, by {off:.2g}"
        raise SceneError(f"{where}: its pose {seen}; a rotation and a place are expected; give a scale apart from it")
    return T
