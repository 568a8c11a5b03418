"""The way out of a singularity, and how fast it may be approached."""

from __future__ import annotations

import numpy as np
import pytest

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FrameJacobian
from manip_learn.constraint.manipulability import (
    SINGULAR_RATIO,
    log_manipulability_gradient,
    manipulability,
    manipulability_gradient,
)
from manip_learn.constraint.small_matrices import row_inverse, svd
from manip_learn.control.singularity import (
    Decomposition,
    approach_bound,
    escape_velocity,
    is_fast,
    pressed_damping,
    seed_speed,
    smallest_gradient,
    smallest_gradient_of,
    stable_damping,
    steepest_ascent,
    with_seed,
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


def test_gradient_away_from_singularities(robot_of, rng):
    """From A, A^{+T} and mu it is that of the decomposition, for one to three rows; at double values one of them."""
    features = FrameJacobian(robot_of("sawyer"), "right_hand", "xyz")
    for s in (1, 2, 3):
        constraint = Constraint(np.linalg.qr(rng.normal(size=(3, s)))[0].T, features)
        q = rng.uniform(-1.0, 1.0, 7)
        (A, vjp), (X, mu, smallest) = constraint.value_and_vjp(q), row_inverse(constraint(q))
        expected = smallest_gradient(Decomposition(*svd(A)), vjp)
        for inverse in (X, None):
            slope = smallest_gradient_of(A, inverse, mu, smallest, vjp)
            np.testing.assert_allclose(slope, expected, rtol=0, atol=1e-9)
    double = np.eye(2, 7)
    slope = smallest_gradient_of(double, double, 1.0, 1.0, lambda weights: weights.sum(axis=0))
    assert np.linalg.norm(slope) == pytest.approx(1.0)


def test_the_seed_is_the_least_speed_in_the_null_space():
    """5e-4 rad/s at the singularity, 0 from a thousandth of the width on; what is rounding alone is left."""
    assert [seed_speed(x, 0.2) for x in (0.0, 1e-4, 2e-4, 1.0)] == pytest.approx([5e-4, 2.5e-4, 0.0, 0.0])
    pi = np.array([1.0, 0.0])
    np.testing.assert_allclose(with_seed(1e-6 * pi, pi, 5e-4), 5e-4 * pi)
    np.testing.assert_array_equal(with_seed(1e-3 * pi, pi, 5e-4), 1e-3 * pi)
    np.testing.assert_array_equal(with_seed(0.9e-9 * pi, pi, 5e-4), 0.9e-9 * pi)
    np.testing.assert_allclose(with_seed(1.1e-9 * pi, pi, 5e-4), 5e-4 * pi)


def test_a_closer_look_is_due_where_braking_may_fail():
    """|u| |A| as the rate of sigma, beside the slower of 20 sigma and the root of 2 * half of the deceleration."""
    for size, weakest, smallest, dt in ((0.5, 3.0, 0.02, 1e-3), (0.5, 0.01, 0.3, 1e-3), (2.0, 9.0, 0.1, 0.1)):
        rate = min(min(20.0, 0.5 / dt) * smallest, np.sqrt(weakest * np.sqrt(size) * smallest))
        for share in (0.999, 1.001):
            assert is_fast((share * rate) ** 2 / size, size, weakest, smallest, dt) == (share > 1.0)


def test_the_escape_leads_out(planar):
    """Near a singularity the escape raises the manipulability, whichever side the arm is bent to."""
    for angle in (-0.1, -1e-3, 1e-5, 1e-2, 0.1):
        q = bent(angle)
        decomposition, vjp = at(planar, q)
        assert decomposition.sigma[-1] < WIDTH
        e = escape_velocity(decomposition, vjp, DT, WIDTH)
        assert e @ log_manipulability_gradient(planar, q) > 0.0
        assert manipulability(planar, q + 1e-3 * abs(angle) * e / np.linalg.norm(e)) > manipulability(planar, q)


def stated(decomposition: Decomposition, vjp, climb: np.ndarray, width: float) -> np.ndarray:
    """The formula of `escape_velocity`'s docstring."""
    sigma, V = decomposition.sigma, decomposition.Vt[: len(decomposition.sigma)]
    w, along, smallest = np.clip(1.0 - (sigma / width) ** 2, 0.0, None) ** 2, V @ climb, sigma[-1]
    r = DT * 0.2 * np.linalg.norm(smallest_gradient(decomposition, vjp)) / 1.25
    speed = 0.2 * w[-1] * smallest / np.hypot(smallest, r)
    speed = max(speed, 5e-4 * max(0.0, 1.0 - smallest / (1e-3 * width)))
    d, turn = (w * along) @ V, DT * speed / 0.25 * np.sum(((1.0 - w) * along) ** 2) * (smallest / width) ** 2
    return speed * d / np.hypot(np.linalg.norm(d), turn)


def test_the_escape_has_the_stated_speed(planar):
    """That of its docstring, along what is nearly lost; 0 from the width on."""
    for angle in (0.01, 0.05, 0.1):
        decomposition, vjp = at(planar, bent(angle))
        e = escape_velocity(decomposition, vjp, DT, WIDTH)
        expected = stated(decomposition, vjp, log_manipulability_gradient(planar, bent(angle)), WIDTH)
        np.testing.assert_allclose(e, expected, rtol=1e-9, atol=1e-15)
        # one singular value only is below the width: its own direction
        assert abs(e @ decomposition.Vt[1]) == pytest.approx(np.linalg.norm(e), rel=1e-9)
    decomposition, vjp = at(planar, bent(0.05))
    np.testing.assert_array_equal(escape_velocity(decomposition, vjp, DT, float(decomposition.sigma[-1])), np.zeros(3))


def test_the_seed_acts_at_the_singularity_only(planar):
    """The larger of the escape's own speed and the seed's, which falls to 0 within a thousandth of the width."""
    for angle, share in ((1e-7, None), (1e-4, None), (0.05, 0.99)):
        decomposition, vjp = at(planar, bent(angle))
        width = WIDTH if share is None else float(decomposition.sigma[-1]) / share
        expected = stated(decomposition, vjp, log_manipulability_gradient(planar, bent(angle)), width)
        np.testing.assert_allclose(escape_velocity(decomposition, vjp, DT, width), expected, rtol=1e-6, atol=1e-12)
        assert (np.linalg.norm(expected) < 5e-4 * 1.001) == (angle != 1e-4)


def test_the_escape_weighs_directions_by_how_nearly_they_are_lost(planar):
    """With both singular values below the width: sum of (1 - (sigma / width)^2)^2 v v^T grad log mu."""
    q = np.array([0.3, 0.7, -0.4])
    decomposition, vjp = at(planar, q)
    width = 1.5 * decomposition.sigma[0]
    V = decomposition.Vt[:2]
    d = V.T @ ((1.0 - (decomposition.sigma / width) ** 2) ** 2 * (V @ log_manipulability_gradient(planar, q)))
    e = escape_velocity(decomposition, vjp, DT, float(width))
    np.testing.assert_allclose(e / np.linalg.norm(e), d / np.linalg.norm(d), atol=1e-9)


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


def test_only_a_task_that_presses_in_is_damped_more():
    """Out of the singularity and along it: the usual damping; into it: the stable one; squares mixed in between."""
    slope = np.array([0.0, 2.0])
    assert pressed_damping(0.1, 0.5, slope, np.array([0.0, 3.0])) == pytest.approx(0.1)
    assert pressed_damping(0.1, 0.5, slope, np.array([3.0, 0.0])) == pytest.approx(0.1)
    assert pressed_damping(0.1, 0.5, slope, np.array([0.0, -3.0])) == pytest.approx(0.5)
    angle = np.arcsin(0.05)  # half of FULLY_PRESSING
    between = pressed_damping(0.1, 0.5, slope, np.array([np.cos(angle), -np.sin(angle)]))
    assert between == pytest.approx(np.sqrt(0.5 * 0.1**2 + 0.5 * 0.5**2))
    assert pressed_damping(0.1, 0.5, slope, np.zeros(2)) == pytest.approx(0.1)


def test_log_gradient_at_the_singularity_has_the_length_at_the_edge_of_rounding(planar):
    """Not infinite: that of the gradient over the mu at which a singularity can be told from rounding."""
    q = bent(0.0)
    largest = np.linalg.svd(planar(q), compute_uv=False)[0]
    expected = manipulability_gradient(planar, q) / (SINGULAR_RATIO * largest**2)
    np.testing.assert_allclose(log_manipulability_gradient(planar, q), expected, rtol=1e-9)


def test_gradient_at_the_singularity_is_that_beside_it(planar):
    """The cone's ascent at a singularity is the limit of the gradient beside it, in length and in direction."""
    q = bent(0.0)
    cone = manipulability_gradient(planar, q)
    beside = manipulability_gradient(planar, q + 1e-6 * cone / np.linalg.norm(cone))
    np.testing.assert_allclose(cone, beside, atol=1e-5)
    assert cone[np.argmax(np.abs(cone))] > 0.0
