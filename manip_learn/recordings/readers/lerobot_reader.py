"""LeRobot data sets v2 and v3: the joint positions in `observation.state`, one recording per episode.

What a data set says about itself is read first. LeRobot does not store units, so the caller must state them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, final

import numpy as np

from manip_learn.errors import MissingExtraError, RecordingError, advice, closest_names, counted
from manip_learn.recordings.format_words import DATASET_HEADER
from manip_learn.recordings.readers.array_reader import column_names
from manip_learn.recordings.readers.quantities import POSITIONS, Columns, arrays_of, entry_columns
from manip_learn.recordings.readers.read_request import RATE, ReadRequest, first_names
from manip_learn.recordings.readers.recording import (
    FEWEST_SAMPLE_BYTES,
    Recording,
    bomb,
    check_columns,
    check_regular,
    float_array,
    metadata_text,
    most_bytes,
    natural_order,
    refusal,
    refuse_lost,
    refusing_damage,
)
from manip_learn.robot.description.text import parsed_json

STATE, VELOCITY, EFFORT = "observation.state", "observation.velocity", "observation.effort"
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
    from pyarrow import types

    return types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind)


def _numbers(file: Path, batch: Any, name: str) -> np.ndarray:
    """A column of numbers, shape (T,), or of lists of one length, shape (T, n)."""
    from pyarrow import types

    array, shape = batch.column(name), (batch.num_rows,)
    if array.null_count:
        raise refusal(file, "not-finite", f"{counted(array.null_count, 'sample')} of {name!r} are missing")
    if _is_list(array.type):
        is_fixed = types.is_fixed_size_list(array.type)
        widths = {array.type.list_size} if is_fixed else set(np.diff(array.offsets.to_numpy()).tolist())
        if len(widths) > 1:
            raise refusal(file, "ragged", f"the samples of {name!r} have {min(widths)} to {max(widths)} entries")
        shape = (batch.num_rows, max(widths, default=0))
        check_columns(file, repr(name), shape[1])
        array = array.flatten()
    if array.null_count:
        raise refusal(file, "not-finite", f"{array.null_count} values of {name!r} are missing")
    if not (types.is_integer(array.type) or types.is_floating(array.type)):
        raise refusal(file, "not-a-number", f"{name!r} holds {array.type}, numbers are needed")
    return float_array(array.to_numpy(zero_copy_only=False)).reshape(shape)


@contextmanager
def opened_parquet(file: Path) -> Iterator[Any]:
    """A `pyarrow.parquet.ParquetFile` with its checksums tested, closed at the end.

    Raises:
        RecordingError: A bomb; or damaged, found when it is opened or while it is read.
        MissingExtraError: The extra `lerobot` is not installed.
    """
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise MissingExtraError("reading LeRobot data", "lerobot") from error
    check_regular(file)
    with refusing_damage(file, pa.ArrowException), pq.ParquetFile(file, page_checksum_verification=True) as parquet:
        rows, size = parquet.metadata.num_rows, file.stat().st_size
        # the library's column metadata would tell more, but asking for it aborts the process if the file is damaged
        if FEWEST_SAMPLE_BYTES * rows > most_bytes(size):
            raise bomb(file, f"{size:,} bytes claim to hold {counted(rows, 'sample')}")
        yield parquet


@final
@dataclass(frozen=True, eq=False)
class LeRobotDataset:
    """A data set, or a single file of one.

    Attributes:
        root: Folder of the data set, or the file.
        files: Parquet files with the samples, in order.
        features: What the data set says of each feature; None of a file that belongs to none.
        fps: Samples per second, or None.
        totals: Numbers of `frames` and `episodes` that a whole data set states.
    """

    root: Path
    files: tuple[Path, ...]
    features: dict[str, Any] | None = None
    fps: float | None = None
    totals: dict[str, Any] = field(default_factory=dict)

    def refuse_lost(self, what: Literal["frames", "episodes"], found: int) -> None:
        """Refuse a data set that states another number of samples or episodes than were found in it.

        Raises:
            RecordingError: Code `lost-samples`.
        """
        way_out = advice(", or read the episodes that are there with {}", "episodes='0:'", "--episodes 0:")
        refuse_lost(self.root, found, what, "meta/info.json", f"total_{what}", self.totals.get(what), way_out)


def open_dataset(path: Path) -> LeRobotDataset:
    """The data set in a folder, or the one that a single Parquet file belongs to.

    Raises:
        RecordingError: Another version, no samples, or metadata that is damaged.
    """
    files, info_path = (path,), path / "meta" / "info.json"
    if path.is_dir():
        files = tuple(sorted((path / "data").rglob("*.parquet"), key=lambda f: natural_order(str(f.relative_to(path)))))
        if not files:
            text = "the data set has no data/**/*.parquet: download its data, not only meta/"
            raise refusal(path, "empty", text, in_full=True)
    else:
        around = (folder / "meta" / "info.json" for folder in list(path.resolve().parents)[:4])  # data/chunk-000/FILE
        info_path = next((place for place in around if place.is_file()), None)
        if info_path is None:
            return LeRobotDataset(path, files)
    with refusing_damage(info_path):
        info = parsed_json(metadata_text(info_path))
    if not isinstance(info, dict):
        raise refusal(info_path, "damaged", f"an object is needed, this is {type(info).__name__}", in_full=True)
    version, features, fps = (info.get(name) for name in ("codebase_version", "features", "fps"))
    if not isinstance(version, str) or not version.startswith(("v2.", "v3.")):
        text = f"codebase_version is {version!r}; v2.0, v2.1 and v3.0 are read: convert the data set"
        raise refusal(info_path, "version", text, in_full=True)
    if not isinstance(features, dict):
        said = "it has no features, so nothing says where the joint positions are"
        raise refusal(info_path, "no-state", said, in_full=True)
    rate = float(fps) if isinstance(fps, int | float) and not isinstance(fps, bool) and 0 < fps < 1e6 else None
    totals = {what: info.get(f"total_{what}") for what in ("frames", "episodes")} if path.is_dir() else {}
    return LeRobotDataset(path, files, features, rate, totals)


def state_feature(dataset: LeRobotDataset, asked: str | None) -> tuple[str, tuple[str, ...] | None, list[str]]:
    """The feature to read: the one that was asked for, otherwise `observation.state`.

    Returns:
        Its name, which is that of a column too; the names of its entries, or None; and other features that look like
        joint positions.

    Raises:
        RecordingError: There is no such feature, or it holds no vector of numbers.
    """
    wanted, features = asked or STATE, dataset.features
    if features is None:
        return wanted, None, []
    vectors = [name for name, feature in features.items() if _is_vector(feature)]
    likely = [name for name in vectors if POSITIONS.search(name) and not name.startswith("action")]
    if wanted not in features:
        raise refusal(dataset.root, "no-state", _missing(wanted, asked, vectors, likely), in_full=True)
    if wanted not in vectors:
        kind = features[wanted].get("dtype") if isinstance(features[wanted], dict) else features[wanted]
        text = f"the feature {wanted!r} holds {kind}, joint positions are a vector of numbers; such are "
        raise refusal(dataset.root, "no-state", text + first_names(vectors), in_full=True)
    return wanted, entry_names(features[wanted].get("names")), [name for name in likely if name != wanted]


def _missing(wanted: str, asked: str | None, vectors: Sequence[str], likely: Sequence[str]) -> str:
    text = f"there is no feature {wanted!r}"
    if asked is not None:
        near = closest_names(asked, vectors)
        hint = f"did you mean {first_names(near)}?" if near else f"vectors of numbers are {first_names(vectors)}"
        return f"{text}; {hint}"
    if likely:
        flag = advice(": read it with {}", f"feature={likely[0]!r}", f"--feature {likely[0]}")
        return f"{text}, joint positions seem to be in {first_names(likely)}{flag}"
    hint = advice("; if one of them holds joint positions, pass {}", "feature=NAME", "--feature NAME")
    return f"{text} (joint positions), there is {first_names(vectors)}{hint}"


def _is_vector(feature: Any) -> bool:
    if not isinstance(feature, dict):
        return False
    shape, dtype = feature.get("shape"), feature.get("dtype")
    is_number = dtype is None or str(dtype).startswith(("float", "int", "uint"))  # old data sets do not say it
    return isinstance(shape, list) and len(shape) == 1 and is_number


def beside(position: str, columns: Iterable[str]) -> dict[str, str]:
    """`velocity` and `effort` -> the column that holds them for the joints of some positions, in the same group."""
    group = position.rpartition(".")[0]
    last = {c.rpartition(".")[2]: c for c in columns if c != position and c.rpartition(".")[0] == group}
    found = {kind: arrays_of(kind, last) for kind in ("velocity", "effort")}
    return {kind: last[names[0]] for kind, names in found.items() if len(names) == 1}


def entry_names(names: Any) -> tuple[str, ...] | None:
    """Names of a vector's entries: of `[...]`, `[[...]]`, `{"motors": [...]}`, `{"shoulder": 0, ...}`; null is None."""
    if isinstance(names, dict) and names:
        values = list(names.values())
        if all(isinstance(v, int) and not isinstance(v, bool) for v in values):
            names = sorted(names, key=lambda n: names[n]) if sorted(values) == list(range(len(values))) else None
        else:
            names = values if all(isinstance(v, list) for v in values) else None
    if isinstance(names, list) and all(isinstance(v, list) for v in names):
        names = [n for v in names for n in v]
    return tuple(names) if isinstance(names, list) and names and all(isinstance(n, str) for n in names) else None


def episode_number(file: Path) -> int | None:
    """The episode that a file of version 2 holds, by its name; None for other files."""
    found = re.fullmatch(r"episode_(\d{1,9})\.parquet", file.name)
    return None if found is None else int(found.group(1))


def episode_numbers(path: Path) -> tuple[int, ...]:
    """Numbers of all episodes of a data set, or of a single file of one, rising."""
    numbers: set[int] = set()
    for file in open_dataset(path).files:
        number = episode_number(file)
        numbers |= set(map(int, np.unique(_episodes_in(file)))) if number is None else {number}
    return tuple(sorted(numbers))


def _episodes_in(file: Path) -> np.ndarray:
    """The episode of each sample of a file, as far as they are known; without the column, one sample of episode 0."""
    with opened_parquet(file) as parquet:
        if "episode_index" not in parquet.schema_arrow.names:
            return np.zeros(1)
        return parquet.read(columns=["episode_index"]).column(0).drop_null().to_numpy()


def separate_files(path: Path) -> list[list[Path]]:
    """Files of a data set of version 3 in runs that share no episode: each run can be read without the others."""
    runs: list[list[Path]] = []
    before, found, dataset = None, 0, open_dataset(path)
    for file in dataset.files:
        numbers = _episodes_in(file)
        if runs and (not len(numbers) or before is None or numbers[0] == before):
            runs[-1].append(file)
        else:
            runs.append([file])
        before, found = numbers[-1] if len(numbers) else None, found + len(numbers)
    dataset.refuse_lost("frames", found)
    return runs
