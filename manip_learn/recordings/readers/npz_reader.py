"""NumPy archives, array by array: sizes are known from the headers before anything is read; no pickles are opened."""

from __future__ import annotations

import functools
import io
import math
import zipfile
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import IO, final

import numpy as np

from manip_learn.errors import DAMAGE, RecordingError, advice, closest_names, counted
from manip_learn.recordings.readers.limits import LARGEST_ARRAYS, LONGEST_TEXT, bomb, check_columns, most_bytes
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording import Recording, float_array, reason, refusal
from manip_learn.recordings.saved_motion import joint_positions

NUMBERS = ("time", "q", "u", "effort", "wrench")


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """The one recording of an archive.

    Raises:
        RecordingError: Objects (pickles), arrays that do not fit together, a bomb, a missing array, no joint names.
    """
    numbers = [n for n in NUMBERS if not request.ignores(n)]
    texts = [] if request.ignores("joint_names") else ["joint_names"]
    archive = NpzArchive(path, numbers, texts, request.renamed)
    _check_shapes(archive)
    arrays = {name: archive.numbers(name) for name in NUMBERS if name in archive.arrays}
    notes = [f"arrays not used: {', '.join(archive.ignored)}"] if archive.ignored else []
    for name in arrays:
        dtype = archive.arrays[name].dtype
        if dtype != np.dtype(np.float64):
            notes.append(f"{name} is stored as {dtype.str}, read as float64")
    names = _joint_names(archive, request)
    q = joint_positions(path, arrays["q"], names, request.robot)
    also = {"wrench": arrays.get("wrench"), "notes": tuple(notes)}
    yield Recording.of(path, path.name, arrays["time"], names, q, arrays.get("u"), arrays.get("effort"), **also)


@final
class NpzArchive:
    """The arrays of an archive, read once the headers of all of them were found good.

    Args:
        path: File.
        numbers: Names of arrays of numbers.
        texts: Names of arrays of text.
        renamed: Name in the file -> name in `numbers` or `texts`.

    Attributes:
        arrays: Name -> array as it is stored, of those that were asked for and are there.
        ignored: Names of arrays that were not asked for.

    Raises:
        RecordingError: Damaged, arrays of objects (pickles), text for numbers, a bomb, an array that occurs twice.
    """

    def __init__(
        self, path: Path, numbers: Collection[str], texts: Collection[str], renamed: Callable[[str], str] = str
    ):
        self.path = path
        self.ignored: list[str] = []
        self._bytes = 0  # of the arrays up to here, in memory
        members: dict[str, zipfile.ZipInfo] = {}
        try:
            with zipfile.ZipFile(path) as archive:
                for info in archive.infolist():
                    name = renamed(info.filename.removesuffix(".npy"))
                    if name in members:
                        raise self.refusal("duplicate-column", f"the array {name!r} occurs twice: keep one")
                    if name in numbers or name in texts:
                        members[name] = info
                    else:
                        self.ignored.append(name)
                self.arrays: dict[str, np.ndarray] = {}
                for name, info in members.items():
                    with archive.open(info) as file:
                        self.arrays[name] = self._read(name, file, info.file_size, "fiu" if name in numbers else "US")
        except DAMAGE as error:
            raise self.refusal("damaged", f"the archive is damaged ({reason(error)}): copy or save it again") from error

    def numbers(self, name: str) -> np.ndarray:
        """An array of numbers, float64.

        Raises:
            RecordingError: It is missing.
        """
        return float_array(self._array(name))

    def texts(self, name: str) -> tuple[str, ...]:
        """An array of texts.

        Raises:
            RecordingError: It is missing, or not one-dimensional.
        """
        array = self._array(name)
        if array.ndim != 1:
            raise self.refusal("shape", f"{name} must be a list of names, it has shape {array.shape}")
        return tuple(map(_decoded, array.tolist()))

    def text(self, name: str) -> str:
        """A single text.

        Raises:
            RecordingError: It is missing, or not a single text.
        """
        array = self._array(name)
        if array.ndim != 0:
            raise self.refusal("shape", f"{name} must be a single text, it has shape {array.shape}")
        return _decoded(array.item())

    def refusal(self, code: str, text: str) -> RecordingError:
        """The error that refuses this archive."""
        return refusal(self.path, code, text)

    def _array(self, name: str) -> np.ndarray:
        if name not in self.arrays:
            raise self.refusal("missing-array", f"there is no array {name!r}, there is {', '.join(self.arrays)}")
        return self.arrays[name]

    def _read(self, name: str, file: IO[bytes], size: int, kinds: str) -> np.ndarray:
        """An array whose header agrees with its size in the file, and which does not fill the memory."""
        is_first = np.lib.format.read_magic(file) == (1, 0)
        length = file.read(2 if is_first else 4)
        header = length + file.read(int.from_bytes(length, "little"))
        shape, is_fortran, dtype = _parsed_header(is_first, header)
        if dtype.hasobject:
            text = f"the array {name!r} holds Python objects, which are not opened (they can run code): save numbers"
            raise self.refusal("pickle", text)
        if dtype.kind not in kinds:
            wanted = "text" if kinds == "US" else "real numbers"
            raise self.refusal("not-a-number", f"the array {name!r} holds {dtype}, {wanted} are needed")
        if dtype.itemsize > 4 * LONGEST_TEXT or any(n < 0 for n in shape):
            raise self.refusal("shape", f"the array {name!r} has shape {shape} of {dtype}: save it again")
        count, there = math.prod(shape), size - file.tell()
        if count * dtype.itemsize != there:
            said = f"asks for {count * dtype.itemsize:,} bytes (shape {shape}), it has {there:,}: save it again"
            raise self.refusal("damaged", f"the array {name!r} {said}")
        if len(shape) == 2:
            check_columns(self.path, f"the array {name!r}", shape[1])
        self._bytes += count * (8 if kinds == "fiu" else dtype.itemsize)  # numbers become float64
        if self._bytes > LARGEST_ARRAYS:
            said = f"the arrays have {self._bytes:,} bytes, more than {LARGEST_ARRAYS:,}: split the recording"
            raise self.refusal("too-large", said)
        # the size of the file counts, for arrays may share packed bytes
        if self._bytes > most_bytes(packed := self.path.stat().st_size):
            raise bomb(self.path, f"its {packed:,} bytes unpack to {self._bytes:,}")
        content = file.read(there + 1)  # at the end, the checksum is compared
        if len(content) != there:
            raise self.refusal("damaged", f"the array {name!r} ends too early: copy or save it again")
        flat = np.frombuffer(content, dtype) if content else np.zeros(count, dtype)
        return flat.reshape(shape, order="F" if is_fortran else "C")


@functools.lru_cache(maxsize=256)
def _parsed_header(is_first: bool, content: bytes) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, order and type; arrays of the same shape share them, and parsing takes longer than reading a small one."""
    parse = np.lib.format.read_array_header_1_0 if is_first else np.lib.format.read_array_header_2_0
    return parse(io.BytesIO(content))


def _decoded(value: str | bytes) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _check_shapes(archive: NpzArchive) -> None:
    for name in ("time", "q"):
        if name not in archive.arrays:
            near = closest_names(name, archive.ignored)
            hint = ""
            if near:
                python, flag = f"rename={{{near[0]!r}: {name!r}}}", f"--rename {near[0]}={name}"
                hint = advice(f"; if {near[0]!r} is meant: {{}}", python, flag)
            there = ", ".join(map(repr, [*archive.arrays, *archive.ignored]))
            raise archive.refusal("missing-array", f"there is no array {name!r}; there is {there}{hint}")
    shapes = {name: array.shape for name, array in archive.arrays.items()}
    time, q = shapes["time"], shapes["q"]
    if len(time) != 1 or len(q) != 2 or q[0] != time[0]:
        raise archive.refusal("shape", f"time must have shape (T,) and q (T, n); they have {time} and {q}")
    for name in ("u", "effort", "wrench"):
        shape = shapes.get(name, q)
        if len(shape) != 2 or shape[0] != time[0]:
            said = f"{name} must have shape ({time[0]}, n), it has {shape}: one row per time stamp"
            raise archive.refusal("shape", said)
    if "effort" in shapes and shapes["effort"] != shapes.get("u", q):
        raise archive.refusal("shape", f"effort has shape {shapes['effort']}: one column per joint is needed")
    if "wrench" in shapes and shapes["wrench"][1] != 6:
        raise archive.refusal("shape", f"wrench has shape {shapes['wrench']}: three forces and torques are needed")


def _joint_names(archive: NpzArchive, request: ReadRequest) -> tuple[str, ...]:
    columns = archive.arrays["q"].shape[1]
    width = archive.arrays["u"].shape[1] if "u" in archive.arrays else columns
    if "joint_names" in archive.arrays:
        names = tuple(request.renamed(n) for n in archive.texts("joint_names"))
    elif request.joint_names is not None:
        request.uses.use("joint_names")
        names = request.joint_names
    else:
        raise archive.refusal(
            "no-joint-names",
            f"the archive has no 'joint_names' for the {counted(columns, 'column')} of q: save them"
            + advice(", or pass {} in the order of the columns", "joint_names=[...]", "--joint-names NAME,NAME,..."),
        )
    if len(names) != width:
        raise archive.refusal(
            "shape", f"there are {len(names)} joint names for {counted(width, 'column')}: one name per column is needed"
        )
    return names
