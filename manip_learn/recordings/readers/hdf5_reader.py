"""HDF5 of any layout, by the names of its arrays; of robomimic (`data/demo_N/obs`) what else it says of itself.

Links and data outside of the file are not followed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from manip_learn.errors import MissingExtraError, RecordingError
from manip_learn.recordings.readers.array_reader import MOST_ARRAYS, NUMBERS, array_groups, group_recording, recordings
from manip_learn.recordings.readers.read_request import ReadRequest, first_names
from manip_learn.recordings.readers.recording import (
    LARGEST_ARRAYS,
    Recording,
    bomb,
    check_columns,
    float_array,
    most_bytes,
    natural_order,
    refusal,
    refuse_lost,
    refusing_damage,
)
from manip_learn.robot.description.text import parsed_json

try:
    import h5py
except ImportError as error:
    raise MissingExtraError("reading HDF5 and MATLAB 7.3 files", "robomimic") from error

DEMONSTRATION = re.compile(r"data/demo[^/]*")  # of robomimic


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """The recordings of a file, each group with joint positions one; one in memory at a time."""
    members: dict[str, Any] = {}

    def note(name: str, link: Any) -> bool | None:
        members[name] = link
        return True if len(members) > MOST_ARRAYS else None  # the end

    def load(roles: Mapping[str, str]) -> dict[str, Any]:
        arrays = {role: _numbers(path, members[name], name) for role, name in roles.items() if role in NUMBERS}
        # MATLAB stores columns one after the other
        return {r: array.T if "MATLAB_class" in members[roles[r]].attrs else array for r, array in arrays.items()}

    # h5py says SystemError where it comes upon damage on its way through the links
    with refusing_damage(path, SystemError), h5py.File(path, "r") as file:
        if file.visititems_links(note):
            raise refusal(path, "too-large", f"it holds more than {MOST_ARRAYS:,} arrays: split it")
        members = {n: file[n] if isinstance(link, h5py.HardLink) else link for n, link in members.items()}
        names = [n for n, member in members.items() if _is_array(member)]
        if names and not any(isinstance(members[n], h5py.Dataset) for n in names):
            raise _elsewhere(path, names[0])
        demos = sorted(filter(DEMONSTRATION.fullmatch, members), key=natural_order)
        if demos:
            yield from _demonstrations(path, {n: members[n] for n in ("data", *demos)}, names, load, request)
        else:
            yield from recordings(path, names, load, request)


def _is_array(member: Any) -> bool:
    """Whether it is an array of numbers, or a link, behind which one may be."""
    if isinstance(member, h5py.Dataset):
        return member.dtype.kind in "fiu" and member.ndim in (1, 2)
    return not isinstance(member, h5py.Group | h5py.Datatype)


def _demonstrations(
    path: Path, groups: Mapping[str, Any], names: list[str], load: Any, request: ReadRequest
) -> Iterator[Recording]:
    """Those of robomimic: each must have positions, as many as are stated, at the rate that is stated."""
    data, *demos = groups
    found = array_groups(path, names, request)  # among them `next_obs`, which is `obs` once more and is not read
    for demo in demos:
        if f"{demo}/obs" not in found:
            there = first_names([n.removeprefix(f"{demo}/") for n in names if n.startswith(f"{demo}/")])
            how = "or, without 'obs', extract observations first (robomimic's dataset_states_to_obs.py)"
            text = f"{demo} has no array of joint positions in 'obs', there is {there}: download it again, {how}"
            raise refusal(path, "no-state", text)
    stated = groups[data].attrs
    refuse_lost(path, len(demos), "demonstrations", "data", "'num_demos'", stated.get("num_demos"))
    rate, total = _control_rate(stated.get("env_args")), 0
    for demo in demos:
        title, group, notes = f"{path.name} {demo.removeprefix('data/')}", found[f"{demo}/obs"], ()
        if request.rate is None and rate and "time" not in group.roles:
            notes = (f"no time stamps in the file: {rate:g} samples per second, from control_freq in env_args",)
        recording = group_recording(path, title, group, load, replace(request, rate=rate) if notes else request)
        n = len(recording.time)
        refuse_lost(path, n, "samples", demo, "'num_samples'", groups[demo].attrs.get("num_samples"))
        total += n
        yield replace(recording, strict_columns=False, notes=(*notes, *recording.notes))
    refuse_lost(path, total, "samples", "data", "'total'", stated.get("total"))


def _control_rate(text: Any) -> float:
    """`control_freq` in `env_args` [Hz]; 0 if it is not there."""
    try:
        env = parsed_json(text) if isinstance(text, str | bytes) else {}
        rate = float(env["env_kwargs"]["control_freq"])
    except (ValueError, KeyError, TypeError):
        return 0.0
    return rate if math.isfinite(rate) and rate > 0 else 0.0


def _elsewhere(path: Path, where: str) -> RecordingError:
    said = f"{where} is stored elsewhere, which is not opened (it could be any file): copy the data into the file"
    return refusal(path, "link", f"{said}, with h5py's copy(expand_external=True)")


def _numbers(path: Path, dataset: Any, where: str) -> Float[np.ndarray, "..."]:
    """A data set that is stored in this very file, as float64.

    Raises:
        RecordingError: Stored elsewhere, too large, or not stored.
    """
    if not isinstance(dataset, h5py.Dataset) or dataset.is_virtual or dataset.external:
        raise _elsewhere(path, where)
    check_columns(path, where, dataset.shape[1] if dataset.ndim == 2 else 1)
    need, stored = math.prod(dataset.shape) * dataset.dtype.itemsize, dataset.id.get_storage_size()
    if need and not stored:
        raise refusal(path, "damaged", f"{where} has shape {dataset.shape}, but no numbers are stored")
    if need > LARGEST_ARRAYS:
        raise refusal(path, "too-large", f"{where} has {need:,} bytes, more than {LARGEST_ARRAYS:,}: split it")
    if need > most_bytes(stored):
        raise bomb(path, f"{where} claims {need:,} bytes, {stored:,} are stored")
    return float_array(dataset[()])
