"""What a LeRobot data set says about itself: version, features, files and the numbers of its episodes."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, final

import numpy as np

from manip_learn.errors import MissingExtraError, advice, closest_names, counted
from manip_learn.recordings.readers.limits import FEWEST_SAMPLE_BYTES, bomb, metadata_text, most_bytes, refuse_lost
from manip_learn.recordings.readers.quantities import POSITIONS, arrays_of
from manip_learn.recordings.readers.read_request import first_names
from manip_learn.recordings.readers.recording import check_regular, natural_order, reason, refusal, refusing_damage

STATE, VELOCITY, EFFORT = "observation.state", "observation.velocity", "observation.effort"


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
    try:
        info = json.loads(metadata_text(info_path))
    except (ValueError, RecursionError) as error:
        raise refusal(info_path, "damaged", f"not valid JSON: {reason(error)}", in_full=True) from error
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
