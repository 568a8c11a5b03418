"""The nearest point of a polytope: the library's own method against the optimality conditions and against DAQP."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_learn.control.bounded_velocity import project_by_active_set, projection_by
from manip_learn.errors import ConstraintError

KINDS = ["random", "duplicated", "zero", "equal", "nearly dependent", "badly scaled", "both"]
Problem = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def problem(kind: str, rng: np.random.Generator) -> Problem:
    """x, C, low, high with a point within the bounds, and x mostly outside them."""
    k = int(rng.integers(1, 10))
    m = k + int(rng.integers(kind == "zero", 9))  # a row of zeros beside others: bounds on nothing are no problem
    C = rng.normal(size=(m, k))
    if kind in ("nearly dependent", "both"):
        few = rng.normal(size=(max(1, k // 2), k))
        C = few[rng.integers(len(few), size=m)] + 10.0 ** rng.uniform(-7.0, -1.0) * C
    if kind in ("badly scaled", "both"):
        C = C * 10.0 ** rng.uniform(-3.0, 0.0, size=k)
    i, j = rng.integers(m, size=2)
    if kind == "duplicated":
        C[i] = rng.choice([-1.0, 1.0]) * C[j]
    if kind == "zero":
        C[i] = 0.0
    inside = rng.normal(size=k)
    low, high = C @ inside - rng.exponential(size=m), C @ inside + rng.exponential(size=m)
    if kind == "equal":
        low[i] = high[i] = C[i] @ inside
    return inside + 3.0 * rng.normal(size=k) / np.max(np.abs(C), axis=0), C, low, high


@given(seed=st.integers(0, 2**32 - 1))
@pytest.mark.fuzz
def test_the_point_is_the_nearest(seed: int) -> None:
    """It meets the bounds to 1e-11, and is DAQP's point to 1e-9, or no farther where that is known to few digits."""
    for kind in KINDS:
        x, C, low, high = problem(kind, np.random.default_rng(seed))
        y, other = project_by_active_set(x, C, low, high), projection_by("qp")(x, C, low, high)
        assert y is not None and other is not None, kind
        assert np.max(np.maximum(C @ y - high, low - C @ y)) <= 1e-11, kind
        size = 1.0 + float(np.linalg.norm(x))
        assert np.linalg.norm(y - x) <= np.linalg.norm(other - x) + 1e-7 * size, kind
        if kind in ("random", "duplicated", "zero", "equal"):
            np.testing.assert_allclose(y, other, rtol=0, atol=1e-9 * size, err_msg=kind)


def test_bounds_that_exclude_each_other(rng: np.random.Generator) -> None:
    """No point: None, not a wrong one."""
    for _ in range(50):
        x, C, low, high = problem("random", rng)
        C, low, high = np.vstack((C, C[0])), np.append(low, high[0] + 0.1), np.append(high, high[0] + 1.0)
        for solver in ("active-set", "qp"):
            assert projection_by(solver)(x, C, low, high) is None


def test_a_point_within_the_bounds_stays(rng: np.random.Generator) -> None:
    """The nearest point to one within the bounds is itself, to the last bit."""
    for _ in range(20):
        x, C, low, high = problem("random", rng)
        wide = np.abs(C @ x) + 1.0
        np.testing.assert_array_equal(project_by_active_set(x, C, -wide, wide), x)


def test_unknown_solver() -> None:
    """The names are listed."""
    with pytest.raises(ConstraintError, match="'qp', 'active-set' or 'compiled'"):
        projection_by("simplex")  # type: ignore[arg-type]


def test_the_unit_of_the_rows_does_not_matter() -> None:
    """Rows and bounds in another unit are the same polytope, with the same nearest point."""
    for kind, factor, seed in product(("random", "nearly dependent"), (1e-3, 1e3), range(100)):
        x, C, low, high = problem(kind, np.random.default_rng([7, seed]))
        y = project_by_active_set(x, C, low, high)
        scaled = project_by_active_set(x, factor * C, factor * low, factor * high)
        assert y is not None and scaled is not None
        np.testing.assert_allclose(scaled, y, rtol=0, atol=1e-7 * (1.0 + np.linalg.norm(x)))
