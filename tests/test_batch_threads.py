"""Work on many postures shared among threads."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from manip_learn.robot.batch.postures import LEAST, cores, in_threads


@pytest.mark.parametrize("n", [0, 1, LEAST, 3 * LEAST + 7])
@pytest.mark.parametrize("workers", [1, 2, 5, None])
def test_every_posture_is_done_once(n: int, workers: int | None) -> None:
    """The slices cover everything and do not overlap; few postures stay in the caller's thread."""
    done, threads = np.zeros(n, dtype=int), set()

    def work(part: slice) -> None:
        done[part] += 1
        threads.add(threading.get_ident())

    in_threads(n, workers, work)
    assert np.all(done == 1)
    if n <= LEAST:
        assert threads == {threading.get_ident()}


def test_errors_reach_the_caller() -> None:
    """What fails in a thread fails for the caller."""

    def work(part: slice) -> None:
        if part.stop == 4 * LEAST:
            raise ValueError("the last part")

    with pytest.raises(ValueError, match="the last part"):
        in_threads(4 * LEAST, 2, work)
    assert cores() >= 1
