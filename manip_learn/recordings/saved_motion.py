"""A motion as the library's own files hold it: the same content in every format."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
from jaxtyping import Float

from manip_learn.errors import DAMAGE, counted
from manip_learn.linalg import finite
from manip_learn.recordings.format_words import EFFORT_SUFFIX, VELOCITY_SUFFIX
from manip_learn.recordings.readers.recording import refusal
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot import Robot
from manip_learn.robot.description.text import parsed_json
from manip_learn.robot.identity import RobotIdentity, names_from

_Kind = Literal["rollout", "recording"]
PREFIX = "manip_learn."
ROLLOUT_CURVES = ("u", "effort", "manipulability", "task_error", "following_error")  # what a motion may have beside q
_SCHEMA = 2
SIZES = {"face": 0, "sphere": 1, "cylinder": 2, "box": 3, "mesh": 0}  # numbers of the things that stood around
UNKNOWN_ROBOT = (
    "the file does not say which robot and which locked joints it was made with: only the names of the joints were "
    "compared; save it again"
)


def _is_thing(thing: Any) -> bool:
    """True for what stood around: a name, a pose and a shape."""
    corners, faces = (np.reshape(thing.get(key, ()), (-1, 3)) for key in ("vertices", "faces"))
    size, n = finite(thing.get("size", ()), SIZES[thing["kind"]]), len(corners)
    is_whole = finite(corners, n, 3) is not None and bool(np.isin(faces, range(n)).all())
    is_placed = isinstance(thing["name"], str) and finite(thing["pose"], 4, 4) is not None
    is_sized = size is not None and bool(np.all(size > 0.0)) and (thing["kind"] == "mesh") == (len(faces) > 0)
    return is_whole and is_placed and is_sized


# what a header may say beside its format, its joints and its robot -> whether a value is right, and how that is called
Check = Callable[[Any], bool]
_FIELDS: dict[str, tuple[Check, str]] = {
    "frame": (lambda name: isinstance(name, str), "a name"),
    "nq": (lambda n: type(n) is int, "a whole number"),
    "target": (lambda x: np.ndim(x) in (1, 2) and finite(x, *np.shape(x)) is not None, "finite numbers"),
    "constraint": (lambda content: isinstance(content, Mapping), "an object"),
    "following_error": (lambda known: isinstance(known, bool), "true or false"),
    "phases": (
        lambda parts: all(isinstance(name, str) and finite(span, 2) is not None for name, *span in parts),
        "a name, a start and an end each",
    ),
    "ways": (
        lambda ways: all(way["begins"] is None or finite(way["begins"]) is not None for way in ways),
        "objects that say when they began",
    ),
    "around": (lambda things: all(map(_is_thing, things)), "things with a name, a pose and a shape"),
    "samples": (lambda n: type(n) is int, "a whole number"),
}


@final
@dataclass(frozen=True)
class FileHeader:
    """What a file says about itself; one JSON object in every format.

    Attributes:
        kind: Rollout (with manipulability, task error and status) or recording.
        joint_names: One name per velocity.
        robot: Robot that it was made with, or None.
        frame: Frame that a rollout's constraint holds, or empty.
        nq: Columns of the postures.
        target: Where a rollout's task was to arrive, as nested lists, or None.
        constraint: What guided a rollout, as `Constraint.to_dict` writes it, or None.
        following_error: Whether a rollout has it.
        phases: Name, start and end [s] of the parts of a rollout, or None.
        ways: What became of each way of a rollout, or None.
        around: What a rollout kept clear of, or None.
        samples: Number of samples that were written; None for a LeRobot data set, which counts them itself.
    """

    kind: _Kind
    joint_names: tuple[str, ...]
    robot: RobotIdentity | None
    frame: str = ""
    nq: int | None = None
    target: list | None = None
    constraint: Mapping[str, Any] | None = None
    following_error: bool = False
    phases: list | None = None
    ways: list | None = None
    around: list | None = None
    samples: int | None = None

    def to_json(self, samples: int | None = None) -> str:
        """One line, with the number of samples that follow."""
        content: dict[str, Any] = {
            "format": PREFIX + self.kind,
            "schema": _SCHEMA,
            "joint_names": list(self.joint_names),
            "nq": self.nq,
            "frame": self.frame,
            "robot": None if self.robot is None else self.robot.to_dict(),
        }
        later = {name: getattr(self, name) or None for name in _FIELDS if name not in content} | {"samples": samples}
        return json.dumps(content | {n: value for n, value in later.items() if value is not None}, allow_nan=False)

    @staticmethod
    def from_json(text: str | bytes) -> FileHeader:
        """What `to_json` gave.

        Raises:
            ValueError: Something else, or a newer version.
        """
        content = parsed_json(text)
        named = content.get("format") if isinstance(content, Mapping) else None
        if named not in (PREFIX + "rollout", PREFIX + "recording"):
            raise ValueError(f"the header must have the format {PREFIX}rollout or {PREFIX}recording, not {named!r:.40}")
        if content.get("schema") != _SCHEMA:
            raise ValueError(f"the file has schema {content.get('schema')!r:.40}, this version reads {_SCHEMA}")
        said = {name: content[name] for name in _FIELDS if content.get(name) is not None}
        for name, value in said.items():
            fits, wanted = _FIELDS[name]
            try:
                is_right = fits(value)
            except DAMAGE:
                is_right = False
            if not is_right:
                raise ValueError(f"{name} must be {wanted}, it is {value!r:.60}")
        names, robot = names_from(content.get("joint_names"), "joint_names"), content.get("robot")
        identity = None if robot is None else RobotIdentity.from_dict(robot)
        return FileHeader("rollout" if named.endswith("rollout") else "recording", names, identity, **said)


@final
@dataclass(frozen=True, eq=False)
class SavedMotion:
    """Content of one file.

    Attributes:
        header: What the file says about itself.
        arrays: `time`, shape (T,) [s], and `q`, shape (T, nq); where they are known `u`, shape (T, nv) [rad/s or m/s],
            and `effort`, likewise [N m or N]; of rollouts `manipulability`, `task_error`, `status` (words) and, where
            it is known, `following_error`, shape (T,) each.
        name: What messages call it.
    """

    header: FileHeader
    arrays: Mapping[str, np.ndarray]
    name: str = "motion"

    def __len__(self) -> int:
        return len(self.arrays.get("time", ()))


def column_groups(header: FileHeader, beside: Collection[str]) -> dict[str, list[str]]:
    """Array -> names of its columns: time, postures, the arrays beside them, and of a rollout its curves and status."""
    joints = list(header.joint_names)
    postures = joints if header.nq in (None, len(joints)) else [f"q[{i}]" for i in range(header.nq or 0)]
    groups = {"time": ["time"], "q": postures}
    possible = {"u": [name + VELOCITY_SUFFIX for name in joints], "effort": [name + EFFORT_SUFFIX for name in joints]}
    groups |= {name: columns for name, columns in possible.items() if name in beside}
    if header.kind == "rollout":
        followed = ["following_error"] if header.following_error else []
        curves = ("manipulability", "task_error", *followed, "status")
        groups |= {name: [name] for name in curves}
    return groups


def column_line(groups: Mapping[str, list[str]]) -> str:
    """The line of column names; names with commas are quoted."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="").writerow([name for names in groups.values() for name in names])
    return " ".join(stream.getvalue().splitlines())


def motion_of_trajectory(trajectory: Trajectory, robot: Robot) -> SavedMotion:
    """A demonstration of a robot, ready to be written."""
    header = FileHeader("recording", trajectory.joint_names, RobotIdentity.of(robot), nq=trajectory.q.shape[1])
    arrays = {"time": trajectory.time, "q": trajectory.q, **trajectory.beside}
    return SavedMotion(header, arrays, trajectory.name)


def checked_motion(path: Path, motion: SavedMotion) -> SavedMotion:
    """The motion, if its arrays fit together.

    Raises:
        RecordingError: Says which array does not fit, its shape, and the shape that is needed.
    """
    header, rows, nv = motion.header, len(motion), len(motion.header.joint_names)
    if header.samples not in (None, rows):
        text = f"the file was written with {counted(header.samples, 'sample')} and holds {rows}: it was cut or changed "
        raise refusal(path, "damaged", text + "afterwards; write it again")
    if not nv:
        raise refusal(path, "no-joint-names", "the file names no joint")
    if len(set(header.joint_names)) != nv:
        raise refusal(path, "duplicate-column", "two joints have the same name: keep one")
    width = header.nq or (header.robot.nq if header.robot else nv)
    shapes = {"time": (rows,), "q": (rows, width), "u": (rows, nv), "effort": (rows, nv)}
    needed = {"time", "q"}
    if header.kind == "rollout":
        curves = column_groups(header, ()).keys() - {"time", "q"}
        shapes |= dict.fromkeys(sorted(curves), (rows,))
        needed |= {"u", *curves}
    for name, shape in shapes.items():
        found = motion.arrays[name].shape if name in motion.arrays else None
        if found != shape and (name in needed or found is not None):
            there = "is missing" if found is None else f"has shape {found}"
            text = f"{name} {there}, {shape} is needed: {rows} times, {nv} joints, {width} columns of q"
            raise refusal(path, "shape", text)
    if header.robot is not None and width not in (nv, header.robot.nq):
        raise refusal(path, "shape", f"q has {width} columns for {nv} joints of a robot with nq = {header.robot.nq}")
    return motion


def check_robot(path: Path, header: FileHeader, robot: Robot | None) -> tuple[str, ...]:
    """Notes on what could not be compared.

    Raises:
        RecordingError: The file was made with another robot, or with other joints locked.
    """
    if header.robot is None:
        return (UNKNOWN_ROBOT,)
    if robot is not None:
        header.robot.refuse_another(robot, path.name, path)
    return ()


def joint_positions(
    path: Path, q: Float[np.ndarray, "T n"], names: tuple[str, ...], robot: Robot
) -> Float[np.ndarray, "T nv"]:
    """Joint positions; configurations of a robot with nq != nv (as in a rollout) are turned into them.

    Raises:
        RecordingError: Neither positions of these joints nor configurations of the robot.
    """
    if q.shape[1] == len(names):
        return q
    if names == robot.joint_names and q.shape[1] == robot.nq and np.all(np.isfinite(q)):
        return np.array([robot.positions(row) for row in q]).reshape(q.shape[0], robot.nv)
    text = f"q has {q.shape[1]} columns for {len(names)} joint names: one column per joint is needed"
    raise refusal(path, "shape", text)
