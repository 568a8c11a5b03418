"""The servo loop: what an arm does between a real-time program's calls, whatever those bring."""

from __future__ import annotations

import numpy as np
import pytest
from servo_cases import (
    BAD_TIMES,
    DT,
    ROUNDING,
    SAME,
    Arm,
    Constantly,
    RobotOf,
    bad_postures,
    command_of,
    law_of,
    start_of,
)

import manip_learn as ml

INVALID, STALE = ml.Status.INVALID_INPUT, ml.Status.STALE


def moving(robot: ml.Robot, periods: int = 300, reach: float = 0.3, **settings: object) -> Arm:
    """An arm in motion, so many periods after its start."""
    arm = Arm(ml.ServoLoop(law_of(robot, robot.name, reach), **settings), start_of(robot))
    arm.calls(periods)
    return arm


def test_jerk_is_limited(robot_of: RobotOf) -> None:
    """Jerk limits hold in every period, braking for bad input included, and the arm still arrives."""
    robot = robot_of("sawyer")
    loop = ml.ServoLoop(law_of(robot, "sawyer"), acceleration_limit=4.0, jerk_limit=80.0)
    assert loop.jerk_limit is not None
    before, rate, q = np.zeros(robot.nv), np.zeros(robot.nv), start_of(robot)
    first = loop.task_error(q)
    for k in range(3500):
        bad = 400 <= k < 700
        command = loop.update(None if bad else q, k * DT)
        change = command.velocity - before
        assert np.all(np.abs(change) <= 4.0 * DT * ROUNDING)
        assert np.all(np.abs(change - rate) <= 80.0 * DT * DT * (1.0 + 1e-6))
        before, rate = command.velocity, change
        q = robot.integrate(q, DT * command.velocity)
    assert loop.task_error(q) < 0.02 * first
    np.testing.assert_allclose(loop.position, q, rtol=0, atol=1e-9)


def test_a_state_that_is_not_new_holds_the_last_command(robot_of: RobotOf) -> None:
    """The same time again: the same velocity and status; nothing is computed from an old state."""
    arm = moving(robot_of("sawyer"))
    last = arm.call()
    assert np.linalg.norm(last.velocity) > 0.1
    for again in arm.calls(50, t=arm.newest):
        np.testing.assert_array_equal(again.velocity, last.velocity)
        assert again.status is last.status


def test_holding_never_leads_beyond_a_limit(robot_of: RobotOf) -> None:
    """A command that is held while the joint approaches its limit is slowed down as a new one would be."""
    robot = robot_of("sawyer")
    loop = ml.ServoLoop(Constantly(robot, robot.velocity_limit), stale_after=0.5)
    arm = Arm(loop, robot.position_upper - 0.15)
    arm.calls(80)
    held = arm.calls(470, t=arm.newest)
    assert np.all(arm.q > robot.position_upper - 0.05)
    assert {command.status for command in held[:300]} == {ml.Status.POSITION_LIMITED}


@pytest.mark.parametrize("jerk", [None, 300.0])
def test_a_stale_state_brakes_and_a_new_one_starts_again(robot_of: RobotOf, jerk: float | None) -> None:
    """`stale_after` without a new state: at rest within the acceleration limit; with new states it goes on."""
    arm = moving(robot_of("sawyer"), reach=1.0, jerk_limit=jerk)
    words = [command.status for command in arm.calls(600, t=arm.newest)]
    assert words.index(STALE) == pytest.approx(100, abs=1) and set(words[101:]) == {STALE}
    assert np.all(arm.last == 0.0) and arm.loop.position is not None
    later = arm.calls(300)
    assert later[0].status is STALE and later[1].status is not STALE
    assert np.linalg.norm(arm.last) > 0.05


def test_bad_input_brakes_and_never_raises(robot_of: RobotOf) -> None:
    """Whatever is no posture or no time: a status, a braked stop, no exception; good input starts the arm again."""
    for name in ("sawyer", "kinova"):
        robot = robot_of(name)
        arm = Arm(ml.ServoLoop(law_of(robot, name)), start_of(robot))
        for posture, time in [(bad, SAME) for bad in bad_postures(robot)] + [(SAME, bad) for bad in BAD_TIMES]:
            assert arm.calls(20)[-1].status is not INVALID
            for _ in range(30):
                command = arm.call(posture, t=time)
                assert command.status is INVALID, (posture, time)
            assert np.all(command.velocity == 0.0)


def test_bad_input_first_does_not_move_the_arm(robot_of: RobotOf) -> None:
    """A loop that has never seen a state commands nothing, and starts at the first good one.

    (cos, sin) = (0, 0) of a continuous joint is no posture either.
    """
    robot = robot_of("kinova")
    loop, q = ml.ServoLoop(law_of(robot, "kinova")), robot.configuration(start_of(robot))
    for posture in [*bad_postures(robot), np.zeros(robot.nq)]:
        command = loop.update(posture, 0.0)
        assert command.status is INVALID and np.all(command.velocity == 0.0)
    for time in (None, "0.1", np.nan, np.inf, True, 10**400):
        assert np.all(loop.update(q, time).velocity == 0.0)
    assert np.any(Arm(loop, start_of(robot)).calls(3)[-1].velocity)


def test_outside_its_limits_the_arm_stands_too(robot_of: RobotOf) -> None:
    """Bad input while a joint returns from outside its limits: it stands, it does not go on returning."""
    robot = robot_of("sawyer")
    for sense, edge in ((1.0, robot.position_upper[1]), (-1.0, robot.position_lower[1])):
        arm = Arm(ml.ServoLoop(law_of(robot, "sawyer")), start_of(robot))
        arm.q[1] = edge + sense * 0.3
        last = arm.calls(100)[-1]
        assert last.status is ml.Status.OUTSIDE_LIMITS and sense * last.velocity[1] < -0.01
        assert np.all(arm.calls(400, None)[-1].velocity == 0.0)


@pytest.mark.parametrize("part", ["task", "policy", "controller"])
def test_what_the_user_wrote_may_fail(part: str, robot_of: RobotOf) -> None:
    """A task, policy or controller that raises or gives nonsense in motion: a braked stop, and on when it is well."""
    robot = robot_of("sawyer")
    law, ill = law_of(robot, "sawyer"), [False]
    for fault in (ZeroDivisionError("task"), np.full(7, np.nan), "text"):

        def spoiled(good: object, fault: object = fault) -> object:
            if ill[0] and isinstance(fault, Exception):
                raise fault
            return fault if ill[0] else good

        class Task(ml.PointAttractor):
            def velocity(self, constraint, q, t, spoiled=spoiled):  # noqa: ANN001, ANN202
                return spoiled(super().velocity(constraint, q, t))

        def own(q: np.ndarray, t: float = 0.0, dt: float | None = None, spoiled: object = spoiled) -> ml.Command:
            return command_of(spoiled(law(q, t, dt).velocity))

        controller = {
            "task": ml.ResolvedRateController(law.constraint, Task(law.task.target), law.null_policy),
            "policy": ml.ResolvedRateController(
                law.constraint, law.task, lambda q, t, spoiled=spoiled: spoiled(np.full(7, 0.2))
            ),
            "controller": own,
        }[part]
        arm = Arm(ml.ServoLoop(controller, robot=robot), start_of(robot))
        for k in range(320):
            ill[0] = 120 <= k < 220
            assert (arm.call().status is INVALID) == ill[0], fault
            assert k != 219 or np.all(arm.last == 0.0)
        assert np.linalg.norm(arm.last) > 0.05
