"""Run experiments of the paper by name, and write numbers and figures."""

from __future__ import annotations

import csv
import io
import itertools
import json
import os
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from manip_learn.atomic_write import write_atomically
from manip_learn.errors import ExperimentError, OutputError, UnknownNameError
from manip_learn.experiments.charts import save_figure
from manip_learn.experiments.rmse import RMSE
from manip_learn.experiments.sawyer import SAWYER
from manip_learn.experiments.singular_starts import NEAR_SINGULAR, SINGULAR, BadStart
from manip_learn.experiments.table import TABLE
from manip_learn.experiments.trials import Trials
from manip_learn.linalg import one_thread
from manip_learn.recordings.load import Progress

PARTS: dict[str, Trials | BadStart] = {one.name: one for one in (TABLE, RMSE, SINGULAR, NEAR_SINGULAR, SAWYER)}
# name from the user -> parts
EXPERIMENTS: dict[str, tuple[str, ...]] = {**{name: (name,) for name in PARTS}, "all": tuple(PARTS)}


def reproduce(
    name: str = "all",
    trials: int = 50,
    seed: int = 0,
    out: str | os.PathLike[str] | None = None,
    progress: Progress | None = None,
    *,
    workers: int | None = None,
    on_result: Callable[[str, Any], None] | None = None,
) -> dict[str, Any]:
    """Run one experiment of the paper, or all, and compare our numbers with the printed ones.

    The same seed gives the same numbers, whatever the number of workers. With an output folder, each experiment is
    written as soon as it is finished.

    Args:
        name: `"table"`, `"rmse"`, `"singular-start"`, `"near-singular-start"`, `"sawyer"` or `"all"`.
        trials: Number of trials per case; 50 in the paper.
        seed: Seed of all random numbers.
        out: Folder for JSON, CSV, PNG, SVG and Markdown files; None to write nothing.
        progress: Function that is called with the name of an experiment and the completed share of all trials, 0 to 1;
            None for none.
        workers: Number of processes; None for all cores.
        on_result: Function that is called with the name and the result of each finished experiment; None for none.

    Returns:
        Dictionary of JSON values: name of the experiment -> our numbers (`ours`) and the printed ones (`paper`); for
        `"table"`, one such pair per constraint.

    Raises:
        UnknownNameError: No such experiment; the message lists the existing ones.
        ExperimentError: `trials`, `seed` or `workers` is out of range.
        OutputError: The folder cannot be created or written.
        MissingExtraError: joblib or matplotlib is not installed.
    """
    if name not in EXPERIMENTS:
        raise UnknownNameError("experiment", name, EXPERIMENTS)
    for what, value, least, most, remedy in (
        ("number of trials", trials, 1, 100_000, "the paper has 50"),  # more would run for months
        ("seed", seed, 0, np.inf, "0 is the usual one"),
        ("number of workers", 1 if workers is None else workers, 1, np.inf, "leave it out for all cores"),
    ):
        if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
            end = f"to {most:.0f}" if np.isfinite(most) else "up"
            raise ExperimentError(f"the {what} must be a whole number from {least} {end}, got {value!r}; {remedy}")
    folder = None if out is None else Path(out).expanduser().resolve()
    if folder is not None:
        try:
            folder.mkdir(parents=True, exist_ok=True)  # fail before the work, which takes minutes
        except OSError as error:
            raise OutputError(f"{folder} cannot be a folder for the results: {error.strerror}; name another") from error
    parts = [PARTS[part] for part in EXPERIMENTS[name]]
    total, counter = sum(part.size(trials) for part in parts), itertools.count(1)
    results: dict[str, Any] = {}
    for part in parts:

        def on_trial(name: str = part.name) -> None:
            if progress is not None:
                progress(name, next(counter) / total)

        with one_thread():
            rng = np.random.default_rng([seed, zlib.crc32(part.name.encode())])
            result: Any = part.run(trials, rng, workers, on_trial)
        results[part.name] = result.to_dict()
        if on_result is not None:
            on_result(part.name, result)
        if folder is not None:
            write_result(part.name, result, folder, {"trials": trials, "seed": seed})
    return results


def write_result(part: str, result: Any, folder: Path, settings: dict[str, Any]) -> list[Path]:
    """Write JSON, CSV, Markdown and figures of one experiment.

    Args:
        part: Name of the experiment and of its files.
        result: Its result, with the methods `to_dict`, `rows`, `markdown` and `figures`.
        folder: Folder for the files.
        settings: Settings of the run, stored in the JSON file.

    Returns:
        Paths of the files.

    Raises:
        OutputError: A file cannot be written.
        MissingExtraError: matplotlib is not installed.
    """
    content = {"experiment": part, "settings": settings, "result": result.to_dict()}
    table, rows = io.StringIO(), result.rows()
    writer = csv.DictWriter(table, list(dict.fromkeys(name for row in rows for name in row)), "", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    texts = {"json": json.dumps(content, indent=1, allow_nan=False) + "\n", "csv": table.getvalue()}
    texts["md"] = result.markdown() + "\n"
    paths = [write_atomically(folder / f"{part}.{kind}", text) for kind, text in texts.items()]
    for name, figure in result.figures().items():
        paths += save_figure(figure, folder, name)
    return paths
