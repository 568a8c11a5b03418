"""Work on many postures shared among threads."""

from __future__ import annotations

import itertools
import threading

import pytest

from manip_learn.errors import ConfigurationError
from manip_learn.robot.batch.postures import LEAST, cores, in_threads


def test_every_posture_is_done_once() -> None:
    """The slices cover everything and do not overlap; few postures stay in the caller's thread."""
    for n, workers in itertools.product((0, 1, LEAST, 3 * LEAST + 7), (1, 2, 5, None)):
        done: list[tuple[int, int]] = []
        in_threads(n, workers, lambda part: done.append((part.start, part.stop)))  # noqa: B023
        ends = sorted(done)
        assert ends[0][0] == 0 and ends[-1][1] == n and all(a[1] == b[0] for a, b in itertools.pairwise(ends))
        assert len(done) == min(workers or cores(), max(1, n // LEAST))
    threads = set()
    in_threads(LEAST, 5, lambda part: threads.add(threading.get_ident()))
    assert threads == {threading.get_ident()}
    with pytest.raises(ConfigurationError, match="workers"):
        in_threads(1, 0, print)


def test_errors_reach_the_caller() -> None:
    """What fails in a thread fails for the caller."""

    def work(part: slice) -> None:
        if part.stop == 4 * LEAST:
            raise ValueError("the last part")

    with pytest.raises(ValueError, match="the last part"):
        in_threads(4 * LEAST, 2, work)
    assert cores() >= 1
