"""Arrays that are known by their names: MATLAB files, and what HDF5 files and NumPy archives share with them.

One group (of a struct, an HDF5 group, an archive) that holds joint positions is one recording. Which array is which is
said by its name, in the words that columns of tables have; where that leaves a choice, the caller says so.
"""

from __future__ import annotations

import re
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from manip_learn.errors import advice, closest_names, counted
from manip_learn.recordings.readers.name_patterns import named_in
from manip_learn.recordings.readers.quantities import ROLES, array_roles, find_time
from manip_learn.recordings.readers.read_request import RATE, ReadRequest, first_names, names_advice, rename_words
from manip_learn.recordings.readers.recording import (
    Recording,
    bomb,
    float_array,
    most_bytes,
    natural_order,
    refusal,
    refusing_damage,
)
from manip_learn.recordings.saved_motion import joint_positions

NUMBERS = ("time", "q", "u", "effort")
_SHOWN = 8  # names in a sentence
LIKELY = re.compile(r"joint|state|pos|angle|theta|meas", re.IGNORECASE)  # in names of what may be joint positions
MOST_ARRAYS = 100_000  # of one file, which are listed before any is read
HEADER_BYTES, COMPRESSED = 128, 15  # of a MATLAB file: before its first element; the type of a packed one

Load = Callable[[Mapping[str, str]], dict[str, Any]]  # what arrays are -> their names in the file; the arrays


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """The recordings of a MATLAB file of version 5, each struct or cell with joint positions one.

    Raises:
        RecordingError: Damaged, a bomb, or without joint positions.
    """
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    leaves: dict[str, Any] = {}
    with refusing_damage(path, MatReadError):
        content, at, total, most = path.read_bytes(), HEADER_BYTES, 0, most_bytes(path.stat().st_size)
        order = "little" if content[HEADER_BYTES - 2 : HEADER_BYTES] == b"IM" else "big"
        while at + 8 <= len(content):
            kind, size = (int.from_bytes(content[at + k : at + k + 4], order) for k in (0, 4))
            if kind == COMPRESSED:
                total += len(zlib.decompressobj().decompress(content[at + 8 : at + 8 + size], most + 1))
            if total > most:
                raise bomb(path, f"its {len(content):,} bytes unpack to more than {most:,}")
            at += 8 + size
        with warnings.catch_warnings(action="ignore"):  # of variables that cannot be read or occur twice
            content = loadmat(path, simplify_cells=True)
        for name, value in content.items():
            if not name.startswith("__"):
                _flatten(name, value, leaves)
    yield from recordings(path, list(leaves), lambda roles: {r: leaves[n] for r, n in roles.items()}, request)


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
    groups = array_groups(path, names, request)
    if not groups:
        there = [n.rpartition("/")[2] for n in names]
        likely = [n for n in there if n not in ROLES and LIKELY.search(n)]
        name = (closest_names("q", there)[:1] or likely or ["NAME"])[0]
        what = f"if {name!r} is meant" if name != "NAME" else "the one with joint positions is read with"
        hint = advice(f"; {what}: {{}}", *rename_words({name: "q"}))
        raise refusal(path, "missing-array", f"there is no array 'q'; there is {first_names(there)}{hint}")
    for name, group in groups.items():
        yield group_recording(path, f"{path.name} {name}" if len(groups) > 1 else path.name, group, load, request)


@final
@dataclass(frozen=True)
class ArrayGroup:
    """Arrays that are one recording.

    Attributes:
        roles: What arrays are (see `ROLES`) -> their names in the file, with the groups around them.
        notes: What the caller should know.
    """

    roles: dict[str, str]
    notes: tuple[str, ...]


def array_groups(path: Path, names: Sequence[str], request: ReadRequest) -> dict[str, ArrayGroup]:
    """The groups with joint positions, in natural order of their names.

    Raises:
        RecordingError: Several arrays of one could be the positions.
    """
    renamed = dict(zip(names, request.renamed(*names), strict=True))
    last = {n: n.rpartition("/")[2] for n in names}
    of_last = dict(zip(last.values(), request.renamed(*last.values()), strict=True))
    groups: dict[str, dict[str, str]] = {}
    for name in names:
        called = renamed[name] if renamed[name] != name else of_last[last[name]]
        if not request.ignores(name, called):
            groups.setdefault(name.rpartition("/")[0], {})[called] = name
    found = {}
    for group in sorted(groups, key=natural_order):
        with named_in(path):
            roles = {role: groups[group][called] for role, called in array_roles(list(groups[group])).items()}
        outer = group if "q" in roles else ""
        while "time" not in roles and outer:  # beside the group
            outer = outer.rpartition("/")[0]
            stamps, _ = find_time(list(groups.get(outer, ())))
            roles |= {"time": list(groups[outer].values())[stamps[0]]} if len(stamps) == 1 else {}
        unused = [called for called, name in groups[group].items() if name not in roles.values()]
        more = ", ..." if len(unused) > _SHOWN else ""
        notes = [f"arrays not used: {', '.join(unused[:_SHOWN])}{more}"] if unused else []
        guessed = [f"{role} from {last[name]!r}" for role, name in roles.items() if role not in groups[group]]
        notes += [f"read by the words in their names: {', '.join(guessed)}"] if guessed else []
        if "q" in roles:
            found[group] = ArrayGroup(roles, tuple(notes))
    return found


def group_recording(path: Path, title: str, group: ArrayGroup, load: Load, request: ReadRequest) -> Recording:
    """The recording in some arrays, one row per sample."""
    notes, stored = list(group.notes), load(group.roles)
    arrays = {role: float_array(array) for role, array in stored.items() if role in NUMBERS}
    for role, array in arrays.items():
        if (kind := np.asarray(stored[role]).dtype) != np.dtype(np.float64):
            notes.append(f"{role} is stored as {kind.str}, read as float64")
        if role != "time" and array.ndim == 1:
            arrays[role] = array[:, None]
        elif role == "time" and array.ndim == 2 and 1 in array.shape:  # as MATLAB keeps vectors
            arrays[role] = array.ravel()
    T = len(arrays["time"]) if "time" in arrays else max(arrays["q"].shape)
    if arrays["q"].shape[0] != T == arrays["q"].shape[1]:
        arrays |= {role: array.T for role, array in arrays.items() if role != "time" and array.shape[-1] == T}
        notes.append("one column per sample: read as one row per sample")
    q = arrays["q"]
    # postures of continuous joints have more numbers than velocities
    width = arrays["u"].shape[1] if "u" in arrays and request.joint_names is None else q.shape[1]
    names = request.renamed(*column_names(path, "q", width, stored.get("joint_names"), request))
    if "time" not in arrays and "time" in names:
        arrays["time"] = q[:, names.index("time")]
    is_counted = "time" not in arrays and request.rate is not None
    if is_counted:
        arrays["time"] = request.counted(len(q))
    _check_shapes(path, arrays, group.roles)
    kept = [i for i, n in enumerate(names) if n != "time"]
    names = tuple(names[i] for i in kept)
    if len(kept) < q.shape[1] and q.shape[1] == len(kept) + 1:
        q = q[:, kept]
    q = joint_positions(path, q, names, request.robot)
    u, effort = arrays.get("u"), arrays.get("effort")
    in_seconds = is_counted and request.time_unit is None
    return Recording.of(path, title, arrays["time"], names, q, u, effort, in_seconds=in_seconds, notes=tuple(notes))


def _check_shapes(path: Path, arrays: Mapping[str, np.ndarray], roles: Mapping[str, str]) -> None:
    shapes = {role: array.shape for role, array in arrays.items()}
    if "time" not in shapes:
        how = advice("pass {}", *RATE)
        how += advice("; or, where another array holds the stamps, {}", "rename={NAME: 'time'}", "--rename NAME=time")
        text = f"there is no array 'time' beside {first_names(list(roles.values()))}: {how or 'add the stamps'}"
        raise refusal(path, "no-time", text)
    time, q = shapes["time"], shapes["q"]
    if len(time) != 1 or len(q) != 2 or q[0] != time[0]:
        raise refusal(path, "shape", f"time must have shape (T,) and q (T, n); they have {time} and {q}")
    width = shapes.get("u", q)[-1]
    for role in ("u", "effort"):
        shape = shapes.get(role, (*time, width))
        if len(shape) != 2 or shape != (*time, width):
            name = roles[role].rpartition("/")[2]
            leave = advice("; or leave it out with {}", f"ignore_columns=[{name!r}]", f"--ignore-column {name}")
            said = f"{role} must have one row per time stamp and one column per joint, {(*time, width)}; it has"
            raise refusal(path, "shape", f"{said} {shape}{leave}")


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
        said = f"there are {len(names)} joint names for the {counted(width, 'column')} of {what}: one for each is"
        raise refusal(path, "shape", f"{said} needed{how}")
    return names
