"""Independent trials, spread over the cores, each with a seed of its own; finished parts are kept."""

from __future__ import annotations

import hashlib
import json
import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar, final

import numpy as np

from manip_learn.atomic_write import write_atomically
from manip_learn.errors import MissingExtraError, OutputError
from manip_learn.experiments.experiment_result import ExperimentResult
from manip_learn.linalg import one_thread
from manip_learn.recordings.trajectory_source import Progress

Backend = Literal["loky", "threading"]
BACKENDS = ("loky", "threading")
# a trial takes frozen settings and a generator, and returns plain numbers, strings, lists and dictionaries
Trial = Callable[[Any, np.random.Generator], dict[str, Any]]
Result = TypeVar("Result", bound=ExperimentResult)
MARKER = "reproduction.json"
FORMAT = "manip_learn.reproduction"
PARTS = "parts"
PART = 5  # trials that are run and kept together: an interruption loses a minute at most


@final
@dataclass(frozen=True)
class Part:
    """Some consecutive trials of one case.

    Attributes:
        experiment: Name, a part of the seeds.
        trial: A function at the top of a module.
        settings: Frozen dataclass, the case.
        first: Number of the first trial.
        count: Number of trials.
        seed: Root of all seeds.
    """

    experiment: str
    trial: Trial
    settings: Any
    first: int
    count: int
    seed: int

    def run(self) -> list[dict[str, Any]]:
        """Outcome of each trial; it depends on the seed, the case and the trial's number alone."""
        label = zlib.crc32(f"{self.experiment} {sorted(asdict(self.settings).items())}".encode())
        rngs = (np.random.default_rng([self.seed, label, self.first + i]) for i in range(self.count))
        with one_thread():
            return [self.trial(self.settings, rng) for rng in rngs]

    @property
    def file(self) -> str:
        """Name of the file that keeps it: another one wherever anything differs that the outcome depends on."""
        trial = f"{self.trial.__module__}.{self.trial.__qualname__}"
        words = (self.experiment, trial, asdict(self.settings), self.first, self.count, self.seed, library_digest())
        return f"{self.experiment}-{hashlib.sha256(json.dumps(words, sort_keys=True).encode()).hexdigest()[:40]}.json"


@cache
def library_digest() -> str:
    """SHA-256 of the library's source: parts made by other code are not used."""
    digest = hashlib.sha256()
    package = Path(__file__).resolve().parents[1]
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


@final
class PartStore:
    """Finished parts as JSON files.

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
            others = sorted(p.name for p in self.folder.iterdir()) if self.folder.exists() else []
        except OSError as error:
            raise OutputError(f"cannot read {self.folder}: {error.strerror}; choose another folder") from error
        content = _read(marker)
        if others and not (isinstance(content, dict) and content.get("format") == FORMAT):
            shown = ", ".join(others[:3]) + (" ..." if len(others) > 3 else "")
            raise OutputError(
                f"{self.folder} holds other files ({shown}): give a new or empty folder, or that of an earlier run"
            )
        if not others:
            write_atomically(marker, json.dumps({"format": FORMAT}) + "\n")

    def load(self, part: Part) -> list[dict[str, Any]] | None:
        """The outcomes that were kept; None if none were, or if the file is damaged."""
        kept = _read(self.folder / PARTS / part.file)
        return kept if isinstance(kept, list) and len(kept) == part.count else None

    def keep(self, part: Part, outcomes: list[dict[str, Any]]) -> None:
        """Write the outcomes of a part, whole or not at all; OutputError if they cannot be written."""
        write_atomically(self.folder / PARTS / part.file, json.dumps(outcomes) + "\n")


@final
class TrialRunner:
    """Runs trials; their numbers depend on the seed only, not on how many workers there are.

    Args:
        workers: Number of processes; all cores by default. 1 runs in this process.
        backend: joblib's: `"loky"` (processes) or `"threading"`.
        store: Where finished parts are kept and found.
        progress: Called with the experiment's name and the completed fraction of `total`, 0 to 1.
        total: Number of trials of all experiments.
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
        """All trials of all settings, in order; parts in the store are not run again. Arguments as in `Part`.

        Raises:
            MissingExtraError: joblib is not installed.
            OutputError: A part cannot be written.
        """
        parts = [
            Part(experiment, trial, one, first, min(PART, trials - first), seed)
            for one in settings
            for first in range(0, trials, PART)
        ]
        outcomes = [None if self.store is None else self.store.load(part) for part in parts]
        for part, kept in zip(parts, outcomes, strict=True):
            if kept is not None:
                self._advance(part)
        with one_thread():  # here too: threads of this process share the setting
            for number, found in self._run([(n, parts[n]) for n, kept in enumerate(outcomes) if kept is None]):
                outcomes[number] = found
                if self.store is not None:
                    self.store.keep(parts[number], found)
                self._advance(parts[number])
        flat = [outcome for part in outcomes for outcome in part or ()]
        return [flat[i * trials : (i + 1) * trials] for i in range(len(settings))]

    def _advance(self, part: Part) -> None:
        self.done += part.count
        if self.progress is not None:
            self.progress(part.experiment, self.done / max(self.total, self.done))

    def _run(self, work: list[tuple[int, Part]]) -> Iterator[tuple[int, list[dict[str, Any]]]]:
        if self.workers == 1 or len(work) <= 1:
            yield from (_numbered(*one) for one in work)
            return
        try:
            import joblib
        except ImportError as error:
            raise MissingExtraError("spreading trials over the cores", "experiments") from error
        with joblib.parallel_config(backend=self.backend, n_jobs=self.workers):
            parallel = joblib.Parallel(return_as="generator_unordered", pre_dispatch="2*n_jobs", batch_size=1)
            yield from parallel(joblib.delayed(_numbered)(*one) for one in work)


def _numbered(number: int, part: Part) -> tuple[int, list[dict[str, Any]]]:
    return number, part.run()


@final
@dataclass(frozen=True)
class Experiment(Generic[Result]):
    """A part of the reproduction.

    Attributes:
        run: (trials, rng, runner) -> result; without a runner in this process.
        size: Trials that the user asks for -> trials that are reported as progress.
    """

    run: Callable[..., Result]
    size: Callable[[int], int]


def of_trials(
    name: str, trial: Trial, cases: Mapping[str, Any], result: Callable[..., Result], share: float = 1.0
) -> Experiment[Result]:
    """An experiment that runs each of its cases in independent trials.

    Args:
        name: Part of the seeds.
        trial: A function at the top of a module.
        cases: Name of a case -> frozen dataclass.
        result: Made from the outcomes: name of a case -> one dictionary per trial.
        share: Trials of each case over those that the user asks for; at least one is run.
    """

    def count(trials: int) -> int:
        return max(1, round(share * trials))

    def run(trials: int, rng: np.random.Generator, runner: TrialRunner | None = None) -> Result:
        runner = runner or TrialRunner(workers=1)
        outcomes = runner.map(name, trial, list(cases.values()), count(trials), int(rng.integers(2**53)))
        return result(dict(zip(cases, outcomes, strict=True)))

    return Experiment(run, lambda trials: count(trials) * len(cases))
