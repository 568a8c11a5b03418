"""Laws that must hold for every input: projectors, inverses, row spaces, motion on the configuration manifold."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import TIPS, URDFS, tip_of
from hypothesis import given
from hypothesis import strategies as st
from rounding import rounding

from manip_learn.linalg import (
    Inverse,
    inverse_singular_values,
    matlab_tolerance,
    null_basis,
    orthonormal_rows,
    row_space_angle,
)

ROBOTS = [*URDFS, *TIPS]


def pseudo_inverse(A: np.ndarray, inverse: Inverse = "exact") -> np.ndarray:
    """A^+ = V diag(1/sigma) U^T in the chosen sense."""
    U, sigma, Vt = np.linalg.svd(A, full_matrices=False)
    return (Vt.T * inverse_singular_values(sigma, A.shape, inverse)) @ U.T


def null_projector(A: np.ndarray) -> np.ndarray:
    """N = I - A^+ A = Z Z^T."""
    Z = null_basis(A)
    return Z @ Z.T


@st.composite
def constraint_matrices(draw: st.DrawFn, smallest: float = 1e-16) -> tuple[np.ndarray, np.ndarray]:
    """A (s, nv) and its singular values: random directions, singular values from `smallest` to 10."""
    nv = draw(st.integers(1, 8))
    s = draw(st.integers(1, nv))
    exponents = st.floats(np.log10(smallest), 1.0)
    sigma = np.sort(10.0 ** np.array(draw(st.lists(exponents, min_size=s, max_size=s))))[::-1]
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    U = np.linalg.qr(rng.normal(size=(s, s)))[0]
    V = np.linalg.qr(rng.normal(size=(nv, s)))[0]
    return (U * sigma) @ V.T, sigma


@given(constraint_matrices())
@pytest.mark.fuzz
def test_null_projector_and_inverse(draw):
    """N = N^T, N^2 = N, A N = 0 and trace N = nv - rank, however near A is to a singularity.

    The exact inverse X satisfies A X A = A, X A X = X, and A X and X A are symmetric, to the conditioning of A; away
    from singularities N = I - X A, and task and null-space parts are orthogonal.
    """
    A, sigma = draw
    N, X, known = null_projector(A), pseudo_inverse(A), rounding(2 * (4 + 1) * A.shape[1] ** 2)
    computed = np.linalg.svd(A, compute_uv=False)
    tolerance = matlab_tolerance(computed, A.shape)
    np.testing.assert_allclose(N, N.T, rtol=0, atol=known)
    np.testing.assert_allclose(N @ N, N, rtol=0, atol=known)
    np.testing.assert_allclose(A @ N, 0.0, rtol=0, atol=known * sigma[0])
    rank = A.shape[1] - np.trace(N)
    assert rank == pytest.approx(round(rank), abs=A.shape[1] * known)
    # two ways to compute singular values may fall on two sides of the tolerance
    assert np.count_nonzero(computed > 2.0 * tolerance) <= round(rank) <= np.count_nonzero(computed > 0.5 * tolerance)
    # a factorisation and a product with its inverse, on both sides of a comparison
    slack = rounding(2 * (4 + 1) * A.shape[1] ** 2, computed[0] / max(computed[-1], 1e-16 * computed[0]))
    np.testing.assert_allclose(A @ X @ A, A, rtol=0, atol=slack * sigma[0])
    np.testing.assert_allclose(X @ A @ X, X, rtol=0, atol=slack * np.max(np.abs(X)))
    np.testing.assert_allclose(A @ X, (A @ X).T, rtol=0, atol=slack)
    np.testing.assert_allclose(X @ A, (X @ A).T, rtol=0, atol=slack)
    if computed[-1] > 1e-3:
        np.testing.assert_allclose(N, np.eye(A.shape[1]) - X @ A, rtol=0, atol=slack)
        np.testing.assert_allclose(N @ X, 0.0, rtol=0, atol=slack * np.max(np.abs(X)))


@given(constraint_matrices(smallest=1e-6), st.integers(0, 2**32 - 1))
@pytest.mark.fuzz
def test_only_the_row_space_counts(draw, seed):
    """Any invertible mixing of the rows leaves N, the polar factor's row space and the angles as they are."""
    A, sigma = draw
    s = A.shape[0]
    rng = np.random.default_rng(seed)
    G = np.linalg.qr(rng.normal(size=(s, s)))[0] * rng.uniform(0.5, 2.0, s)
    known = rounding(4 * A.shape[1] ** 2, sigma[0] / sigma[-1], 2.0 / 0.5)  # by the conditions of A and of the mixing
    np.testing.assert_allclose(null_projector(G @ A), null_projector(A), rtol=0, atol=known)
    assert row_space_angle(G @ A, A) <= known
    Q = orthonormal_rows(A)
    np.testing.assert_allclose(Q @ Q.T, np.eye(s), rtol=0, atol=rounding(4 * A.shape[1] ** 2))
    assert row_space_angle(Q, A) <= known


@given(st.integers(2, 7), st.integers(1, 6), st.floats(-15.0, 0.0), st.integers(0, 2**32 - 1))
@pytest.mark.fuzz
def test_principal_angles_of_turned_spaces(p, s, exponent, seed):
    """A row space turned by a known angle is found at that angle, from 1e-15 to 1 rad, and angles are symmetric."""
    s = min(s, p - 1)
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.normal(size=(p, p)))[0].T
    angle = 10.0**exponent
    turned = basis[:s].copy()
    turned[0] = np.cos(angle) * basis[0] + np.sin(angle) * basis[s]
    mixed = rng.normal(size=(s, s)) + 3.0 * np.eye(s)
    known = rounding(4 * p * p, np.linalg.cond(mixed))
    for one, other in ((mixed @ basis[:s], turned), (turned, mixed @ basis[:s])):
        assert row_space_angle(one, other) == pytest.approx(angle, abs=known + 1e-9 * angle)


@pytest.mark.parametrize("name", ROBOTS)
def test_postures(robot_of, rng, name):
    """integrate and difference undo each other, as positions and configuration do; kinematics from either kind of
    vector agree, also after a full turn of an unlimited joint.
    """
    robot, frame = robot_of(name), tip_of(name)
    for scale in (1e-12, 1e-6, 0.5, 0.5, 0.5):
        q, v = robot.random_configuration(rng), scale * rng.uniform(-1.0, 1.0, robot.nv)
        positions = robot.positions(q)
        assert (q.shape, positions.shape) == ((robot.nq,), (robot.nv,))
        known, back = rounding(8, q), robot.positions(robot.configuration(positions))
        np.testing.assert_allclose(robot.configuration(positions), q, rtol=0, atol=known)
        np.testing.assert_allclose(back, positions, rtol=0, atol=known)
        np.testing.assert_allclose(robot.configuration(q), q, rtol=0, atol=known)
        for posture in (q, positions):
            moved = robot.integrate(posture, v)
            assert moved.shape == posture.shape
            np.testing.assert_allclose(robot.difference(posture, moved), v, rtol=0, atol=1e-14 + 1e-9 * scale)
        r = robot.integrate(q, v)
        back = robot.integrate(q, robot.difference(q, r))
        np.testing.assert_allclose(robot.difference(back, r), 0.0, rtol=0, atol=1e-12)
        turned = positions.copy()
        for block in robot.blocks:
            turned[block.v] += 2.0 * np.pi * (block.kind == "continuous")
        J = robot.jacobian(q, frame)
        known = rounding(8 * robot.nv, turned, 1.0 + np.linalg.norm(J))  # angles of this size, and levers like J's
        np.testing.assert_allclose(robot.pose(turned, frame), robot.pose(q, frame), rtol=0, atol=known)
        np.testing.assert_allclose(robot.jacobian(turned, frame), J, rtol=0, atol=known)
        np.testing.assert_allclose(robot.difference(q, turned), 0.0, rtol=0, atol=rounding(8, turned))


def test_shortest_way_round(robot_of):
    """Between 3 rad and -3 rad a continuous joint goes through pi, the short way; a limited one does not."""
    robot = robot_of("wrist")
    a, b = np.array([3.0, 1.0, -3.0, 0.0]), np.array([-3.0, -1.0, 3.0, 0.0])
    short = 2.0 * np.pi - 6.0
    np.testing.assert_allclose(robot.difference(a, b), [short, -2.0, -short, 0.0], rtol=0, atol=1e-14)
