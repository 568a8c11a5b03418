"""Independent trials, spread over the cores, each with a seed of its own."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Generic, TypeVar, final

import numpy as np

from manip_learn.errors import MissingExtraError
from manip_learn.experiments.experiment_result import ExperimentResult
from manip_learn.linalg import one_thread
from manip_learn.recordings.load import Progress

# a trial takes frozen settings and a generator, and returns plain numbers, strings, lists and dictionaries
Trial = Callable[[Any, np.random.Generator], dict[str, Any]]
_Result = TypeVar("_Result", bound=ExperimentResult)


@final
class TrialRunner:
    """Runs trials; their numbers depend on the seed only, not on how many workers there are.

    Args:
        workers: Number of processes; all cores by default. 1 runs in this process.
        progress: Called with the experiment's name and the completed fraction of `total`, 0 to 1.
        total: Number of trials of all experiments.
    """

    def __init__(self, workers: int | None = None, progress: Progress | None = None, total: int = 0):
        self.workers, self.progress, self.total = workers or os.cpu_count() or 1, progress, total
        self.done = 0

    def map(
        self, experiment: str, trial: Trial, settings: Sequence[Any], trials: int, seed: int
    ) -> list[list[dict[str, Any]]]:
        """The outcomes of all trials of each of some settings.

        Args:
            experiment: Part of the seeds.
            trial: A function at the top of a module.
            settings: Frozen dataclasses, one a case.
            trials: Number of trials of each case.
            seed: Root of all seeds.

        Raises:
            MissingExtraError: joblib is not installed.
        """
        work = [(experiment, trial, one, number, seed) for one in settings for number in range(trials)]
        outcomes: list[dict[str, Any]] = []
        made: Iterable[Any] = (_outcome(*one) for one in work)
        if self.workers > 1 and len(work) > 1:
            try:
                import joblib
            except ImportError as error:
                raise MissingExtraError("spreading trials over the cores", "experiments") from error
            made = joblib.Parallel(self.workers, return_as="generator")(joblib.delayed(_outcome)(*one) for one in work)
        with one_thread():  # here too: threads of this process share the setting
            for outcome in made:
                outcomes.append(outcome)
                self.done += 1
                if self.progress is not None:
                    self.progress(experiment, self.done / max(self.total, self.done))
        return [outcomes[i * trials : (i + 1) * trials] for i in range(len(settings))]


def _outcome(experiment: str, trial: Trial, settings: Any, number: int, seed: int) -> dict[str, Any]:
    """Outcome of a trial; it depends on the seed, the case and the trial's number alone."""
    label = zlib.crc32(f"{experiment} {sorted(asdict(settings).items())}".encode())
    with one_thread():
        return trial(settings, np.random.default_rng([seed, label, number]))


@final
@dataclass(frozen=True)
class Experiment(Generic[_Result]):
    """A part of the reproduction.

    Attributes:
        run: (trials, rng, runner) -> result; without a runner in this process.
        size: Trials that the user asks for -> trials that are reported as progress.
    """

    run: Callable[..., _Result]
    size: Callable[[int], int]


def of_trials(
    name: str, trial: Trial, cases: Mapping[str, Any], result: Callable[..., _Result], share: float = 1.0
) -> Experiment[_Result]:
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

    def run(trials: int, rng: np.random.Generator, runner: TrialRunner | None = None) -> _Result:
        runner = runner or TrialRunner(workers=1)
        outcomes = runner.map(name, trial, list(cases.values()), count(trials), int(rng.integers(2**53)))
        return result(dict(zip(cases, outcomes, strict=True)))

    return Experiment(run, lambda trials: count(trials) * len(cases))
