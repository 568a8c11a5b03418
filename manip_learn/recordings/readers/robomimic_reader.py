"""robomimic HDF5: `data/demo_N/obs/robot0_joint_pos`, one recording per demonstration.

Links and data outside of the file are not followed. The file names no joints, so the caller must.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from manip_learn.errors import DAMAGE, MissingExtraError, advice
from manip_learn.recordings.readers.array_reader import column_names, hdf5_recordings, numbers
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording import Recording, natural_order, reason, refusal

try:
    import h5py
except ImportError as error:
    raise MissingExtraError("reading robomimic data", "robomimic") from error

POSITION, VELOCITY = "robot0_joint_pos", "robot0_joint_vel"
EFFORTS = ("robot0_joint_effort", "robot0_joint_torque", "robot0_joint_torques")


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """One recording per demonstration; one in memory at a time."""
    try:
        with h5py.File(path, "r") as file:
            link = file.get("data", getlink=True)
            data = _member(path, file, "data", h5py.Group) if link is not None else {}
            demos = sorted((n for n in data if n.startswith("demo")), key=natural_order)
            if not demos:  # of any other layout
                yield from hdf5_recordings(path, file, request)
                return
            rate, note = _rate(path, data, request)
            _refuse_lost(path, "data", len(demos), "demonstrations", data, "num_demos")
            total = 0
            for name in demos:
                recording = _recording(path, data, name, request, rate, note)
                total += len(recording.time)
                yield recording
            _refuse_lost(path, "data", total, "samples", data, "total")
    except DAMAGE as error:
        said = f"the HDF5 file cannot be read ({reason(error)}): download or write it again"
        raise refusal(path, "damaged", said) from error


def _recording(path: Path, data: Any, name: str, request: ReadRequest, rate: float, note: str) -> Recording:
    demo = _member(path, data, name, h5py.Group)
    if "obs" not in demo:
        text = f"{name} has no group 'obs': extract observations first (robomimic's dataset_states_to_obs.py)"
        raise refusal(path, "no-state", text)
    obs = _member(path, demo, "obs", h5py.Group)
    positions = _matrix(path, _member(path, obs, POSITION, h5py.Dataset), f"{name}/obs/{POSITION}")
    names = request.renamed(*column_names(path, POSITION, positions.shape[1], None, request))
    _refuse_lost(path, f"data/{name}", positions.shape[0], "samples", demo, "num_samples")
    velocities = efforts = None
    for effort in (e for e in EFFORTS if e in obs):
        efforts = _matrix(path, _member(path, obs, effort, h5py.Dataset), f"{name}/obs/{effort}")
        efforts = efforts if efforts.shape == positions.shape else None
    if VELOCITY in obs:
        velocities = _matrix(path, _member(path, obs, VELOCITY, h5py.Dataset), f"{name}/obs/{VELOCITY}")
        if velocities.shape != positions.shape:
            raise refusal(
                path, "shape", f"{name}: velocities have shape {velocities.shape}, positions {positions.shape}"
            )
    time, known = np.arange(positions.shape[0]) / rate, {"strict_columns": False, "in_seconds": True, "notes": (note,)}
    return Recording.of(path, f"{path.name} {name}", time, names, positions, velocities, efforts, **known)


def _refuse_lost(path: Path, where: str, found: int, what: str, group: Any, attribute: str) -> None:
    """Refuse a group that states another number than what was found in it."""
    stated = group.attrs.get(attribute)
    if isinstance(stated, int | np.integer) and int(stated) != found:
        raise refusal(
            path,
            "lost-samples",
            f"{found} {what} are there, the attribute {attribute!r} of {where!r} states {int(stated)}: the file is "
            "damaged or was edited; download it again, or correct the attribute",
        )


def _member(path: Path, group: Any, name: str, kind: type) -> Any:
    """A member of a group that is stored in this very file."""
    link = group.get(name, getlink=True)
    if link is None:
        text = f"there is no {name!r} in {group.name!r}, only {', '.join(list(group)[:8]) or 'nothing'}"
        raise refusal(path, "not-robomimic", text)
    if not isinstance(link, h5py.HardLink):
        target = getattr(link, "filename", "") or link.path
        raise refusal(
            path,
            "link",
            f"{group.name.rstrip('/')}/{name} is a link to {target!r}; links are not followed (they can point at any "
            "file): copy the data into the file, with h5py's copy(expand_external=True)",
        )
    member = group[name]
    if not isinstance(member, kind):
        raise refusal(path, "not-robomimic", f"{member.name} is a {type(member).__name__}, not a {kind.__name__}")
    return member


def _matrix(path: Path, dataset: Any, where: str) -> np.ndarray:
    if dataset.dtype.kind in "fiu" and dataset.ndim != 2:
        raise refusal(path, "shape", f"{where} must have shape (T, n), it has {dataset.shape}")
    return numbers(path, dataset, where)


def _rate(path: Path, data: Any, request: ReadRequest) -> tuple[float, str]:
    if request.rate is not None:
        request.uses.use("rate")
        return request.rate, f"no time stamps in the file: {request.rate:g} samples per second, as asked"
    text = data.attrs.get("env_args")
    try:
        env = json.loads(text) if isinstance(text, str | bytes) else {}
        frequency = env["env_kwargs"]["control_freq"]
        rate = float(frequency)
    except (ValueError, KeyError, TypeError, RecursionError):
        rate = 0.0
    if not (math.isfinite(rate) and rate > 0):
        raise refusal(
            path,
            "no-time",
            "neither time stamps nor a control_freq in env_args are in the file: "
            + advice("pass {}", "rate=<samples per second>", "--rate <samples per second>"),
        )
    return rate, f"no time stamps in the file: {rate:g} samples per second, from control_freq in env_args"
