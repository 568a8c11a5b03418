"""Motions as a LeRobot v3.0 data set: one episode each, `observation.state` and, where known,
`observation.velocity` and `observation.effort` in float64.

Timestamps count from the first sample of each episode. Nothing that was not recorded is made up: there is no `action`.
"""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from manip_learn.atomic_write import write_atomically
from manip_learn.errors import MissingExtraError, OutputError
from manip_learn.recordings.format_words import DATASET_HEADER
from manip_learn.recordings.readers.lerobot_reader import EFFORT, STATE, VELOCITY
from manip_learn.recordings.saved_motion import SavedMotion

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError as error:
    raise MissingExtraError("writing LeRobot data", "lerobot") from error

TASK = "recorded motion"
FILE = "chunk-000/file-000.parquet"
FEATURES = {STATE: "q", VELOCITY: "u", EFFORT: "effort"}  # and the arrays of a motion that they hold


def write_lerobot(folder: Path, motions: Sequence[SavedMotion]) -> Path:
    """Write a data set into a folder that is new or empty.

    Returns:
        The folder.

    Raises:
        OutputError: The folder has files, it cannot be written, or only some motions have velocities or efforts.
        MissingExtraError: pyarrow is not installed.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"cannot write a LeRobot data set to {folder}: it exists; name a new or an empty folder")
    for what, name in (("velocities", "u"), ("efforts", "effort")):
        if len({name in m.arrays for m in motions}) > 1:
            raise OutputError(f"some trajectories have {what} and others not: export them to data sets of their own")
    lengths, times = [len(m) for m in motions], [m.arrays["time"] for m in motions]
    columns: dict[str, Any] = {}
    for feature, name in FEATURES.items():
        if name in motions[0].arrays:
            table = np.concatenate([m.arrays[name] for m in motions])
            columns[feature] = pa.FixedSizeListArray.from_arrays(pa.array(table.ravel()), table.shape[1])
    numbers = {
        "timestamp": np.concatenate([time - time[0] for time in times]),
        "frame_index": np.concatenate(list(map(np.arange, lengths))),
        "episode_index": np.repeat(np.arange(len(motions)), lengths),
        "index": np.arange(sum(lengths)),
        "task_index": np.zeros(sum(lengths), dtype=np.int64),
    }
    table = pa.table(columns | numbers)
    fps = samples_per_second([m.arrays["time"] for m in motions])
    write_atomically(folder / "data" / FILE, _parquet(table))
    write_atomically(folder / "meta" / "episodes" / FILE, _parquet(_episodes(motions)))
    tasks = pa.table({"task_index": pa.array([0], pa.int64()), "task": [TASK]})
    described = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            {"name": n, "field_name": n, "pandas_type": kind, "numpy_type": dtype, "metadata": None}
            for n, kind, dtype in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
        ],
        "pandas_version": "2.0.0",
    }
    write_atomically(
        folder / "meta" / "tasks.parquet", _parquet(tasks.replace_schema_metadata({"pandas": json.dumps(described)}))
    )
    found = {}
    for name in table.column_names:
        column = table.column(name).combine_chunks()
        is_vector = pa.types.is_fixed_size_list(column.type)
        flat = column.flatten() if is_vector else column
        values = flat.to_numpy(zero_copy_only=False).reshape(len(column), -1).astype(np.float64)
        parts = {"min": values.min(0), "max": values.max(0), "mean": values.mean(0), "std": values.std(0)}
        found[name] = {key: part.tolist() for key, part in parts.items()} | {"count": [len(values)]}
    write_atomically(folder / "meta" / "stats.json", json.dumps(found, indent=2))
    write_atomically(folder / "meta" / "info.json", json.dumps(_info(motions, fps, table), indent=2))
    write_atomically(folder / DATASET_HEADER, motions[0].header.to_json() + "\n")
    return folder.resolve()


def _episodes(motions: Sequence[SavedMotion]) -> Any:
    lengths = np.array([len(m) for m in motions])
    places = ("data/chunk_index", "data/file_index", "meta/episodes/chunk_index", "meta/episodes/file_index")
    known = {
        "episode_index": np.arange(len(motions)),
        "tasks": pa.array([[TASK]] * len(motions)),
        "length": lengths,
        "dataset_from_index": np.cumsum(lengths) - lengths,
        "dataset_to_index": np.cumsum(lengths),
    }
    return pa.table(known | dict.fromkeys(places, np.zeros(len(motions), dtype=np.int64)))


def samples_per_second(times: Sequence[np.ndarray]) -> float:
    """Samples per second, by the median step; an integer where it is one but for rounding."""
    step = float(np.median(np.concatenate(list(map(np.diff, times)))))
    rate = 1.0 / step
    return round(rate) if abs(rate - round(rate)) < 1e-3 * rate and rate >= 1.0 else rate


def _info(motions: Sequence[SavedMotion], fps: float, table: Any) -> dict[str, Any]:
    header = motions[0].header
    joints = {"dtype": "float64", "shape": [len(header.joint_names)], "names": list(header.joint_names)}
    features: dict[str, Any] = {name: joints for name in FEATURES if name in table.column_names}
    for name in table.column_names:
        kind = "float64" if name == "timestamp" else "int64"
        features.setdefault(name, {"dtype": kind, "shape": [1], "names": None})
    return {
        "codebase_version": "v3.0",
        "robot_type": None if header.robot is None else header.robot.name,
        "total_episodes": len(motions),
        "total_frames": table.num_rows,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{len(motions)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": features,
    }


def _parquet(table: Any) -> bytes:
    stream = io.BytesIO()
    pq.write_table(table, stream)
    return stream.getvalue()
