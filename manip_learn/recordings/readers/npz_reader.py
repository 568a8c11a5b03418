"""NumPy archives of a user: `time` (T,), `q` (T, n), `joint_names` (n,), and where recorded `u` and `effort` (T, n)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from manip_learn.errors import advice, closest_names, counted
from manip_learn.recordings.readers.npz_archive import NpzArchive
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording import Recording
from manip_learn.recordings.readers.saved_reader import joint_positions

NUMBERS = ("time", "q", "u", "effort")


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """The one recording of an archive.

    Raises:
        RecordingError: Objects (pickles), arrays that do not fit together, a bomb, a missing array, no joint names.
    """
    archive = NpzArchive(
        path,
        [n for n in NUMBERS if not request.ignores(n)],
        [n for n in ("joint_names",) if not request.ignores(n)],
        request.renamed,
    )
    _check_shapes(archive)
    arrays = {name: archive.numbers(name) for name in NUMBERS if name in archive}
    notes = [f"arrays not used: {', '.join(archive.ignored)}"] if archive.ignored else []
    for name in arrays:
        dtype = archive.headers[name].dtype
        if dtype != np.dtype(np.float64):
            notes.append(f"{name} is stored as {dtype.str}, read as float64")
    names = _joint_names(archive, request)
    yield Recording(
        path=path,
        name=path.name,
        time=arrays["time"],
        position_names=names,
        positions=joint_positions(path, arrays["q"], names, request.robot),
        velocity_names=names if "u" in arrays else (),
        velocities=arrays.get("u"),
        effort_names=names if "effort" in arrays else (),
        efforts=arrays.get("effort"),
        notes=tuple(notes),
    )


def _check_shapes(archive: NpzArchive) -> None:
    for name in ("time", "q"):
        if name not in archive:
            near = closest_names(name, archive.ignored)
            hint = ""
            if near:
                python, flag = f"rename={{{near[0]!r}: {name!r}}}", f"--rename {near[0]}={name}"
                hint = advice(f"; if {near[0]!r} is meant: {{}}", python, flag)
            there = ", ".join(map(repr, [*archive.names, *archive.ignored]))
            raise archive.refusal("missing-array", f"there is no array {name!r}; there is {there}{hint}")
    time, q = archive.shape("time"), archive.shape("q")
    if len(time) != 1 or len(q) != 2 or q[0] != time[0]:
        raise archive.refusal("shape", f"time must have shape (T,) and q (T, n); they have {time} and {q}")
    for name in ("u", "effort"):
        shape = archive.shape(name) if name in archive else q
        if len(shape) != 2 or shape[0] != time[0]:
            raise archive.refusal(
                "shape", f"{name} must have shape ({time[0]}, n), it has {shape}: one row per time stamp"
            )
    if "effort" in archive and archive.shape("effort") != archive.shape("u" if "u" in archive else "q"):
        raise archive.refusal("shape", f"effort has shape {archive.shape('effort')}: one column per joint is needed")


def _joint_names(archive: NpzArchive, request: ReadRequest) -> tuple[str, ...]:
    width = archive.shape("u" if "u" in archive else "q")[1]
    if "joint_names" in archive:
        names = tuple(request.renamed(n) for n in archive.texts("joint_names"))
    elif request.joint_names is not None:
        request.uses.use("joint_names")
        names = request.joint_names
    else:
        raise archive.refusal(
            "no-joint-names",
            f"the archive has no 'joint_names' for the {counted(archive.shape('q')[1], 'column')} of q: save them"
            + advice(", or pass {} in the order of the columns", "joint_names=[...]", "--joint-names NAME,NAME,..."),
        )
    if len(names) != width:
        raise archive.refusal(
            "shape", f"there are {len(names)} joint names for {counted(width, 'column')}: one name per column is needed"
        )
    return names
