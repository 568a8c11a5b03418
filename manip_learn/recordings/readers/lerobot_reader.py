"""LeRobot data sets v2 and v3: the joint positions in `observation.state`, one recording per episode.

LeRobot does not store units, so the caller must state them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from manip_learn.errors import MissingExtraError, RecordingError, advice, counted
from manip_learn.recordings.format_words import DATASET_HEADER
from manip_learn.recordings.readers.array_reader import column_names
from manip_learn.recordings.readers.lerobot_dataset import (
    LeRobotDataset,
    beside,
    episode_number,
    open_dataset,
    opened_parquet,
    state_feature,
)
from manip_learn.recordings.readers.limits import check_columns, refuse_lost
from manip_learn.recordings.readers.quantities import Columns, entry_columns
from manip_learn.recordings.readers.read_request import RATE, ReadRequest, first_names
from manip_learn.recordings.readers.recording import Recording, float_array, refusal

try:
    import pyarrow as pa
except ImportError as error:
    raise MissingExtraError("reading LeRobot data", "lerobot") from error

BATCH = 65_536  # rows in memory: some 10 MB
STAMPS = ("timestamp", "frame_index", "episode_index")
FPS_OFF = 1.25  # times fps by which stamps may be off: dropped frames
GRIPPER = "gripper"  # always 0 .. 100 in LeRobot, whatever the unit of the other motors

# number of an episode, and its samples: `time`, `state`, and `velocity` and `effort` where they were recorded
Episode = tuple[int, dict[str, np.ndarray]]


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """One recording per episode; one episode in memory at a time."""
    dataset = open_dataset(path)
    is_ours = (path / DATASET_HEADER).is_file()
    if is_ours:  # in radians; its robot has been checked
        request = replace(request, units=request.units or "radians")
    feature, entries, others = state_feature(dataset, request.feature)
    request.uses.use("feature")
    said: tuple[str, ...] = ()
    if others:
        how = advice(" ({} reads it)", f"feature={others[0]!r}", f"--feature {others[0]}")
        said = (f"read from {feature}; also like joint positions, not used: {', '.join(others)}{how}",)
    names: tuple[str, ...] | None = None
    numbers, frames = set(), 0
    for number, columns in _episodes(dataset, feature, request):
        numbers.add(number)
        frames += len(columns["state"])
        if names is None:
            names = column_names(dataset.root, feature, columns["state"].shape[1], entries, request)
            if request.units is None:
                raise _unknown_units(dataset, names, entry_columns(names, request), columns["state"])
        recording = _recording(dataset, request, names, number, columns)
        yield replace(recording, trusted=is_ours, notes=(*recording.notes, *said))
    if request.chosen is None:
        dataset.refuse_lost("frames", frames)
        dataset.refuse_lost("episodes", len(numbers))


def _recording(
    dataset: LeRobotDataset, request: ReadRequest, names: tuple[str, ...], number: int, columns: dict[str, np.ndarray]
) -> Recording:
    state, entries = columns["state"], entry_columns(names, request)
    position_names = tuple(entries.positions.values())
    positions, notes = _gripper(state[:, list(entries.positions)], position_names, request)
    if any(names[i].endswith(".pos") and names[i] != n for i, n in entries.positions.items()):
        notes.insert(0, "'.pos' was taken off the names")
    values = {}  # in the state; where that holds positions alone, in features of their own
    for kind, part in (("velocity", entries.velocities), ("effort", entries.efforts)):
        own = columns.get(kind) if len(position_names) == len(names) else None
        if own is not None and own.shape != state.shape:
            notes.append(f"the {kind} has {own.shape[1]} entries for {len(names)} joints, not used")
        is_own = own is not None and own.shape == state.shape
        values[f"{kind}_names"] = position_names if is_own else tuple(part.values())
        values["velocities" if kind == "velocity" else "efforts"] = own if is_own else state[:, list(part)]
    title = f"episode {number}"
    time, note = _times(dataset, request, title, columns)
    known = {"strict_columns": False, "in_seconds": True, "notes": (*notes, *filter(None, [note]))}
    name = f"{dataset.root.name} {title}"
    return Recording(dataset.root, name, time, position_names, positions, **values, **known)


def _times(
    dataset: LeRobotDataset, request: ReadRequest, title: str, columns: dict[str, np.ndarray]
) -> tuple[np.ndarray, str]:
    """Times of an episode [s]: its stamps where they increase, else the numbers of its frames over fps; and a note.

    Raises:
        RecordingError: Stamps that contradict fps.
    """
    stamps, frames, rate = columns.get("timestamp"), columns.get("frame_index"), request.rate or dataset.fps
    if request.rate is not None and frames is not None:
        request.uses.use("rate")
    if frames is None or rate is None or stamps is None:
        return stamps if frames is None or rate is None else frames / rate, ""  # type: ignore[return-value]
    if len(stamps) < 2 or np.any(np.diff(stamps) <= 0.0) or request.rate is not None:
        said = f"the stamps {'are overruled' if request.rate else 'do not increase'}"
        return frames / rate, f"{said}: frame_index / {rate:g} is the time" if len(stamps) > 1 else ""
    by_stamps = (frames[-1] - frames[0]) / (stamps[-1] - stamps[0])
    if not 1 / FPS_OFF < by_stamps / rate < FPS_OFF:
        said = f"{title}: its time stamps say {by_stamps:.3g} frames per second, fps says {rate:.3g}"
        how = advice(": pass the right one, {}", f"rate={rate:g}", f"--rate {rate:g}")
        raise refusal(dataset.root, "fps", said + how)
    return stamps, ""


def _gripper(positions: np.ndarray, names: tuple[str, ...], request: ReadRequest) -> tuple[np.ndarray, list[str]]:
    """Positions with the gripper's 0 .. 100 in the unit of the other motors."""
    robot = request.robot
    if GRIPPER not in names or GRIPPER not in robot.joint_names or request.units == "radians":
        return positions, []
    i, j = names.index(GRIPPER), robot.joint_index(GRIPPER)
    lower, upper = np.degrees([robot.position_lower[j], robot.position_upper[j]])
    if request.units == "normalised":
        lower, upper = -100.0, 100.0
    spread = positions.copy()
    spread[:, i] = lower + positions[:, i] / 100.0 * (upper - lower)
    return spread, ["the gripper's 0 .. 100 is spread over its joint limits"]


def _unknown_units(dataset: LeRobotDataset, names: tuple[str, ...], entries: Columns, q: np.ndarray) -> RecordingError:
    values = q[:, [i for i in entries.positions if GRIPPER not in names[i]] or [0]]
    low, high = np.min(values), np.max(values)
    likely = "'degrees'" + (", or 'normalised' (-100 .. 100)" if max(-low, high) <= 100 else "")
    said = f"LeRobot data does not say its units and the arm's values are {low:.4g} .. {high:.4g}: "
    said += advice("pass {}", "units='radians', 'degrees' or 'normalised'", "--units radians, degrees or normalised")
    said += f"; these look like {likely if max(-low, high) >= 2 * np.pi else repr('radians')}"
    return refusal(dataset.root, "units", said)


def _episodes(dataset: LeRobotDataset, feature: str, request: ReadRequest) -> Iterator[Episode]:
    """Episodes of all files, or the chosen ones; one may go on in the next batch or file."""
    number, open_parts = -1, []
    for file in dataset.files:
        own = episode_number(file)
        if request.chosen is not None and own is not None and own not in request.chosen:
            continue
        for next_number, columns in _parts(file, dataset, feature, request):
            if request.chosen is not None and next_number not in request.chosen:
                continue
            if open_parts and next_number != number:
                yield number, _joined(open_parts)
                open_parts = []
            number = next_number
            open_parts.append(columns)
    if open_parts:
        yield number, _joined(open_parts)


def _joined(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    common = [name for name in parts[0] if all(name in part for part in parts)]
    return {name: np.concatenate([part[name] for part in parts]) for name in common}


def _parts(file: Path, dataset: LeRobotDataset, feature: str, request: ReadRequest) -> Iterator[Episode]:
    """Runs of samples with the same episode number, batch by batch; only the needed columns are read."""
    with opened_parquet(file) as parquet:
        there = parquet.schema_arrow.names
        if feature not in there:
            raise refusal(file, "no-state", f"there is no column {feature!r}, there is {first_names(there)}")
        if "timestamp" not in there and ("frame_index" not in there or (request.rate or dataset.fps) is None):
            how = advice("pass {}", *RATE)
            raise refusal(file, "no-time", f"there is neither 'timestamp' nor 'frame_index' with a rate: {how}")
        lists = [field.name for field in parquet.schema_arrow if _is_list(field.type)]
        named = {"state": feature, **beside(feature, lists), **{name: name for name in STAMPS if name in there}}
        stated, found = parquet.metadata.num_rows, 0
        for batch in parquet.iter_batches(batch_size=BATCH, columns=list(named.values())):
            found += batch.num_rows
            columns = {name: _numbers(file, batch, column) for name, column in named.items()}
            if columns["state"].ndim == 1:  # of one joint
                columns["state"] = columns["state"][:, None]
            number = columns.pop("episode_index", np.zeros(batch.num_rows))
            bounds = [0, *(int(i) + 1 for i in np.flatnonzero(np.diff(number))), batch.num_rows]
            for a, b in zip(bounds, bounds[1:], strict=False):
                if b > a:
                    yield int(number[a]), {name: values[a:b] for name, values in columns.items()}
        refuse_lost(file, found, "samples", "the file", "its number", stated)
        groups = sum(parquet.metadata.row_group(i).num_rows for i in range(parquet.num_row_groups))
        refuse_lost(file, found, "samples", "the file", "the sum of its parts", groups)


def _is_list(kind: Any) -> bool:
    return pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)


def _numbers(file: Path, batch: Any, name: str) -> np.ndarray:
    """A column of numbers, shape (T,), or of lists of one length, shape (T, n)."""
    array, shape = batch.column(name), (batch.num_rows,)
    if array.null_count:
        raise refusal(file, "not-finite", f"{counted(array.null_count, 'sample')} of {name!r} are missing")
    if _is_list(array.type):
        is_fixed = pa.types.is_fixed_size_list(array.type)
        widths = {array.type.list_size} if is_fixed else set(np.diff(array.offsets.to_numpy()).tolist())
        if len(widths) > 1:
            raise refusal(file, "ragged", f"the samples of {name!r} have {min(widths)} to {max(widths)} entries")
        shape = (batch.num_rows, max(widths, default=0))
        check_columns(file, repr(name), shape[1])
        array = array.flatten()
    if array.null_count:
        raise refusal(file, "not-finite", f"{array.null_count} values of {name!r} are missing")
    if not (pa.types.is_integer(array.type) or pa.types.is_floating(array.type)):
        raise refusal(file, "not-a-number", f"{name!r} holds {array.type}, numbers are needed")
    return float_array(array.to_numpy(zero_copy_only=False)).reshape(shape)
