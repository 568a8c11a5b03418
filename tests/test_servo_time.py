"""The servo loop and time: periods that are wrong or irregular, gaps, and tasks that change in motion."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from servo_cases import DT, Arm, Constantly, RobotOf, law_of, start_of

import manip_learn as ml

ROUNDING = 1.0 + 1e-6


def fast(robot: ml.Robot, seed: int) -> Constantly:
    """Full speed towards a corner of the joint limits."""
    return Constantly(robot, robot.velocity_limit * np.random.default_rng(seed).choice([-1.0, 1.0], robot.nv))


def outside(robot: ml.Robot, q: np.ndarray) -> float:
    """Largest distance beyond a position limit."""
    return float(max(np.max(q - robot.position_upper), np.max(robot.position_lower - q)))


@pytest.mark.parametrize(
    ("period", "jerk", "servo"),
    [(0.004, None, "position"), (0.01, 500.0, "velocity"), (0.03, None, "velocity"), (0.03, 500.0, "position")],
)
def test_another_period_than_agreed(
    period: float, jerk: float | None, servo: str, robot_of: RobotOf, caplog: pytest.LogCaptureFixture
) -> None:
    """Made for 1 ms and called every 4, 10 or 30 ms: every limit holds in time, and one line says so with numbers."""
    robot = robot_of("sawyer")
    loop, q = ml.ServoLoop(fast(robot, 1), DT, jerk_limit=jerk), start_of(robot)
    before, rate = np.zeros(7), np.zeros(7)
    with caplog.at_level(logging.WARNING, "manip_learn"):
        for k in range(int(3.0 / period)):
            u = loop.update(q, k * period).velocity
            change = (u - before) / period
            assert np.all(np.abs(u) <= robot.velocity_limit * ROUNDING)
            assert np.all(np.abs(change) <= loop.acceleration_limit * ROUNDING)
            assert jerk is None or np.all(np.abs(change - rate) <= jerk * period * ROUNDING)
            q, before, rate = robot.integrate(q, period * u) if servo == "velocity" else loop.position, u, change
            assert outside(robot, q) <= 1e-9 and outside(robot, loop.position) <= 1e-9
    assert np.max(outside(robot, q)) > -0.02  # it has come to a limit
    words = [r.getMessage() for r in caplog.records if "servo loop" in r.getMessage()]
    assert len(words) == 1 and "period of 1 ms" in words[0] and f"every {1e3 * period:g} ms" in words[0]


@pytest.mark.parametrize(("seed", "jerk"), [(0, 500.0), (1, None), (2, 500.0)])
def test_random_stamps(seed: int, jerk: float | None, robot_of: RobotOf) -> None:
    """Stamps 0.2 to 100 ms apart: no command steps by more than a dt's worth, or the time's where that is shorter."""
    robot, rng = robot_of("sawyer"), np.random.default_rng(seed)
    law = fast(robot, seed) if seed else law_of(robot, "sawyer", 2.0)
    loop = ml.ServoLoop(law, DT, jerk_limit=jerk)
    q, t, period, at, before, rate, shortest = start_of(robot), 0.0, DT, None, np.zeros(7), np.zeros(7), DT
    for k in range(1000):
        if seed and k % 700 == 699:
            law.velocity[:] = -law.velocity
        u, held = loop.update(q, t).velocity, min(period, DT)
        change = (u - before) / held
        assert np.all(np.abs(u) <= robot.velocity_limit * ROUNDING)
        assert np.all(np.abs(change) <= loop.acceleration_limit * ROUNDING)
        assert jerk is None or np.all(np.abs(change - rate) <= jerk * max(held, shortest) * ROUNDING)
        assert at is None or np.all(np.abs(loop.position - at) <= robot.velocity_limit * held * ROUNDING)
        assert outside(robot, loop.position) <= 1e-9
        q = at = loop.position
        before, rate, shortest = u, change, held
        period = 10.0 ** rng.uniform(np.log10(2e-4), -1.0)
        t += period


@pytest.mark.parametrize(("seed", "jerk"), [(1, None), (2, 500.0)])
def test_random_stamps_of_a_velocity_servo(seed: int, jerk: float | None, robot_of: RobotOf) -> None:
    """It goes on at the last velocity for up to 100 ms: once such a gap was seen, no position limit is exceeded."""
    robot, rng = robot_of("sawyer"), np.random.default_rng(seed)
    law = fast(robot, seed)
    loop, q, t, before = ml.ServoLoop(law, DT, jerk_limit=jerk), start_of(robot), 0.0, np.zeros(7)
    nearest = -np.inf
    for k in range(2000):
        if k % 700 == 699:
            law.velocity[:] = -law.velocity
        u, gap = loop.update(q, t).velocity, 10.0 ** rng.uniform(np.log10(2e-4), -1.0)
        assert np.all(np.abs(u) <= robot.velocity_limit * ROUNDING)
        assert np.all(np.abs(u - before) <= loop.acceleration_limit * DT * ROUNDING)
        q, t, before = robot.integrate(q, gap * u), t + gap, u
        nearest = max(nearest, outside(robot, q))
    assert -0.02 < nearest <= 1e-9


def test_braking_keeps_position_limits(robot_of: RobotOf) -> None:
    """All joints brake together, and none goes the faster to its limit the longer others need to stop."""
    robot = robot_of("sawyer")
    own, q = Constantly(robot, np.eye(7)[6] * 1.5), np.zeros(7)
    loop = ml.ServoLoop(own, acceleration_limit=np.where(np.arange(7) == 6, 5.0, 20.0))
    q[6], q[0] = robot.position_lower[6], robot.position_upper[0] - 0.8
    arm = Arm(loop, q)
    arm.calls(400)  # the last joint needs 0.3 s for its full speed
    own.velocity[0] = 1.5
    arm.calls(150)
    assert arm.last[0] > 1.4 and arm.last[6] > 1.4
    loop.stop()
    together = arm.call()
    np.testing.assert_allclose(together.velocity[[0, 6]], 1.5 - 5.0 * DT, rtol=1e-6)
    arm.calls(400)
    assert np.all(arm.last == 0.0)
    loop.start()
    for _ in range(2500):
        before = robot.position_upper[0] - arm.q[0]
        arm.call()
        assert outside(robot, arm.q) <= 1e-9
        assert arm.last[0] * arm.last[6] / 5.0 <= 1.02 * before + 1e-3
    assert np.all(arm.last[0] < 1e-3) and arm.q[0] > robot.position_upper[0] - 1e-3


def test_the_task_changes_in_motion(robot_of: RobotOf) -> None:
    """`set_target`, `set_task`, `set_constraint`: the velocity goes on within the limits, the new goal is reached."""
    robot = robot_of("sawyer")
    law = law_of(robot, "sawyer")
    loop, q, before = ml.ServoLoop(law, jerk_limit=500.0), start_of(robot), np.zeros(7)
    here = law.constraint.features.coordinates(q)
    one = ml.Constraint(np.eye(3)[:1], law.constraint.features)
    changes = {
        300: lambda: loop.set_target(here + [0.1, -0.1, 0.1]),
        600: lambda: loop.set_task(ml.PointAttractor(here - 0.1, gain=3.0)),
        900: lambda: loop.set_constraint(one),
    }
    for k in range(2500):
        changes.get(k, lambda: None)()
        u = loop.update(q, k * DT).velocity
        assert np.all(np.abs(u - before) <= loop.acceleration_limit * DT * (1.0 + 1e-9))
        assert k not in changes or np.linalg.norm(u) > 0.02
        q, before = robot.integrate(q, DT * u), u
    assert loop.controller.robot is robot and loop.task_error(q) < 1e-3
    assert one.features.coordinates(q)[0] == pytest.approx(here[0] - 0.1, abs=1e-3)


def test_a_motion_waits_while_the_arm_stands(robot_of: RobotOf) -> None:
    """After `stop` and `start`, a motion along a free direction goes on where it was, as gently as it began."""
    robot = robot_of("sawyer")
    constraint = ml.Constraint(np.eye(3)[:2], ml.FrameJacobian(robot, "right_hand"))
    task = ml.FreeDirection(constraint, 0.1, 0.1)
    loop, q = ml.ServoLoop(ml.ResolvedRateController(constraint, task)), start_of(robot)
    places = []
    for k in range(4500):
        if k == 700:
            loop.stop()
        if k == 2200:
            loop.start()
        places.append(robot.position(q, "right_hand"))
        q = robot.integrate(q, DT * loop.update(q, k * DT).velocity)
    speed = np.linalg.norm(np.diff(places, axis=0), axis=1) / DT
    assert np.max(speed[2200:]) < 0.115
    assert np.linalg.norm(places[-1] - places[0]) == pytest.approx(0.1, abs=1e-3)
