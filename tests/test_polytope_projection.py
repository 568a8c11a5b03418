"""The nearest point of a polytope: the library's own method against the optimality conditions and against DAQP."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from manip_learn.control.bounded_velocity import Desired, bounded_velocity, project_by_active_set, project_by_daqp
from manip_learn.control.limits import Bounds

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
        y, other = project_by_active_set(x, C, low, high), project_by_daqp(x, C, low, high)
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
        for solve in (project_by_active_set, project_by_daqp):
            assert solve(x, C, low, high) is None


def test_a_point_within_the_bounds_stays(rng: np.random.Generator) -> None:
    """The nearest point to one within the bounds is itself, to the last bit."""
    for _ in range(20):
        x, C, low, high = problem("random", rng)
        wide = np.abs(C @ x) + 1.0
        np.testing.assert_array_equal(project_by_active_set(x, C, -wide, wide), x)


def test_the_unit_of_the_rows_does_not_matter() -> None:
    """Rows and bounds in another unit are the same polytope, with the same nearest point."""
    for kind, factor, seed in product(("random", "nearly dependent"), (1e-3, 1e3), range(100)):
        x, C, low, high = problem(kind, np.random.default_rng([7, seed]))
        y = project_by_active_set(x, C, low, high)
        scaled = project_by_active_set(x, factor * C, factor * low, factor * high)
        assert y is not None and scaled is not None
        np.testing.assert_allclose(scaled, y, rtol=0, atol=1e-7 * (1.0 + np.linalg.norm(x)))


def bounded(A: np.ndarray, v: np.ndarray, w: np.ndarray, box: np.ndarray, slide: float, damping: float) -> np.ndarray:
    """The answer of `bounded_velocity` as (velocity, scale)."""
    low, high = box
    bounds = Bounds(low.tolist(), high.tolist(), [1] * len(low), [1] * len(low), 0.0)
    null = np.linalg.svd(A)[2][len(A) :].T
    for basis in (null, null @ null.T):  # a basis, or the projector, which serve both
        found = bounded_velocity(A, Desired(v, w, None), basis, bounds, np.full(len(v), 1e3), None, slide, damping)
        np.testing.assert_allclose(found.null_part, null @ (null.T @ found.velocity), rtol=0, atol=1e-12)
    return np.append(found.velocity, found.task_scale)


def test_the_programs_are_those_of_the_docstring(rng: np.random.Generator) -> None:
    """One row, whose direction is always kept, and two rows that cannot be kept: SciPy's minimum of what is stated.

    min |N u - w|^2 + (100 max(|v|, |w|))^2 (1 - s)^2 in the box; min (100 / sigma_1)^2 |P A (u - u*)|^2 + |u - u*|^2.
    """
    for _ in range(20):
        A = rng.normal(size=(1, 5))
        N = np.eye(5) - np.linalg.pinv(A) @ A
        v, w = np.linalg.pinv(A)[:, 0] * rng.uniform(0.1, 2.0), N @ rng.normal(size=5) * rng.choice([0.01, 3.0])
        box = np.array([-rng.uniform(0.05, 0.5, 5), rng.uniform(0.05, 0.5, 5)])
        weight = 100.0 * max(np.linalg.norm(v), np.linalg.norm(w))
        rows = np.vstack([N, weight * v / (v @ v)])
        best = lsq_linear(rows, np.append(w, weight), box, method="bvls").x
        scale = float(v @ best / (v @ v))
        if 0.0 < scale < 1.0:
            np.testing.assert_allclose(bounded(A, v, w, box, 0.0, 0.05), np.append(best, scale), rtol=0, atol=1e-8)
    for _ in range(20):
        A = rng.normal(size=(2, 4))
        b, w = rng.normal(size=2), np.zeros(4)
        v = np.linalg.pinv(A) @ b
        middle = -np.sign(v) * rng.uniform(0.3, 1.0, 4)  # every joint moves the other way: no s is possible
        box = np.array([middle - 0.1, middle + 0.1])
        P, largest = np.eye(2) - np.outer(b, b) / (b @ b), np.linalg.svd(A)[1][0]
        u = [np.empty(0)] * 2
        for i, rows in enumerate((100.0 / largest * P @ A, A / 0.05)):
            whole = np.vstack([rows, np.eye(4)])
            u[i] = lsq_linear(whole, whole @ v, box, method="bvls").x
        for slide in (0.0, 0.3, 1.0):
            expected = u[0] + slide * (u[1] - u[0])
            found = bounded(A, v, w, box, slide, 0.05)
            np.testing.assert_allclose(found[:4], expected, rtol=0, atol=1e-8)
            assert found[4] == pytest.approx(max(0.0, float(b @ A @ u[0]) / float(b @ b)), abs=1e-8)
