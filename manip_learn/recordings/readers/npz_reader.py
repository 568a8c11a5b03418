"""NumPy archives, array by array: sizes are known from the headers before anything is read; no pickles are opened."""

from __future__ import annotations

import functools
import io
import math
import zipfile
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from manip_learn.recordings.readers.array_reader import recordings
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording import (
    LARGEST_ARRAYS,
    LONGEST_TEXT,
    Recording,
    bomb,
    check_columns,
    check_regular,
    most_bytes,
    refusal,
    refusing_damage,
)

BARE = b"\x93NUMPY"  # how a single array begins, without an archive around


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """The recording of an archive, or of one bare array of positions."""
    is_bare = check_regular(path).startswith(BARE)

    def load(roles: Mapping[str, str]) -> dict[str, Any]:
        if is_bare:
            with refusing_damage(path), path.open("rb") as file:
                return {role: _array(path, "q", file, path.stat().st_size, "fiu", 0)[0] for role in roles}
        texts = [name for role, name in roles.items() if role == "joint_names"]
        arrays, _ = stored_arrays(path, [name for name in roles.values() if name not in texts], texts)
        return {r: texts_of(path, r, arrays[n]) if n in texts else arrays[n] for r, n in roles.items()}

    yield from recordings(path, ["q"] if is_bare else stored_arrays(path, (), ())[1], load, request)


def stored_arrays(
    path: Path, numbers: Collection[str], texts: Collection[str]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """The arrays of an archive.

    Args:
        path: File.
        numbers: Names of arrays of numbers.
        texts: Names of arrays of text.

    Returns:
        Name -> array as it is stored, of those that were asked for and are there; and the names of the others.

    Raises:
        RecordingError: Damaged, arrays of objects (pickles), text for numbers, a bomb, an array that occurs twice.
    """
    members: dict[str, zipfile.ZipInfo] = {}
    arrays: dict[str, np.ndarray] = {}
    total = 0  # bytes of the arrays up to here, in memory
    with refusing_damage(path), zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            name = info.filename.removesuffix(".npy")
            if name in members:
                raise refusal(path, "duplicate-column", f"the array {name!r} occurs twice: keep one")
            members[name] = info
        for name in [n for n in members if n in numbers or n in texts]:
            kinds = "fiu" if name in numbers else "US"
            with archive.open(members[name]) as file:
                arrays[name], total = _array(path, name, file, members[name].file_size, kinds, total)
    return arrays, [n for n in members if n not in arrays]


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
