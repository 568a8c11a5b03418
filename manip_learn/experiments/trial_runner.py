"""Independent trials, spread over the cores, each with a seed of its own."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import zlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal, final

import numpy as np

from manip_learn.errors import MissingExtraError
from manip_learn.experiments.part_store import PartStore, library_digest
from manip_learn.linalg import one_thread

Progress = Callable[[int, int], None]
Backend = Literal["loky", "threading", "dask"]
BACKENDS = ("loky", "threading", "dask")
# a trial takes frozen settings and a generator, and returns plain numbers, strings, lists and dictionaries
Trial = Callable[[Any, np.random.Generator], dict[str, Any]]
PART = 5  # trials that are run and kept together


@final
class TrialRunner:
    """Runs trials; their numbers depend on the seed only, not on how many workers there are.

    Args:
        workers: Number of processes; all cores by default. 1 runs in this process.
        backend: joblib's: `"loky"` (processes), `"threading"`, or `"dask"` (an embedded cluster on 127.0.0.1).
        store: Where finished parts are kept and found.
        progress: Called with the number of trials done and their total.
        total: Number of trials that `progress` counts to.
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
                self.advance(key["count"])
        work = [(trial, settings[i], key) for i, _, key in missing]
        with one_thread():  # here too: threads of this process share the setting
            for number, part in self._run(work):
                i, first, key = missing[number]
                results[i, first] = part
                if self.store is not None:
                    self.store.keep(key, part)
                self.advance(len(part))
        return [[r for first in range(0, trials, PART) for r in results[i, first]] for i in range(len(settings))]

    def advance(self, trials: int = 1) -> None:
        """Report trials as done."""
        self.done += trials
        if self.progress is not None:
            self.progress(self.done, max(self.total, self.done))

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
