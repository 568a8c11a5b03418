"""Executor over the samples by the workers of a dask client, with the same answer for any number of them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, final

from manip_learn.errors import ManipLearnError, MissingExtraError
from manip_learn.learning.streaming.accumulator import Accumulator, Chunk, Executor, accumulate_part, merge_optional
from manip_learn.learning.streaming.sample_stream import SampleStream
from manip_learn.recordings.trajectory_source import Progress, TrajectorySource

try:
    import dask
    from dask.distributed import Client, Future, LocalCluster, as_completed
    from distributed.scheduler import KilledWorker
except ImportError as error:
    raise MissingExtraError("learning on a dask cluster", "dask") from error

Result = TypeVar("Result")

LOOPBACK = "127.0.0.1"
PATIENCE = "10s"
# a worker of this machine that does not answer is gone: no half minute of waiting for it
LOCAL_CONFIG = {"distributed.comm.timeouts.connect": "3s"}
# every call of a client needs names of its own: the same name would stand for the result of an earlier fit
_CALLS = itertools.count()


@contextmanager
def dask_client(address: str, n_workers: int | None = None) -> Iterator[Client]:
    """A client of a scheduler, or of a cluster on this machine that nobody else can reach.

    Args:
        address: `"local"`, or where the scheduler listens, e.g. `"tcp://10.0.0.1:8786"`.
        n_workers: Of a local cluster; one per processor by default, each a process with one thread.

    Raises:
        ManipLearnError: Nobody answers at the address.
    """
    if address != "local":
        try:
            client = Client(address, timeout=PATIENCE)
        except (OSError, ValueError) as error:
            raise ManipLearnError(
                f"there is no dask scheduler at {address!r} ({error}): start one with `dask scheduler`, or use 'local'"
            ) from error
        with client:
            yield client
        return
    # dask's own defaults would listen on all networks
    with (
        dask.config.set(LOCAL_CONFIG),  # pyright: ignore[reportPrivateImportUsage]
        LocalCluster(
            n_workers=n_workers, threads_per_worker=1, host=LOOPBACK, dashboard_address=f"{LOOPBACK}:0"
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


@contextmanager
def connected_executor(client: Client, stream: SampleStream, progress: Progress | None) -> Iterator[DaskExecutor]:
    """Executor for one fit; what the workers hold for them is released at the end."""
    executor = DaskExecutor(client, stream, progress)
    try:
        yield executor
    finally:
        executor.release()


@final
class DaskExecutor(Executor):
    """Each part is read once, and kept by the worker that read it; a pass is one task per part and a tree of merges.

    All tasks are pure functions of what the source says, so that a lost worker's share is done again by another.

    Args:
        client: Whose workers.
        stream: The samples.
        progress: Told how far a pass is.
    """

    def __init__(self, client: Client, stream: SampleStream, progress: Progress | None = None):
        self._client = client
        self._progress = progress
        self._prefix = f"manip-learn-{client.id}-{next(_CALLS)}"
        self._passes = itertools.count()
        self._parts = [
            client.submit(_read, stream.alone(i), i, key=f"{self._prefix}-read-{i}", pure=False)
            for i in range(stream.source.n_parts)
        ]

    def total(self, accumulator: Accumulator, first_trajectories: dict[int, int], title: str) -> Any:
        """One pass.

        Raises:
            ManipLearnError: Workers die again and again.
        """
        name = f"{self._prefix}-pass-{next(self._passes)}"
        level: list[Future] = [
            self._client.submit(
                _accumulated, accumulator, part, first_trajectories.get(i, 0), key=f"{name}-part-{i}", pure=False
            )
            for i, part in enumerate(self._parts)
        ]
        leaves, depth = level, 0
        while len(level) > 1:
            depth += 1
            pairs = [level[i : i + 2] for i in range(0, len(level), 2)]
            level = [
                self._client.submit(merge_optional, accumulator, *pair, key=f"{name}-sum-{depth}-{i}", pure=False)
                if len(pair) == 2
                else pair[0]
                for i, pair in enumerate(pairs)
            ]
        if self._progress is not None:
            for done, _ in enumerate(as_completed(leaves), start=1):
                self._progress(title, done / len(leaves))
        try:
            return level[0].result()
        except KilledWorker as error:
            raise ManipLearnError(
                f"the dask workers die again and again on the same part ({error}): is there enough memory for each?"
            ) from error

    def release(self) -> None:
        """Let the workers forget the samples."""
        for part in self._parts:
            part.release()
        self._parts = []


def map_parts(
    client: Client,
    function: Callable[..., Result],
    source: TrajectorySource,
    arguments: tuple[Any, ...],
    progress: Progress | None,
    title: str,
) -> Iterator[Result]:
    """function(one part of the source, *arguments) of each part, made by the workers, in the order of the parts.

    Raises:
        ManipLearnError: Workers die again and again.
    """
    prefix = f"manip-learn-{client.id}-{next(_CALLS)}"
    futures = [
        client.submit(function, source.alone(i), *arguments, key=f"{prefix}-map-{i}", pure=False)
        for i in range(source.n_parts)
    ]
    if progress is not None:
        for done, _ in enumerate(as_completed(futures), start=1):
            progress(title, done / len(futures))
    for future in futures:
        try:
            yield future.result()
        except KilledWorker as error:
            raise ManipLearnError(
                f"the dask workers die again and again on the same part ({error}): is there enough memory for each?"
            ) from error


def _read(stream: SampleStream, number: int) -> tuple[list[Chunk], list[str]]:
    notes: list[str] = []
    return list(stream.chunks(0, notes, number)), notes


def _accumulated(accumulator: Accumulator, held: tuple[list[Chunk], list[str]], first_trajectory: int) -> Any:
    samples, notes = held
    return accumulate_part(accumulator, samples, first_trajectory, notes)
