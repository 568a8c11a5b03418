"""Limits: bounds on the next velocity that can always be kept in the step that follows."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest

import manip_learn as ml
from manip_learn.control.barriers import approach_bound
from manip_learn.control.limits import Limits
from manip_learn.errors import ConfigurationError
from manip_learn.robot.robot import Robot

RobotOf = Callable[[str], Robot]


def test_greedy_motion_keeps_every_limit(robot_of, rng):
    """A joint that always takes an extreme of its bounds meets no limit of position, velocity or acceleration."""
    for name, dt in product(("sawyer", "gantry", "kinova"), (1e-4, 1e-3, 0.01, 0.05)):
        robot = robot_of(name)
        limits = Limits(robot)
        low = np.where(np.isfinite(robot.position_lower), robot.position_lower, -3.0)
        high = np.where(np.isfinite(robot.position_upper), robot.position_upper, 3.0)
        q, u = rng.uniform(low, high), np.zeros(robot.nv)
        for step in range(600):
            if step % 100 == 0:
                sense = rng.choice([-1.0, 1.0], robot.nv)
            bounds = limits.bounds(q, dt, u)
            lowest, highest = np.array(bounds.low), np.array(bounds.high)
            assert np.all(lowest <= highest)
            following = np.where(sense > 0.0, highest, lowest)
            assert np.all(np.abs(following - u) <= limits.acceleration * dt * (1.0 + 1e-12))
            assert np.all(np.abs(following) <= limits.velocity * (1.0 + 1e-12))
            q, u = q + dt * following, following
            assert np.all(q <= robot.position_upper + 1e-12) and np.all(q >= robot.position_lower - 1e-12)


def braking(d: float, v: float, a: float, dt: float) -> float:
    """brake(d) of `Limits`' docstring: half of the deceleration, 20 per second, a quarter of the speed outside."""
    a, kappa = 0.5 * a, min(20.0, 0.5 / dt)
    d1 = (a / kappa - 0.5 * a * dt) / kappa
    d0 = d1 - ((a / kappa) ** 2 - (0.5 * a * dt) ** 2) / (2.0 * a)
    if d <= d1:
        return max(kappa * d, -0.25 * v)
    return min(v, np.sqrt(2.0 * a * (d - d0) + (0.5 * a * dt) ** 2) - 0.5 * a * dt)


def test_bounds_are_those_of_the_docstring(robot_of, rng):
    """Velocity, braking distance and change of velocity, on both sides, and which of them each bound comes from."""
    robot = robot_of("sawyer")
    speed, acceleration = rng.uniform(0.5, 2.0, 7), rng.uniform(1.0, 8.0, 7)
    limits = Limits(robot, velocity=speed, acceleration=acceleration, margin=0.01)
    low, high = robot.position_lower + 0.01, robot.position_upper - 0.01
    for dt, distance, previous in product((0.001, 0.02, 0.1), (-0.3, -1e-3, 0.0, 1e-3, 0.03, 0.2, 9.0), (None, 0.3)):
        q = np.maximum(high - distance, 0.5 * (low + high))
        u = None if previous is None else previous * speed
        for mirrored in (False, True):
            x, before = (low + high - q, u if u is None else -u) if mirrored else (q, u)
            together = 0.0 if u is None else float(np.max(np.abs(u) / acceleration))  # [s] in which all joints stop
            bounds = limits.bounds(x, dt, before)
            far, near = (bounds.high, bounds.low) if mirrored else (bounds.low, bounds.high)
            causes = bounds.low_cause if mirrored else bounds.high_cause
            for j in range(7):
                v, a = float(speed[j]), float(acceleration[j])
                top, bottom = (
                    min(braking(d, v, a, dt), d / together if together > 0.0 and d > 0.0 else np.inf)
                    for d in (high[j] - q[j], q[j] - low[j])
                )
                bottom, cause = -bottom, 0 if top < v else 1
                if u is not None:
                    cause = 2 if u[j] + a * dt < top else cause
                    top, bottom = min(top, u[j] + a * dt), max(bottom, u[j] - a * dt)
                    if bottom > top:  # the acceleration limit has precedence
                        top = bottom = u[j] - a * dt if top < u[j] - a * dt else u[j] + a * dt
                sign = -1.0 if mirrored else 1.0
                assert sign * near[j] == pytest.approx(top, rel=1e-12, abs=1e-14)
                assert sign * far[j] == pytest.approx(bottom, rel=1e-12, abs=1e-14)
                assert causes[j] == cause
            assert bounds.outside == pytest.approx(max(0.0, -distance), abs=1e-12)


def test_a_joint_outside_returns(robot_of):
    """From outside, at rest or still moving out, the joint brakes at its acceleration limit and comes back."""
    robot = robot_of("sawyer")
    limits, dt = Limits(robot), 0.001
    for speed in (0.0, 1.0):
        q, u = robot.position_upper + 0.1, np.full(7, speed)
        assert limits.bounds(q, dt, u).outside == pytest.approx(0.1)
        for _ in range(4000):
            bounds = limits.bounds(q, dt, u)
            following = np.clip(np.full(7, 9.0), bounds.low, bounds.high)
            assert np.all(np.abs(following - u) <= limits.acceleration * dt * (1.0 + 1e-12))
            q, u = q + dt * following, following
        np.testing.assert_allclose(q, robot.position_upper, rtol=0, atol=1e-6)


def test_defaults_and_settings(robot_of):
    """The default acceleration is documented; every limit can be given, as one number or one per joint."""
    robot = robot_of("sawyer")
    np.testing.assert_array_equal(Limits(robot).acceleration, 5.0 * robot.velocity_limit)
    assert Limits(robot).acceleration.min() == 5.0 * robot.velocity_limit.min()
    unbounded = Limits(robot, velocity=np.where(np.arange(7) == 2, np.inf, 1.0)).acceleration
    np.testing.assert_array_equal(unbounded, np.where(np.arange(7) == 2, 10.0, 5.0))
    other = Limits(robot, jerk=100.0).with_rates(2.0, None)
    np.testing.assert_array_equal([other.acceleration, other.jerk], [np.full(7, 2.0), np.full(7, 100.0)])
    assert other.acceleration.min() == 2.0 and other.bounds(np.zeros(7), 0.01, np.zeros(7)).high[0] == pytest.approx(
        0.02
    )
    own = Limits(robot, velocity=0.5, acceleration=np.arange(1.0, 8.0), jerk=100.0, margin=0.05)
    np.testing.assert_array_equal(own.velocity, np.full(7, 0.5))
    np.testing.assert_array_equal(own.upper, robot.position_upper - 0.05)
    assert own.jerk is not None and own.jerk[0] == 100.0
    free = Limits(robot, position=False)
    assert np.all(np.isinf(free.upper)) and free.bounds(robot.position_upper + 1.0, 0.01, None).outside == 0.0


def test_wrong_limits_are_refused(robot_of):
    """The joint and the value seen are named, and the width of a range that a margin uses up."""
    robot = robot_of("sawyer")
    widths = robot.position_upper - robot.position_lower
    narrow = robot.joint_names[int(widths.argmin())]
    for settings, words in (
        ({"velocity": 0.0}, "velocity limit of joint 'right_j0' must be positive, got 0"),
        ({"acceleration": [1.0, 1.0]}, "7 numbers"),
        ({"acceleration": [1, 1, -1, 1, 1, 1, 1]}, "'right_j2' must be positive, got -1"),
        ({"jerk": np.nan}, "must be positive, got nan"),
        ({"margin": 4.0}, "no room to joint 'right_j0'"),
        ({"margin": 0.501 * float(widths.min())}, f"'{narrow}', whose range is {widths.min():g} wide"),
        ({"margin": -0.1}, "margin"),
    ):
        with pytest.raises(ConfigurationError, match=words):
            ml.Limits(robot, **settings)


def test_a_singularity_is_approached_so_slowly_that_the_arm_can_stop():
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
