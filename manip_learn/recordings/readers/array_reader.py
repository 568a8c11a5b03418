"""Arrays that are known by their names: MATLAB files and HDF5 files of any layout, and what NumPy archives share.

One group (of a struct, an HDF5 group, an archive) that holds joint positions is one recording. Which array is which is
said by its name, in the words that columns of tables have; where that leaves a choice, the caller says so.
"""

from __future__ import annotations

import math
import re
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from manip_learn.errors import DAMAGE, MissingExtraError, RecordingError, advice, closest_names, counted
from manip_learn.recordings.readers.limits import LARGEST_ARRAYS, bomb, check_columns, most_bytes
from manip_learn.recordings.readers.name_patterns import named_in
from manip_learn.recordings.readers.quantities import ROLES, array_roles, find_time
from manip_learn.recordings.readers.read_request import ReadRequest, first_names, names_advice, rename_words
from manip_learn.recordings.readers.recording import Recording, float_array, natural_order, reason, refusal
from manip_learn.recordings.saved_motion import joint_positions

NUMBERS = ("time", "q", "u", "effort")
SHOWN = 8  # names in a sentence
MOST_ARRAYS = 100_000  # of one file, which are listed before any is read
HEADER_BYTES, COMPRESSED = 128, 15  # of a MATLAB file: before its first element; the type of a packed one

Load = Callable[[Mapping[str, str]], dict[str, Any]]  # what arrays are -> their names in the file; the arrays


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """The recordings of a MATLAB file, each struct or cell with joint positions one.

    Raises:
        RecordingError: Damaged, a bomb, or without joint positions.
        MissingExtraError: Version 7.3, which is HDF5, without the extra `robomimic`.
    """
    with path.open("rb") as file:
        is_hdf5 = b"MATLAB 7.3" in file.read(HEADER_BYTES)
    if is_hdf5:
        try:
            import h5py
        except ImportError as error:
            raise MissingExtraError("reading MATLAB 7.3 files", "robomimic") from error
        try:
            with h5py.File(path, "r") as opened:
                yield from hdf5_recordings(path, opened, request)
        except DAMAGE as error:
            said = f"the file cannot be read ({reason(error)}): save it again"
            raise refusal(path, "damaged", said) from error
        return
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    leaves: dict[str, Any] = {}
    try:
        _refuse_bomb(path)
        with warnings.catch_warnings(action="ignore"):  # of variables that cannot be read or occur twice
            content = loadmat(path, simplify_cells=True)
        for name, value in content.items():
            if not name.startswith("__"):
                _flatten(name, value, leaves)
    except (MatReadError, *DAMAGE) as error:
        said = f"the MATLAB file cannot be read ({reason(error)}): save it again"
        raise refusal(path, "damaged", said) from error
    yield from recordings(path, list(leaves), lambda roles: {r: leaves[n] for r, n in roles.items()}, request)


def _refuse_bomb(path: Path) -> None:
    """Refuse packed elements that unpack to far too much."""
    content, at, total, most = path.read_bytes(), HEADER_BYTES, 0, most_bytes(path.stat().st_size)
    order = "little" if content[HEADER_BYTES - 2 : HEADER_BYTES] == b"IM" else "big"
    while at + 8 <= len(content):
        kind, size = (int.from_bytes(content[at + k : at + k + 4], order) for k in (0, 4))
        if kind == COMPRESSED:
            total += len(zlib.decompressobj().decompress(content[at + 8 : at + 8 + size], most + 1))
        if total > most:
            raise bomb(path, f"its {len(content):,} bytes unpack to more than {most:,}")
        at += 8 + size


def _flatten(name: str, value: Any, leaves: dict[str, Any]) -> None:
    """Arrays of a MATLAB variable, by the names of the fields and the numbers of the cells in which they are."""
    if len(leaves) > MOST_ARRAYS:
        raise ValueError(f"it holds more than {MOST_ARRAYS:,} arrays")
    is_cell = isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object)
    if isinstance(value, dict):
        for key, inner in value.items():
            _flatten(f"{name}/{key}", inner, leaves)
    elif is_cell and len(value) and all(isinstance(inner, str) for inner in value):
        leaves[name] = tuple(value)
    elif is_cell:
        for number, inner in enumerate(np.ravel(value) if isinstance(value, np.ndarray) else value):
            _flatten(f"{name}/{number}", inner, leaves)
    elif isinstance(value, np.ndarray) and value.dtype.kind in "fiu" and value.ndim in (1, 2):
        leaves[name] = value


def hdf5_recordings(path: Path, file: Any, request: ReadRequest) -> Iterator[Recording]:
    """The recordings of an open HDF5 file; links are not followed."""
    import h5py

    sets: dict[str, Any] = {}

    def note(name: str, member: Any) -> None:
        if isinstance(member, h5py.Dataset) and member.dtype.kind in "fiu" and member.ndim in (1, 2):
            sets[name] = member
        if len(sets) > MOST_ARRAYS:
            raise refusal(path, "too-large", f"it holds more than {MOST_ARRAYS:,} arrays: split it")

    file.visititems(note)

    def load(roles: Mapping[str, str]) -> dict[str, Any]:
        arrays = {role: numbers(path, sets[name], name) for role, name in roles.items() if role in NUMBERS}
        # MATLAB stores columns one after the other
        return {r: array.T if "MATLAB_class" in sets[roles[r]].attrs else array for r, array in arrays.items()}

    yield from recordings(path, list(sets), load, request)


def numbers(path: Path, dataset: Any, where: str) -> Float[np.ndarray, "..."]:
    """A data set of HDF5 that is stored in this very file, as float64.

    Raises:
        RecordingError: Stored elsewhere, no numbers, too large.
    """
    if dataset.is_virtual or dataset.external:
        text = f"{where} is stored in other files, which are not opened: copy the data into the file"
        raise refusal(path, "link", text)
    if dataset.dtype.kind not in "fiu":
        raise refusal(path, "not-a-number", f"{where} holds {dataset.dtype}, numbers are needed")
    check_columns(path, where, dataset.shape[1] if dataset.ndim == 2 else 1)
    need, stored = math.prod(dataset.shape) * dataset.dtype.itemsize, dataset.id.get_storage_size()
    if need and not stored:
        raise refusal(path, "damaged", f"{where} has shape {dataset.shape}, but no numbers are stored")
    if need > LARGEST_ARRAYS:
        raise refusal(path, "too-large", f"{where} has {need:,} bytes, more than {LARGEST_ARRAYS:,}: split it")
    if need > most_bytes(stored):
        raise bomb(path, f"{where} claims {need:,} bytes, {stored:,} are stored")
    return float_array(dataset[()])


def recordings(path: Path, names: Sequence[str], load: Load, request: ReadRequest) -> Iterator[Recording]:
    """One recording for each group of arrays with joint positions.

    Args:
        path: The file.
        names: Of all its arrays, with the groups around them: `demos/0/q`.
        load: What arrays are -> their names in the file; gives the arrays, and the names of joints as texts.
        request: How it is read.

    Raises:
        RecordingError: No joint positions, or arrays whose shapes do not fit.
    """
    renamed = dict(zip(names, request.renamed(*names), strict=True))
    last = {n: n.rpartition("/")[2] for n in names}
    of_last = dict(zip(last.values(), request.renamed(*last.values()), strict=True))
    groups: dict[str, dict[str, str]] = {}
    for name in names:
        called = renamed[name] if renamed[name] != name else of_last[last[name]]
        if not request.ignores(name, called):
            groups.setdefault(name.rpartition("/")[0], {})[called] = name
    chosen = {}
    for group in sorted(groups, key=natural_order):
        with named_in(path):
            roles = {role: groups[group][called] for role, called in array_roles(list(groups[group])).items()}
        if "q" not in roles:
            continue
        outer = group
        while "time" not in roles and outer:  # beside the group
            outer = outer.rpartition("/")[0]
            found = find_time(list(groups.get(outer, ())))
            roles |= {} if found.column is None else {"time": list(groups[outer].values())[found.column]}
        chosen[group] = roles
    if not chosen:
        raise _missing(path, [n for group in groups.values() for n in group])
    for group, roles in chosen.items():
        unused = [called for called, name in groups[group].items() if name not in roles.values()]
        notes = (
            [f"arrays not used: {', '.join(unused[:SHOWN])}{', ...' if len(unused) > SHOWN else ''}"] if unused else []
        )
        guessed = [f"{role} from {name!r}" for role, name in roles.items() if role not in groups[group]]
        notes += [f"read by the words in their names: {', '.join(guessed)}"] if guessed else []
        title = f"{path.name} {group}" if len(chosen) > 1 else path.name
        yield _recording(path, title, roles, load, request, notes)


def _missing(path: Path, there: Sequence[str]) -> RecordingError:
    likely = [n for n in there if n not in ROLES and re.search(r"joint|state|pos|angle|theta|meas", n, re.IGNORECASE)]
    name = (closest_names("q", there)[:1] or likely or ["NAME"])[0]
    what = f"if {name!r} is meant" if name != "NAME" else "the one with joint positions is read with"
    hint = advice(f"; {what}: {{}}", *rename_words({name: "q"}))
    return refusal(path, "missing-array", f"there is no array 'q'; there is {first_names(there)}{hint}")


def _recording(
    path: Path, title: str, roles: dict[str, str], load: Load, request: ReadRequest, notes: list[str]
) -> Recording:
    """The recording in some arrays, one row per sample."""
    stored = load(roles)
    arrays = {role: float_array(array) for role, array in stored.items() if role in NUMBERS}
    for role, array in arrays.items():
        if (kind := np.asarray(stored[role]).dtype) != np.dtype(np.float64):
            notes.append(f"{role} is stored as {kind.str}, read as float64")
        if role != "time" and array.ndim == 1:
            arrays[role] = array[:, None]
    q = arrays["q"]
    if "time" in arrays and arrays["time"].ndim == 2 and 1 in arrays["time"].shape:  # as MATLAB keeps vectors
        arrays["time"] = arrays["time"].ravel()
    T = len(arrays["time"]) if "time" in arrays else max(q.shape)
    if q.shape[0] != T == q.shape[1]:
        arrays |= {role: array.T for role, array in arrays.items() if role != "time" and array.shape[-1] == T}
        notes.append("one column per sample: read as one row per sample")
    q = arrays["q"]
    # postures of continuous joints have more numbers than velocities
    width = arrays["u"].shape[1] if "u" in arrays and request.joint_names is None else q.shape[1]
    names = request.renamed(*column_names(path, "q", width, stored.get("joint_names"), request))
    if "time" not in arrays and "time" in names:
        arrays["time"] = q[:, names.index("time")]
    if "time" not in arrays:
        if request.rate is None:
            raise _no_time(path, roles)
        arrays["time"] = request.counted(len(q))
    _check_shapes(path, arrays)
    kept = [i for i, n in enumerate(names) if n != "time"]
    names = tuple(names[i] for i in kept)
    if len(kept) < q.shape[1] and q.shape[1] == len(kept) + 1:
        q = q[:, kept]
    q = joint_positions(path, q, names, request.robot)
    beside = (arrays.get("u"), arrays.get("effort"))
    return Recording.of(path, title, arrays["time"], names, q, *beside, notes=tuple(notes))


def _no_time(path: Path, roles: Mapping[str, str]) -> RecordingError:
    how = advice("pass {}", "rate=<samples per second>", "--rate <samples per second>")
    how += advice("; or, where another array holds the stamps, {}", "rename={NAME: 'time'}", "--rename NAME=time")
    there = first_names(list(roles.values()))
    return refusal(path, "missing-array", f"there is no array 'time' beside {there}: {how or 'add the stamps'}")


def _check_shapes(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    shapes = {role: array.shape for role, array in arrays.items()}
    time, q = shapes["time"], shapes["q"]
    if len(time) != 1 or len(q) != 2 or q[0] != time[0]:
        raise refusal(path, "shape", f"time must have shape (T,) and q (T, n); they have {time} and {q}")
    for role in ("u", "effort"):
        shape = shapes.get(role, q)
        if len(shape) != 2 or shape[0] != time[0]:
            leave = advice("; or leave it out with {}", f"ignore_columns=[{role!r}]", f"--ignore-column {role}")
            said = f"{role} must have shape ({time[0]}, n), it has {shape}: one row per time stamp{leave}"
            raise refusal(path, "shape", said)
    if "effort" in shapes and shapes["effort"] != shapes.get("u", q):
        raise refusal(path, "shape", f"effort has shape {shapes['effort']}: one column per joint is needed")


def column_names(
    path: Path, what: str, width: int, stored: tuple[str, ...] | None, request: ReadRequest
) -> tuple[str, ...]:
    """One name for each column of an array: the caller's, who knows better, else those in the file.

    Raises:
        RecordingError: No names, or another number of them.
    """
    names = stored if request.joint_names is None else request.joint_names
    request.uses.use("joint_names")
    how = names_advice(width, request.robot)
    if names is None:
        said = f"nothing names the {counted(width, 'column')} of {what}: save names with them"
        raise refusal(path, "no-joint-names", said + how)
    if len(names) != width:
        said = (
            f"there are {len(names)} joint names for the {counted(width, 'column')} of {what}: one for each is needed"
        )
        raise refusal(path, "shape", said + how)
    return names
