"""Laws that must hold for every input: inverses, null spaces, row spaces, rotations, motion on the manifold."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import TIPS, URDFS, tip_of
from hypothesis import given
from hypothesis import strategies as st
from rounding import rounding
from scipy.spatial.transform import Rotation

from manip_learn import linalg
from manip_learn.linalg import EPS
from manip_learn.robot import rotations

seeds = st.integers(0, 2**32 - 1)


def pseudo_inverse(A: np.ndarray, inverse: linalg.Inverse = "exact") -> np.ndarray:
    """A^+ = V diag(1/sigma) U^T in the chosen sense."""
    U, sigma, Vt = np.linalg.svd(A, full_matrices=False)
    return (Vt.T * linalg.inverse_singular_values(sigma, A.shape, inverse)) @ U.T


def null_projector(A: np.ndarray) -> np.ndarray:
    """N = I - A^+ A = Z Z^T."""
    Z = linalg.null_basis(A)
    return Z @ Z.T


def near(got: np.ndarray, wanted: np.ndarray | float, known: float) -> None:
    """Equal to what rounding lets be known."""
    np.testing.assert_allclose(got, wanted, rtol=0, atol=known)


@st.composite
def constraint_matrices(draw: st.DrawFn, smallest: float = 1e-16) -> tuple[np.ndarray, np.ndarray]:
    """A (s, nv) and its singular values: random directions, singular values from `smallest` to 10."""
    nv = draw(st.integers(1, 8))
    s = draw(st.integers(1, nv))
    exponents = st.floats(np.log10(smallest), 1.0)
    sigma = np.sort(10.0 ** np.array(draw(st.lists(exponents, min_size=s, max_size=s))))[::-1]
    rng = np.random.default_rng(draw(seeds))
    U, V = (np.linalg.qr(rng.normal(size=(n, s)))[0] for n in (s, nv))
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
    tolerance = linalg.matlab_tolerance(computed, A.shape)
    near(N, N.T, known)
    near(N @ N, N, known)
    near(A @ N, 0.0, known * sigma[0])
    rank = A.shape[1] - np.trace(N)
    assert rank == pytest.approx(round(rank), abs=A.shape[1] * known)
    # two ways to compute singular values may fall on two sides of the tolerance
    assert np.count_nonzero(computed > 2.0 * tolerance) <= round(rank) <= np.count_nonzero(computed > 0.5 * tolerance)
    # a factorisation and a product with its inverse, on both sides of a comparison
    slack = rounding(2 * (4 + 1) * A.shape[1] ** 2, computed[0] / max(computed[-1], 1e-16 * computed[0]))
    near(A @ X @ A, A, slack * sigma[0])
    near(X @ A @ X, X, slack * np.max(np.abs(X)))
    near(A @ X, (A @ X).T, slack)
    near(X @ A, (X @ A).T, slack)
    if computed[-1] > 1e-3:
        near(N, np.eye(A.shape[1]) - X @ A, slack)
        near(N @ X, 0.0, slack * np.max(np.abs(X)))


def test_exact_inverse_inverts_however_small():
    """The exact inverse keeps a singular value of 1e-200; truncation at Matlab's tolerance drops it."""
    A = np.array([[1.0, 0.0, 0.0], [0.0, 1e-200, 0.0]])
    assert pseudo_inverse(A, "exact")[1, 1] == pytest.approx(1e200)
    np.testing.assert_array_equal(pseudo_inverse(A, "truncated")[:2, :2], [[1.0, 0.0], [0.0, 0.0]])
    at = linalg.matlab_tolerance(np.array([1000.0]), (3, 3))  # max(size) eps(norm) = 3.4e-13: at it dropped, above kept
    for kept, dropped in ((4e-13, 3e-13), (np.nextafter(at, 1.0), at)):
        sigma = np.array([1000.0, kept, dropped])
        got = linalg.inverse_singular_values(sigma, (3, 3), "truncated")
        np.testing.assert_array_equal(got, [1e-3, 1.0 / kept, 0.0])
    with pytest.raises(ValueError, match="'exact' or 'truncated'"):
        pseudo_inverse(np.eye(2), "damp")  # type: ignore[arg-type]
    for bad in ([[1, 2, 3]], [1, 2], [1, np.nan, 2], "xyz", ["1", "2", "3"], [True, False, True], [[1], [2, 3]], None):
        assert linalg.finite(bad, 3) is None
    np.testing.assert_array_equal(linalg.finite((1, 2.5, 3), 3), [1.0, 2.5, 3.0])
    assert [linalg.rank_of(np.array([1.0, x]), (2, 3)) for x in (3 * EPS, 3.1 * EPS, 0.0)] == [1, 2, 1]
    assert linalg.rank_of(np.array([]), (0, 3)) == linalg.rank_of(np.zeros(2), (2, 3)) == 0


ANGLES = [0.0, 1e-300, 1e-12, 1e-6, 0.1, 0.0999999, 0.1000001, 1.0, 3.0, *(np.pi - x for x in (1e-2, 1e-6, 1e-12, 0.0))]


@pytest.mark.parametrize("angle", ANGLES)
def test_rotations(rng: np.random.Generator, angle: float) -> None:
    """Vectors and matrices become each other as SciPy has them, one by one and many at once, to rounding, up to the
    sign at half a turn; the left Jacobian turns rates of the vector into angular velocities, and its inverse is one.
    """
    axes = np.concatenate([np.eye(3), -np.eye(3), rng.normal(size=(50, 3))])
    vectors = angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    R = Rotation.from_rotvec(vectors).as_matrix()
    known = rounding(16, max(1.0, angle))  # products and sums on either way, of an angle of this size
    near(np.array([rotations.rotation_matrix(v) for v in vectors]), R, known)
    got = np.array([rotations.rotation_vector(x) for x in R])
    near(rotations.rotation_vectors(R), got, rounding(16, np.pi))
    sign = np.where((angle > np.pi - 1e-9) & (np.sum(got * vectors, axis=1) < 0.0), -1.0, 1.0)
    near(sign[:, None] * got, vectors, known)
    assert np.max(np.linalg.norm(got, axis=1)) <= np.pi + known
    assert rotations.rotation_vectors(np.zeros((0, 3, 3))).shape == (0, 3)
    for r in vectors[-10:] if angle < np.pi - 1e-3 else ():
        J, inverse, h = rotations.left_jacobian(r), rotations.left_jacobian_inverse(r), 1e-5
        near(J @ inverse, np.eye(3), rounding(24, J, inverse))
        near(inverse @ r, r, rounding(24, inverse, r))
        for rate in np.eye(3):
            turned = rotations.rotation_matrix(r + h * rate) @ rotations.rotation_matrix(r - h * rate).T
            near(J @ rate, rotations.rotation_vector(turned) / (2.0 * h), 1e-9)


@pytest.mark.parametrize("name", [*URDFS, *TIPS])
def test_postures(robot_of, rng, name):
    """integrate and difference undo each other, as positions and configuration do; kinematics from either kind of
    vector agree, also after a full turn of an unlimited joint.
    """
    robot, frame = robot_of(name), tip_of(name)
    for scale in (1e-12, 1e-6, 0.5, 0.5, 0.5):
        q, v = robot.random_configuration(rng), scale * rng.uniform(-1.0, 1.0, robot.nv)
        positions = robot.positions(q)
        assert (q.shape, positions.shape) == ((robot.nq,), (robot.nv,))
        known = rounding(8, q)
        near(robot.configuration(positions), q, known)
        near(robot.positions(robot.configuration(positions)), positions, known)
        near(robot.configuration(q), q, known)
        for posture in (q, positions):
            moved = robot.integrate(posture, v)
            assert moved.shape == posture.shape
            near(robot.difference(posture, moved), v, 1e-14 + 1e-9 * scale)
        r = robot.integrate(q, v)
        near(robot.difference(robot.integrate(q, robot.difference(q, r)), r), 0.0, 1e-12)
        turned = positions.copy()
        for block in robot.blocks:
            turned[block.v] += 2.0 * np.pi * (block.kind == "continuous")
        J = robot.jacobian(q, frame)
        known = rounding(8 * robot.nv, turned, 1.0 + np.linalg.norm(J))  # angles of this size, and levers like J's
        near(robot.pose(turned, frame), robot.pose(q, frame), known)
        near(robot.jacobian(turned, frame), J, known)
        near(robot.difference(q, turned), 0.0, rounding(8, turned))
    a, b, short = np.array([3.0, 1.0, -3.0, 0.0]), np.array([-3.0, -1.0, 3.0, 0.0]), 2.0 * np.pi - 6.0
    shortest = robot_of("wrist").difference(a, b)  # through pi, of continuous joints alone
    near(shortest, [short, -2.0, -short, 0.0], 1e-14)
