"""Independent trials, distributed over the cores, each with its own seed."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from numpy.random import Generator, default_rng

from manip_learn.errors import MissingExtraError
from manip_learn.experiments.results import TrialsResult
from manip_learn.linalg import one_thread


@dataclass(frozen=True)
class Trials:
    """Experiment that runs each of its cases in independent trials, on several processes.

    Attributes:
        name: Name of the experiment, from which the seeds are computed.
        trial: Function that takes a case and a random generator and returns a dictionary of numbers, texts, lists and
            dictionaries. It must be a function at the top level of a module.
        cases: Name of a case -> its settings, a frozen dataclass.
        result: Class of the result, which is built from the outcomes: name of a case -> one dictionary per trial.
        share: Number of trials of each case, as a multiple of the number that the user requests; at least one is run.
    """

    name: str
    trial: Callable[[Any, Generator], dict[str, Any]]
    cases: Mapping[str, Any]
    result: type[TrialsResult]
    share: float = 1.0

    def size(self, trials: int) -> int:
        """Return the number of trials of all cases.

        Args:
            trials: Number of trials that the user requests.
        """
        return max(1, round(self.share * trials)) * len(self.cases)

    def run(
        self, trials: int, rng: Generator, workers: int | None = None, on_trial: Callable[[], object] = lambda: None
    ) -> TrialsResult:
        """Run all trials; their numbers do not depend on the number of workers.

        Args:
            trials: Number of trials that the user requests.
            rng: Random generator from which all seeds are derived.
            workers: Number of processes; None for all cores, 1 to run in this process.
            on_trial: Function without arguments that is called after each trial.

        Returns:
            The outcomes of all cases.

        Raises:
            MissingExtraError: joblib is not installed.
        """
        seed, n = int(rng.integers(2**53)), self.size(trials) // len(self.cases)
        workers = workers or os.cpu_count() or 1
        work = [(self.name, self.trial, case, number, seed) for case in self.cases.values() for number in range(n)]
        running: Iterable[Any] = (_outcome(*one) for one in work)
        if workers > 1 and len(work) > 1:
            try:
                import joblib
            except ImportError as error:
                raise MissingExtraError("spreading trials over the cores", "experiments") from error
            running = joblib.Parallel(workers, return_as="generator")(joblib.delayed(_outcome)(*one) for one in work)
        outcomes = []
        with one_thread():  # needed here too: threads of this process share the setting
            for outcome in running:
                outcomes.append(outcome)
                on_trial()
        return self.result({case: outcomes[i * n : (i + 1) * n] for i, case in enumerate(self.cases)})


def _outcome(experiment: str, trial: Callable[..., Any], case: Any, number: int, seed: int) -> dict[str, Any]:
    """Return the outcome of a trial; it depends only on the seed, the case and the trial's number."""
    label = zlib.crc32(f"{experiment} {sorted(asdict(case).items())}".encode())
    with one_thread():
        return trial(case, default_rng([seed, label, number]))
