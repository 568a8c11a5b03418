"""Obstacles around an arm: a floor, boxes, spheres, cylinders and meshes in its base frame."""

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

LARGEST = 20.0  # [m] largest size and coordinate, as of a hall; larger numbers are probably in millimetres


class Thing:
    """Base class of the obstacles in a `Scene`; the constructor checks the numbers.

    Attributes:
        name: Name, unique in a scene.
        pose: Pose (4, 4) of the obstacle's own frame in the robot's base frame [m].
        shape: Shape in the obstacle's own frame [m].
        span: Largest dimension; for a mesh the longest side of its bounding box [m].

    Raises:
        SceneError: An argument is not valid, see `Box`.
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
                entry, n = getattr(self, field), 3 if field == "size" else 1
                numbers = finite(np.atleast_1d(entry), n)
                if numbers is None or np.any(numbers <= 0.0):
                    expected = "three positive numbers are" if n == 3 else "a positive number is"
                    raise SceneError(f"{where}: its {field} is {entry!r:.80}; {expected} expected [m]; correct it")
                sizes += numbers.tolist()
        pose = _pose(getattr(self, "centre" if kind == "sphere" else "pose"), where)
        shape = _mesh(self, where) if isinstance(self, Mesh) else Solid(kind, tuple(sizes))
        span = np.array(sizes) if isinstance(shape, Solid) else np.ptp(shape.vertices, axis=0)
        fix = "divide by 1000" if isinstance(shape, Solid) else "give scale=0.001"
        for item, metres, remedy in (("size", span.max(), fix), ("place", np.abs(pose[:3, 3]).max(), "divide by 1000")):
            if metres > LARGEST:
                expected = f"at most {LARGEST:g} m is expected; if it is in millimetres, {remedy}"
                raise SceneError(f"{where}: its {item} is {metres:g} m; {expected}")
        for name, value in (("pose", pose), ("shape", shape), ("span", float(span.max()))):
            object.__setattr__(self, name, value)


@final
@dataclass(frozen=True, eq=False)
class Box(Thing):
    """Box in the workspace.

    Args:
        size: Edge lengths (3,) along its own x, y, z [m].
        pose: Pose (4, 4) of its centre in the robot's base frame [m]; or a position (3,) [m]; or x, y, z, roll, pitch,
            yaw [m, rad], as in a URDF: the rotation matrix is Rz(yaw) Ry(pitch) Rx(roll).
        name: Name, unique in a scene.

    Raises:
        SceneError: A length is not positive, the pose is not rigid, a length or a coordinate of the position is larger
            than 20 m, or the name is empty.
    """

    size: ArrayLike
    pose: ArrayLike
    name: str


@final
@dataclass(frozen=True, eq=False)
class Sphere(Thing):
    """Sphere in the workspace.

    Args:
        radius: Radius [m].
        centre: Position (3,) of its centre in the robot's base frame [m].
        name: Name, unique in a scene.

    Raises:
        SceneError: An argument is not valid, see `Box`.
    """

    radius: float
    centre: ArrayLike
    name: str


@final
@dataclass(frozen=True, eq=False)
class Cylinder(Thing):
    """Cylinder in the workspace.

    Args:
        radius: Radius [m].
        length: Length along its own z axis [m].
        pose: Pose of its centre in the robot's base frame, in a form that `Box` accepts.
        name: Name, unique in a scene.

    Raises:
        SceneError: An argument is not valid, see `Box`.
    """

    radius: float
    length: float
    pose: ArrayLike
    name: str


@final
@dataclass(frozen=True, eq=False)
class Mesh(Thing):
    """Triangle mesh in the workspace; an open mesh is a surface, without an inside.

    Args:
        source: An STL, OBJ or COLLADA file; or vertices (n, 3) and triangles (m, 3), which are indices of vertices from
            0.
        pose: Pose of the mesh's frame in the robot's base frame, in a form that `Box` accepts.
        name: Name, unique in a scene.
        scale: Metres per unit of the source, one number or one for each axis of the mesh's frame: 0.001 for
            millimetres. A negative number mirrors the mesh.

    Raises:
        SceneError: The file does not exist or cannot be read, the arrays are no valid mesh, the scale is 0, or another
            argument is not valid, see `Box`.
    """

    source: str | os.PathLike[str] | tuple[ArrayLike, ArrayLike]
    pose: ArrayLike
    name: str
    scale: ArrayLike = 1.0


_KINDS: dict[str, type[Thing]] = {"boxes": Box, "spheres": Sphere, "cylinders": Cylinder, "meshes": Mesh}


@final
@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """Obstacles around an arm, in its base frame.

    Args:
        floor: Height of the floor, z in the base frame [m]; None for no floor.
        boxes, spheres, cylinders, meshes: Obstacles, each with its own name.
        handled: Names of objects that the hand grasps or opens: its links may touch these.

    Raises:
        SceneError: The height of the floor is not a number or more than 10 m from the base, an entry is of another
            class, or two obstacles share a name.
        UnknownNameError: `handled` names an object that is not in the scene.

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
            expected = f"a height of at most {0.5 * LARGEST:g} m from the base is expected; correct it"
            raise SceneError(f"floor is {self.floor!r}; {expected}")
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
                raise SceneError(f"{names[name]} things are called {name!r}; a unique name is expected; rename them")

    @property
    def solids(self) -> tuple[Thing, ...]:
        """All obstacles without the floor, e.g. to draw them: each has a `name`, a `pose` and a `shape`."""
        return (*self.boxes, *self.spheres, *self.cylinders, *self.meshes)

    def obstacles(self, robot: Robot) -> tuple[Obstacle, ...]:
        """Return the obstacles for collision checks, with a large box for the floor.

        The base and the links on its first joint may touch the floor, and an obstacle that contains the base's origin.

        Args:
            robot: The robot.
        """
        margin = 0.01  # [m] around the origin of the base: obstacles there carry the arm
        parents, out = robot.pinocchio_model.parents, list[Obstacle]()
        low = frozenset(name for name in robot.frame_names if parents[robot.frame(name).parent_joint] == 0)
        below = [] if self.floor is None else [Box((LARGEST,) * 3, (0, 0, self.floor - 0.5 * LARGEST), "floor")]
        for thing in (*below, *self.solids):
            pose = np.asarray(thing.pose)
            stands = np.abs(pose[:3, 3] @ pose[:3, :3]) - margin  # origin of the base in the frame of the obstacle
            for obstacle in obstacles_of(thing.name, pose, thing.shape):
                is_below = thing in below or np.all(stands <= obstacle.half)
                out.append(replace(obstacle, may_touch=low) if is_below else obstacle)
        return tuple(out)

    @property
    def notes(self) -> tuple[str, ...]:
        """Assumptions about meshes, in sentences."""
        shapes = {mesh.name: mesh.shape for mesh in self.meshes}
        edges = {name: triangles.open_edges(s) for name, s in shapes.items() if not isinstance(s, Solid)}
        meaning = "it counts as a surface, and the space behind it as free"
        return tuple(f"mesh {name!r} has {counted(n, 'open edge')}: {meaning}" for name, n in edges.items() if n)

    @staticmethod
    def load(path: str | os.PathLike[str], robot: Robot | None = None) -> Scene:
        """Read a scene from a scene file, or from a URDF or MJCF file without moving joints.

        Of a URDF or MJCF the collision shapes are used, and the visual shapes of links without any. A scene file is
        JSON with the arguments of `Scene` and of its obstacles; paths of mesh files are relative to its folder:

            {"floor": 0.0, "boxes": [{"name": "table", "size": [1.0, 0.6, 0.04], "pose": [0.6, 0.0, 0.3]}],
             "meshes": [{"name": "cabinet", "source": "cabinet.stl", "scale": 0.001, "pose": [0.8, 0, 0, 0, 0, 1.57]}],
             "handled": ["cabinet"]}

        Args:
            path: File to read.
            robot: Robot whose reach shows if an obstacle is too large to be in metres: larger than 10 times the reach.
                None to skip this check.

        Returns:
            Scene in the base frame of the robot.

        Raises:
            SceneError: The file is empty or no scene, it has a moving joint, or an obstacle is not valid or too large.
            UnknownNameError: The file has an unknown key, or `handled` names an object that is not in the scene.
            RobotError: The file cannot be read, or is no valid URDF or MJCF.
        """
        factor = 10.0  # reaches of the robot: larger things are probably in millimetres
        file = Path(path).expanduser()
        content = read_description(file)
        try:
            if not content.strip():
                raise SceneError('the file is empty; a scene is expected, e.g. {"floor": 0.0}; write one')
            is_xml = content.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")
            scene = _from_xml(content, file) if is_xml else _from_json(Scene, parsed_json(content), "the scene", file)
        except UnknownNameError as error:
            error.args = (f"{file}: {error}",)
            raise
        except (SceneError, TypeError, ValueError) as error:
            problem = error if isinstance(error, SceneError) else f"it is no scene ({error}); repair it"
            raise SceneError(f"{file}: {problem}") from error
        most = np.inf if robot is None else factor * max(map(robot.reach, robot.frame_names))
        if large := [thing for thing in scene.solids if thing.span > most]:
            expected = f"at most {most:.3g} m, {factor:g} reaches of the arm, are expected; are these millimetres?"
            raise SceneError(f"{file}: {large[0].name!r} is {large[0].span:g} m large; {expected}")
        return scene

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write a scene file, see `load`; after an error, no incomplete file is left.

        Args:
            path: File to write.

        Returns:
            Path of the written file.

        Raises:
            OutputError: The file cannot be written.
        """
        name = "manip_learn.scene"
        text = json.dumps({"format": name} | self.to_dict(), indent=2) + "\n"
        return write_atomically(path, re.sub(r"\s+(?=[^\[\]{}]*\])", " ", text))  # keep each row of numbers on one line

    def to_dict(self) -> dict[str, Any]:
        """Return the content of a scene file as a dictionary, see `load`; paths of mesh files are absolute."""
        things = {field: [_to_json(thing) for thing in getattr(self, field)] for field in _KINDS}
        floor = {} if self.floor is None else {"floor": float(self.floor)}
        return floor | {field: all_ for field, all_ in things.items() if all_} | {"handled": list(self.handled)}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Scene) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash((self.floor, *(thing.name for thing in self.solids)))

    def __repr__(self) -> str:
        parts = [] if self.floor is None else [f"floor at {self.floor:g} m"]
        for field, kind in _KINDS.items():
            names = [thing.name for thing in getattr(self, field)]
            parts += [f"{counted(len(names), kind.__name__.lower())} ({', '.join(names)})"] if names else []
        return f"Scene: {', '.join(parts) or 'nothing'}"


def _to_json(thing: Any) -> dict[str, Any]:
    """Return the fields of an obstacle for JSON; a pose without a rotation as a position."""
    out: dict[str, Any] = {field.name: getattr(thing, field.name) for field in fields(thing)}
    if "pose" in out and np.array_equal(thing.pose[:3, :3], np.eye(3)):
        out["pose"] = thing.pose[:3, 3]
    if "source" in out:
        is_file = isinstance(thing.source, str | os.PathLike)
        out["source"] = os.path.abspath(thing.source) if is_file else [np.asarray(p).tolist() for p in thing.source]
    return {key: value if isinstance(value, str | list) else np.asarray(value).tolist() for key, value in out.items()}


def _from_json(kind: Any, content: Any, where: str, file: Path) -> Any:
    """Make a scene or one of its obstacles from the content of a file."""
    if not isinstance(content, Mapping):
        raise SceneError(f"{where} is {content!r:.80}; an object of JSON, in braces, is expected; correct it")
    is_required, values = {field.name: field.default is MISSING for field in fields(kind)}, dict(content)
    values.pop("format", None)
    for key in values:
        if key not in is_required:
            raise UnknownNameError("key", key, is_required, where)
    if missing := [repr(name) for name, needed in is_required.items() if needed and name not in values]:
        raise SceneError(f"{where} lacks {named('key', missing)}; give a value")
    for field, thing in _KINDS.items() if kind is Scene else ():
        values[field] = [_from_json(thing, v, f"{field}[{i}]", file) for i, v in enumerate(values.get(field, ()))]
    if isinstance(source := values.get("source"), str):
        values["source"] = file.parent / Path(source).expanduser()
    return kind(**values)


def _from_xml(content: bytes, file: Path) -> Scene:
    """Return the scene of a URDF or MJCF."""
    root = parse_xml(content, file)
    if root.tag == "mujoco":
        valid, content = validate_mjcf(root, scene=True)
    else:
        valid = validate_urdf(root)
    if moving := [repr(joint.name) for joint in valid.joints if joint.nv]:
        remedy = "obstacles must be static; fix each joint"
        raise SceneError(f"{named('joint', moving)} can move; {remedy}")
    robot = robot_from_text(content, file)
    touched, drawn = (visual_elements(content, file, tag) for tag in ("collision", "visual"))
    links, names, things = {e.link for e in touched}, Counter[str](), {field: list[Any]() for field in _KINDS}
    for e in [*touched, *(e for e in drawn if e.link not in links)]:
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
        result = triangles.read_meshes([path])[path]
        if isinstance(result, RobotError):
            raise SceneError(f"{where}: {result}; an STL, OBJ or COLLADA file is expected; check the path") from result
        vertices, faces = result.vertices, result.faces
    else:
        vertices, faces = (np.asarray(part) for part in mesh.source)
        numbers = finite(vertices, len(vertices), 3)
        if numbers is None or finite(faces, len(faces), 3) is None or not np.isin(faces, range(len(numbers))).all():
            expected = "vertices (n, 3) [m] and triangles (m, 3) of vertex numbers are expected; correct them"
            raise SceneError(f"{where}: arrays of shape {vertices.shape} and {faces.shape} make no mesh; {expected}")
    # a mirrored scale turns every triangle inside out
    return triangles.Mesh(vertices * scale, faces[:, ::-1] if np.prod(scale) < 0.0 else faces)


def _pose(pose: ArrayLike, where: str) -> Float[np.ndarray, "4 4"]:
    tolerance = 1e-6  # of the entries of a rotation: files have seven digits
    T = np.eye(4)
    if (place := finite(pose, 3)) is not None:
        T[:3, 3] = place
    elif (numbers := finite(pose, 6)) is not None:
        x, y, z, roll, pitch, yaw = numbers.tolist()
        T = as_matrix(Pose((x, y, z), (roll, pitch, yaw)))
    elif (matrix := finite(pose, 4, 4)) is not None:
        T = matrix
    else:
        expected = "three numbers, six with roll, pitch and yaw, or a 4 x 4 matrix are expected [m, rad]"
        raise SceneError(f"{where}: its pose is {pose!r}; {expected}; correct it")
    R = T[:3, :3]
    off = float(max(np.abs(R.T @ R - np.eye(3)).max(), np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max()))
    if off > tolerance or np.linalg.det(R) < 0.0:
        fault = "mirrors" if off <= tolerance else f"is not rigid, by {off:.2g}"
        raise SceneError(f"{where}: its pose {fault}; expected a rotation and a translation; pass the scale separately")
    return T
