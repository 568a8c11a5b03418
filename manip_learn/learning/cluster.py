"""The parts of a source, read by this process or by the workers of a dask client."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

from manip_learn.errors import ManipLearnError, MissingExtraError
from manip_learn.recordings.load import Progress, TrajectorySource

_Result = TypeVar("_Result")

LOOPBACK = "127.0.0.1"  # dask's own defaults would listen on all networks
PATIENCE = "10s"  # for a scheduler that is elsewhere
# a worker of this machine that does not answer is gone: no half minute of waiting for it
LOCAL_CONFIG = {"distributed.comm.timeouts.connect": "3s"}


@contextmanager
def dask_client(address: str, n_workers: int | None = None) -> Iterator[Any]:
    """A client of a scheduler, or of a cluster on this machine that nobody else can reach.

    Args:
        address: `"local"`, or where the scheduler listens, e.g. `"tcp://10.0.0.1:8786"`.
        n_workers: Of a local cluster; one per processor by default, each a process with one thread.

    Raises:
        ManipLearnError: Nobody answers at the address.
        MissingExtraError: dask is not installed.
    """
    try:
        import dask
        from dask.distributed import Client, LocalCluster
    except ImportError as error:
        raise MissingExtraError("learning on a dask cluster", "dask") from error
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
    from dask.distributed import Security
    from dask.utils import parse_timedelta
    from distributed.comm.core import connect

    comm = await connect(address, parse_timedelta(PATIENCE), **Security().get_connection_args("client"))
    await comm.close()


def each_part(
    function: Callable[..., _Result],
    source: TrajectorySource,
    client: Any,
    progress: Progress | None,
    title: str,
    **arguments: Any,
) -> Iterator[_Result]:
    """function(number of a part, source=source, **arguments) of each part, in their order.

    The function is pure, so that a lost worker's share is done again by another. Without a client this process reads.

    Raises:
        ManipLearnError: Workers die again and again.
        MissingExtraError: A client, and dask is not installed.
    """
    if client is None:
        for number in range(source.n_parts):
            yield function(number, source=source, **arguments)
            if progress is not None:
                progress(title, (number + 1) / source.n_parts)
        return
    try:
        from dask.distributed import as_completed
        from distributed.scheduler import KilledWorker
    except ImportError as error:
        raise MissingExtraError("learning on a dask cluster", "dask") from error
    name = f"manip-learn-{function.__name__}"
    futures = client.map(function, range(source.n_parts), key=name, pure=False, source=source, **arguments)
    for done, _ in enumerate(as_completed(futures) if progress else (), start=1):
        progress(title, done / len(futures))  # type: ignore[misc]
    for future in futures:
        try:
            yield future.result()
        except KilledWorker as error:
            raise ManipLearnError(
                f"the dask workers die again and again on the same part ({error}): is there enough memory for each?"
            ) from error
