"""Numbers and tasks of the episodes of a LeRobot data set, without reading their samples."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from manip_learn.errors import RecordingError, UnknownNameError, advice
from manip_learn.recordings.readers.episode_spans import FIRST, LAST
from manip_learn.recordings.readers.lerobot_dataset import SEARCHED_LEVELS, open_dataset
from manip_learn.recordings.readers.natural_order import natural_order
from manip_learn.recordings.readers.parser_process import parsed_rows
from manip_learn.recordings.readers.recording import reason

ONE_EPISODE = re.compile(r"episode_(\d{1,9})\.parquet")  # files of version 2
ROWS = "manip_learn.recordings.readers.parquet_rows"  # the parser of what describes the episodes
SPANS = "manip_learn.recordings.readers.episode_spans"  # and that of the first and last episode of a file
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
            numbers |= {int(row["episode_index"]) for row in parsed_rows(ROWS, file, ("episode_index",))}
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
        span = next(parsed_rows(SPANS, file, ("episode_index",)), None)
        if runs and (span is None or before is None or span[FIRST] == before):
            runs[-1].append(file)
        else:
            runs.append([file])
        before = None if span is None else span[LAST]
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
        rows = (row for table in tables for row in parsed_rows(ROWS, table, ("episode_index", "tasks")))
    else:
        raise RecordingError(
            f"{path}: the data set does not name the tasks of its episodes (no meta/episodes.jsonl or meta/episodes/): "
            "download all of meta/"
            + advice(", or select by number with {}", "episodes='0:50,60'", "--episodes 0:50,60"),
            code="no-tasks",
            path=path,
        )
    for row in rows:
        number, tasks = row.get("episode_index"), row.get("tasks", ())
        if not isinstance(number, int) or not isinstance(tasks, list | tuple):
            raise RecordingError(
                f"{meta}: an episode is described by {reason(ValueError(str(row)))}; its number and a list of tasks "
                "are needed: download meta/ again",
                code="damaged",
                path=meta,
            )
        yield number, tuple(t for t in tasks if isinstance(t, str))


def _meta(path: Path) -> Path:
    for folder in [path, *list(path.resolve().parents)[:SEARCHED_LEVELS]]:
        if (folder / "meta" / "info.json").is_file():
            return folder / "meta"
    return path / "meta"


def _json_lines(path: Path) -> Iterator[dict[str, Any]]:
    if path.stat().st_size > MOST_BYTES:
        raise RecordingError(
            f"{path}: larger than {MOST_BYTES:,} bytes, which no such file should be", code="too-large", path=path
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
        raise RecordingError(f"{path}: not valid JSON lines: {reason(error)}", code="damaged", path=path) from error
