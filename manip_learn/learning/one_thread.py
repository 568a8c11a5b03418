"""Linear algebra on one thread: on matrices this small a second thread costs more than it brings."""

from __future__ import annotations

import functools
from contextlib import AbstractContextManager
from typing import Any

from threadpoolctl import ThreadpoolController


@functools.cache
def _libraries() -> ThreadpoolController:
    # looking for the loaded BLAS libraries takes milliseconds: once is enough, NumPy and SciPy stay loaded
    import numpy.linalg  # noqa: F401
    import scipy.linalg  # noqa: F401

    return ThreadpoolController()


def one_thread() -> AbstractContextManager[Any]:
    """A context in which BLAS and LAPACK use one thread; the number that was set before comes back at its end."""
    return _libraries().limit(limits=1, user_api="blas")
