"""Executor over the samples by the workers of a dask client, with the same answer for any number of them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar, final

from manip_learn.errors import ManipLearnError, MissingExtraError
from manip_learn.learning.streaming.sample_stream import (
    Accumulator,
    Chunk,
    Executor,
    SampleStream,
    accumulate,
    chunks,
    merge_parts,
    merge_tree,
)
from manip_learn.recordings.trajectory_source import Progress, TrajectorySource

try:
    import dask
    from dask.distributed import Client, Future, LocalCluster, Security, as_completed
    from dask.utils import parse_timedelta
    from distributed.comm.core import connect
    from distributed.scheduler import KilledWorker
except ImportError as error:
    raise MissingExtraError("learning on a dask cluster", "dask") from error

Result = TypeVar("Result")

LOOPBACK = "127.0.0.1"
PATIENCE = "10s"
# a worker of this machine that does not answer is gone: no half minute of waiting for it
LOCAL_CONFIG = {"distributed.comm.timeouts.connect": "3s"}


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
            with ThreadPoolExecutor(1) as beside:  # a notebook has a loop of its own
                beside.submit(asyncio.run, _greet(address)).result()
            client = Client(address, timeout=PATIENCE)
        except (OSError, ValueError, TypeError, AssertionError, ImportError, RuntimeError) as error:
            scheme = address.partition("://")[0] if "://" in address else "tcp"
            start = "start one with `dask scheduler`, or use 'local'"
            needs = {
                "tcp": start,
                "tls": f"tls needs certificates in dask's settings (distributed.comm.tls); or {start}",
            }.get(scheme, f"{scheme} needs packages and settings of its own; use tcp://HOST:PORT, or 'local'")
            raise ManipLearnError(f"there is no dask scheduler at {address!r} ({error}): {needs}") from error
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


async def _greet(address: str) -> None:
    """Connect to a scheduler and leave again.

    A client that cannot connect stays half made and closes itself when it is collected: where another one is being made
    at that moment, dask waits for a lock that it holds.
    """
    comm = await connect(address, parse_timedelta(PATIENCE), **Security().get_connection_args("client"))
    await comm.close()


@final
class DaskExecutor(Executor):
    """Each part is read once, and kept by the worker that read it; a pass is one task per part and a tree of merges.

    All tasks are pure functions of what the source says, so that a lost worker's share is done again by another. The
    workers forget the samples with the last reference to the executor.

    Args:
        client: Whose workers.
        stream: The samples.
        progress: Told how far a pass is.
    """

    def __init__(self, client: Client, stream: SampleStream, progress: Progress | None = None):
        n = stream.source.n_parts
        self._client = client
        self._progress = progress
        self._parts = _mapped(client, "read", _read, [stream.alone(i) for i in range(n)], list(range(n)))

    def total(self, accumulator: Accumulator, title: str, first_trajectories: dict[int, int] | None = None) -> Any:
        """One pass.

        Raises:
            ManipLearnError: Workers die again and again.
        """
        n = len(self._parts)
        first = [(first_trajectories or {}).get(i, 0) for i in range(n)]
        parts = _mapped(self._client, "pass", _accumulated, [accumulator] * n, self._parts, first)
        total = merge_tree(partial(self._client.submit, merge_parts, accumulator, pure=False), parts)
        return next(_results([total], parts, self._progress, title))


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
    alone = [source.alone(i) for i in range(source.n_parts)]
    futures = _mapped(client, "map", function, alone, *([argument] * len(alone) for argument in arguments))
    yield from _results(futures, futures, progress, title)


def _mapped(client: Client, name: str, function: Callable[..., Any], *arguments: list[Any]) -> list[Future]:
    """Futures of function of the first, the second, ... of each list; named anew, or they would be an earlier fit's."""
    return client.map(function, *arguments, key=f"manip-learn-{name}", pure=False)


def _results(futures: list[Future], leaves: list[Future], progress: Progress | None, title: str) -> Iterator[Any]:
    """What the workers make; the progress is the share of the leaves that are done.

    Raises:
        ManipLearnError: Workers die again and again.
    """
    if progress is not None:
        for done, _ in enumerate(as_completed(leaves), start=1):
            progress(title, done / len(leaves))
    for future in futures:
        try:
            yield future.result()
        except KilledWorker as error:
            raise ManipLearnError(
                f"the dask workers die again and again on the same part ({error}): is there enough memory for each?"
            ) from error


def _read(stream: SampleStream, number: int) -> tuple[list[Chunk], list[str]]:
    notes: list[str] = []
    return list(chunks(stream.trajectories(0, notes), number)), notes


def _accumulated(accumulator: Accumulator, held: tuple[list[Chunk], list[str]], first_trajectory: int) -> Any:
    return accumulate(accumulator, *held, first_trajectory)
