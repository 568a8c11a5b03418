"""The servo loop: what an arm does between a real-time program's calls, whatever those bring."""

from __future__ import annotations

import numpy as np
import pytest
from servo_cases import BAD_TIMES, DT, Constantly, RobotOf, bad_postures, command_of, law_of, run, start_of

import manip_learn as ml

ROBOTS = ["planar3", "sawyer", "panda", "kinova", "gantry", "wrist", "tree"]
# of the change that the acceleration limits allow in a period
ROUNDING = 1.0 + 1e-9


@pytest.mark.parametrize("name", ROBOTS)
def test_motion_starts_from_rest_and_keeps_every_limit(name: str, robot_of: RobotOf) -> None:
    """Velocity, acceleration and position limits hold in every period; the first command is one period from rest."""
    robot = robot_of(name)
    loop = ml.ServoLoop(law_of(robot, name, 2.0))
    before, moved = np.zeros(robot.nv), 0.0
    for q, command in run(loop, start_of(robot), 500):
        u = command.velocity
        assert np.all(np.abs(u - before) <= loop.acceleration_limit * DT * ROUNDING)
        assert np.all(np.abs(u) <= robot.velocity_limit * ROUNDING)
        x = robot.positions(q)
        assert np.all(x <= robot.position_upper + 1e-9) and np.all(x >= robot.position_lower - 1e-9)
        before, moved = u, max(moved, float(np.max(np.abs(u))))
    assert moved > 0.05


@pytest.mark.parametrize("name", ["sawyer", "gantry"])
def test_jerk_is_limited(name: str, robot_of: RobotOf) -> None:
    """Jerk limits hold in every period, braking for bad input included, and the arm still arrives."""
    robot = robot_of(name)
    loop = ml.ServoLoop(law_of(robot, name), acceleration_limit=4.0, jerk_limit=80.0)
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
    robot = robot_of("sawyer")
    loop = ml.ServoLoop(law_of(robot, "sawyer"))
    *_, (q, last) = run(loop, start_of(robot), 300)
    assert np.linalg.norm(last.velocity) > 0.1
    for _ in range(50):
        again = loop.update(q, 299 * DT)
        np.testing.assert_array_equal(again.velocity, last.velocity)
        assert again.status is last.status


def test_holding_never_leads_beyond_a_limit(robot_of: RobotOf) -> None:
    """A command that is held while the joint approaches its limit is slowed down as a new one would be."""
    robot = robot_of("sawyer")
    loop = ml.ServoLoop(Constantly(robot, robot.velocity_limit), stale_after=0.5)
    q, t = robot.position_upper - 0.15, 0.0
    for k in range(550):
        t = k * DT if k < 80 else t
        q = robot.integrate(q, DT * loop.update(q, t).velocity)
        assert np.all(q <= robot.position_upper + 1e-9)
    assert np.all(q > robot.position_upper - 0.05)


@pytest.mark.parametrize("jerk", [None, 300.0])
def test_a_stale_state_brakes_and_a_new_one_starts_again(robot_of: RobotOf, jerk: float | None) -> None:
    """`stale_after` without a new state: at rest within the acceleration limit; with new states it goes on."""
    robot = robot_of("sawyer")
    loop = ml.ServoLoop(law_of(robot, "sawyer", 1.0), jerk_limit=jerk)
    *_, (q, last) = run(loop, start_of(robot), 300)
    before, words = last.velocity, []
    for _ in range(600):
        command = loop.update(q, 299 * DT)
        assert np.all(np.abs(command.velocity - before) <= loop.acceleration_limit * DT * ROUNDING)
        before = command.velocity
        words.append(command.status)
    assert words.index(ml.Status.STALE) == pytest.approx(100, abs=1)
    assert set(words[101:]) == {ml.Status.STALE}
    assert np.all(before == 0.0)
    assert loop.position is not None
    later = list(run(loop, loop.position, 300, t=1.0))
    assert later[0][1].status is ml.Status.STALE and later[1][1].status is not ml.Status.STALE
    assert np.linalg.norm(later[-1][1].velocity) > 0.05
    speeds = np.array([np.zeros(robot.nv), *(c.velocity for _, c in later)])
    assert np.all(np.abs(np.diff(speeds, axis=0)) <= loop.acceleration_limit * DT * ROUNDING)


@pytest.mark.parametrize("name", ["sawyer", "kinova", "gantry"])
def test_bad_input_brakes_and_never_raises(name: str, robot_of: RobotOf) -> None:
    """Whatever is no posture or no time: a status, a braked stop, no exception; good input starts the arm again."""
    robot = robot_of(name)
    bad = [(q, None) for q in bad_postures(robot)] + [("good", t) for t in BAD_TIMES]
    loop = ml.ServoLoop(law_of(robot, name))
    q, t, before = start_of(robot), 0.0, np.zeros(robot.nv)
    for posture, time in bad:
        for _ in range(20):
            t += DT
            command = loop.update(q, t)
            assert np.all(np.abs(command.velocity - before) <= loop.acceleration_limit * DT * ROUNDING)
            q, before = robot.integrate(q, DT * command.velocity), command.velocity
        assert command.status is not ml.Status.INVALID_INPUT
        for _ in range(30):
            t += DT
            command = (
                loop.update(q, time) if isinstance(posture, str) and posture == "good" else loop.update(posture, t)
            )
            assert command.status is ml.Status.INVALID_INPUT, (posture, time)
            assert np.all(np.abs(command.velocity - before) <= loop.acceleration_limit * DT * ROUNDING)
            q, before = robot.integrate(q, DT * command.velocity), command.velocity
        assert np.all(before == 0.0)


@pytest.mark.parametrize("name", ["sawyer", "kinova"])
def test_bad_input_first_does_not_move_the_arm(name: str, robot_of: RobotOf) -> None:
    """A loop that has never seen a state commands nothing, and starts at the first good one."""
    robot = robot_of(name)
    loop = ml.ServoLoop(law_of(robot, name))
    for posture in bad_postures(robot):
        assert np.all(loop.update(posture, 0.0).velocity == 0.0)
    for time in BAD_TIMES:
        if not isinstance(time, float | int) or time != time or abs(time) > 1e15 or isinstance(time, bool):
            assert np.all(loop.update(start_of(robot), time).velocity == 0.0)
    assert np.any([c.velocity for _, c in run(loop, start_of(robot), 3)])


def test_a_direction_of_no_length_is_no_posture(robot_of: RobotOf) -> None:
    """(cos, sin) = (0, 0) of a continuous joint is bad input, also as the first; the loop recovers."""
    robot = robot_of("kinova")
    loop, q = ml.ServoLoop(law_of(robot, "kinova")), robot.configuration(start_of(robot))
    assert loop.update(np.zeros(robot.nq), 0.0).status is ml.Status.INVALID_INPUT
    assert loop.update(q, 0.1).status is not ml.Status.INVALID_INPUT


def test_outside_its_limits_the_arm_stands_too(robot_of: RobotOf) -> None:
    """Bad input while a joint returns from outside its limits: it stands, it does not go on returning."""
    robot = robot_of("sawyer")
    loop = ml.ServoLoop(law_of(robot, "sawyer"))
    q = start_of(robot)
    q[1] = robot.position_upper[1] + 0.3
    *_, (_, last) = run(loop, q, 100)
    assert last.status is ml.Status.OUTSIDE_LIMITS and last.velocity[1] < -0.01
    commands = [loop.update(None, 0.0) for _ in range(400)]
    assert np.all(commands[-1].velocity == 0.0)


@pytest.mark.parametrize("part", ["task", "policy", "controller"])
@pytest.mark.parametrize("fault", [ZeroDivisionError("task"), MemoryError(), "nan", "size", "text"])
def test_what_the_user_wrote_may_fail(part: str, fault: object, robot_of: RobotOf) -> None:
    """A task, policy or controller that raises or gives nonsense in motion: a braked stop, and on when it is well."""
    robot = robot_of("sawyer")
    law, ill = law_of(robot, "sawyer"), [False]

    def spoiled(good: object) -> object:
        if ill[0] and isinstance(fault, Exception):
            raise fault
        return {"nan": np.full(7, np.nan), "size": np.zeros(11), "text": "text"}[str(fault)] if ill[0] else good

    class Task(ml.PointAttractor):
        def velocity(self, constraint, q, t):  # noqa: ANN001, ANN202
            return spoiled(super().velocity(constraint, q, t))

    def own(q: np.ndarray, t: float = 0.0, dt: float | None = None) -> ml.Command:
        return command_of(spoiled(law(q, t, dt).velocity))

    if part == "task":
        controller = ml.ResolvedRateController(law.constraint, Task(law.task.target), law.null_policy)
    elif part == "policy":
        policy = lambda q, t: spoiled(np.full(7, 0.2))  # noqa: E731
        controller = ml.ResolvedRateController(law.constraint, law.task, policy)
    else:
        controller = own
    loop, q, before = ml.ServoLoop(controller, robot=robot), start_of(robot), np.zeros(7)
    for k in range(500):
        ill[0] = 150 <= k < 350
        command = loop.update(q, k * DT)
        assert np.all(np.isfinite(command.velocity))
        assert np.all(np.abs(command.velocity - before) <= loop.acceleration_limit * DT * ROUNDING)
        assert (command.status is ml.Status.INVALID_INPUT) == ill[0]
        if k == 349:
            assert np.all(command.velocity == 0.0)
        q, before = robot.integrate(q, DT * command.velocity), command.velocity
    assert np.linalg.norm(before) > 0.05
