"""What a LeRobot data set says about itself: version, features, files, numbers and tasks of its episodes."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from manip_learn.errors import UnknownNameError, advice, closest_names
from manip_learn.recordings.readers.parser_process import parsed_rows
from manip_learn.recordings.readers.read_request import first_names
from manip_learn.recordings.readers.recording import natural_order, read_json, reason, refusal

DATASET_HEADER = "meta/manip_learn.json"  # of a data set that this library wrote, beside LeRobot's own metadata
KNOWN_VERSIONS = ("v2.", "v3.")
SEARCHED_LEVELS = 4  # <root>/data/chunk-000/file-000.parquet


@final
@dataclass(frozen=True, eq=False)
class LeRobotDataset:
    """A data set, or a single file of one.

    Attributes:
        root: Folder of the data set, or the file.
        files: Parquet files with the samples, in order.
        features: What the data set says of each feature; None of a file that belongs to none.
        fps: Samples per second, or None.
    """

    root: Path
    files: tuple[Path, ...]
    features: dict[str, Any] | None
    fps: float | None


def open_dataset(path: Path) -> LeRobotDataset:
    """The data set in a folder, or the one that a single Parquet file belongs to.

    Raises:
        RecordingError: Another version, no samples, or metadata that is damaged.
    """
    if path.is_dir():
        files = tuple(sorted((path / "data").rglob("*.parquet"), key=lambda f: natural_order(str(f.relative_to(path)))))
        if not files:
            raise refusal(
                path, "empty", "the data set has no data/**/*.parquet: download its data, not only meta/", in_full=True
            )
        return LeRobotDataset(path, files, *_described(path / "meta" / "info.json"))
    for folder in list(path.resolve().parents)[:SEARCHED_LEVELS]:
        info = folder / "meta" / "info.json"
        if info.is_file():
            return LeRobotDataset(path, (path,), *_described(info))
    return LeRobotDataset(path, (path,), None, None)


def _described(info_path: Path) -> tuple[dict[str, Any], float | None]:
    info = read_json(info_path)
    if not isinstance(info, dict):
        raise refusal(info_path, "damaged", f"an object is needed, this is {type(info).__name__}", in_full=True)
    version = info.get("codebase_version")
    if not isinstance(version, str) or not version.startswith(KNOWN_VERSIONS):
        raise refusal(
            info_path,
            "version",
            f"codebase_version is {version!r}; v2.0, v2.1 and v3.0 are read: convert the data set",
            in_full=True,
        )
    features = info.get("features")
    if not isinstance(features, dict):
        text = "it has no features, so nothing says where the joint positions are"
        raise refusal(info_path, "no-state", text, in_full=True)
    return features, _rate(info.get("fps"))


def _rate(fps: object) -> float | None:
    usable = isinstance(fps, int | float) and not isinstance(fps, bool) and 0 < fps < 1e6
    return float(fps) if isinstance(fps, int | float) and usable else None


STATE, VELOCITY, EFFORT = "observation.state", "observation.velocity", "observation.effort"
# names that data sets give to joint positions: joint_position (DROID), joint_pos, joint_positions, qpos
POSITIONS = re.compile(r"(joint_?pos(ition)?s?|qpos)$", re.IGNORECASE)
VELOCITY_WORDS = (("position", "velocity"), ("pos", "vel"))
EFFORT_WORDS = tuple(
    (p, e) for p in ("positions", "position", "pos") for e in ("effort", "torque", "torques", "efforts")
)
NUMBERS = ("float", "int", "uint")  # how the types of features that hold numbers begin


@final
@dataclass(frozen=True)
class StateFeature:
    """The feature that is read.

    Attributes:
        position: Its name, which is that of a column too.
        velocity: Name that the velocities of the same joints would have.
        names: Names of its entries, or None.
        effort: Name that the efforts of the same joints would have.
        others: Other features that look like joint positions.
    """

    position: str
    velocity: str
    names: tuple[str, ...] | None
    others: tuple[str, ...] = ()
    effort: str = EFFORT


def state_feature(path: Path, features: Mapping[str, Any] | None, asked: str | None) -> StateFeature:
    """The feature to read: the one that was asked for, otherwise `observation.state`.

    Args:
        path: The data set, for messages.
        features: What `meta/info.json` says of each feature; None of a single file without it.
        asked: Name of the feature, or None.

    Raises:
        RecordingError: There is no such feature, or it holds no vector of numbers.
    """
    wanted = STATE if asked is None else asked
    if features is None:
        return StateFeature(wanted, _velocity_of(wanted, ()), None, effort=_effort_of(wanted, ()))
    vectors = [name for name, feature in features.items() if _is_vector(feature)]
    likely = tuple(name for name in vectors if POSITIONS.search(name) and not name.startswith("action"))
    if wanted not in features:
        raise refusal(path, "no-state", _missing(wanted, asked, vectors, likely), in_full=True)
    if wanted not in vectors:
        kind = features[wanted].get("dtype") if isinstance(features[wanted], dict) else features[wanted]
        raise refusal(
            path,
            "no-state",
            f"the feature {wanted!r} holds {kind}, joint positions are a vector of numbers; such are "
            f"{first_names(vectors)}",
            in_full=True,
        )
    others = tuple(name for name in likely if name != wanted)
    names, effort = entry_names(features[wanted].get("names")), _effort_of(wanted, vectors)
    return StateFeature(wanted, _velocity_of(wanted, vectors), names, others, effort)


def _missing(wanted: str, asked: str | None, vectors: Sequence[str], likely: Sequence[str]) -> str:
    text = f"there is no feature {wanted!r}"
    if asked is not None:
        return f"{text}; {_near(asked, vectors)}"
    if likely:
        flag = advice(": read it with {}", f"feature={likely[0]!r}", f"--feature {likely[0]}")
        return f"{text}, joint positions seem to be in {first_names(likely)}{flag}"
    hint = advice("; if one of them holds joint positions, pass {}", "feature=NAME", "--feature NAME")
    return f"{text} (joint positions), there is {first_names(vectors)}{hint}"


def _near(asked: str, vectors: Sequence[str]) -> str:
    near = closest_names(asked, vectors)
    return f"did you mean {first_names(near)}?" if near else f"vectors of numbers are {first_names(vectors)}"


def _is_vector(feature: Any) -> bool:
    if not isinstance(feature, dict):
        return False
    shape, dtype = feature.get("shape"), feature.get("dtype")
    # old data sets leave the type of the state out
    return isinstance(shape, list) and len(shape) == 1 and (dtype is None or str(dtype).startswith(NUMBERS))


def _velocity_of(position: str, vectors: Sequence[str]) -> str:
    """`observation.velocity` of the usual state; of another feature the one with the word exchanged."""
    return VELOCITY if position == STATE else _exchanged(position, VELOCITY_WORDS, vectors, VELOCITY)


def _effort_of(position: str, vectors: Sequence[str]) -> str:
    """`observation.effort`, likewise."""
    return EFFORT if position == STATE else _exchanged(position, EFFORT_WORDS, vectors, EFFORT)


def _exchanged(position: str, words: Sequence[tuple[str, str]], vectors: Sequence[str], usual: str) -> str:
    head, dot, last = position.rpartition(".")
    exchanged = [head + dot + last.replace(p, v) for p, v in words if p in last]
    return next((name for name in exchanged if name in vectors), exchanged[0] if exchanged else usual)


def entry_names(names: Any) -> tuple[str, ...] | None:
    """Names of a vector's entries: from a list, `{"motors": [...]}` or `{"shoulder": 0, ...}`; null is None."""
    if isinstance(names, dict) and names:
        values = list(names.values())
        if all(isinstance(v, int) and not isinstance(v, bool) for v in values):
            if sorted(values) != list(range(len(values))):
                return None
            return tuple(sorted(names, key=lambda n: names[n]))
        names = [n for v in values for n in v] if all(isinstance(v, list) for v in values) else None
    if isinstance(names, list) and names and all(isinstance(n, str) for n in names):
        return tuple(names)
    return None


ONE_EPISODE = re.compile(r"episode_(\d{1,9})\.parquet")  # files of version 2
MOST_BYTES = 200_000_000  # of meta/episodes.jsonl: a million episodes


def episode_number(file: Path) -> int | None:
    """The episode that a file of version 2 holds, by its name; None for other files."""
    found = ONE_EPISODE.fullmatch(file.name)
    return None if found is None else int(found.group(1))


def episode_numbers(path: Path) -> tuple[int, ...]:
    """Numbers of all episodes of a data set, or of a single file of one, rising.

    Raises:
        RecordingError: No data set, or damaged.
        MissingExtraError: The extra `lerobot` is not installed.
    """
    numbers: set[int] = set()
    for file in open_dataset(path).files:
        number = episode_number(file)
        if number is not None:
            numbers.add(number)
        else:
            numbers |= {int(row["episode_index"]) for row in parsed_rows(file, ("episode_index",))}
    return tuple(sorted(numbers))


def separate_files(path: Path) -> list[list[Path]]:
    """Files of a data set of version 3 in runs that share no episode: each run can be read without the others.

    Raises:
        RecordingError: No data set, or damaged.
        MissingExtraError: The extra `lerobot` is not installed.
    """
    runs: list[list[Path]] = []
    before: int | None = None
    for file in open_dataset(path).files:
        ends = [row["episode_index"] for row in parsed_rows(file, ("episode_index",), ends_only=True)]
        if runs and (not ends or before is None or ends[0] == before):
            runs[-1].append(file)
        else:
            runs.append([file])
        before = ends[-1] if ends else None
    return runs


def episodes_of_task(path: Path, task: str) -> frozenset[int]:
    """Numbers of the episodes that show a task; capitals and spaces around it do not count.

    Raises:
        UnknownNameError: There is no such task; lists near matches.
        RecordingError: The data set does not say which episode shows which task, or is damaged.
        MissingExtraError: The extra `lerobot` is not installed.
    """
    tasks = {number: shown for number, shown in _described_episodes(path)}
    asked = _plain(task)
    found = frozenset(number for number, shown in tasks.items() if asked in map(_plain, shown))
    if not found:
        raise UnknownNameError("task", task, {t for shown in tasks.values() for t in shown}, f"data set {path.name!r}")
    return found


def _plain(task: str) -> str:
    return " ".join(task.casefold().split())


def _described_episodes(path: Path) -> Iterator[tuple[int, tuple[str, ...]]]:
    """Number and tasks of each episode: meta/episodes.jsonl of version 2, meta/episodes/**/*.parquet of version 3."""
    meta = _meta(path)
    lines = meta / "episodes.jsonl"
    tables = sorted((meta / "episodes").rglob("*.parquet"), key=lambda f: natural_order(str(f)))
    if lines.is_file():
        rows: Iterator[dict[str, Any]] = _json_lines(lines)
    elif tables:
        rows = (row for table in tables for row in parsed_rows(table, ("episode_index", "tasks")))
    else:
        raise refusal(
            path,
            "no-tasks",
            "the data set does not name the tasks of its episodes (no meta/episodes.jsonl or meta/episodes/): "
            "download all of meta/"
            + advice(", or select by number with {}", "episodes='0:50,60'", "--episodes 0:50,60"),
            in_full=True,
        )
    for row in rows:
        number, tasks = row.get("episode_index"), row.get("tasks", ())
        if not isinstance(number, int) or not isinstance(tasks, list | tuple):
            raise refusal(
                meta,
                "damaged",
                f"an episode is described by {reason(ValueError(str(row)))}; its number and a list of tasks "
                "are needed: download meta/ again",
                in_full=True,
            )
        yield number, tuple(t for t in tasks if isinstance(t, str))


def _meta(path: Path) -> Path:
    for folder in [path, *list(path.resolve().parents)[:SEARCHED_LEVELS]]:
        if (folder / "meta" / "info.json").is_file():
            return folder / "meta"
    return path / "meta"


def _json_lines(path: Path) -> Iterator[dict[str, Any]]:
    if path.stat().st_size > MOST_BYTES:
        raise refusal(
            path, "too-large", f"larger than {MOST_BYTES:,} bytes, which no such file should be", in_full=True
        )
    try:
        with path.open(encoding="utf-8") as file:
            for number, line in enumerate(file, 1):
                row = json.loads(line) if line.strip() else {}
                if line.strip() and not isinstance(row, dict):
                    raise ValueError(f"line {number} is no object")
                if row:
                    yield row
    except (ValueError, RecursionError, OSError) as error:
        raise refusal(path, "damaged", f"not valid JSON lines: {reason(error)}", in_full=True) from error
