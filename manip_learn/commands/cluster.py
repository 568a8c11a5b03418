"""The dask client that `--dask` names."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def cluster_client(dask: str | None) -> Iterator[Any]:
    """A client of the scheduler at an address, or of a cluster on this machine (`local`); None without one.

    Raises:
        ManipLearnError: Nobody answers at the address.
        MissingExtraError: dask is not installed.
    """
    if dask is None:
        yield None
        return
    from manip_learn.learning.streaming.dask_executor import dask_client

    with dask_client(dask) as client:
        yield client
