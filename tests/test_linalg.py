"""Inverses, null spaces and angles between row spaces; laws for every input are in test_axioms.py."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from case import case
from rounding import rounding
from test_axioms import pseudo_inverse

from manip_learn.linalg import (
    EPS,
    along_axes,
    batch_row_spaces,
    finite,
    inverse_singular_values,
    inverse_triangles_beside,
    matlab_tolerance,
    rank_of,
    row_bases,
    row_basis,
    row_space_angle,
    row_space_angles,
    whitener,
)


def with_singular_values(rng: np.random.Generator, sigma: list[float], n: int) -> np.ndarray:
    """A random (s, n) matrix with these singular values."""
    U = np.linalg.qr(rng.normal(size=(len(sigma), len(sigma))))[0]
    V = np.linalg.qr(rng.normal(size=(n, len(sigma))))[0]
    return (U * sigma) @ V.T


def test_exact_inverse_inverts_however_small(rng):
    """The exact inverse keeps a singular value of 1e-200; truncation at Matlab's tolerance drops it."""
    A = np.array([[1.0, 0.0, 0.0], [0.0, 1e-200, 0.0]])
    assert pseudo_inverse(A, "exact")[1, 1] == pytest.approx(1e200)
    assert pseudo_inverse(A, "truncated")[1, 1] == 0.0
    assert pseudo_inverse(A, "truncated")[0, 0] == 1.0
    sigma = np.array([1000.0, 4e-13, 3e-13])  # max(size) eps(norm) = 3.4e-13
    np.testing.assert_array_equal(inverse_singular_values(sigma, (3, 3), "truncated"), [1e-3, 1.0 / 4e-13, 0.0])
    at = matlab_tolerance(sigma, (3, 3))  # what is exactly at the tolerance is dropped, one rounding above it is kept
    np.testing.assert_array_equal(
        inverse_singular_values(np.array([1000.0, np.nextafter(at, 1.0), at]), (3, 3), "truncated"),
        [1e-3, 1.0 / np.nextafter(at, 1.0), 0.0],
    )
    for values in (
        [[1, 2, 3]],
        [1, 2],
        [1, np.nan, 2],
        "xyz",
        ["1", "2", "3"],
        [True, False, True],
        [[1], [2, 3]],
        None,
    ):
        assert finite(values, 3) is None
    assert [rank_of(np.array([1.0, x]), (2, 3)) for x in (3 * EPS, 3.1 * EPS, 0.0)] == [1, 2, 1]
    assert rank_of(np.array([]), (0, 3)) == rank_of(np.zeros(2), (2, 3)) == 0
    with pytest.raises(ValueError, match="'exact' or 'truncated'"):
        pseudo_inverse(np.eye(2), "damp")  # type: ignore[arg-type]
    np.testing.assert_array_equal(finite((1, 2.5, 3), 3), [1.0, 2.5, 3.0])


def test_angles_of_every_size():
    """Angles of 1e-16 to 1 radian are known to the rounding of the rows: no digits are lost to the arc cosine."""
    for angle in 10.0 ** -np.arange(17):
        M1 = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 2.0]])
        M2 = np.array([[np.cos(angle), np.sin(angle), 0.0, 0.0]])
        M2 = np.vstack([M2, 3.0 * M2 + [0.0, 0.0, 0.0, 5.0]])  # same space, other rows
        known = rounding(4 * M2.size, np.linalg.cond(M2))
        assert row_space_angle(M2, M1) == pytest.approx(angle, rel=1e-9, abs=known)
        assert row_space_angles(M2[None], row_basis(M1))[0] == pytest.approx(angle, rel=1e-9, abs=known)


def test_angles_see_no_rows_that_add_nothing():
    """Zero and repeated rows (the paper prints Lambda with a zero row) neither hide nor make an angle."""
    xy, yz = np.diag([1.0, 1.0, 0.0]), np.diag([0.0, 1.0, 1.0])
    assert row_space_angle(xy, yz) == pytest.approx(np.pi / 2)
    assert row_space_angle(xy, np.eye(3)[:2]) < rounding(4 * 9)
    assert row_space_angle(np.eye(3)[[0, 0]], np.eye(3)[:1]) < rounding(4 * 9)
    assert row_space_angle(np.eye(3)[[0, 0]], np.eye(3)[:2]) == np.pi / 2
    assert row_space_angle(np.zeros((2, 3)), np.zeros((1, 3))) == 0.0


def test_whitener(rng):
    """W S W^T = I over what S determines, whatever the units of the unknowns; what is rounding is left out."""
    B = rng.normal(size=(5, 5)) * [1e-6, 1.0, 1e5, 1.0, 1.0]
    W = whitener(B.T @ B)
    np.testing.assert_allclose(W @ B.T @ B @ W.T, np.eye(5), rtol=0, atol=1e-9)
    flat = B.copy()
    flat[:, 4] = flat[:, 3] * (1.0 + 1e-8)  # nearly the same unknown twice: 1e-16 of the largest eigenvalue
    assert whitener(flat.T @ flat).shape == (4, 5) and whitener(np.zeros((3, 3))).shape == (0, 3)
    np.testing.assert_allclose(whitener(np.diag([4.0, 0.0])), [[0.5, 0.0]])
    assert whitener(np.array([[1.0, 0.9], [0.9, 1.0]]), least=0.1).shape == (1, 2)  # 0.1 over 1.9


def test_rows_along_axes(rng):
    """The same space in rows along single axes where they can be, in the axes' order, the largest entry positive."""
    wanted = np.array([[0.6, -0.8, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]) * [[-1], [1], [1]]
    for _ in range(5):
        mixed = np.linalg.qr(rng.normal(size=(3, 3)))[0] @ wanted
        np.testing.assert_allclose(along_axes(mixed), wanted, rtol=0, atol=1e-12)


def test_batch_row_spaces(rng):
    """In a stack, each Q is orthogonal, A^T = Q[:, :s] R, and Q[:, s:] is a null basis, as matrix by matrix; the thin
    factors are the first columns of the full ones, for singular and zero matrices too.
    """
    for s, nv in ((0, 7), (1, 3), (2, 3), (3, 3), (2, 7), (6, 7)):
        with case(s, nv):
            A = rng.normal(size=(30, s, nv))
            A[3, :1], A[4, -1:], A[7] = 0.0, A[4, :1], 0.0
            Q, R = batch_row_spaces(A)
            longest = max(1.0, *np.linalg.norm(A, axis=(1, 2)))
            known = rounding(4 * nv * nv, longest)
            sigma = np.linalg.svd(np.delete(A, [3, 4, 7], axis=0), compute_uv=False)  # of independent rows
            turned = rounding(4 * nv * nv, longest, np.max(sigma[:, :1] / sigma[:, -1:], initial=1.0))
            unit = np.broadcast_to(np.eye(nv), (30, nv, nv))
            np.testing.assert_allclose(Q.transpose(0, 2, 1) @ Q, unit, rtol=0, atol=known)
            np.testing.assert_allclose(Q[:, :, :s] @ R, A.transpose(0, 2, 1), rtol=0, atol=known)
            np.testing.assert_allclose(A @ Q[:, :, s:], 0.0, rtol=0, atol=known)
            np.testing.assert_array_equal(R, np.triu(R))
            thin_Q, thin_R = (x.transpose(2, 0, 1) for x in row_bases(A.transpose(2, 1, 0)))
            others = np.arange(30) != 4  # of dependent rows rounding decides what is added
            np.testing.assert_allclose(thin_Q[others], Q[others, :, :s], rtol=0, atol=turned)
            np.testing.assert_allclose(thin_R[others], R[others], rtol=0, atol=turned)
            np.testing.assert_allclose(thin_Q @ thin_R, A.transpose(0, 2, 1), rtol=0, atol=known)
            np.testing.assert_allclose(thin_Q.transpose(0, 2, 1) @ thin_Q, unit[:, :s, :s], rtol=0, atol=turned)


def test_samples_that_lose_rank_have_no_say(rng):
    """Triangles are inverted sample by sample; dependent or zero rows give zeros and spoil no other sample."""
    A = rng.standard_normal((5, 3, 7))
    A[1, 2] = A[1, 0] - 0.5 * A[1, 1]  # dependent
    A[3] = 0.0
    A[4, 2] = A[4, 0] + 1e-6 * A[4, 2]  # nearly, and still told apart
    _, R = batch_row_spaces(A)
    inverses = inverse_triangles_beside(R.transpose(1, 2, 0)).transpose(2, 0, 1)
    for i in (0, 2, 4):
        np.testing.assert_allclose(inverses[i] @ R[i], np.eye(3), atol=1e-8)
    for i in (1, 3):
        np.testing.assert_array_equal(inverses[i], np.zeros((3, 3)))


def test_one_thread_for_libraries_that_are_loaded_later():
    """SciPy's BLAS, loaded within the context, has one thread where the context is entered again."""
    code = """
import sys
from manip_learn.linalg import one_thread
with one_thread():
    assert "scipy.linalg" not in sys.modules
    import scipy.linalg
    with one_thread():
        from threadpoolctl import threadpool_info
        threads = [x["num_threads"] for x in threadpool_info() if x["user_api"] == "blas"]
        assert len(threads) > 1 and set(threads) == {1}, threads
"""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
