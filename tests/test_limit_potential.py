"""The joint-limit potential and the weights that fall towards the limits."""

from __future__ import annotations

import numpy as np
import pytest
from test_gradients import central_difference

from manip_learn.robot.limit_potential import limit_weights

LIMITED = ["one", "planar3", "gantry", "panda", "ur5", "sawyer"]


def slope_of(robot, q: np.ndarray) -> np.ndarray:
    """dh/dq_j = 4 x_j / ((u_j - l_j) (1 - x_j^2)^2)."""
    width = robot.position_upper - robot.position_lower
    x = (2.0 * q - robot.position_upper - robot.position_lower) / width
    return 4.0 * x / (width * (1.0 - x**2) ** 2)


@pytest.mark.parametrize("name", LIMITED)
def test_potential_and_weights(robot_of, rng, name: str):
    """w = (1 + h'^2)^(-1/4), at most 2^(1/4) of (1 + |h'|)^(-1/2) and never less, and exact dw.

    At a limit and outside the weights are 0, of finite slope; they fall towards both limits.
    """
    robot = robot_of(name)
    for share in (0.0, 0.5, 0.9, 0.999):
        q = near_limits(robot, rng, share)
        w, slope = limit_weights(robot, q)
        steep = slope_of(robot, q)
        np.testing.assert_allclose(w, (1.0 + steep**2) ** -0.25, rtol=1e-9)
        published = 1.0 / np.sqrt(1.0 + np.abs(steep))
        assert np.all(w >= published * (1.0 - 1e-12)) and np.all(w <= 2.0**0.25 * published)
        expected = central_difference(lambda x: limit_weights(robot, x)[0], robot, q)
        np.testing.assert_allclose(np.diag(slope), expected, rtol=1e-5, atol=1e-7)
    for q, sign in ((robot.position_upper, -1.0), (robot.position_lower, 1.0)):
        w, slope = limit_weights(robot, np.nextafter(q, -sign * np.inf))
        assert np.all(w < 1e-6)
        w, slope = limit_weights(robot, q)
        assert np.all(w >= 0.0) and np.all(w < 1e-6) and np.all(np.isfinite(slope))
        inside = limit_weights(robot, q + sign * 1e-9)[1]
        assert np.all(sign * inside > 0.0)
        w, slope = limit_weights(robot, q - sign * 0.1)
        np.testing.assert_array_equal(np.stack([w, slope]), 0.0)


def near_limits(robot, rng: np.random.Generator, share: float) -> np.ndarray:
    """Positions with each joint at +- share of its half range, at random; a random posture for share 0."""
    q = robot.positions(robot.random_configuration(rng))
    if share == 0.0:
        return q
    limited, sign = np.isfinite(robot.position_upper), rng.choice([-1.0, 1.0], robot.nv)
    lower, upper = robot.position_lower[limited], robot.position_upper[limited]
    q[limited] = 0.5 * (lower + upper + share * sign[limited] * (upper - lower))
    return q
