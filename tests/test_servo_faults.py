"""The servo loop and what it is not used to: following errors, other controllers, odd periods, a million bad calls."""

from __future__ import annotations

import numpy as np
import pytest
from servo_cases import DT, ROUNDING, SAME, Arm, Constantly, RobotOf, law_of, start_of

import manip_learn as ml
from manip_learn.control.contact import STIFFNESS, Contact, FollowingError
from manip_learn.errors import ConfigurationError, ManipLearnError
from manip_learn.robot.tips import default_tip

FOLLOWING_ERROR = ml.Status.FOLLOWING_ERROR


@pytest.fixture
def robot(robot_of: RobotOf) -> ml.Robot:
    """Return the robot of all tests."""
    return robot_of("sawyer")


def tripped(robot: ml.Robot, **settings: object) -> tuple[Arm, ml.Command]:
    """An arm that is blocked where it starts, and the command of the period in which the loop finds out."""
    contact = ml.Contact(latency=0.01, stiffness=2000.0)
    arm = Arm(ml.ServoLoop(law_of(robot, "sawyer", 3.0), contact=contact, **settings), start_of(robot))
    for _ in range(2000):
        command = arm.call(start_of(robot))
        if command.status is FOLLOWING_ERROR:
            break
    return arm, command


def test_a_following_error_trips_until_reset(robot: ml.Robot) -> None:
    """A blocked arm: the loop brakes, goes back to where the arm was measured, and stands there until `reset`."""
    (arm, command), q = tripped(robot), start_of(robot)
    loop = arm.loop
    # 15 N on servos of 2,000 N m/rad: less than 13 N m in any joint, beside 15 N m of friction that it might have
    assert 5e-4 < command.following_error < 0.0065 + 0.0075
    assert loop.stopped_by is not None and loop.stopped_by.startswith("row ") and " mm off" in loop.stopped_by
    assert {c.status for c in arm.calls(2000, q)} == {FOLLOWING_ERROR}
    assert np.all(arm.last == 0.0) and loop.position is not None
    # no load is left but what friction would go on holding, 0.5 N m
    assert np.max(np.abs(loop.position - q)) <= 2.5e-4
    commands = arm.calls(300, loop.position)  # the block is gone: that is no reason to move
    assert {c.status for c in commands} == {FOLLOWING_ERROR}
    assert not np.any([c.velocity for c in commands])
    loop.reset()
    assert max(np.linalg.norm(command.velocity) for command in Arm(loop, q).calls(800)) > 0.05


def test_reset_after_a_trip_ramps_back(robot: ml.Robot) -> None:
    """`position` goes back to where the arm is within velocity and acceleration limits, also if `reset` comes twice."""
    (arm, _), q = tripped(robot), start_of(robot)
    arm.calls(300, q)
    q = q + 0.02  # somebody has pushed the arm away
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
    assert far > 0.01 and i < 590
    assert np.all(np.abs(speeds) <= robot.velocity_limit * ROUNDING)
    assert np.all(np.abs(np.diff(speeds, axis=0)) <= loop.acceleration_limit * DT * (1.0 + 1e-6))
    np.testing.assert_allclose(places[-2], q, rtol=0, atol=1e-5)


def test_a_false_reading_after_a_reset_is_no_place_to_go_back_to(robot: ml.Robot) -> None:
    """Zeros that a driver reads once, before its first state, lead `position` nowhere: it goes to where the arm is."""
    (arm, _), q = tripped(robot), start_of(robot)
    arm.calls(300, q)
    arm.loop.reset()
    loop, q = arm.loop, q + 0.02
    readings = [np.zeros(7), *[q] * 600]
    places = [loop.position for k, reading in enumerate(readings) if loop.update(reading, k * DT)]
    assert np.max(np.abs(np.array(places) - q)) < 0.05
    np.testing.assert_allclose(places[-1], q, rtol=0, atol=1e-5)


@pytest.mark.parametrize("first", [0.0, 1.0])
def test_a_first_reading_that_is_wrong_moves_nothing(first: float, robot: ml.Robot) -> None:
    """Zeros, or an old posture, once before the first state: `position` is where the arm is from the second reading on,
    the arm stands until two readings agree, and then it moves; a loop that was stopped stays stopped.
    """
    loop, q = ml.ServoLoop(law_of(robot, "sawyer")), start_of(robot)
    loop.update(np.full(7, first), 0.0)
    loop.stop()
    command = loop.update(q, DT)
    assert command.status is ml.Status.INVALID_INPUT and not command.velocity.any()
    np.testing.assert_array_equal(loop.position, q)
    assert loop.stopped_by is not None and "was read" in loop.stopped_by
    assert loop.update(q, 2 * DT).status is ml.Status.STOPPED
    loop.start()
    for k in range(3, 500):
        command = loop.update(loop.position, k * DT)
        assert np.max(np.abs(loop.position - q)) < 1.0 and command.status is not FOLLOWING_ERROR
    assert np.linalg.norm(command.velocity) > 0.05


def test_a_posture_that_no_arm_can_have_is_none(robot: ml.Robot) -> None:
    """Finite numbers turns beyond all limits start no motion; a turn too much, as encoders count, is a posture."""
    farthest = np.maximum(-robot.position_lower, robot.position_upper) + 2.0 * np.pi
    for far in (1e200, 1e7, 30.0, 1.001 * farthest):
        loop = ml.ServoLoop(law_of(robot, "sawyer"))
        for k in range(20):
            command = loop.update(np.full(robot.nv, far), k * DT)
            assert command.status is ml.Status.INVALID_INPUT and not command.velocity.any()
        assert loop.stopped_by is not None and "no posture" in loop.stopped_by
    assert ml.ServoLoop(law_of(robot, "sawyer")).update(0.999 * farthest, 0.0).status is ml.Status.OUTSIDE_LIMITS


def test_distances_mean_forces(robot: ml.Robot) -> None:
    """Across what is driven, a push of 14 N at the hand is no reason to stop, 16 N is; along it 58 N and 62 N.
    Beside 50 N along it, 16.5 N across are no reason, 27 N are.

    Down to 2 kg of weight are no push at all. The force that is told is the one that explains how far the servos gave
    way, less what friction and encoders leave.
    """
    q, tip = start_of(robot), default_tip(robot)
    J = robot.jacobian(q, tip)[:3]
    along_x = np.linalg.pinv(J)[:, :1].T
    for force, trips in (
        ([14.0, 0.0, 0.0], False), ([58.0, 0.0, 0.0], False), ([62.0, 0.0, 0.0], True), ([0.0, 14.0, 0.0], False),
        ([0.0, -16.5, 0.0], True), ([0.0, 0.0, 16.5], True), ([0.0, 0.0, -19.6], False),
        ([0.0, 0.0, -19.6 - 17.0], True), ([14.0, 0.0, -19.6], False),
        ([50.0, 16.5, 0.0], False), ([50.0, 27.0, 0.0], True),
    ):  # fmt: skip
        following = FollowingError(robot, Contact(stiffness=STIFFNESS), DT, np.full(7, 10.0), tip)
        away = J.T @ np.array(force) / STIFFNESS
        for _ in range(40):
            following.compare(q, q + away, lambda _q: along_x)
        assert bool(following.tripped) == trips, (force, following.tripped)
        pushed = np.array(force) + [0.0, 0.0, min(19.62, max(0.0, -force[2]))]
        if not trips:
            np.testing.assert_allclose(following.force, pushed, atol=0.6, err_msg=str(force))
        assert following.largest == pytest.approx(np.abs(away).max(), rel=1e-3) or trips
        np.testing.assert_allclose(following.distance, away, atol=1e-12)


def test_a_payload_that_is_told_is_no_push(robot: ml.Robot) -> None:
    """The weight of 5 kg trips the loop of an arm that is not told; inertia and weight include a payload."""
    q, tip, centre = start_of(robot), default_tip(robot), [0.0, 0.0, 0.05]
    loaded = robot.with_payload(5.0, tip, centre)
    ends = np.array([robot.pose(q + 1e-6 * e, tip) for e in np.eye(7)]) - robot.pose(q, tip)
    J = (ends @ [*centre, 1.0]).T[:3] / 1e-6
    weight = loaded.weight_effort(q) - robot.weight_effort(q)
    np.testing.assert_allclose(weight, J.T @ [0.0, 0.0, 5.0 * 9.81], atol=1e-3)
    a = np.linspace(-1.0, 2.0, 7)
    np.testing.assert_allclose(loaded.inertial_effort(q, a) - robot.inertial_effort(q, a), 5.0 * J.T @ J @ a, atol=1e-3)
    assert loaded.with_payload(1.0, tip).mass == pytest.approx(robot.mass + 1.0) and robot.payload == 0.0
    away = robot.jacobian(q, tip)[:3].T @ [0.0, 0.0, -5.0 * 9.81] / STIFFNESS
    for arm, trips in ((robot, True), (loaded, False)):
        following = FollowingError(arm, Contact(stiffness=STIFFNESS), DT, np.full(7, 10.0), tip)
        for _ in range(40):
            following.compare(q, q + away)
        assert bool(following.tripped) == trips
    for mass, place in ((-1.0, centre), (np.nan, centre), (1.0, [0.0, np.inf, 0.0]), (1.0, 0.05)):
        with pytest.raises(ConfigurationError, match="a payload has a mass"):
            robot.with_payload(mass, tip, place)


STOPPED, STALE, INVALID = ml.Status.STOPPED, ml.Status.STALE, ml.Status.INVALID_INPUT
WRONG, AGAIN = "an encoder that jumped by half a radian", "and has stayed there"
# settings of the loop, and what happens in order: a call of the loop, or for how many periods something is measured at
# some time, and the statuses that come of it; a status that is none of these is one of motion
GO, JUMP, STAY = (400, SAME, SAME, None), (100, WRONG, SAME, INVALID), (3000, AGAIN, SAME, FOLLOWING_ERROR)
FAULTS: dict[str, tuple[dict, list]] = {
    "stopped, and started": ({}, [GO, "stop", (400, SAME, SAME, STOPPED), "start", GO]),
    "bad input, again and again": ({}, [(51, SAME, SAME, None), (49, None, SAME, INVALID)] * 4),
    "infinite acceleration": (
        {"acceleration_limit": np.inf},
        [(50, SAME, SAME, None), (1, None, SAME, INVALID), JUMP, (1400, AGAIN, SAME, FOLLOWING_ERROR)],
    ),
    "one stamp from the future": (
        {},
        [(20, SAME, SAME, None), (1, SAME, 1e6, STALE), (1, SAME, SAME, INVALID), (110, SAME, SAME, None)],
    ),
    "a wrong measurement": ({}, [GO, JUMP, STAY]),
    "one wrong measurement": ({}, [GO, (1, WRONG, SAME, INVALID), (110, SAME, SAME, None)] * 3),
    "a wrong measurement under a jerk limit": ({"acceleration_limit": 3.0, "jerk_limit": 30.0}, [GO, JUMP, STAY]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_brake_the_arm_and_are_named(fault: str, robot: ml.Robot) -> None:
    """Within every limit (see `Arm`) to rest, nowhere near a wrong measurement; where the reason goes, it goes on."""
    settings, steps = FAULTS[fault]
    arm, wrong = Arm(ml.ServoLoop(law_of(robot, "sawyer", 2.0), **settings), start_of(robot)), None
    for step in steps:
        if isinstance(step, str):
            getattr(arm.loop, step)()
            continue
        periods, measured, time, status = step
        at, fastest = arm.q, np.max(np.abs(arm.last))
        wrong = at + 0.5 if measured is WRONG else wrong
        commands = arm.calls(periods, wrong if measured in (WRONG, AGAIN) else measured, time)
        if status is None:
            assert commands[-1].status not in (STOPPED, STALE, INVALID, FOLLOWING_ERROR)
            assert np.linalg.norm(arm.last) > (0.05 if periods > 100 else 0.0)
            continue
        assert {command.status for command in commands} == {status}
        speeds = [np.max(np.abs(command.velocity)) for command in commands]
        hardest = np.min(arm.loop.acceleration_limit)
        if np.isinf(hardest) or periods * DT * hardest > fastest:
            assert periods < 300 or speeds[-1] == 0.0
        if "jerk_limit" in settings and status is FOLLOWING_ERROR:  # the average does not go on pressing
            assert fastest > 0.1 and speeds[1500] < 0.01
        if status is FOLLOWING_ERROR and np.isfinite(hardest):
            assert np.max(np.abs(arm.loop.position - at)) < 0.02 + 0.02 * fastest + fastest**2 / hardest


@pytest.mark.parametrize("own", [False, True])
def test_commands_belong_to_the_caller(own: bool, robot: ml.Robot) -> None:
    """Writing into a command, a posture or a position changes no later one, and later updates change no command."""
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


def test_wrong_settings_are_refused(robot: ml.Robot) -> None:
    """Before the arm moves, with an error of the library's own that names the setting."""
    law = law_of(robot, "sawyer")
    wrong: dict[str, list] = {
        "dt": [0.0, np.nan, "fast", True], "stale_after": [-1.0, 0.0],
        "acceleration_limit": [0.0, [1.0]], "jerk_limit": [-1.0, 1e-9],
    }  # fmt: skip
    for name, values in wrong.items():
        for value in values:
            with pytest.raises(ConfigurationError, match=name.split("_")[0]):
                ml.ServoLoop(law, **{name: value})
    with pytest.raises(ConfigurationError, match="jerk"):
        ml.ServoLoop(law, acceleration_limit=np.inf, jerk_limit=10.0)
    with pytest.raises(ConfigurationError, match="stale after 0.1 s and the period is 0.2 s"):
        ml.ServoLoop(law, dt=0.2)
    wrong = {"max_lateral_force": [0.0, np.inf, "much"], "max_axial_force": [-1.0], "resolution": [np.nan]}
    for name, values in {**wrong, "latency": [-0.1, "never"]}.items():
        for value in values:
            with pytest.raises(ConfigurationError, match=name):
                ml.Contact(**{name: value})
    assert ml.Contact(held=9.0, driven=4.0) == ml.Contact(9.0, 4.0) and ml.Contact(9.0).held == 9.0  # until 0.4
    with pytest.raises(TypeError, match="unexpected keyword argument 'hold'"):
        ml.Contact(hold=9.0)
    for value in (0.0, [1.0]):
        with pytest.raises(ConfigurationError, match="stiffness"):
            ml.ServoLoop(law, contact=ml.Contact(stiffness=value))
    ml.ServoLoop(law, contact=ml.Contact(latency=0.0))
    for name in ("following_error_limit", "latency", "stiffness"):
        with pytest.raises(TypeError, match=f"no argument '{name}': give contact=Contact"):
            ml.ServoLoop(law, **{name: 0.1})


def test_step_raises_what_update_hides(robot: ml.Robot) -> None:
    """`step` shows the error of a task, for finding out what is wrong with it."""
    controller = ml.ResolvedRateController(law_of(robot, "sawyer").constraint, null_policy=lambda q, t: np.zeros(3))
    loop = ml.ServoLoop(controller)
    assert loop.update(start_of(robot), 0.0).status is ml.Status.INVALID_INPUT
    with pytest.raises(ManipLearnError, match="7 finite numbers"):
        loop.step(start_of(robot), 0.1)


def test_between_two_states_in_order_there_may_be_none(robot: ml.Robot) -> None:
    """A clock that went back is believed after two good states that follow each other, not across a lost one."""
    loop, q = ml.ServoLoop(law_of(robot, "sawyer"), DT), start_of(robot)
    one_lost = [(x, 1.0 + k * DT) for k, x in enumerate((q, None, q, q))]
    far_apart = [(q, 1.0 + periods * loop.stale_after) for periods in (0.0, 1.01, 1.99)]
    for start, states in ((100.0, one_lost), (200.0, far_apart)):
        for k in range(30):
            loop.update(q, start + k * DT)
        *before, last = [loop.update(x, t).status for x, t in states]
        assert set(before) == {INVALID} and last is not INVALID


def test_wrong_units_are_named(robot: ml.Robot) -> None:
    """Degrees and milliseconds stop the arm, with what was read and what it is to be; so does a full turn too much."""
    loop = ml.ServoLoop(law_of(robot, "sawyer"))
    assert loop.update(np.degrees(start_of(robot)), 0.0).status is INVALID
    assert loop.stopped_by is not None and "in degrees? It is to be in radians" in loop.stopped_by
    loop.reset(start_of(robot))
    statuses = [loop.update(start_of(robot), 1.0 * k).status for k in range(5)]
    assert statuses[1:] == [STALE] * 4
    assert loop.stopped_by is not None and "went on by 1, in milliseconds? It is to be in seconds" in loop.stopped_by
    arm = Arm(ml.ServoLoop(law_of(robot, "sawyer")), start_of(robot))
    arm.calls(50)
    turned = arm.q + 2.0 * np.pi * np.eye(7)[5]
    assert arm.call(turned).status is INVALID
    assert arm.loop.stopped_by is not None and f"joint {robot.joint_names[5]} was read +6.28 rad" in arm.loop.stopped_by
    assert "1 full turn: the driver counts" in arm.loop.stopped_by
    assert arm.call().status not in (INVALID, FOLLOWING_ERROR)
