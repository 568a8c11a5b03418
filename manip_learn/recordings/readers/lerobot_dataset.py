"""What a LeRobot data set says about itself: version, names of the state's entries, rate, data files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from manip_learn.errors import RecordingError
from manip_learn.recordings.readers.json_file import read_json
from manip_learn.recordings.readers.natural_order import natural_order

STATE, VELOCITY = "observation.state", "observation.velocity"
KNOWN_VERSIONS = ("v2.", "v3.")
SEARCHED_LEVELS = 4  # <root>/data/chunk-000/file-000.parquet


@final
@dataclass(frozen=True)
class LeRobotDataset:
    """A data set, or a single file of one.

    Attributes:
        root: Folder of the data set, or the file.
        files: Parquet files with the samples, in order.
        names: Names of the entries of `observation.state`, or None if the data set has none.
        fps: Samples per second, or None.
    """

    root: Path
    files: tuple[Path, ...]
    names: tuple[str, ...] | None
    fps: float | None


def open_dataset(path: Path) -> LeRobotDataset:
    """The data set in a folder, or the one that a single Parquet file belongs to.

    Raises:
        RecordingError: Another version, no samples, or metadata that is damaged.
    """
    if path.is_dir():
        files = tuple(sorted((path / "data").rglob("*.parquet"), key=lambda f: natural_order(str(f.relative_to(path)))))
        if not files:
            raise RecordingError(
                f"{path}: the data set has no data/**/*.parquet: download its data, not only meta/",
                code="empty",
                path=path,
            )
        return LeRobotDataset(path, files, *_described(path / "meta" / "info.json"))
    for folder in list(path.resolve().parents)[:SEARCHED_LEVELS]:
        info = folder / "meta" / "info.json"
        if info.is_file():
            return LeRobotDataset(path, (path,), *_described(info))
    return LeRobotDataset(path, (path,), None, None)


def _described(info_path: Path) -> tuple[tuple[str, ...] | None, float | None]:
    info = read_json(info_path)
    if not isinstance(info, dict):
        raise _refusal(info_path, "damaged", f"an object is needed, this is {type(info).__name__}")
    version = info.get("codebase_version")
    if not isinstance(version, str) or not version.startswith(KNOWN_VERSIONS):
        raise _refusal(
            info_path, "version", f"codebase_version is {version!r}; v2.0, v2.1 and v3.0 are read: convert the data set"
        )
    features = info.get("features")
    if not isinstance(features, dict) or not isinstance(features.get(STATE), dict):
        there = ", ".join(map(str, features)) if isinstance(features, dict) else "nothing"
        raise _refusal(info_path, "no-state", f"there is no feature {STATE!r} (joint positions), there is {there}")
    return entry_names(features[STATE].get("names")), _rate(info.get("fps"))


def _rate(fps: object) -> float | None:
    usable = isinstance(fps, int | float) and not isinstance(fps, bool) and 0 < fps < 1e6
    return float(fps) if isinstance(fps, int | float) and usable else None


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


def _refusal(path: Path, code: str, text: str) -> RecordingError:
    return RecordingError(f"{path}: {text}", code=code, path=path)
