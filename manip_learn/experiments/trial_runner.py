"""Independent trials, spread over the cores, each with a seed of its own."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar, final

import numpy as np

from manip_learn.atomic_write import write_atomically
from manip_learn.errors import MissingExtraError, OutputError
from manip_learn.experiments.experiment_result import ExperimentResult
from manip_learn.linalg import one_thread
from manip_learn.recordings.trajectory_source import Progress

Backend = Literal["loky", "threading", "dask"]
BACKENDS = ("loky", "threading", "dask")
# a trial takes frozen settings and a generator, and returns plain numbers, strings, lists and dictionaries
Trial = Callable[[Any, np.random.Generator], dict[str, Any]]
Result = TypeVar("Result", bound=ExperimentResult)
MARKER = "reproduction.json"
FORMAT = "manip_learn.reproduction"
PARTS = "parts"
PART = 5  # trials that are run and kept together


@final
class PartStore:
    """Finished parts as JSON files, found again by everything that they depend on.

    Args:
        folder: Output folder; it is made, or must be empty, or one of ours.

    Raises:
        OutputError: The folder holds other files, is a file, or cannot be written.
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder).expanduser().resolve()
        marker = self.folder / MARKER
        try:
            if self.folder.exists() and not self.folder.is_dir():
                raise OutputError(f"{self.folder} is a file; give a folder for the results")
            others = [] if not self.folder.exists() else sorted(p.name for p in self.folder.iterdir())
        except OSError as error:
            raise OutputError(f"cannot read {self.folder}: {error.strerror}; choose another folder") from error
        if others and not _is_ours(marker):
            shown = ", ".join(others[:3]) + (" ..." if len(others) > 3 else "")
            raise OutputError(
                f"{self.folder} holds other files ({shown}): give a new or empty folder, or that of an earlier run"
            )
        if not others:
            write_atomically(marker, json.dumps({"format": FORMAT}) + "\n")

    def load(self, key: dict[str, Any]) -> list[dict[str, Any]] | None:
        """What was kept under a key; None if nothing was, or if the file is damaged."""
        path = self._path(key)
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return content.get("value") if isinstance(content, dict) and content.get("key") == _plain(key) else None

    def keep(self, key: dict[str, Any], value: list[dict[str, Any]]) -> None:
        """Write a finished part, whole or not at all.

        Raises:
            OutputError: It cannot be written.
        """
        write_atomically(self._path(key), json.dumps({"key": _plain(key), "value": value}) + "\n")

    def _path(self, key: dict[str, Any]) -> Path:
        name = str(key.get("experiment", "part")).replace("/", "-")
        return self.folder / PARTS / f"{name}-{_digest(key)[:20]}.json"


@cache
def library_digest() -> str:
    """SHA-256 of the library's source: parts made by other code are not used."""
    digest = hashlib.sha256()
    package = Path(__file__).resolve().parents[1]
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


@final
class TrialRunner:
    """Runs trials; their numbers depend on the seed only, not on how many workers there are.

    Args:
        workers: Number of processes; all cores by default. 1 runs in this process.
        backend: joblib's: `"loky"` (processes), `"threading"`, or `"dask"` (an embedded cluster on 127.0.0.1).
        store: Where finished parts are kept and found.
        progress: Called with the experiment's name and the completed fraction of `total`, 0 to 1.
        total: Number of trials of all experiments that this runner is for.
    """

    def __init__(
        self,
        workers: int | None = None,
        backend: Backend = "loky",
        store: PartStore | None = None,
        progress: Progress | None = None,
        total: int = 0,
    ):
        self.workers = workers or os.cpu_count() or 1
        self.backend: Backend = backend
        self.store = store
        self.progress = progress
        self.total = total
        self.done = 0

    def map(
        self, experiment: str, trial: Trial, settings: Sequence[Any], trials: int, seed: int
    ) -> list[list[dict[str, Any]]]:
        """All trials of all settings, in order; parts that are in the store are not run again.

        Args:
            experiment: Name, part of the seeds.
            trial: A function at the top of a module.
            settings: Frozen dataclasses.
            trials: Number of trials of each.
            seed: Root of all seeds.

        Raises:
            MissingExtraError: joblib or dask is not installed.
            OutputError: A part cannot be written.
        """
        keys = [
            (i, first, self._key(experiment, trial, one, first, min(PART, trials - first), seed))
            for i, one in enumerate(settings)
            for first in range(0, trials, PART)
        ]
        results: dict[tuple[int, int], list[dict[str, Any]]] = {}
        missing = []
        for i, first, key in keys:
            kept = None if self.store is None else self.store.load(key)
            if kept is None:
                missing.append((i, first, key))
            else:
                results[i, first] = kept
                self.advance(experiment, key["count"])
        work = [(trial, settings[i], key) for i, _, key in missing]
        with one_thread():  # here too: threads of this process share the setting
            for number, part in self._run(work):
                i, first, key = missing[number]
                results[i, first] = part
                if self.store is not None:
                    self.store.keep(key, part)
                self.advance(experiment, len(part))
        return [[r for first in range(0, trials, PART) for r in results[i, first]] for i in range(len(settings))]

    def advance(self, experiment: str, trials: int) -> None:
        """Report trials of an experiment as done."""
        self.done += trials
        if self.progress is not None:
            self.progress(experiment, self.done / max(self.total, self.done))

    def _key(self, experiment: str, trial: Trial, one: Any, first: int, count: int, seed: int) -> dict[str, Any]:
        return {
            "experiment": experiment,
            "trial": f"{trial.__module__}.{trial.__qualname__}",
            "settings": dataclasses.asdict(one),
            "first": first,
            "count": count,
            "seed": seed,
            "library": library_digest() if self.store is not None else "",
        }

    def _run(self, work: list[tuple[Trial, Any, dict[str, Any]]]) -> Iterator[tuple[int, list[dict[str, Any]]]]:
        if self.workers == 1 or len(work) <= 1:
            yield from (_numbered(n, *w) for n, w in enumerate(work))
            return
        try:
            import joblib
        except ImportError as error:
            raise MissingExtraError("spreading trials over the cores", "experiments") from error
        with _cluster(self.backend, self.workers), joblib.parallel_config(backend=self.backend, n_jobs=self.workers):
            parallel = joblib.Parallel(return_as="generator_unordered", pre_dispatch="2*n_jobs", batch_size=1)
            yield from parallel(joblib.delayed(_numbered)(n, *w) for n, w in enumerate(work))


@final
@dataclasses.dataclass(frozen=True)
class Experiment(Generic[Result]):
    """A part of the reproduction.

    Attributes:
        run: (trials, rng, runner) -> result; without a runner in this process.
        size: Trials that the user asks for -> trials that are reported as progress.
    """

    run: Callable[..., Result]
    size: Callable[[int], int]


def of_trials(
    name: str,
    trial: Trial,
    cases: Mapping[Any, Any],
    result: Callable[[dict[Any, list[dict[str, Any]]]], Result],
    share: Callable[[int], int] = lambda trials: trials,
) -> Experiment[Result]:
    """An experiment that runs each of its cases in independent trials.

    Args:
        name: Part of the seeds.
        trial: A function at the top of a module.
        cases: What the result calls a case -> frozen dataclass.
        result: Made from what a case is called -> outcome of each of its trials.
        share: Trials that the user asks for -> trials of each case, at least one.
    """

    def count(trials: int) -> int:
        return max(1, share(trials))

    def run(trials: int, rng: np.random.Generator, runner: TrialRunner | None = None) -> Result:
        runner = runner or TrialRunner(workers=1)
        outcomes = runner.map(name, trial, list(cases.values()), count(trials), int(rng.integers(2**53)))
        return result(dict(zip(cases, outcomes, strict=True)))

    return Experiment(run, lambda trials: count(trials) * len(cases))


def two_fifths(trials: int) -> int:
    """Of the paper's 50 trials 20, which are enough for paired tests."""
    return round(0.4 * trials)


def a_tenth(trials: int) -> int:
    """Of the paper's 50 trials 5."""
    return trials // 10


def _numbered(number: int, trial: Trial, one: Any, key: dict[str, Any]) -> tuple[int, list[dict[str, Any]]]:
    label = zlib.crc32(f"{key['experiment']} {sorted(key['settings'].items())}".encode())
    numbers = range(key["first"], key["first"] + key["count"])
    with one_thread():
        return number, [trial(one, np.random.default_rng([key["seed"], label, i])) for i in numbers]


@contextlib.contextmanager
def _cluster(backend: Backend, workers: int) -> Iterator[None]:
    if backend != "dask":
        yield
        return
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise MissingExtraError("the dask backend", "dask") from error
    # by default the dashboard listens on all interfaces
    with (
        LocalCluster(
            n_workers=workers, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"
        ) as cluster,
        Client(cluster),
    ):
        yield


def _digest(key: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(_plain(key), sort_keys=True).encode()).hexdigest()


def _plain(key: dict[str, Any]) -> Any:
    return json.loads(json.dumps(key, sort_keys=True))


def _is_ours(marker: Path) -> bool:
    try:
        content = json.loads(marker.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and content.get("format") == FORMAT
