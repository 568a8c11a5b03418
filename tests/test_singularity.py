"""The way out of a singularity, and how fast it may be approached."""

from __future__ import annotations

import numpy as np
import pytest

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FrameJacobian
from manip_learn.constraint.manipulability import (
    log_manipulability_gradient,
    manipulability,
)
from manip_learn.constraint.small_matrices import svd
from manip_learn.control.singularity import (
    Decomposition,
    approach_bound,
    escape_velocity,
    smallest_gradient,
    stable_damping,
    steepest_ascent,
)

DT, WIDTH = 0.001, 0.2


@pytest.fixture
def planar(robot_of) -> Constraint:
    return Constraint(np.eye(2), FrameJacobian(robot_of("planar3"), "tip", "x y"))


def at(constraint: Constraint, q: np.ndarray):
    """Singular value decomposition of A and the vector-Jacobian product."""
    A, vjp = constraint.value_and_vjp(q)
    return Decomposition(*svd(A)), vjp


def bent(angle: float) -> np.ndarray:
    """The arm stretched but for its middle joint."""
    return np.array([0.4, angle, 0.0])


def test_gradient_of_the_smallest_singular_value(planar):
    """It is the slope of sigma_min, by central differences."""
    q, h = np.array([0.3, 0.5, -0.4]), 1e-6
    smallest = lambda x: np.linalg.svd(planar(x), compute_uv=False)[-1]  # noqa: E731
    slope = [(smallest(q + h * e) - smallest(q - h * e)) / (2.0 * h) for e in np.eye(3)]
    np.testing.assert_allclose(smallest_gradient(*at(planar, q)), slope, atol=1e-8)


def test_the_escape_leads_out(planar):
    """Near a singularity the escape raises the manipulability, whichever side the arm is bent to."""
    for angle in (-0.1, -1e-3, 1e-5, 1e-2, 0.1):
        q = bent(angle)
        decomposition, vjp = at(planar, q)
        assert decomposition.sigma[-1] < WIDTH
        e = escape_velocity(decomposition, vjp, DT, WIDTH)
        assert e @ log_manipulability_gradient(planar, q) > 0.0
        assert manipulability(planar, q + 1e-3 * abs(angle) * e / np.linalg.norm(e)) > manipulability(planar, q)


def test_an_exact_singularity_is_left_slowly_and_out(planar):
    """At the singularity itself the seed has its own small speed, in the null space, and mu grows along it."""
    q = bent(0.0)
    decomposition, vjp = at(planar, q)
    seed = escape_velocity(decomposition, vjp, DT, WIDTH)
    assert np.linalg.norm(seed) == pytest.approx(5e-4, rel=1e-9)
    assert np.linalg.norm(planar(q) @ seed) < 1e-12
    ascent = steepest_ascent(decomposition, vjp)
    np.testing.assert_allclose(seed, 5e-4 * ascent, atol=1e-12)
    for other in np.random.default_rng(5).standard_normal((200, 3)):
        z = decomposition.Vt[1:].T @ (decomposition.Vt[1:] @ other)
        z *= 1e-4 / np.linalg.norm(z)
        assert manipulability(planar, q + z) <= manipulability(planar, q + 1e-4 * ascent) * (1.0 + 1e-3)
    assert ascent[np.argmax(np.abs(ascent))] > 0.0 and np.linalg.norm(ascent) == pytest.approx(1.0)


def test_more_rows_than_joints_have_no_way_out(robot_of):
    """Where every posture is singular there is nothing to escape to: zero, not an error."""
    crowded = Constraint(np.eye(6)[:4], FrameJacobian(robot_of("planar3"), "tip", "pose"))
    np.testing.assert_array_equal(escape_velocity(*at(crowded, np.array([0.1, 0.5, 0.2])), DT, WIDTH), np.zeros(3))


def test_approach_is_slow_enough_to_stop():
    """Half of the joints' deceleration brakes sigma to the crossing speed within the distance that is left."""
    slope, acceleration = np.array([3.0, 0.0, 4.0]), np.array([6.0, 1e-3, 2.0])
    # a joint that does not move sigma has no say; the others brake it with 0.5 * 5 * min(6 / 0.6, 2 / 0.8)
    deceleration = 0.5 * 5.0 * 2.5
    for sigma in (1e-4, 1e-3, 0.02, 0.3):
        expected = 5.0 * 5e-4 + min(20.0 * sigma, np.sqrt(2.0 * deceleration * sigma))
        assert approach_bound(sigma, slope, acceleration, 1e-3) == pytest.approx(expected, rel=1e-12)
    # a long step leaves less: half of the distance in each
    assert approach_bound(1e-3, slope, acceleration, 0.1) == pytest.approx(5.0 * 5e-4 + 5.0 * 1e-3)
    assert approach_bound(0.1, np.zeros(3), acceleration, 1e-3) == np.inf


@pytest.mark.parametrize("rows", [1, 2])
def test_damping_that_a_step_can_follow(planar, rows):
    """lambda^2 = 2 dt |d(A^T w) / dq|, by central differences, w the nearly lost part of b; none where nothing is."""
    constraint = Constraint(np.eye(2)[:rows], planar.features)
    q, h, b = np.array([1e-3, 2e-3, -1e-3]), 1e-6, np.array([-0.4, 0.3])[:rows]
    (U, sigma, _), vjp = decomposition, _ = at(constraint, q)
    along = (b @ U).tolist()
    w = U[:, -1] * along[-1]
    rates = np.array([(constraint(q + h * e) - constraint(q - h * e)).T @ w / (2.0 * h) for e in np.eye(3)])
    expected = np.sqrt(2.0 * 0.01 * np.linalg.norm(rates))
    assert stable_damping(decomposition, along, 0.1, 0.01, vjp) == pytest.approx(expected, rel=1e-6)
    assert stable_damping(decomposition, along, 0.5 * float(sigma[-1]), 0.01, vjp) == 0.0
    assert stable_damping(decomposition, [0.0] * rows, 0.1, 0.01, vjp) == 0.0
