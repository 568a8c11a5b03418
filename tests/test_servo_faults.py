"""The servo loop and what it is not used to: following errors, other controllers, odd periods, a million bad calls."""

from __future__ import annotations

import gc
import tracemalloc

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
)  # fmt: skip

import manip_learn as ml
from manip_learn.control.following import STIFFNESS, FollowingError, _postures, following_error_limit
from manip_learn.errors import ConfigurationError, ConstraintError, ManipLearnError
from manip_learn.robot.tips import default_tip

FOLLOWING_ERROR = ml.Status.FOLLOWING_ERROR


def tripped(robot: ml.Robot, **settings: object) -> tuple[Arm, ml.Command]:
    """An arm that is blocked where it starts, and the command of the period in which the loop finds out."""
    arm = Arm(ml.ServoLoop(law_of(robot, "sawyer", 3.0), **settings), start_of(robot))
    for _ in range(2000):
        command = arm.call(start_of(robot))
        if command.status is FOLLOWING_ERROR:
            break
    return arm, command


def test_a_following_error_trips_until_reset(robot_of: RobotOf) -> None:
    """A blocked arm: the loop brakes, goes back to where the arm was measured, and stands there until `reset`."""
    robot = robot_of("sawyer")
    (arm, command), q = tripped(robot), start_of(robot)
    loop = arm.loop
    # 15 N on servos of 2,000 N m/rad: less than 13 N m in any joint
    assert 5e-4 < command.following_error < 0.0065
    assert loop.stopped_by is not None and loop.stopped_by.startswith("row ") and " mm off" in loop.stopped_by
    assert {c.status for c in arm.calls(2000, q)} == {FOLLOWING_ERROR}
    assert np.all(arm.last == 0.0) and loop.position is not None
    # no load is left but what friction would go on holding, 0.5 N m
    assert np.max(np.abs(loop.position - q)) <= 2.5e-4
    commands = arm.calls(300, loop.position)  # the block is gone: that is no reason to move
    assert {c.status for c in commands} == {FOLLOWING_ERROR}
    assert not np.any([c.velocity for c in commands])
    loop.reset()
    assert np.linalg.norm(Arm(loop, q).calls(800)[-1].velocity) > 0.01


def test_reset_after_a_trip_ramps_back(robot_of: RobotOf) -> None:
    """`position` goes back to where the arm is within velocity and acceleration limits, also if `reset` comes twice."""
    robot = robot_of("sawyer")
    (arm, _), q = tripped(robot), start_of(robot)
    arm.calls(300, q)
    loop, places = arm.loop, [arm.loop.position]
    far = np.max(np.abs(robot.difference(places[0], q)))
    loop.reset()
    arm = Arm(loop, q)
    for i in range(600):
        if i == 20:
            loop.reset()
        command = arm.call(q)
        places.append(loop.position)
        if command.status is not FOLLOWING_ERROR:
            break
        assert np.all(command.velocity == 0.0)
    speeds = np.diff(np.array([places[0], *places]), axis=0)[:-1] / DT
    assert far > 1e-4 and i < 590  # what letting go has left
    assert np.all(np.abs(speeds) <= robot.velocity_limit * ROUNDING)
    assert np.all(np.abs(np.diff(speeds, axis=0)) <= loop.acceleration_limit * DT * (1.0 + 1e-6))
    np.testing.assert_allclose(places[-2], q, rtol=0, atol=1e-5)


def test_a_wrong_measurement_leads_the_arm_nowhere(robot_of: RobotOf) -> None:
    """An encoder that jumps by a radian for good: the arm stops, and goes towards it by no more than the limits."""
    robot = robot_of("sawyer")
    arm = Arm(ml.ServoLoop(law_of(robot, "sawyer")), start_of(robot))
    arm.calls(200)
    at = arm.loop.position
    command = arm.calls(3000, arm.q + 1.0)[-1]
    assert command.status is FOLLOWING_ERROR and np.all(command.velocity == 0.0)
    assert at is not None and arm.loop.position is not None
    assert np.max(np.abs(arm.loop.position - at)) < 0.02


def test_a_posture_that_no_arm_can_have_is_none(robot_of: RobotOf) -> None:
    """Finite numbers turns beyond all limits start no motion; a turn too much, as encoders count, is a posture."""
    robot = robot_of("sawyer")
    farthest = np.maximum(-robot.position_lower, robot.position_upper) + 2.0 * np.pi
    for far in (1e200, 1e7, 30.0, 1.001 * farthest):
        loop = ml.ServoLoop(law_of(robot, "sawyer"))
        for k in range(20):
            command = loop.update(np.full(robot.nv, far), k * DT)
            assert command.status is ml.Status.INVALID_INPUT and not command.velocity.any()
        assert loop.stopped_by is not None and "no posture" in loop.stopped_by
    assert ml.ServoLoop(law_of(robot, "sawyer")).update(0.999 * farthest, 0.0).status is ml.Status.OUTSIDE_LIMITS


def test_a_limit_of_ones_own_counts_joint_by_joint(robot_of: RobotOf) -> None:
    """A given limit is what trips, for the joint that it belongs to, and nothing else does."""
    robot = robot_of("sawyer")
    limit = np.linspace(0.01, 0.07, 7)
    for j in range(7):
        loop, q = ml.ServoLoop(law_of(robot, "sawyer"), following_error_limit=limit, latency=0.0), start_of(robot)
        loop.reset(q)
        loop.stop()
        off = np.eye(7)[j] * limit[j]
        assert loop.update(q + 0.999 * off, 0.0).status is ml.Status.STOPPED
        assert loop.update(q - 1.001 * off, 0.1).status is ml.Status.FOLLOWING_ERROR
        assert loop.stopped_by is not None and robot.joint_names[j] in loop.stopped_by


def test_distances_mean_forces(robot_of: RobotOf) -> None:
    """A push of 14 N at the hand is no reason to stop, 16 N is; down to 2 kg of weight are no push at all.

    The force that is told is the one that explains how far the servos gave way, less what friction and encoders leave.
    """
    robot = robot_of("sawyer")
    q, tip = start_of(robot), default_tip(robot)
    J = robot.jacobian(q, tip)[:3]
    for force, trips in (
        ([14.0, 0.0, 0.0], False), ([16.5, 0.0, 0.0], True), ([0.0, -16.5, 0.0], True), ([0.0, 0.0, 16.5], True),
        ([0.0, 0.0, -19.6], False), ([0.0, 0.0, -19.6 - 17.0], True), ([14.0, 0.0, -19.6], False),
    ):  # fmt: skip
        following = FollowingError(robot, None, 0.0, DT, STIFFNESS, tip)
        away = J.T @ np.array(force) / STIFFNESS
        following.compare(q, q + away)
        assert following.tripped == trips, force
        pushed = np.array(force) + [0.0, 0.0, min(19.62, max(0.0, -force[2]))]
        assert following.force == pytest.approx(np.linalg.norm(pushed), abs=0.6), force
        assert following.largest == pytest.approx(np.abs(away).max())
        np.testing.assert_allclose(following.distance, away, atol=1e-12)


def test_what_lags_is_no_error(robot_of: RobotOf) -> None:
    """A measurement may belong to any posture commanded within the latency; a friction's worth more lets go."""
    robot = robot_of("sawyer")
    following, q = FollowingError(robot, 0.02, 0.01, DT), start_of(robot)
    speed, places = np.linspace(0.5, 1.1, 7), [q]
    for _ in range(40):
        following.moved(places[-1], DT, speed)
        places.append(places[-1] + DT * speed)
    for lag, excess in ((0, 0.0), (5, 0.0), (10, 0.0), (15, 0.005), (20, 0.010)):
        following.compare(places[-1], places[-1 - lag])
        np.testing.assert_allclose(-following.excess, excess * speed, rtol=0, atol=1.01 * DT * speed.max())
    assert not following.tripped
    way = following.relief()  # 20 ms at most, of the limits and of what was commanded within the latency
    most = 0.02 + np.minimum(0.01, 0.02) * speed + DT * speed
    assert np.all(np.abs(way) <= most * 1.1) and np.all(way < 0.0)
    np.testing.assert_allclose(way, -0.02 * speed * (1.0 + 2.5e-4 / (0.02 * speed + 2.5e-4)), rtol=1e-9)
    following.compare(places[-1], places[-1] - 0.031)
    assert following.tripped
    following.forget()
    assert not following.tripped and following.largest == 0.0


def test_limits_of_the_following_error(robot_of: RobotOf) -> None:
    """force / stiffness times the least lever, over directions a degree apart; bad numbers are refused."""
    robot, q = robot_of("planar3"), np.array([0.3, 0.8, 0.4])
    J = robot.jacobian(q, "tip")[:2]
    angles = np.linspace(0.0, np.pi, 20_000)
    lever = np.abs(np.column_stack([np.cos(angles), np.sin(angles)]) @ J).max(axis=1).min()
    got = following_error_limit(robot, 20.0, [1000.0, 2000.0, 4000.0], q=q)
    np.testing.assert_allclose(got, 20.0 * lever / np.array([1000.0, 2000.0, 4000.0]), rtol=0.04)
    row = ml.Constraint([[0.6, 0.8]], ml.FrameJacobian(robot, "tip", "x y"))
    np.testing.assert_allclose(following_error_limit(robot, q=q, constraint=row), 15.0 * np.abs(row(q)).max() / 2000.0)
    some = [following_error_limit(robot, q=x)[0] for x in _postures(robot)]
    np.testing.assert_allclose(following_error_limit(robot), np.median(some), rtol=1e-12)
    for wrong in (
        {"force": 0.0},
        {"force": np.inf},
        {"stiffness": -1.0},
        {"stiffness": [1.0, 1.0]},
        {"q": [np.nan] * 3},
    ):
        with pytest.raises(ConfigurationError):
            following_error_limit(robot, **wrong)


def test_a_blocked_arm_is_let_go_at_five_per_second(robot_of: RobotOf) -> None:
    """The way left falls by a share of 5 dt a period, in the end by 1 mrad/s, and the arm arrives."""
    robot = robot_of("sawyer")
    (arm, _), left = tripped(robot), []
    for _ in range(1200):
        arm.call(start_of(robot))
        left.append(np.abs(robot.difference(arm.loop.position, arm.loop._relief)).max())
    left = np.array(left[60:])
    fast, slow = left[:-1] > 3e-4, (left[:-1] < 1.9e-4) & (left[1:] > 2e-6)
    np.testing.assert_allclose(left[1:][fast], left[:-1][fast] * (1.0 - 5.0 * DT), rtol=1e-6)
    np.testing.assert_allclose(left[1:][slow], left[:-1][slow] - 1e-3 * DT, rtol=1e-6)
    assert fast.any() and slow.any() and left[-1] < 1e-8


def test_a_correction_makes_up_for_a_payload(robot_of: RobotOf) -> None:
    """Servos that give way by 3 mrad for good: with a correction the arm comes to where it was sent."""
    robot = robot_of("sawyer")
    loop, q = ml.ServoLoop(law_of(robot, "sawyer"), correction_time=0.5), start_of(robot)
    features = ml.FrameJacobian(robot, "right_gripper_tip", "xyz")
    sag = features(q).T @ [0.0, 0.0, -15.0] / 2000.0  # 1.5 kg
    loop.reset(q)
    loop.stop()
    first = None
    for k in range(4000):
        assert loop.position is not None
        measured = loop.position + sag
        first = measured if first is None else first
        assert loop.update(measured, k * DT).status is ml.Status.STOPPED
    np.testing.assert_allclose(first, q + sag, atol=1e-9)
    np.testing.assert_allclose(measured, q, atol=0.05 * np.abs(sag).max())
    # it comes at the rate that was asked for, and its steps are those of a first-order filter
    np.testing.assert_allclose(loop.position, q - sag * (1.0 - (1.0 - DT / 0.5) ** 4000), atol=1e-5)


def test_waiting_for_a_state_is_no_following_error(robot_of: RobotOf) -> None:
    """At full speed, states that come late trip nothing: an old measurement says nothing of newer commands."""
    robot = robot_of("sawyer")
    loop, q = ml.ServoLoop(Constantly(robot, robot.velocity_limit)), np.minimum(robot.position_lower, -1.0)
    for k in range(600):
        if k % 90 == 0:
            seen, at = q, k * DT
        command = loop.update(seen, at)
        assert command.status is not ml.Status.FOLLOWING_ERROR
        q = robot.integrate(q, DT * command.velocity)


def test_stop_and_start(robot_of: RobotOf) -> None:
    """`stop` brakes within the acceleration limit and holds; `start` goes on from rest."""
    robot = robot_of("sawyer")
    arm = Arm(ml.ServoLoop(law_of(robot, "sawyer")), start_of(robot))
    speeds = [np.linalg.norm(command.velocity) for command in arm.calls(300)]
    arm.loop.stop()
    stopping = arm.calls(400)
    assert {c.status for c in stopping} == {ml.Status.STOPPED}
    braking = np.array([np.linalg.norm(command.velocity) for command in stopping])
    assert np.all(np.diff([speeds[-1], *braking]) <= 0.0) and braking[0] < speeds[-1] and braking[-1] == 0.0
    arm.loop.start()
    arm.calls(200)
    assert np.linalg.norm(arm.last) > 0.05


def test_loops_share_nothing(robot_of: RobotOf) -> None:
    """Two loops round one controller: interleaved they do what each does alone."""
    robot = robot_of("sawyer")
    law, q = law_of(robot, "sawyer"), start_of(robot)
    alone = [command.velocity for command in Arm(ml.ServoLoop(law), q).calls(200)]
    first, second = Arm(ml.ServoLoop(law), q), Arm(ml.ServoLoop(law, acceleration_limit=1.0, jerk_limit=100.0), q + 0.1)
    together = [(first.call().velocity, second.call())[0] for _ in range(200)]
    np.testing.assert_array_equal(together, alone)
    assert law.limits is not None and law.limits.jerk is None and law.limits.acceleration[0] != 1.0


@pytest.mark.parametrize("own", [False, True])
def test_commands_belong_to_the_caller(own: bool, robot_of: RobotOf) -> None:
    """Writing into a command, a posture or a position changes no later one, and later updates change no command."""
    robot = robot_of("sawyer")
    law = Constantly(robot, np.linspace(-1.0, 1.0, 7)) if own else law_of(robot, "sawyer")
    clean, spoiled, q = ml.ServoLoop(law), ml.ServoLoop(law), start_of(robot)
    kept = []
    for k in range(300):
        t = (k - k % 3) * DT  # every state twice more
        posture = q.copy()
        expected, command = clean.update(q, t), spoiled.update(posture, t)
        np.testing.assert_array_equal(command.velocity, expected.velocity)
        kept.append((expected, expected.velocity.copy(), expected.task_part.copy()))
        for array in (posture, command.velocity, command.task_velocity, command.task_part, command.null_part):
            array[:] = 1e6
        position = spoiled.position
        assert position is not None
        position[:] = np.nan
        q = robot.integrate(q, DT * expected.velocity)
    for command, velocity, task_part in kept:
        np.testing.assert_array_equal(command.velocity, velocity)
        np.testing.assert_array_equal(command.task_part, task_part)


def test_a_controller_of_the_users_own_is_kept_within_the_limits(robot_of: RobotOf) -> None:
    """Full speed at once, in one array that is used again: acceleration, velocity and position limits hold."""
    robot = robot_of("sawyer")
    arm = Arm(ml.ServoLoop(Constantly(robot, 1e300 * robot.velocity_limit)), start_of(robot))
    assert ml.Status.OK not in {command.status for command in arm.calls(3000)}
    np.testing.assert_allclose(arm.q, robot.position_upper, rtol=0, atol=1e-2)


def test_velocities_of_any_kind_are_numbers(robot_of: RobotOf) -> None:
    """A list of ints or a float32 array from a user's own controller becomes a float64 velocity of the loop's own."""
    robot = robot_of("sawyer")
    for velocity in ([0] * 7, np.full(7, 0.001, np.float32), (0.001,) * 7):
        loop = ml.ServoLoop(lambda q, t, dt, v=velocity: command_of(v), robot=robot)
        for command in Arm(loop, start_of(robot)).calls(20):
            assert command.velocity.dtype == np.float64 and command.status is ml.Status.OK
            np.testing.assert_allclose(command.velocity, velocity, rtol=1e-6)


def test_the_compiled_controller_gives_the_same_commands(robot_of: RobotOf) -> None:
    """A loop compiles its controller by itself, and sends what a loop round its law sends, up to a joint limit."""
    pytest.importorskip("numba")
    robot = robot_of("sawyer")
    law, q = law_of(robot, "sawyer"), start_of(robot)
    loops = ml.ServoLoop(law, compiled=False), ml.ServoLoop(law), ml.ServoLoop(ml.CompiledController(law))
    assert [type(loop.controller) for loop in loops] == [type(law), ml.CompiledController, ml.CompiledController]
    for expected, *commands in zip(*(Arm(loop, q).calls(400) for loop in loops), strict=True):
        for command in commands:
            np.testing.assert_allclose(command.velocity, expected.velocity, rtol=0, atol=1e-9)
            assert command.status is expected.status


def test_only_controllers_of_the_library_are_compiled(robot_of: RobotOf) -> None:
    """A user's own controller is taken as it is, and refused where it has to be compiled."""
    own = Constantly(robot_of("sawyer"), np.zeros(7))
    assert ml.ServoLoop(own).controller is own
    with pytest.raises(ConstraintError, match="Constantly"):
        ml.ServoLoop(own, compiled=True)


@pytest.mark.parametrize("jerk", [None, 200.0])
def test_irregular_periods(robot_of: RobotOf, rng: np.random.Generator, jerk: float | None) -> None:
    """Late calls, with commands that are held in between: the commanded posture is where the arm is, limits hold."""
    robot = robot_of("sawyer")
    law = law_of(robot, "sawyer")
    loop, q, t, before = ml.ServoLoop(law, jerk_limit=jerk), start_of(robot), 0.0, np.zeros(7)
    first, period, fastest = law.task_error(q), DT, 0.0
    for k in range(2500):
        command = loop.update(q, t)
        assert np.all(np.abs(command.velocity - before) <= 1.5 * loop.acceleration_limit * max(period, DT))
        # times within 1 % of a period are taken for whole ones
        assert command.following_error <= 0.01 * DT * fastest + 1e-12
        fastest = max(fastest, np.max(np.abs(command.velocity)))
        period = DT * (rng.uniform(0.8, 1.2) if k % 50 else rng.uniform(1.0, 8.0))
        q, t, before = robot.integrate(q, period * command.velocity), t + period, command.velocity
        assert loop.position is not None
        assert np.max(np.abs(loop.position - q)) < 0.02
    assert law.task_error(q) < 0.02 * first


def test_twice_as_often_as_agreed(robot_of: RobotOf) -> None:
    """Called at 2 kHz with dt = 1 ms, the arm still accelerates within its limit in time."""
    robot = robot_of("sawyer")
    loop, q, before = ml.ServoLoop(law_of(robot, "sawyer", 2.0)), start_of(robot), np.zeros(7)
    for k in range(500):
        command = loop.update(q, k * 0.5 * DT)
        if k > 0:
            change = np.abs(command.velocity - before)
            assert np.all(change <= loop.acceleration_limit * 0.5 * DT * (1.0 + 1e-6))
        q, before = robot.integrate(q, 0.5 * DT * command.velocity), command.velocity


def test_after_bad_input_the_arm_does_not_make_up_for_it(robot_of: RobotOf) -> None:
    """After periods of bad input, the next command is one period's acceleration away, not all of theirs."""
    robot = robot_of("sawyer")
    arm = Arm(ml.ServoLoop(law_of(robot, "sawyer", 2.0)), start_of(robot))
    for _ in range(4):
        arm.calls(51)
        arm.calls(49, None)


def test_without_acceleration_limits_a_stop_is_a_stop(robot_of: RobotOf) -> None:
    """Infinite acceleration: bad input stops the arm at once, and a following error still trips."""
    robot = robot_of("sawyer")
    arm = Arm(ml.ServoLoop(law_of(robot, "sawyer", 2.0), acceleration_limit=np.inf), start_of(robot))
    arm.calls(50)
    assert np.any(arm.last != 0.0)
    assert np.all(arm.call(None).velocity == 0.0)
    last = arm.calls(1500, arm.q)[-1]
    assert last.status is FOLLOWING_ERROR and np.all(last.velocity == 0.0)


LONG = (pytest.mark.slow, pytest.mark.timeout(3000))


@pytest.mark.parametrize("periods", [1_500, pytest.param(1_000_000, marks=LONG)])
def test_memory_does_not_grow(periods: int, robot_of: RobotOf) -> None:
    """Thousands of periods, good and bad, leave nothing behind."""
    robot = robot_of("sawyer")
    loop, q = ml.ServoLoop(law_of(robot, "sawyer"), jerk_limit=500.0), start_of(robot)

    def work(first: int, last: int, q: np.ndarray) -> np.ndarray:
        for k in range(first, last):
            command = loop.update(None if k % 500 > 450 else q, k * DT)
            q = robot.integrate(q, DT * command.velocity)
        return q

    tracemalloc.start()  # before the first periods, for what the loop keeps of the last ones is replaced, not added
    try:
        q = work(0, 600, q)
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        work(600, 600 + periods, q)
        gc.collect()
        assert tracemalloc.get_traced_memory()[0] - before < 20_000
    finally:
        tracemalloc.stop()


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_a_million_bad_calls(robot_of: RobotOf, rng: np.random.Generator) -> None:
    """1,000,000 calls with bad or stale input: no exception, no motion."""
    robot = robot_of("sawyer")
    loop, q = ml.ServoLoop(law_of(robot, "sawyer")), start_of(robot)
    loop.update(q, 0.0)
    loop.reset(q)
    bad = [(p, 1.0) for p in bad_postures(robot)] + [(q, t) for t in BAD_TIMES if t != -1.0 and t != -(10**9)]
    for i in rng.integers(len(bad), size=1_000_000).tolist():
        assert not loop.update(*bad[i]).velocity.any()


def test_a_loop_can_be_simulated_again(robot_of: RobotOf) -> None:
    """`simulate` runs a loop from rest at the start given, as often as it is asked to, with the task's error."""
    robot = robot_of("sawyer")
    law = law_of(robot, "sawyer")
    loop = ml.ServoLoop(law, DT)
    first = ml.simulate(robot, loop, start_of(robot), 0.3, DT)
    second = ml.simulate(robot, loop, start_of(robot), 0.3, DT)
    plain = ml.simulate(robot, law, start_of(robot), 0.3, DT)
    np.testing.assert_array_equal(first.q, second.q)
    np.testing.assert_allclose(first.q, plain.q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(first.task_error, plain.task_error, rtol=0, atol=1e-9)


def test_wrong_settings_are_refused(robot_of: RobotOf) -> None:
    """Before the arm moves, with an error of the library's own that names the setting."""
    law = law_of(robot_of("sawyer"), "sawyer")
    wrong: dict[str, list] = {
        "dt": [0.0, np.nan, "fast", True], "stale_after": [-1.0, 0.0], "latency": [-0.1], "stiffness": [0.0, [1.0]],
        "acceleration_limit": [0.0, [1.0]], "jerk_limit": [-1.0, 1e-9], "correction_time": [0.0, np.inf, "fast"],
        "following_error_limit": [[0.1, 0.1], np.nan, 0.0],
    }  # fmt: skip
    for name, values in wrong.items():
        for value in values:
            with pytest.raises(ConfigurationError, match=name.split("_")[0]):
                ml.ServoLoop(law, **{name: value})
    with pytest.raises(ConfigurationError, match="jerk"):
        ml.ServoLoop(law, acceleration_limit=np.inf, jerk_limit=10.0)
    ml.ServoLoop(law, latency=0.0)


def test_step_raises_what_update_hides(robot_of: RobotOf) -> None:
    """`step` shows the error of a task, for finding out what is wrong with it."""
    robot = robot_of("sawyer")
    controller = ml.ResolvedRateController(law_of(robot, "sawyer").constraint, null_policy=lambda q, t: np.zeros(3))
    loop = ml.ServoLoop(controller)
    assert loop.update(start_of(robot), 0.0).status is ml.Status.INVALID_INPUT
    with pytest.raises(ManipLearnError, match="7 finite numbers"):
        loop.step(start_of(robot), 0.1)


def test_a_trip_brakes_past_the_average(robot_of: RobotOf) -> None:
    """With a jerk limit too, the arm brakes at its acceleration limit from the period in which the loop trips.

    What is left then is the slow way to where it was measured, at most the limits and 10 ms of motion in a fifth of a
    second.
    """
    robot = robot_of("sawyer")
    loop = ml.ServoLoop(law_of(robot, "sawyer", 2.0), acceleration_limit=3.0, jerk_limit=30.0)
    arm = Arm(loop, start_of(robot))
    arm.calls(400)
    fastest, wrong = np.max(np.abs(arm.last)), arm.q + 0.5
    braking = arm.calls(int(np.ceil(fastest / (3.0 * DT))) + 1, wrong)
    assert fastest > 0.1 and np.max(np.abs(arm.last)) < 0.1
    assert {command.status for command in braking} == {FOLLOWING_ERROR}
    np.testing.assert_array_equal(arm.calls(2000, wrong)[-1].velocity, np.zeros(7))


def test_a_clock_that_was_set_back(robot_of: RobotOf) -> None:
    """One stamp from the future stops the arm for a moment only; states in order are believed again."""
    robot = robot_of("sawyer")
    arm = Arm(ml.ServoLoop(law_of(robot, "sawyer")), start_of(robot))
    words = [str(arm.call(t=1e6 if k == 20 else SAME).status) for k in range(60)]
    assert words[20] == "stale" and words[21] == "invalid-input"
    assert set(words[22:]).isdisjoint({"stale", "invalid-input"})


def test_between_two_states_in_order_there_may_be_none(robot_of: RobotOf) -> None:
    """A clock that went back is believed after two good states that follow each other, not across a lost one."""
    robot = robot_of("sawyer")
    loop, q = ml.ServoLoop(law_of(robot, "sawyer"), DT), start_of(robot)
    for k in range(30):
        loop.update(q, 100.0 + k * DT)
    words = [
        str(loop.update(x, t).status) for x, t in ((q, 1.0), (None, 1.0 + DT), (q, 1.0 + 2 * DT), (q, 1.0 + 3 * DT))
    ]
    assert words[:3] == ["invalid-input"] * 3 and words[3] != "invalid-input"
    far = loop.stale_after
    for k in range(30):
        loop.update(q, 200.0 + k * DT)
    words = [str(loop.update(q, t).status) for t in (1.0, 1.0 + 1.01 * far, 1.0 + 1.99 * far)]
    assert words[:2] == ["invalid-input"] * 2 and words[2] != "invalid-input"


def test_reset_begins_the_task_again(robot_of: RobotOf) -> None:
    """After `reset` a motion along a free direction starts where the arm is then, not where it was."""
    robot = robot_of("sawyer")
    constraint = ml.Constraint(np.eye(3)[:2], ml.FrameJacobian(robot, "right_hand"))
    loop = ml.ServoLoop(ml.ResolvedRateController(constraint, ml.FreeDirection(constraint, 0.05, 0.2)))
    q = start_of(robot)
    for _ in range(2):
        loop.reset(q)
        at = robot.position(q, "right_hand")
        for k in range(1500):
            q = robot.integrate(q, DT * loop.update(q, k * DT).velocity)
        assert np.linalg.norm(robot.position(q, "right_hand") - at) == pytest.approx(0.05, abs=1e-3)
