"""Files that the library itself wrote: rollouts and exported recordings, in any format, for their own robot only."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from manip_learn.errors import DAMAGE, RecordingError
from manip_learn.recordings.readers.joint_trajectory_reader import is_joint_trajectory, read_joint_trajectory
from manip_learn.recordings.readers.lerobot_dataset import DATASET_HEADER
from manip_learn.recordings.readers.npz_archive import NpzArchive
from manip_learn.recordings.readers.parser_process import parsed_recordings
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording import Recording, reason
from manip_learn.recordings.readers.saved_mcap import mcap_header, read_saved_rollout
from manip_learn.recordings.readers.saved_text import TEXT_READERS, first_line, header_text
from manip_learn.recordings.saved_motion import (
    PREFIX,
    FileHeader,
    SavedMotion,
    check_robot,
    checked_motion,
    refusal,
)
from manip_learn.robot import Robot

BAG_PARSER = "manip_learn.recordings.readers.rosbag_reader"
CURVES = ("u", "effort", "manipulability", "task_error", "following_error")
ARRAYS = ("time", "q", *CURVES)
TEXTS = ("format", "header", "status", "joint_names", "frame")


def file_header(path: Path) -> FileHeader | None:
    """What a file of the library, or a LeRobot data set that it wrote, says about itself; None for any other file.

    Raises:
        RecordingError: The header is damaged, or of a newer version.
    """
    with _refusing_damage(path):
        if path.is_dir():
            inner = path / DATASET_HEADER
            return FileHeader.from_json(inner.read_bytes()) if inner.is_file() else None
        if path.exists() and not path.is_file():
            raise refusal(path, "not-a-file", "this is not a regular file; give a rollout or a recording")
        with path.open("rb") as file:
            start = file.read(8)
        if start.startswith(b"PK"):
            return _npz_header(path)
        text = mcap_header(path) if start.startswith(b"\x89MCAP0") else header_text(first_line(path))
        return None if text is None else FileHeader.from_json(text)


def read_saved(path: Path) -> SavedMotion:
    """The motion in a file of the library: a rollout, or a recording that is not in MCAP.

    Raises:
        RecordingError: No such file, a damaged one, or one of another kind.
    """
    with _refusing_damage(path):
        header = file_header(path)
        if header is None:
            raise refusal(path, "not-a-rollout", "no rollout; `manip-learn control ... --out FILE.npz` writes one")
        with path.open("rb") as file:
            start = file.read(4).removeprefix(b"\xef\xbb\xbf")[:1].decode("latin-1")
        if start == "P":
            motion = _npz_motion(path, header)
        elif start == "#" and is_joint_trajectory(path):
            motion = read_joint_trajectory(path, header)
        elif start in TEXT_READERS:
            motion = TEXT_READERS[start](path, header)
        else:
            motion = read_saved_rollout(path, header)
        return checked_motion(path, motion)


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """The one recording of a file.

    Raises:
        RecordingError: Made with another robot or other locked joints, or damaged.
    """
    header = file_header(path)
    notes = () if header is None else check_robot(path, header, request.robot)
    if header is not None and header.kind == "recording" and _is_mcap(path):
        for recording in parsed_recordings(BAG_PARSER, path, request.for_parser()):
            yield replace(recording, trusted=True)
        return
    motion = read_saved(path)
    names = tuple(request.renamed(n) for n in motion.header.joint_names)
    yield Recording(
        path=path,
        name=path.name,
        time=motion.time,
        position_names=names,
        positions=joint_positions(path, motion.q, names, request.robot),
        velocity_names=names if motion.u is not None else (),
        velocities=motion.u,
        effort_names=names if motion.effort is not None else (),
        efforts=motion.effort,
        in_seconds=True,
        trusted=True,
        notes=notes,
    )


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


def _npz_header(path: Path) -> FileHeader | None:
    with zipfile.ZipFile(path) as zipped:
        names = zipped.namelist()
    if "format.npy" not in names:
        return None
    archive = NpzArchive(path, (), TEXTS)
    named = archive.text("format") if archive.shape("format") == () else ""
    if not named.startswith(PREFIX):
        return None
    if "header" in archive:
        return FileHeader.from_json(archive.text("header"))
    if named != PREFIX + "rollout":
        raise refusal(path, "not-a-rollout", f"its format is {named!r:.40}, which this version does not read")
    frame = archive.text("frame") if "frame" in archive else ""
    return FileHeader("rollout", archive.texts("joint_names"), None, frame, schema=1)


def _npz_motion(path: Path, header: FileHeader) -> SavedMotion:
    archive = NpzArchive(path, ARRAYS, TEXTS)
    if "joint_names" in archive and archive.texts("joint_names") != header.joint_names:
        raise refusal(path, "damaged", "its joint_names are not those of its header: save it again")
    for name in ("time", "q"):
        if len(archive.shape(name) if name in archive else ()) != (1 if name == "time" else 2):
            shape = archive.shape(name) if name in archive else "missing"
            raise refusal(path, "shape", f"time must have shape (T,) and q (T, n); {name} is {shape}")
    arrays = {name: archive.numbers(name) for name in ARRAYS if name in archive}
    nq = header.nq if header.schema > 1 else arrays["q"].shape[1]
    status = archive.texts("status") if "status" in archive else ()
    curves = {name: arrays.get(name) for name in CURVES}
    return SavedMotion(replace(header, nq=nq), arrays["time"], arrays["q"], **curves, status=status, name=path.name)


def _is_mcap(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(6) == b"\x89MCAP0"


@contextmanager
def _refusing_damage(path: Path) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError as error:
        raise RecordingError(f"rollout file {path} does not exist", code="missing", path=path) from error
    except DAMAGE as error:
        raise refusal(path, "damaged", f"the file cannot be read ({reason(error)}): copy or save it again") from error
