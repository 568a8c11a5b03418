"""One thread of linear algebra, so that numbers do not depend on the machine's cores."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from manip_learn.errors import MissingExtraError


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """BLAS with one thread while this is open: with more, sums are split otherwise and the last digits differ.

    Raises:
        MissingExtraError: threadpoolctl is not installed.
    """
    try:
        from threadpoolctl import threadpool_limits
    except ImportError as error:
        raise MissingExtraError("running experiments", "experiments") from error
    with threadpool_limits(limits=1):
        yield
