"""NumPy archives, array by array: sizes are known from the headers before anything is read; no pickles are opened."""

from __future__ import annotations

import functools
import io
import math
import zipfile
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, final

import numpy as np

from manip_learn.errors import DAMAGE, RecordingError, advice, closest_names, counted
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording import Recording, bomb, float_array, most_bytes, reason, refusal
from manip_learn.recordings.saved_motion import joint_positions

LARGEST = 16_000_000_000  # bytes of all arrays together
LONGEST_TEXT = 1_000_000  # characters of one text
SMALL = 4_000_000  # bytes, packed and unpacked, of an archive that is read at once


@final
@dataclass(frozen=True)
class ArrayHeader:
    """What an array in the archive says about itself."""

    shape: tuple[int, ...]
    dtype: np.dtype
    fortran_order: bool

    @property
    def bytes(self) -> int:
        """In memory, numbers as float64."""
        return math.prod(self.shape) * (8 if self.dtype.kind in "fiu" else self.dtype.itemsize)


@final
class NpzArchive:
    """An archive whose headers were read, and whose size was checked; `read` then reads one array.

    Args:
        path: File.
        numbers: Names of arrays of numbers.
        texts: Names of arrays of text.
        renamed: Name in the file -> name in `numbers` or `texts`.

    Attributes:
        ignored: Names of arrays that were not asked for.

    Raises:
        RecordingError: Damaged, arrays of objects (pickles), text for numbers, a bomb, an array that occurs twice.
    """

    def __init__(
        self, path: Path, numbers: Collection[str], texts: Collection[str], renamed: Callable[[str], str] = str
    ):
        self.path = path
        self._members: dict[str, zipfile.ZipInfo] = {}
        self.headers: dict[str, ArrayHeader] = {}
        self.ignored: list[str] = []
        self._contents: dict[str, bytes] = {}
        try:
            size = path.stat().st_size
            with zipfile.ZipFile(path) as archive:
                self._find(archive, {*numbers, *texts}, renamed)
                small = max(size, sum(info.file_size for info in self._members.values())) <= SMALL
                for name, info in self._members.items():
                    if small:
                        self._contents[name] = archive.read(info)
                    self.headers[name] = self._header(name, info.file_size, "fiu" if name in numbers else "US")
        except DAMAGE as error:
            raise self._damaged(error) from error
        self._check_size(size)

    def __contains__(self, name: str) -> bool:
        return name in self._members

    @property
    def names(self) -> tuple[str, ...]:
        """Arrays that were asked for and are there."""
        return tuple(self._members)

    def shape(self, name: str) -> tuple[int, ...]:
        """Of an array, without reading it."""
        return self.headers[name].shape

    def numbers(self, name: str) -> np.ndarray:
        """An array of numbers, float64.

        Raises:
            RecordingError: Damaged or missing.
        """
        return float_array(self._read(name))

    def texts(self, name: str) -> tuple[str, ...]:
        """An array of texts.

        Raises:
            RecordingError: Damaged or missing, or not one-dimensional.
        """
        array = self._read(name)
        if array.ndim != 1:
            raise self.refusal("shape", f"{name} must be a list of names, it has shape {array.shape}")
        return tuple(map(_decoded, array.tolist()))

    def text(self, name: str) -> str:
        """A single text.

        Raises:
            RecordingError: Damaged or missing, or not a single text.
        """
        array = self._read(name)
        if array.ndim != 0:
            raise self.refusal("shape", f"{name} must be a single text, it has shape {array.shape}")
        return _decoded(array.item())

    def refusal(self, code: str, text: str) -> RecordingError:
        """The error that refuses this archive."""
        return refusal(self.path, code, text)

    def _find(self, archive: zipfile.ZipFile, wanted: Collection[str], renamed: Callable[[str], str]) -> None:
        for info in archive.infolist():
            name = renamed(info.filename.removesuffix(".npy"))
            if name in self._members:
                raise self.refusal("duplicate-column", f"the array {name!r} occurs twice: keep one")
            if name in wanted:
                self._members[name] = info
            else:
                self.ignored.append(name)

    def _header(self, name: str, size: int, kinds: str) -> ArrayHeader:
        with self._opened(name) as file:
            header = _parse_header(file)
            data_bytes = size - file.tell()
        if header.dtype.hasobject:
            raise self.refusal(
                "pickle",
                f"the array {name!r} holds Python objects, which are not opened (they can run code): save numbers",
            )
        if header.dtype.kind not in kinds:
            wanted = "text" if kinds == "US" else "real numbers"
            raise self.refusal("not-a-number", f"the array {name!r} holds {header.dtype}, {wanted} are needed")
        if header.dtype.itemsize > 4 * LONGEST_TEXT or any(n < 0 for n in header.shape):
            raise self.refusal("shape", f"the array {name!r} has shape {header.shape} of {header.dtype}: save it again")
        need = math.prod(header.shape) * header.dtype.itemsize
        if need != data_bytes:
            raise self.refusal(
                "damaged",
                f"the array {name!r} asks for {need:,} bytes (shape {header.shape}), it has {data_bytes:,}: save it "
                "again",
            )
        return header

    def _check_size(self, packed: int) -> None:
        """Refuse what would fill the memory; the size of the file counts, for arrays may share packed bytes."""
        total = sum(h.bytes for h in self.headers.values())
        if total > LARGEST:
            raise self.refusal(
                "too-large", f"the arrays have {total:,} bytes, more than {LARGEST:,}: split the recording"
            )
        if total > most_bytes(packed):
            raise bomb(self.path, f"its {packed:,} bytes unpack to {total:,}")

    def _read(self, name: str) -> np.ndarray:
        if name not in self._members:
            raise self.refusal("missing-array", f"there is no array {name!r}, there is {', '.join(self.names)}")
        header = self.headers[name]
        count = math.prod(header.shape)
        try:
            with self._opened(name) as file:
                _parse_header(file)
                content = file.read(count * header.dtype.itemsize + 1)
            if len(content) != count * header.dtype.itemsize:
                raise self.refusal("damaged", f"the array {name!r} ends too early: copy or save it again")
            flat = np.frombuffer(content, dtype=header.dtype, count=count) if content else np.zeros(count, header.dtype)
            return flat.reshape(header.shape, order="F" if header.fortran_order else "C")
        except DAMAGE as error:
            raise self._damaged(error) from error

    @contextmanager
    def _opened(self, name: str) -> Iterator[IO[bytes]]:
        if name in self._contents:
            yield io.BytesIO(self._contents[name])
        else:
            with zipfile.ZipFile(self.path) as archive, archive.open(self._members[name]) as packed:
                yield packed

    def _damaged(self, error: Exception) -> RecordingError:
        return self.refusal("damaged", f"the archive is damaged ({reason(error)}): copy or save it again")


def _decoded(value: str | bytes) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _parse_header(file: IO[bytes]) -> ArrayHeader:
    version = np.lib.format.read_magic(file)
    width = 2 if version == (1, 0) else 4
    length = file.read(width)
    text = file.read(int.from_bytes(length, "little")) if len(length) == width else b""
    return _parsed_header(version == (1, 0), length + text)


@functools.lru_cache(maxsize=256)
def _parsed_header(is_first: bool, content: bytes) -> ArrayHeader:
    """What follows the magic number; arrays of the same shape share it, and parsing it costs more than reading them."""
    file = io.BytesIO(content)
    parse = np.lib.format.read_array_header_1_0 if is_first else np.lib.format.read_array_header_2_0
    shape, fortran_order, dtype = parse(file)
    return ArrayHeader(tuple(shape), dtype, fortran_order)


NUMBERS = ("time", "q", "u", "effort", "wrench")


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
    q = joint_positions(path, arrays["q"], names, request.robot)
    u, effort = arrays.get("u"), arrays.get("effort")
    also = {"wrench": arrays.get("wrench"), "notes": tuple(notes)}
    yield Recording.of(path, path.name, arrays["time"], names, q, u, effort, **also)


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
    for name in ("u", "effort", "wrench"):
        shape = archive.shape(name) if name in archive else q
        if len(shape) != 2 or shape[0] != time[0]:
            raise archive.refusal(
                "shape", f"{name} must have shape ({time[0]}, n), it has {shape}: one row per time stamp"
            )
    if "effort" in archive and archive.shape("effort") != archive.shape("u" if "u" in archive else "q"):
        raise archive.refusal("shape", f"effort has shape {archive.shape('effort')}: one column per joint is needed")
    if "wrench" in archive and archive.shape("wrench")[1] != 6:
        raise archive.refusal(
            "shape", f"wrench has shape {archive.shape('wrench')}: three forces and torques are needed"
        )


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
