"""A motion as the library's own files hold it: the same content in every format."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
from jaxtyping import Float

from manip_learn.errors import counted
from manip_learn.linalg import finite
from manip_learn.recordings.format_words import EFFORT_SUFFIX, VELOCITY_SUFFIX
from manip_learn.recordings.readers.recording import refusal
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot import Robot
from manip_learn.robot.identity import RobotIdentity, names_from

Kind = Literal["rollout", "recording"]
PREFIX = "manip_learn."
CURVES = ("u", "effort", "manipulability", "task_error", "following_error")  # what a motion may have beside q
SCHEMA = 2
SIZES = {"face": 0, "sphere": 1, "cylinder": 2, "box": 3, "mesh": 0}  # numbers of the things that stood around
UNKNOWN_ROBOT = (
    "the file does not say which robot and which locked joints it was made with: only the names of the joints were "
    "compared; save it again"
)


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
        follows: Whether a rollout has the following error.
        phases: Name, start and end [s] of the parts of a rollout, or None.
        ways: What became of each way of a rollout, or None.
        around: What a rollout kept clear of, or None.
        samples: Number of samples that were written; None for a LeRobot data set, which counts them itself.
    """

    kind: Kind
    joint_names: tuple[str, ...]
    robot: RobotIdentity | None
    frame: str = ""
    nq: int | None = None
    target: list | None = None
    constraint: Mapping[str, Any] | None = None
    follows: bool = False
    phases: list | None = None
    ways: list | None = None
    around: list | None = None
    samples: int | None = None

    def to_json(self, samples: int | None = None) -> str:
        """One line, with the number of samples that follow."""
        content: dict[str, Any] = {
            "format": PREFIX + self.kind,
            "schema": SCHEMA,
            "joint_names": list(self.joint_names),
            "nq": self.nq,
            "frame": self.frame,
            "robot": None if self.robot is None else self.robot.to_dict(),
        }
        later = {"target": self.target, "constraint": self.constraint, "following_error": self.follows or None}
        later |= {"phases": self.phases or None, "ways": self.ways or None, "around": self.around or None}
        later |= {"samples": samples}
        return json.dumps(
            content | {name: value for name, value in later.items() if value is not None}, allow_nan=False
        )

    @staticmethod
    def from_json(text: str | bytes) -> FileHeader:
        """What `to_json` gave.

        Raises:
            ValueError: Something else, or a newer version.
        """
        content = json.loads(text)
        named = content.get("format") if isinstance(content, Mapping) else None
        if named not in (PREFIX + "rollout", PREFIX + "recording"):
            raise ValueError(f"the header must have the format {PREFIX}rollout or {PREFIX}recording, not {named!r:.40}")
        if content.get("schema") != SCHEMA:
            raise ValueError(f"the file has schema {content.get('schema')!r:.40}, this version reads {SCHEMA}")
        nq, frame, robot = content.get("nq"), content.get("frame", ""), content.get("robot")
        if not isinstance(frame, str):
            raise ValueError(f"the frame must be a name, it is {frame!r:.40}")
        for name, number in {"nq": nq, "samples": content.get("samples")}.items():
            if number is not None and (not isinstance(number, int) or isinstance(number, bool)):
                raise ValueError(f"{name} must be a whole number, it is {number!r:.40}")
        target, constraint = content.get("target"), content.get("constraint")
        if target is not None:
            array = np.array(target, dtype=np.float64)
            if array.ndim not in (1, 2) or not np.all(np.isfinite(array)):
                raise ValueError(f"the target must be finite numbers, it is {target!r:.60}")
            target = array.tolist()
        if constraint is not None and not isinstance(constraint, Mapping):
            raise ValueError(f"the constraint must be an object, it is {constraint!r:.40}")
        return FileHeader(
            "rollout" if named.endswith("rollout") else "recording",
            names_from(content.get("joint_names"), "joint_names"),
            None if robot is None else RobotIdentity.from_dict(robot),
            frame,
            nq,
            target,
            constraint,
            bool(content.get("following_error")),
            _phases(content.get("phases")),
            _ways(content.get("ways")),
            _around(content.get("around")),
            content.get("samples"),
        )


def _phases(value: object) -> list | None:
    """Name, start and end of each part."""

    def fits(part: object) -> bool:
        if not (isinstance(part, list) and len(part) == 3 and isinstance(part[0], str)):
            return False
        return all(isinstance(t, int | float) and not isinstance(t, bool) and np.isfinite(t) for t in part[1:])

    if value is not None and not (isinstance(value, list) and all(map(fits, value))):
        raise ValueError(f"the phases must be a name, a start and an end each, they are {value!r:.60}")
    return value


def _ways(value: object) -> list | None:
    """Objects, each of which says when its way began [s], or null if it never did."""

    def fits(way: object) -> bool:
        if not isinstance(way, dict) or "begins" not in way:
            return False
        begins = way["begins"]
        return begins is None or (isinstance(begins, int | float) and bool(np.isfinite(begins)))

    if value is not None and not (isinstance(value, list) and all(map(fits, value))):
        raise ValueError(f"the ways must be objects that say when they began, they are {value!r:.60}")
    return value


def _around(value: Any) -> list | None:
    """Things that stood around: a name, a pose and a shape each."""

    def fits(thing: Any) -> bool:
        corners, faces = (np.reshape(thing.get(key, ()), (-1, 3)) for key in ("vertices", "faces"))
        size, n = finite(thing.get("size", ()), SIZES[thing["kind"]]), len(corners)
        is_whole = finite(corners, n, 3) is not None and bool(np.isin(faces, range(n)).all())
        is_placed = isinstance(thing["name"], str) and finite(thing["pose"], 4, 4) is not None
        is_sized = size is not None and bool(np.all(size > 0.0)) and (thing["kind"] == "mesh") == (len(faces) > 0)
        return is_whole and is_placed and is_sized

    try:
        fit = value is None or all(map(fits, value))
    except (AttributeError, KeyError, TypeError, ValueError):
        fit = False
    if not fit:
        raise ValueError(f"what stood around must be things with a name, a pose and a shape, it is {value!r:.60}")
    return value


@final
@dataclass(frozen=True, eq=False)
class SavedMotion:
    """Content of one file.

    Attributes:
        header: What the file says about itself.
        time: shape (T,) [s].
        q: shape (T, nq).
        u: shape (T, nv), or None [rad/s or m/s].
        manipulability: shape (T,), of rollouts; else None.
        task_error: shape (T,), of rollouts; else None.
        status: One word per sample, of rollouts; else empty.
        following_error: shape (T,), of rollouts for which it is known; else None.
        name: What messages call it.
        effort: shape (T, nv), of recordings; None if it is not known [N m or N].
    """

    header: FileHeader
    time: Float[np.ndarray, " T"]
    q: Float[np.ndarray, "T nq"]
    u: Float[np.ndarray, "T nv"] | None
    manipulability: Float[np.ndarray, " T"] | None = None
    task_error: Float[np.ndarray, " T"] | None = None
    status: tuple[str, ...] = ()
    name: str = "motion"
    following_error: Float[np.ndarray, " T"] | None = None
    effort: Float[np.ndarray, "T nv"] | None = None


def column_groups(header: FileHeader, beside: Collection[str]) -> dict[str, list[str]]:
    """Array -> names of its columns: time, postures, the arrays beside them, and of a rollout its curves and status."""
    joints = list(header.joint_names)
    postures = joints if header.nq in (None, len(joints)) else [f"q[{i}]" for i in range(header.nq or 0)]
    groups = {"time": ["time"], "q": postures}
    possible = {"u": [name + VELOCITY_SUFFIX for name in joints], "effort": [name + EFFORT_SUFFIX for name in joints]}
    groups |= {name: columns for name, columns in possible.items() if name in beside}
    if header.kind == "rollout":
        curves = ("manipulability", "task_error", *(("following_error",) if header.follows else ()), "status")
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
    beside: dict[str, Any] = {"u": None} | trajectory.beside
    return SavedMotion(header, trajectory.time, trajectory.q, name=trajectory.name, **beside)


def checked_motion(path: Path, motion: SavedMotion) -> SavedMotion:
    """The motion, if its arrays fit together.

    Raises:
        RecordingError: Says which array does not fit, its shape, and the shape that is needed.
    """
    header, rows, nv = motion.header, motion.time.shape[0], len(motion.header.joint_names)
    if header.samples not in (None, rows):
        raise refusal(
            path,
            "damaged",
            f"the file was written with {counted(header.samples, 'sample')} and holds {rows}: it was cut or changed "
            "afterwards; write it again",
        )
    if not nv:
        raise refusal(path, "no-joint-names", "the file names no joint")
    if len(set(header.joint_names)) != nv:
        raise refusal(path, "duplicate-column", "two joints have the same name: keep one")
    width = header.nq or (header.robot.nq if header.robot else nv)
    needed = {"q": (motion.q, (rows, width)), "u": (motion.u, (rows, nv))}
    needed |= {"manipulability": (motion.manipulability, (rows,)), "task_error": (motion.task_error, (rows,))}
    if header.follows:
        needed |= {"following_error": (motion.following_error, (rows,))}
    if header.kind == "recording":
        needed = {"q": needed["q"]} | ({} if motion.u is None else {"u": needed["u"]})
    if motion.effort is not None:
        needed |= {"effort": (motion.effort, (rows, nv))}
    for name, (array, shape) in needed.items():
        if array is None or array.shape != shape:
            there = "is missing" if array is None else f"has shape {array.shape}"
            raise refusal(
                path, "shape", f"{name} {there}, {shape} is needed: {rows} times, {nv} joints, {width} columns of q"
            )
    if header.robot is not None and width not in (nv, header.robot.nq):
        raise refusal(path, "shape", f"q has {width} columns for {nv} joints of a robot with nq = {header.robot.nq}")
    if header.kind == "rollout" and len(motion.status) != rows:
        raise refusal(path, "shape", f"there are {len(motion.status)} status words for {rows} times")
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
    raise refusal(
        path, "shape", f"q has {q.shape[1]} columns for {len(names)} joint names: one column per joint is needed"
    )
