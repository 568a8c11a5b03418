"""What a LeRobot data set says about itself: version, names of the state's entries, rate, data files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from manip_learn.errors import RecordingError
from manip_learn.recordings.readers.json_file import read_json
from manip_learn.recordings.readers.natural_order import natural_order

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


def _described(info_path: Path) -> tuple[dict[str, Any], float | None]:
    info = read_json(info_path)
    if not isinstance(info, dict):
        raise _refusal(info_path, "damaged", f"an object is needed, this is {type(info).__name__}")
    version = info.get("codebase_version")
    if not isinstance(version, str) or not version.startswith(KNOWN_VERSIONS):
        raise _refusal(
            info_path, "version", f"codebase_version is {version!r}; v2.0, v2.1 and v3.0 are read: convert the data set"
        )
    features = info.get("features")
    if not isinstance(features, dict):
        raise _refusal(info_path, "no-state", "it has no features, so nothing says where the joint positions are")
    return features, _rate(info.get("fps"))


def _rate(fps: object) -> float | None:
    usable = isinstance(fps, int | float) and not isinstance(fps, bool) and 0 < fps < 1e6
    return float(fps) if isinstance(fps, int | float) and usable else None


def _refusal(path: Path, code: str, text: str) -> RecordingError:
    return RecordingError(f"{path}: {text}", code=code, path=path)
