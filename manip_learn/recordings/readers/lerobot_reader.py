"""LeRobot data sets v2 and v3: the joint positions in `observation.state`, one recording per episode.

LeRobot does not store units, so the caller must state them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np

from manip_learn.errors import MissingExtraError, advice, counted
from manip_learn.recordings.format_words import DATASET_HEADER, wrench_columns
from manip_learn.recordings.readers.lerobot_dataset import (
    LeRobotDataset,
    StateFeature,
    WrenchFeature,
    episode_number,
    open_dataset,
    opened_parquet,
    state_feature,
    wrench_feature,
)
from manip_learn.recordings.readers.limits import FEWEST_SAMPLE_BYTES, bomb, most_bytes
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording import Recording, float_array, refusal

try:
    import pyarrow as pa
except ImportError as error:
    raise MissingExtraError("reading LeRobot data", "lerobot") from error

BATCH = 65_536  # rows in memory: some 10 MB
STAMPS = ("timestamp", "frame_index", "episode_index")
EFFORT_ENDS = (".torque", ".effort")  # of entries of the state, as motors that measure it are named beside `.pos`
GRIPPER = "gripper"  # always 0 .. 100 in LeRobot, whatever the unit of the other motors


@final
@dataclass(frozen=True, eq=False)
class Episode:
    """Samples of one episode: `time`, `state`, and `velocity`, `effort` and `wrench` where they were recorded."""

    index: int
    columns: dict[str, np.ndarray]

    @property
    def state(self) -> np.ndarray:
        """Joint positions, in the unit of the file."""
        return self.columns["state"]

    def like_state(self, name: str) -> np.ndarray | None:
        """Another column, if it has one number per joint."""
        values = self.columns.get(name)
        return values if values is not None and values.shape == self.state.shape else None


Features = tuple[StateFeature, WrenchFeature]


def read(path: Path, request: ReadRequest) -> Iterator[Recording]:
    """One recording per episode; one episode in memory at a time.

    Raises:
        RecordingError: Units or names not known, damaged, values missing.
    """
    dataset = open_dataset(path)
    is_ours = (path / DATASET_HEADER).is_file()
    if is_ours:  # in radians; its robot has been checked
        request = replace(request, units=request.units or "radians")
    feature = state_feature(dataset.root, dataset.features, request.feature)
    wrench = wrench_feature(dataset.features, request.ignores)
    request.uses.use("feature")
    names: tuple[str, ...] | None = None
    numbers, frames = set(), 0
    for episode in _episodes(dataset, (feature, wrench), request):
        numbers.add(episode.index)
        frames += len(episode.state)
        if names is None:
            names = _names(dataset, feature, request, episode.state.shape[1])
            _refuse_unknown_units(dataset, request, names, episode.state)
        recording = _recording(dataset, request, names, episode)
        said = [*_other_features(feature), *([wrench.note] if wrench.note else [])]
        yield replace(recording, trusted=is_ours, notes=(*recording.notes, *said))
    if request.chosen is None:
        dataset.refuse_lost("frames", frames)
        dataset.refuse_lost("episodes", len(numbers))


def _other_features(feature: StateFeature) -> list[str]:
    if not feature.others:
        return []
    how = advice(" ({} reads it)", f"feature={feature.others[0]!r}", f"--feature {feature.others[0]}")
    return [f"read from {feature.position}; also like joint positions, not used: {', '.join(feature.others)}{how}"]


def _recording(dataset: LeRobotDataset, request: ReadRequest, names: tuple[str, ...], episode: Episode) -> Recording:
    position, velocity, effort, wrench = _kinds(names)
    position_names = tuple(_joint_name(names[i], request) for i in position)
    positions, notes = _gripper(episode.state[:, position], position_names, request)
    if any(names[i] != n for i, n in zip(position, position_names, strict=True)):
        notes.insert(0, "'.pos' was taken off the names")
    velocity_names, velocities = position_names, episode.like_state("velocity")
    effort_names, efforts = position_names, episode.like_state("effort")
    if len(position) < len(names):
        velocity_names, effort_names = (tuple(_joint_name(names[i], request) for i in k) for k in (velocity, effort))
        velocities, efforts = (episode.state[:, k] if k else None for k in (velocity, effort))
    return Recording(
        path=dataset.root,
        name=f"{dataset.root.name} episode {episode.index}",
        time=episode.columns["time"],
        position_names=position_names,
        positions=positions,
        velocity_names=() if velocities is None else velocity_names,
        velocities=velocities,
        effort_names=() if efforts is None else effort_names,
        efforts=efforts,
        wrench=episode.state[:, wrench] if wrench else episode.columns.get("wrench"),
        strict_columns=False,
        in_seconds=True,
        notes=tuple(notes),
    )


def _kinds(names: tuple[str, ...]) -> tuple[list[int], list[int], list[int], list[int]]:
    """Entries of the state that are positions, velocities, efforts and the six of a wrench."""
    wrench = list(wrench_columns(names)[0])
    velocity = [i for i, n in enumerate(names) if n.endswith(".vel")]
    effort = [i for i, n in enumerate(names) if n.endswith(EFFORT_ENDS)]
    beside = {*wrench, *velocity, *effort}
    return [i for i in range(len(names)) if i not in beside], velocity, effort, wrench


def _joint_name(name: str, request: ReadRequest) -> str:
    wanted = request.renamed(name)
    if wanted in request.robot.joint_names:
        return wanted
    end = next((end for end in (".pos", ".vel", *EFFORT_ENDS) if wanted.endswith(end)), "")
    return request.renamed(wanted.removesuffix(end))


def _gripper(positions: np.ndarray, names: tuple[str, ...], request: ReadRequest) -> tuple[np.ndarray, list[str]]:
    """Positions with the gripper's 0 .. 100 in the unit of the other motors."""
    robot = request.robot
    if GRIPPER not in names or GRIPPER not in robot.joint_names or request.units == "radians":
        return positions, []
    i, j = names.index(GRIPPER), robot.joint_index(GRIPPER)
    share = positions[:, i] / 100.0
    positions = positions.copy()
    if request.units == "normalised":
        positions[:, i] = 200.0 * share - 100.0
    else:
        lower, upper = robot.position_lower[j], robot.position_upper[j]
        positions[:, i] = np.degrees(lower + share * (upper - lower))
    return positions, ["the gripper's 0 .. 100 is spread over its joint limits"]


def _names(dataset: LeRobotDataset, feature: StateFeature, request: ReadRequest, width: int) -> tuple[str, ...]:
    names = request.joint_names or feature.names
    request.uses.use("joint_names")
    if names is None:
        raise refusal(
            dataset.root,
            "no-joint-names",
            f"the data set does not name the {width} entries of {feature.position}: "
            + advice("pass {} in their order", "joint_names=[...]", "--joint-names NAME,NAME,..."),
        )
    if len(names) != width:
        raise refusal(
            dataset.root,
            "shape",
            f"{feature.position} has {width} entries, there are {len(names)} names: {', '.join(names)}",
        )
    return names


def _refuse_unknown_units(
    dataset: LeRobotDataset, request: ReadRequest, names: tuple[str, ...], state: np.ndarray
) -> None:
    if request.units is not None:
        return
    arm = [i for i in _kinds(names)[0] if GRIPPER not in names[i]] or [0]
    low, high = float(np.min(state[:, arm])), float(np.max(state[:, arm]))
    largest = max(abs(low), abs(high))
    guess = (
        "'radians'"
        if largest < 2 * np.pi
        else "'degrees', or 'normalised' (-100 .. 100)"
        if largest <= 100
        else "'degrees'"
    )
    raise refusal(
        dataset.root,
        "units",
        f"LeRobot data does not say its units and the arm's values are {low:.4g} .. {high:.4g}: "
        + advice("pass {}", "units='radians', 'degrees' or 'normalised'", "--units radians, degrees or normalised")
        + f"; these look like {guess}",
    )


def _episodes(dataset: LeRobotDataset, features: Features, request: ReadRequest) -> Iterator[Episode]:
    """Episodes of all files, or the chosen ones; one may go on in the next file."""
    open_parts: list[Episode] = []
    for file in dataset.files:
        number = episode_number(file)
        if request.chosen is not None and number is not None and number not in request.chosen:
            continue
        for part in _parts(file, dataset, features, request):
            if request.chosen is not None and part.index not in request.chosen:
                continue
            if open_parts and open_parts[0].index != part.index:
                yield _joined(open_parts)
                open_parts = []
            open_parts.append(part)
    if open_parts:
        yield _joined(open_parts)


def _joined(parts: list[Episode]) -> Episode:
    common = [name for name in parts[0].columns if all(name in part.columns for part in parts)]
    return Episode(parts[0].index, {name: np.concatenate([part.columns[name] for part in parts]) for name in common})


def _parts(file: Path, dataset: LeRobotDataset, features: Features, request: ReadRequest) -> Iterator[Episode]:
    """Runs of samples with the same episode number, batch by batch; only the needed columns are read."""
    feature, wrench = features
    with opened_parquet(file) as parquet:
        there = parquet.schema_arrow.names
        if feature.position not in there:
            raise refusal(
                file, "no-state", f"there is no column {feature.position!r}, there is {', '.join(there[:12])}"
            )
        known = (feature.position, feature.velocity, feature.effort, *wrench.names, *STAMPS)
        columns = [c for c in dict.fromkeys(known) if c in there]
        stated, found = parquet.metadata.num_rows, 0
        # the library's column metadata would tell more, but asking for it aborts the process if the file is damaged
        if FEWEST_SAMPLE_BYTES * stated > most_bytes(size := file.stat().st_size):
            raise bomb(file, f"{size:,} bytes claim to hold {counted(stated, 'sample')}")
        for batch in parquet.iter_batches(batch_size=BATCH, columns=columns):
            found += batch.num_rows
            yield from _split(file, batch, dataset, features, request)
        groups = sum(parquet.metadata.row_group(i).num_rows for i in range(parquet.num_row_groups))
        if not found == stated == groups:
            text = f"{counted(found, 'sample')} are there, it states {stated}, in parts {groups}: download it again"
            raise refusal(file, "lost-samples", text)


def _split(
    file: Path, batch: Any, dataset: LeRobotDataset, features: Features, request: ReadRequest
) -> Iterator[Episode]:
    feature, wrench = features
    named = {"state": feature.position, "velocity": feature.velocity, "effort": feature.effort}
    columns = {name: _matrix(file, batch, column) for name, column in named.items() if column in batch.schema.names}
    if wrench.names and all(name in batch.schema.names for name in wrench.names):
        both = np.hstack([_matrix(file, batch, name) for name in wrench.names])
        columns |= {"wrench": both[:, wrench.order]} if both.shape[1] == len(wrench.order) else {}
    n = len(columns["state"])
    number = _vector(file, batch, "episode_index") if "episode_index" in batch.schema.names else np.zeros(n)
    columns["time"] = _time(file, batch, dataset, request)
    bounds = [0, *(int(i) + 1 for i in np.flatnonzero(np.diff(number))), n]
    for a, b in zip(bounds, bounds[1:], strict=False):
        if b > a:
            yield Episode(int(number[a]), {name: values[a:b] for name, values in columns.items()})


def _time(file: Path, batch: Any, dataset: LeRobotDataset, request: ReadRequest) -> np.ndarray:
    if "timestamp" in batch.schema.names:
        return _vector(file, batch, "timestamp")
    rate = request.rate or dataset.fps
    request.uses.use("rate")
    if rate is None or "frame_index" not in batch.schema.names:
        raise refusal(
            file,
            "no-time",
            "there is neither 'timestamp' nor 'frame_index' with a rate: "
            + advice("pass {}", "rate=<samples per second>", "--rate <samples per second>"),
        )
    return _vector(file, batch, "frame_index") / rate


def _vector(file: Path, batch: Any, name: str) -> np.ndarray:
    return _numbers(file, batch.column(name), name)


def _numbers(file: Path, array: Any, name: str) -> np.ndarray:
    if array.null_count:
        raise refusal(file, "not-finite", f"{array.null_count} values of {name!r} are missing")
    if not (pa.types.is_integer(array.type) or pa.types.is_floating(array.type)):
        raise refusal(file, "not-a-number", f"{name!r} holds {array.type}, numbers are needed")
    return float_array(array.to_numpy(zero_copy_only=False))


def _matrix(file: Path, batch: Any, name: str) -> np.ndarray:
    array = batch.column(name)
    if array.null_count:
        raise refusal(file, "not-finite", f"{counted(array.null_count, 'sample')} of {name!r} are missing")
    if pa.types.is_fixed_size_list(array.type):
        width = array.type.list_size
    elif pa.types.is_list(array.type) or pa.types.is_large_list(array.type):
        widths = np.unique(np.diff(array.offsets.to_numpy()))
        if len(widths) > 1:
            raise refusal(file, "ragged", f"the samples of {name!r} have {widths[0]} to {widths[-1]} entries")
        width = int(widths[0]) if len(widths) else 0
    else:
        return _numbers(file, array, name)[:, None]
    return _numbers(file, array.flatten(), name).reshape(len(array), width)
