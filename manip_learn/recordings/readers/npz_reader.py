"""NumPy archives: `time` (T,), `q` (T, n), `joint_names` (n,), and where recorded `u` (T, n); our rollouts too.

No pickles, and no array is read before its header, its size in the archive and the other arrays agree with it.
"""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, final

import numpy as np

from manip_learn.errors import RecordingError, advice, closest_names
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording import Recording, float_array, reason

WANTED = ("time", "q", "u", "joint_names", "format")
ROLLOUT = "manip_learn.rollout"
LARGEST = 16_000_000_000  # bytes of all arrays together
BOMB_SIZE, BOMB_RATIO = 50_000_000, 100  # bytes, and how much smaller zipped: measured motions shrink 1 to 20 times
LONGEST_NAME = 1_000
DAMAGE = (zipfile.BadZipFile, zlib.error, EOFError, OSError, ValueError, NotImplementedError, RuntimeError)


@final
@dataclass(frozen=True)
class ArrayHeader:
    """What an array in the archive says about itself."""

    shape: tuple[int, ...]
    dtype: np.dtype
    fortran_order: bool


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """The one recording of an archive.

    Raises:
        RecordingError: Objects (pickles), arrays that do not fit together, a bomb, a missing array, no joint names.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            arrays, notes = _read_arrays(path, archive, request)
    except DAMAGE as error:
        raise _refusal(path, "damaged", f"the archive is damaged ({reason(error)}): copy or save it again") from error
    names = _joint_names(path, arrays, request)
    is_rollout = "format" in arrays and str(arrays["format"]) == ROLLOUT
    yield Recording(
        path=path,
        name=path.name,
        time=arrays["time"],
        position_names=names,
        positions=_positions(path, arrays["q"], names, request),
        velocity_names=names if "u" in arrays else (),
        velocities=arrays.get("u"),
        in_seconds=is_rollout,
        trusted=is_rollout,
        notes=tuple(notes),
    )


def _read_arrays(path: Path, archive: zipfile.ZipFile, request: ReadRequest) -> tuple[dict[str, np.ndarray], list[str]]:
    members: dict[str, zipfile.ZipInfo] = {}
    ignored: list[str] = []
    for info in archive.infolist():
        key = request.renamed(info.filename.removesuffix(".npy"))
        if key in members:
            raise _refusal(path, "duplicate-column", f"the array {key!r} occurs twice: keep one")
        if key in WANTED and not request.ignores(key):
            members[key] = info
        else:
            ignored.append(key)
    for key in ("time", "q"):
        if key not in members:
            near = closest_names(key, ignored)
            hint = ""
            if near:
                python, flag = f"rename={{{near[0]!r}: {key!r}}}", f"--rename {near[0]}={key}"
                hint = advice(f"; if {near[0]!r} is meant: {{}}", python, flag)
            raise _refusal(
                path,
                "missing-array",
                f"there is no array {key!r}; there is {', '.join(map(repr, [*members, *ignored]))}{hint}",
            )
    headers = {key: _header(path, archive, key, info) for key, info in members.items()}
    _check_sizes(path, headers, members)
    notes = [f"arrays not used: {', '.join(ignored)}"] if ignored and "format" not in members else []
    arrays = {key: _array(path, archive, members[key], header) for key, header in headers.items()}
    for key in ("time", "q", "u"):
        if key in arrays:
            if arrays[key].dtype != np.dtype(np.float64):
                notes.append(f"{key} is stored as {arrays[key].dtype.str}, read as float64")
            arrays[key] = float_array(arrays[key])
    return arrays, notes


def _header(path: Path, archive: zipfile.ZipFile, key: str, info: zipfile.ZipInfo) -> ArrayHeader:
    with archive.open(info) as file:
        header = _parse_header(file)
        data_bytes = info.file_size - file.tell()
    if header.dtype.hasobject:
        raise _refusal(
            path,
            "pickle",
            f"the array {key!r} holds Python objects, which are not opened (they can run code): save numbers",
        )
    kinds = "US" if key in ("joint_names", "format") else "fiu"
    if header.dtype.kind not in kinds:
        wanted = "text" if kinds == "US" else "real numbers"
        raise _refusal(path, "not-a-number", f"the array {key!r} holds {header.dtype}, {wanted} are needed")
    need = math.prod(header.shape) * header.dtype.itemsize
    if need != data_bytes:
        raise _refusal(
            path,
            "damaged",
            f"the array {key!r} asks for {need:,} bytes (shape {header.shape}), it has {data_bytes:,}: save it again",
        )
    return header


def _parse_header(file: IO[bytes]) -> ArrayHeader:
    version = np.lib.format.read_magic(file)
    parse = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran_order, dtype = parse(file)
    return ArrayHeader(tuple(shape), dtype, fortran_order)


def _check_sizes(path: Path, headers: dict[str, ArrayHeader], members: dict[str, zipfile.ZipInfo]) -> None:
    total = sum(info.file_size for info in members.values())
    if total > LARGEST:
        raise _refusal(
            path, "too-large", f"the arrays have {total:,} bytes, more than {LARGEST:,}: split the recording"
        )
    for key, info in members.items():
        if info.file_size > BOMB_SIZE and info.file_size > BOMB_RATIO * max(info.compress_size, 1):
            raise _refusal(
                path,
                "bomb",
                f"the array {key!r} has {info.file_size:,} bytes, {info.compress_size:,} packed: no recorded motion "
                "packs so well; if it is real, save it with np.savez (not compressed)",
            )
    time, q = headers["time"].shape, headers["q"].shape
    if len(time) != 1 or len(q) != 2 or q[0] != time[0]:
        raise _refusal(path, "shape", f"time must have shape (T,) and q (T, n); they have {time} and {q}")
    u = headers["u"].shape if "u" in headers else q
    if len(u) != 2 or u[0] != time[0]:
        raise _refusal(path, "shape", f"u must have shape ({time[0]}, n), it has {u}: one row per time stamp")


def _array(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo, header: ArrayHeader) -> np.ndarray:
    with archive.open(info) as file:
        _parse_header(file)
        content = file.read()
    count = math.prod(header.shape)
    if len(content) != count * header.dtype.itemsize:
        raise _refusal(path, "damaged", f"the array {info.filename!r} ends too early: copy or save it again")
    flat = np.frombuffer(content, dtype=header.dtype, count=count) if count else np.empty(0, header.dtype)
    return flat.reshape(header.shape, order="F" if header.fortran_order else "C")


def _joint_names(path: Path, arrays: dict[str, np.ndarray], request: ReadRequest) -> tuple[str, ...]:
    width = arrays["u"].shape[1] if "u" in arrays else arrays["q"].shape[1]
    if "joint_names" not in arrays:
        if request.joint_names is None:
            raise _refusal(
                path,
                "no-joint-names",
                f"the archive has no 'joint_names' for the {arrays['q'].shape[1]} columns of q: save them"
                + advice(
                    ", or pass {} in the order of the columns", "joint_names=[...]", "--joint-names NAME,NAME,..."
                ),
            )
        request.uses.use("joint_names")
        names = request.joint_names
    else:
        raw = arrays["joint_names"]
        if raw.ndim != 1 or raw.dtype.itemsize > 4 * LONGEST_NAME:
            raise _refusal(path, "shape", f"joint_names must be a list of names, it has shape {raw.shape}")
        names = tuple(n.decode("utf-8", "replace") if isinstance(n, bytes) else str(n) for n in raw.tolist())
        names = tuple(request.renamed(n) for n in names)
    if len(names) != width:
        raise _refusal(
            path, "shape", f"there are {len(names)} joint names for {width} columns: one name per column is needed"
        )
    return names


def _positions(path: Path, q: np.ndarray, names: tuple[str, ...], request: ReadRequest) -> np.ndarray:
    """Joint positions; configurations of a robot with nq != nv (as in a rollout) are turned into them."""
    robot = request.robot
    if q.shape[1] == len(names):
        return q
    if names == robot.joint_names and q.shape[1] == robot.nq and np.all(np.isfinite(q)):
        return np.array([robot.positions(row) for row in q]).reshape(q.shape[0], robot.nv)
    raise _refusal(
        path, "shape", f"q has {q.shape[1]} columns for {len(names)} joint names: one column per joint is needed"
    )


def _refusal(path: Path, code: str, text: str) -> RecordingError:
    return RecordingError(f"{path.name}: {text}", code=code, path=path)
