"""NumPy archives, array by array: sizes are known from the headers before anything is read; no pickles are opened."""

from __future__ import annotations

import functools
import io
import math
import zipfile
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import IO

import numpy as np

from manip_learn.errors import DAMAGE, advice, closest_names, counted
from manip_learn.recordings.readers.limits import LARGEST_ARRAYS, LONGEST_TEXT, bomb, check_columns, most_bytes
from manip_learn.recordings.readers.read_request import ReadRequest, names_advice
from manip_learn.recordings.readers.recording import Recording, float_array, reason, refusal
from manip_learn.recordings.saved_motion import joint_positions

NUMBERS = ("time", "q", "u", "effort")


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """The one recording of an archive."""
    numbers = [n for n in NUMBERS if not request.ignores(n)]
    texts = [] if request.ignores("joint_names") else ["joint_names"]
    stored, ignored = stored_arrays(path, numbers, texts, request.renamed)
    _check_shapes(path, stored, ignored)
    arrays = {name: float_array(stored[name]) for name in NUMBERS if name in stored}
    notes = [f"arrays not used: {', '.join(ignored)}"] if ignored else []
    for name in arrays:
        if stored[name].dtype != np.dtype(np.float64):
            notes.append(f"{name} is stored as {stored[name].dtype.str}, read as float64")
    names = _joint_names(path, stored, request)
    q = joint_positions(path, arrays["q"], names, request.robot)
    u, effort = arrays.get("u"), arrays.get("effort")
    yield Recording.of(path, path.name, arrays["time"], names, q, u, effort, notes=tuple(notes))


def stored_arrays(
    path: Path,
    numbers: Collection[str],
    texts: Collection[str],
    renamed: Callable[..., tuple[str, ...]] = lambda *names: names,
) -> tuple[dict[str, np.ndarray], list[str]]:
    """The arrays of an archive.

    Args:
        path: File.
        numbers: Names of arrays of numbers.
        texts: Names of arrays of text.
        renamed: Name in the file -> name in `numbers` or `texts`.

    Returns:
        Name -> array as it is stored, of those that were asked for and are there; and the names of the others.

    Raises:
        RecordingError: Damaged, arrays of objects (pickles), text for numbers, a bomb, an array that occurs twice.
    """
    ignored: list[str] = []
    members: dict[str, zipfile.ZipInfo] = {}
    arrays: dict[str, np.ndarray] = {}
    total = 0  # bytes of the arrays up to here, in memory
    try:
        with zipfile.ZipFile(path) as archive:
            for info in archive.infolist():
                (name,) = renamed(info.filename.removesuffix(".npy"))
                if name in members:
                    raise refusal(path, "duplicate-column", f"the array {name!r} occurs twice: keep one")
                if name in numbers or name in texts:
                    members[name] = info
                else:
                    ignored.append(name)
            for name, info in members.items():
                with archive.open(info) as file:
                    kinds = "fiu" if name in numbers else "US"
                    arrays[name], total = _array(path, name, file, info.file_size, kinds, total)
    except DAMAGE as error:
        said = f"the archive is damaged ({reason(error)}): copy or save it again"
        raise refusal(path, "damaged", said) from error
    return arrays, ignored


def texts_of(path: Path, name: str, array: np.ndarray, ndim: int = 1) -> tuple[str, ...]:
    """The texts of an array; of one without dimensions the only one.

    Raises:
        RecordingError: Another number of dimensions.
    """
    if array.ndim != ndim:
        wanted = "a list of names" if ndim else "a single text"
        raise refusal(path, "shape", f"{name} must be {wanted}, it has shape {array.shape}")
    values = np.atleast_1d(array).tolist()
    return tuple(v.decode("utf-8", "replace") if isinstance(v, bytes) else str(v) for v in values)


def _array(path: Path, name: str, file: IO[bytes], size: int, kinds: str, before: int) -> tuple[np.ndarray, int]:
    """An array whose header agrees with its size in the file, and which does not fill the memory; bytes in memory."""
    is_first = np.lib.format.read_magic(file) == (1, 0)
    length = file.read(2 if is_first else 4)
    header = length + file.read(int.from_bytes(length, "little"))
    shape, is_fortran, dtype = _parsed_header(is_first, header)
    if dtype.hasobject:
        text = f"the array {name!r} holds Python objects, which are not opened (they can run code): save numbers"
        raise refusal(path, "pickle", text)
    if dtype.kind not in kinds:
        wanted = "text" if kinds == "US" else "real numbers"
        raise refusal(path, "not-a-number", f"the array {name!r} holds {dtype}, {wanted} are needed")
    if dtype.itemsize > 4 * LONGEST_TEXT or any(n < 0 for n in shape):
        raise refusal(path, "shape", f"the array {name!r} has shape {shape} of {dtype}: save it again")
    count, there = math.prod(shape), size - file.tell()
    if count * dtype.itemsize != there:
        said = f"asks for {count * dtype.itemsize:,} bytes (shape {shape}), it has {there:,}: save it again"
        raise refusal(path, "damaged", f"the array {name!r} {said}")
    if len(shape) == 2:
        check_columns(path, f"the array {name!r}", shape[1])
    total = before + count * (8 if kinds == "fiu" else dtype.itemsize)  # numbers become float64
    if total > LARGEST_ARRAYS:
        said = f"the arrays have {total:,} bytes, more than {LARGEST_ARRAYS:,}: split the recording"
        raise refusal(path, "too-large", said)
    # the size of the file counts, for arrays may share packed bytes
    if total > most_bytes(packed := path.stat().st_size):
        raise bomb(path, f"its {packed:,} bytes unpack to {total:,}")
    content = file.read(there + 1)  # at the end, the checksum is compared
    if len(content) != there:
        raise refusal(path, "damaged", f"the array {name!r} ends too early: copy or save it again")
    flat = np.frombuffer(content, dtype) if content else np.zeros(count, dtype)
    return flat.reshape(shape, order="F" if is_fortran else "C"), total


@functools.lru_cache(maxsize=256)
def _parsed_header(is_first: bool, content: bytes) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, order and type; arrays of the same shape share them, and parsing takes longer than reading a small one."""
    parse = np.lib.format.read_array_header_1_0 if is_first else np.lib.format.read_array_header_2_0
    return parse(io.BytesIO(content))


def _check_shapes(path: Path, arrays: dict[str, np.ndarray], ignored: list[str]) -> None:
    for name in ("time", "q"):
        if name not in arrays:
            near = closest_names(name, ignored)
            hint = ""
            if near:
                python, flag = f"rename={{{near[0]!r}: {name!r}}}", f"--rename {near[0]}={name}"
                hint = advice(f"; if {near[0]!r} is meant: {{}}", python, flag)
            there = ", ".join(map(repr, [*arrays, *ignored]))
            raise refusal(path, "missing-array", f"there is no array {name!r}; there is {there}{hint}")
    shapes = {name: array.shape for name, array in arrays.items()}
    time, q = shapes["time"], shapes["q"]
    if len(time) != 1 or len(q) != 2 or q[0] != time[0]:
        raise refusal(path, "shape", f"time must have shape (T,) and q (T, n); they have {time} and {q}")
    for name in ("u", "effort"):
        shape = shapes.get(name, q)
        if len(shape) != 2 or shape[0] != time[0]:
            said = f"{name} must have shape ({time[0]}, n), it has {shape}: one row per time stamp"
            raise refusal(path, "shape", said)
    if "effort" in shapes and shapes["effort"] != shapes.get("u", q):
        raise refusal(path, "shape", f"effort has shape {shapes['effort']}: one column per joint is needed")


def _joint_names(path: Path, arrays: dict[str, np.ndarray], request: ReadRequest) -> tuple[str, ...]:
    columns = arrays["q"].shape[1]
    width = arrays["u"].shape[1] if "u" in arrays else columns
    if "joint_names" in arrays:
        names = request.renamed(*texts_of(path, "joint_names", arrays["joint_names"]))
    elif request.joint_names is not None:
        request.uses.use("joint_names")
        names = request.renamed(*request.joint_names)
    else:
        raise refusal(
            path,
            "no-joint-names",
            f"the archive has no 'joint_names' for the {counted(columns, 'column')} of q: save them"
            + names_advice(columns, request.robot),
        )
    if len(names) != width:
        raise refusal(
            path,
            "shape",
            f"there are {len(names)} joint names for {counted(width, 'column')}: one name per column is needed",
        )
    return names
