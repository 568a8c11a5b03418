"""Joint states of several publishers in one table: nothing is invented where one of them was silent."""

from __future__ import annotations

import numpy as np
import pytest

from manip_learn.errors import RecordingError
from manip_learn.recordings.streams import JointStates, joint_groups, merge

MS = 1_000_000  # [ns]
START = 1_700_000_000_123_456_789  # [ns] an integer that float64 cannot hold


def group(topic: str, names: str, stamps: np.ndarray, *, u: bool = True) -> JointStates:
    """Joints whose positions are 0.001 per millisecond times 1, 2, 3, ..., and their velocities."""
    slopes = 1.0 + np.arange(len(names.split()))
    q = np.outer((stamps - START) / MS, 1e-3 * slopes)
    return states(topic, names, stamps, q, np.ones((len(stamps), 1)) * slopes if u else None)


def states(topic: str, names: str, stamps: np.ndarray, q: np.ndarray, u: np.ndarray | None, *received) -> JointStates:
    """Messages of one topic."""
    arrays = {"position": q} | ({} if u is None else {"velocity": u})
    return JointStates(topic, tuple(names.split()), stamps, arrays, *received)


def every(step: float, first: float, last: float) -> np.ndarray:
    """Stamps at a regular step [ms]."""
    return START + (np.arange(first, last + 1e-9, step) * MS).astype(np.int64)


def milliseconds(merged: JointStates) -> list[float]:
    """Stamps of what was merged, from the start."""
    return ((merged.stamps - START) / MS).tolist()


def test_gaps_of_a_publisher_are_not_bridged():
    """Where another publisher was silent far longer than usual the samples are left out, and the note counts them."""
    arm = group("/arm", "a b", every(10, 0, 2000))
    stamps = np.concatenate([every(20, 5, 805), every(20, 1505, 2005)])
    merged, notes = merge([arm, group("/hand", "c", stamps)], frozenset())
    kept = np.array(milliseconds(merged))
    np.testing.assert_array_equal(kept, [*range(10, 801, 10), *range(1510, 2001, 10)])
    assert "71 samples left out" in " ".join(map(str, notes))
    np.testing.assert_allclose(merged.arrays["position"], np.outer(kept, [1e-3, 2e-3, 1e-3]), rtol=0, atol=1e-12)


def test_velocities_are_interpolated_too_or_all_left_out():
    """Velocities belong to the stamps of their row; with one publisher that has none there are none, and it is said."""
    arm, late = group("/arm", "a b", every(10, 0, 100)), every(10, 5, 95)
    hand = states("/hand", "c", late, np.zeros((10, 1)), (np.arange(10.0) ** 2)[:, None])
    merged, _ = merge([arm, hand], frozenset())
    assert merged.arrays.get("velocity") is not None and merged.names == ("a", "b", "c")
    squares = np.arange(10.0) ** 2
    np.testing.assert_allclose(merged.arrays.get("velocity")[:, 2], 0.5 * (squares[1:] + squares[:-1]), atol=1e-9)
    np.testing.assert_array_equal(merged.arrays.get("velocity")[:, :2], [[1.0, 2.0]] * 9)
    without, notes = merge([arm, group("/hand", "c", late, u=False)], frozenset())
    assert without.arrays.get("velocity") is None and "/hand has none" in " ".join(map(str, notes))


def test_angles_that_wrap_are_interpolated_the_short_way():
    """A continuous joint that passes from 3.1 to -3.1 is near pi in between; any other joint passes through 0."""
    arm, ends = group("/arm", "a b", every(10, 0, 20)), np.array([[3.1], [-3.1]])
    hand = states("/hand", "c", every(20, 0, 20), ends, None)
    assert merge([arm, hand], frozenset({"c"}))[0].arrays["position"][1, 2] == pytest.approx(np.pi)
    assert merge([arm, hand], frozenset())[0].arrays["position"][1, 2] == pytest.approx(0.0)


def stream(stamps, received=None, q=None, u=None, *, topic="/arm", names="a b") -> JointStates:
    """Messages about one list of joints; positions count the messages unless given."""
    stamps, n = np.asarray(stamps, dtype=np.int64), len(stamps)
    received = stamps if received is None else np.asarray(received, dtype=np.int64)
    count = len(names.split())
    q = np.arange(n * count, dtype=float).reshape(n, count) if q is None else np.asarray(q, dtype=float)
    return states(topic, names, stamps, q, u, received)


CHOSEN = {"a": "/arm", "b": "/arm"}


def test_the_last_message_of_equal_stamps_is_kept_with_its_velocity():
    """Of messages of two kinds with one stamp the last stays, its positions and its own velocities, and it is said."""
    first = stream(START + np.array([0, 10, 20]) * MS, u=np.array([[0.0, 0.0], [1.0, -1.0], [2.0, -2.0]]))
    other = stream(START + np.array([10]) * MS, q=[[8, 7]], u=np.array([[9.0, 6.0]]), names="b a")
    (one,), notes = joint_groups([first, other], CHOSEN)
    np.testing.assert_array_equal(one.arrays["position"], [[0, 1], [7, 8], [4, 5]])
    assert one.arrays.get("velocity") is not None
    np.testing.assert_array_equal(one.arrays.get("velocity"), [[0, 0], [6, 9], [2, -2]])
    assert [*map(str, notes)] == ["/arm: 1 message left out for a repeated stamp, the last is kept"]


def test_a_late_message_is_told_from_a_clock_that_was_set_back():
    """After a late message the next stamp is where it would have been, after a clock was set back it is not; what is in
    no order is refused.
    """
    arrival = START + np.arange(40) * 10 * MS
    q = np.column_stack([np.arange(40.0), -np.arange(40.0)])
    late = np.array([*range(20), 22, 20, 21, *range(23, 40)])
    (one,), notes = stream(START + late * 10 * MS, arrival, q=q[late]).in_order()
    np.testing.assert_array_equal(one.stamps, arrival)
    np.testing.assert_array_equal(one.arrays["position"], q)
    assert [*map(str, notes)] == ["/arm: 1 sample came late: sorted by their stamps"]
    (one,), notes = stream(arrival - 300 * MS * (np.arange(40) >= 20), arrival, q=q).in_order()
    np.testing.assert_array_equal(one.stamps, arrival)
    np.testing.assert_array_equal(one.arrays["position"], q)
    assert "set back by 0.3 s" in str(notes[0])
    with pytest.raises(RecordingError, match="the stamps of /arm are in no order; pass rate=") as caught:
        stream(np.random.default_rng(0).permutation(every(10, 0, 1990)), every(10, 0, 1990)).in_order()
    assert caught.value.code == "time-order"
