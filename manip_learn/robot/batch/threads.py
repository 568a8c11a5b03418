"""Work on many postures shared among threads: what runs in bulk holds no interpreter lock."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from manip_learn.errors import ConfigurationError

LEAST = 2048  # postures a thread: fewer take less time than starting it


def in_threads(n: int, workers: int | None, work: Callable[[slice], None]) -> None:
    """Call `work` on slices that together cover 0 .. n, in as many threads.

    The numbers do not depend on the number of workers: every posture is computed by itself.

    Args:
        n: Number of postures.
        workers: Number of threads; None for one per core that this process may use.
        work: Takes one slice, writes to that part of arrays made before.

    Raises:
        ConfigurationError: Fewer than one worker.
    """
    if workers is None:
        workers = cores()
    if workers < 1:
        raise ConfigurationError(
            f"workers must be a number of threads, 1 or more, or None for all cores; got {workers}"
        )
    parts = min(workers, max(1, n // LEAST))
    if parts == 1:
        work(slice(0, n))
        return
    ends = [n * i // parts for i in range(parts + 1)]
    with ThreadPoolExecutor(parts) as threads:
        # errors of a thread are raised here
        list(threads.map(work, [slice(a, b) for a, b in zip(ends, ends[1:], strict=False)]))


def cores() -> int:
    """Number of cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # macOS
        return os.cpu_count() or 1
