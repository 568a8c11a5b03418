"""The servo loop: what an arm does between a real-time program's calls, whatever those bring."""

from __future__ import annotations

import logging
import re

import numpy as np
import pytest
from case import rows_in
from servo_cases import BAD_TIMES, DT, OLD, ROUNDING, SAME, Arm, Constantly, bad_postures, command_of, law_of, start_of

import manip_learn as ml
from manip_learn.control.contact import STIFFNESS, Contact, FollowingError, other_turns
from manip_learn.errors import ManipLearnError
from manip_learn.robot.tips import default_tip

STOPPED, STALE, INVALID = ml.Status.STOPPED, ml.Status.STALE, ml.Status.INVALID_INPUT
FOLLOWING_ERROR, OUTSIDE = ml.Status.FOLLOWING_ERROR, ml.Status.OUTSIDE_LIMITS


@pytest.fixture
def robot(sawyer):
    return sawyer


# ---- faults, and the limits that are kept all the same (`Arm` looks at every command) ----

WRONG, AGAIN = "an encoder that jumped by half a radian", "and has stayed there"
HELD, MOVES, ANY = "the last command again", "a status of motion", "any status"
# what happens in order: a call of the loop, or for how many periods something is measured at
# some time, and the statuses that come of it
GO, JUMP, STAY = (400, SAME, SAME, MOVES), (100, WRONG, SAME, INVALID), (3000, AGAIN, SAME, FOLLOWING_ERROR)
SILENT = [(499, SAME, OLD, STALE), (1, SAME, SAME, STALE), (1, SAME, SAME, MOVES), GO]
FAULTS = {  # how far away the target is [m], settings, and what happens
    "stopped, and started": (2.0, {}, [GO, "stop", (400, SAME, SAME, STOPPED), "start", GO]),
    "bad input, again and again": (2.0, {}, [(51, SAME, SAME, MOVES), (49, None, SAME, INVALID)] * 4),
    "no new state": (2.0, {}, [GO, (98, SAME, OLD, HELD), (2, SAME, OLD, ANY), *SILENT]),
    "infinite acceleration": (2.0, {"acceleration_limit": np.inf}, [(50, SAME, SAME, MOVES), (1, None, SAME, INVALID),
                                                                    JUMP, (1400, AGAIN, SAME, FOLLOWING_ERROR)]),
    "one stamp from the future": (2.0, {}, [(20, SAME, SAME, MOVES), (1, SAME, 1e6, STALE), (1, SAME, SAME, INVALID),
                                            (110, SAME, SAME, MOVES)]),
    "a wrong measurement": (2.0, {}, [GO, JUMP, STAY]),
    "one wrong measurement": (2.0, {}, [GO, (1, WRONG, SAME, INVALID), (110, SAME, SAME, MOVES)] * 3),
    "a wrong measurement under a jerk limit": (2.0, {"acceleration_limit": 3.0, "jerk_limit": 30.0}, [GO, JUMP, STAY]),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_brake_the_arm_and_are_named(fault, robot):
    """Within every limit to rest, nowhere near a wrong measurement; where the reason goes, it goes on and arrives."""
    reach, settings, steps = FAULTS[fault]
    arm, wrong = Arm(ml.ServoLoop(law_of(robot, "sawyer", reach), **settings), start_of(robot)), None
    first = arm.loop.task_error(arm.q)
    for step in steps:
        if isinstance(step, str):
            getattr(arm.loop, step)()
            continue
        periods, measured, time, status = step
        at, before, fastest = arm.q, arm.last, np.max(np.abs(arm.last))
        wrong = at + 0.5 if measured is WRONG else wrong
        commands = arm.calls(periods, wrong if measured in (WRONG, AGAIN) else measured, time)
        if status is HELD:
            assert np.linalg.norm(before) > 0.1
            for command in commands:
                np.testing.assert_array_equal(command.velocity, before)
        elif status is MOVES:
            assert commands[-1].status not in (STOPPED, STALE, INVALID, FOLLOWING_ERROR)
            assert np.linalg.norm(arm.last) > (0.05 if 100 < periods < 2000 else 0.0)
            assert periods < 2000 or arm.loop.task_error(arm.q) < 0.02 * first
        elif status is not ANY:
            assert {command.status for command in commands} == {status}
            speeds = [np.max(np.abs(command.velocity)) for command in commands]
            hardest = np.min(arm.loop.acceleration_limit)
            if np.isinf(hardest) or periods * DT * hardest > fastest:
                assert periods < 300 or speeds[-1] == 0.0
            if "jerk_limit" in settings and status is FOLLOWING_ERROR:  # the average does not go on pressing
                assert fastest > 0.1 and speeds[1500] < 0.01
            if status is FOLLOWING_ERROR and np.isfinite(hardest):
                assert np.max(np.abs(arm.loop.position - at)) < 0.02 + 0.02 * fastest + fastest**2 / hardest
    assert FOLLOWING_ERROR in {c.status for c in commands} or np.allclose(arm.loop.position, arm.q, rtol=0, atol=1e-9)


def test_a_command_that_is_held_never_leads_beyond_a_limit(robot):
    """While the joint approaches its limit it is slowed down as a new one would be."""
    arm = Arm(ml.ServoLoop(Constantly(robot, robot.velocity_limit), stale_after=0.5), robot.position_upper - 0.15)
    arm.calls(80)
    held = arm.calls(470, t=OLD)
    assert np.all(arm.q > robot.position_upper - 0.05)
    assert {command.status for command in held[:300]} == {ml.Status.POSITION_LIMITED}


@pytest.mark.parametrize("name", ["sawyer", "kinova"])
def test_bad_input_brakes_and_never_raises(name, robot_of):
    """Whatever is no posture or no time: a braked stop, no exception, no motion before the first good state; good input
    starts the arm again. (cos, sin) = (0, 0) of a continuous joint is no posture either.
    """
    robot = robot_of(name)
    arm, q = Arm(ml.ServoLoop(law_of(robot, name)), start_of(robot)), robot.configuration(start_of(robot))
    for posture in [*bad_postures(robot), *[np.zeros(robot.nq)] * (name == "kinova")]:
        command = arm.loop.update(posture, 0.0)
        assert command.status is INVALID and np.all(command.velocity == 0.0)
    for time in (None, "0.1", np.nan, np.inf, True, 10**400):
        assert np.all(arm.loop.update(q, time).velocity == 0.0)
    assert np.any(arm.calls(3)[-1].velocity)
    for posture, time in [(bad, SAME) for bad in bad_postures(robot)] + [(SAME, bad) for bad in BAD_TIMES]:
        assert arm.calls(20)[-1].status is not INVALID
        commands = arm.calls(30, posture, time)
        assert {command.status for command in commands} == {INVALID}, (posture, time)
        assert np.all(commands[-1].velocity == 0.0)


@pytest.mark.parametrize("part", ["task", "policy", "controller"])
@pytest.mark.parametrize("fault", [ZeroDivisionError("task"), np.full(7, np.nan), "text"], ids=str)
def test_what_the_user_wrote_may_fail(part, fault, robot):
    """A task, policy or controller that raises or gives nonsense in motion: a braked stop, and on when it is well;
    `step` shows the error of the library's own, for finding out what is wrong.
    """
    law, ill = law_of(robot, "sawyer"), [False]

    def spoiled(good):
        if ill[0] and isinstance(fault, Exception):
            raise fault
        return fault if ill[0] else good

    class Task(ml.PointAttractor):
        def velocity(self, constraint, q, t):
            return spoiled(super().velocity(constraint, q, t))

    controller = {
        "task": ml.ResolvedRateController(law.constraint, Task(law.task.target), law.null_policy),
        "policy": ml.ResolvedRateController(law.constraint, law.task, lambda q, t: spoiled(np.full(7, 0.2))),
        "controller": lambda q, t=0.0, dt=None: command_of(spoiled(law(q, t, dt).velocity)),
    }[part]
    arm = Arm(ml.ServoLoop(controller, robot=robot), start_of(robot))
    for k in range(320):
        ill[0] = 120 <= k < 220
        assert (arm.call().status is INVALID) == ill[0]
        assert k != 219 or np.all(arm.last == 0.0)
    assert np.linalg.norm(arm.last) > 0.05
    ill[0] = True
    with pytest.raises((ManipLearnError, ZeroDivisionError, ValueError)) as caught:
        arm.loop.step(arm.q, arm.t)
    assert not isinstance(fault, np.ndarray) or re.search("finite", str(caught.value))


def test_a_stop_in_the_midst_of_an_update_is_kept(robot):
    """As that of a signal, which comes while a command is computed."""
    law, q = law_of(robot, "sawyer"), start_of(robot)
    stops = ml.ResolvedRateController(law.constraint, law.task, lambda _q: loop.stop() or np.zeros(7))
    loop = ml.ServoLoop(stops, DT)
    assert loop.update(q, 0.0).status is not STOPPED and loop.update(q, DT).status is STOPPED
    assert loop.state.is_stopped


# ---- time ----


def outside(robot, q) -> float:
    """Largest distance beyond a position limit."""
    return float(max(np.max(q - robot.position_upper), np.max(robot.position_lower - q)))


@pytest.mark.parametrize(
    ("every", "jerk", "servo", "seed"),
    [(0.004, None, "position", 1), (0.01, 500.0, "velocity", 1), (0.03, None, "velocity", 1),
     (0.03, 500.0, "position", 1), (None, 500.0, "position", 0), (None, None, "position", 1),
     (None, 500.0, "position", 2), (None, None, "velocity", 1), (None, 500.0, "velocity", 2)],
)  # fmt: skip
def test_every_limit_holds_in_time(every, jerk, servo, seed, robot, caplog):
    """Made for 1 ms and called every 4, 10 or 30 ms: every limit holds in time, and one line says so with numbers.

    Of stamps 0.2 to 100 ms apart (None) no command steps by more than a period's worth, or the time's where that is
    shorter; a velocity servo goes on at the last velocity meanwhile, and no position limit is exceeded.
    """
    rng, corner = np.random.default_rng(seed), np.random.default_rng(seed).choice([-1.0, 1.0], robot.nv)
    law = Constantly(robot, robot.velocity_limit * corner) if seed else law_of(robot, "sawyer", 2.0)
    loop, rounding, stamps = ml.ServoLoop(law, DT, jerk_limit=jerk), 1.0 + 1e-6, every is None
    q, t, period, at, nearest = start_of(robot), 0.0, every or DT, None, -np.inf
    before, rate, shortest = np.zeros(7), np.zeros(7), DT
    caplog.set_level(logging.WARNING, "manip_learn")
    for k in range((1000 if servo == "position" else 2000) if stamps else int(3.0 / every)):
        if stamps and seed and k % 700 == 699:
            law.velocity[:] = -law.velocity
        u = loop.update(q, t).velocity
        held = every or (min(period, DT) if servo == "position" else DT)
        change = (u - before) / held
        assert np.all(np.abs(u) <= robot.velocity_limit * rounding)
        assert np.all(np.abs(change) <= loop.acceleration_limit * rounding)
        if jerk is not None and (every or servo == "position"):
            assert np.all(np.abs(change - rate) <= jerk * max(held, shortest if stamps else 0.0) * rounding)
        if servo == "position":
            assert at is None or np.all(np.abs(loop.position - at) <= robot.velocity_limit * held * rounding)
        assert outside(robot, loop.position) <= 1e-9 or (stamps and servo == "velocity")
        at, before, rate, shortest = loop.position, u, change, held
        period = 10.0 ** rng.uniform(np.log10(2e-4), -1.0) if stamps else every
        q, t = at if servo == "position" else robot.integrate(q, period * u), t + period
        nearest = max(nearest, outside(robot, q))
    assert nearest <= 1e-9 and (nearest > -0.02 or (stamps and servo == "position"))  # it has come to a limit
    words = [r.getMessage() for r in caplog.records if "servo loop" in r.getMessage()]
    if every:
        assert len(words) == 1 and "period of 1 ms" in words[0] and f"every {1e3 * every:g} ms" in words[0]


def test_the_task_changes_in_motion(robot):
    """`set_target`, `set_task`, `set_constraint`: the velocity goes on within the limits, the new goal is reached."""
    law = law_of(robot, "sawyer")
    arm, here = Arm(ml.ServoLoop(law, jerk_limit=500.0), start_of(robot)), law.constraint.features.coordinates
    here, one = here(arm.q), ml.Constraint(np.eye(3)[:1], law.constraint.features)
    changes = (
        (arm.loop.set_target, here + [0.1, -0.1, 0.1]),
        (arm.loop.set_task, ml.PointAttractor(here - 0.1, gain=3.0)),
        (arm.loop.set_constraint, one),
    )
    for change, to in changes:
        arm.calls(300)
        change(to)
        assert np.linalg.norm(arm.call().velocity) > 0.02
    arm.calls(1600)
    assert arm.loop.controller.robot is robot and arm.loop.task_error(arm.q) < 1e-3
    assert one.features.coordinates(arm.q)[0] == pytest.approx(here[0] - 0.1, abs=1e-3)


def test_a_motion_waits_while_the_arm_stands(robot):
    """After `stop` and `start`, a motion along a free direction goes on where it was, as gently as it began."""
    constraint = ml.Constraint(np.eye(3)[:2], ml.FrameJacobian(robot, "right_hand"))
    loop = ml.ServoLoop(ml.ResolvedRateController(constraint, ml.FreeDirection(constraint, 0.1, 0.1)))
    q, places = start_of(robot), []
    for k in range(4500):
        {700: loop.stop, 2200: loop.start}.get(k, lambda: None)()
        places.append(robot.position(q, "right_hand"))
        q = robot.integrate(q, DT * loop.update(q, k * DT).velocity)
    assert np.max(np.linalg.norm(np.diff(places, axis=0), axis=1)[2200:]) < 0.115 * DT
    assert np.linalg.norm(places[-1] - places[0]) == pytest.approx(0.1, abs=1e-3)


# ---- an arm that is not where it was sent ----


def tripped(robot, **limits):
    """An arm that is blocked where it starts, and the command of the period in which the loop finds out."""
    contact, limits = ml.Contact(latency=0.01, stiffness=2000.0), ml.Limits(robot, **limits)
    arm = Arm(ml.ServoLoop(law_of(robot, "sawyer", 3.0, limits=limits), contact=contact), start_of(robot))
    command = next(c for c in (arm.call(start_of(robot)) for _ in range(2000)) if c.status is FOLLOWING_ERROR)
    return arm, command


def test_a_following_error_trips_until_reset(robot):
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


@pytest.mark.parametrize("slow", [{}, {"velocity": 0.05, "acceleration": 1.0}])
def test_reset_after_a_trip_ramps_back(slow, robot):
    """`position` goes back to where the arm is as fast as velocity and acceleration limits allow, also if `reset` comes
    twice.
    """
    (arm, _), q = tripped(robot, **slow), start_of(robot)
    arm.calls(300, q)
    loop, places, q = arm.loop, [arm.loop.position], q + 0.02  # somebody has pushed the arm away
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
    np.testing.assert_allclose(places[-2], q, rtol=0, atol=1e-5)
    speeds = np.diff([places[0], *places[:-1]], axis=0) / DT
    assert 20 < i < 590 and np.all(np.abs(speeds) <= loop.limits.velocity * ROUNDING)
    assert not slow or np.max(np.abs(speeds)) == pytest.approx(0.05, rel=1e-9)
    assert np.all(np.abs(np.diff(speeds, axis=0)) <= loop.acceleration_limit * DT * (1.0 + 1e-6))


@pytest.mark.parametrize(("jump", "is_refused"), [(0.045, False), (-0.045, False), (0.06, True), (-0.06, True)])
def test_how_far_a_reading_may_jump(jump, is_refused, robot):
    """By 0.05 rad beyond what the joint can move meanwhile, twice 1.7 mrad here."""
    arm = Arm(ml.ServoLoop(law_of(robot, "sawyer")), start_of(robot))
    arm.calls(20)
    assert (arm.call(arm.q + jump * np.eye(7)[0]).status is INVALID) == is_refused


def test_wrong_units_are_named(robot):
    """Degrees and milliseconds stop the arm, with what was read and what it is to be; so does a full turn too much."""
    arm = Arm(ml.ServoLoop(law_of(robot, "sawyer")), start_of(robot))
    assert arm.loop.update(np.degrees(arm.q), 0.0).status is INVALID
    assert "in degrees? It must be in radians" in arm.loop.stopped_by
    assert arm.loop.update(arm.q + 1e5, DT).status is INVALID  # no angle in degrees either
    assert "another unit or order of the joints, or another robot?" in arm.loop.stopped_by
    arm.loop.reset(arm.q)
    assert [arm.loop.update(arm.q, 1.0 * k).status for k in range(5)][1:] == [STALE] * 4
    assert "advanced by 1, in milliseconds? It must be in seconds" in arm.loop.stopped_by
    arm = Arm(ml.ServoLoop(law_of(robot, "sawyer")), start_of(robot))
    arm.calls(50)
    assert arm.call(arm.q + 2.0 * np.pi * np.eye(7)[5]).status is INVALID
    assert f"joint {robot.joint_names[5]} reads +6.28 rad" in arm.loop.stopped_by
    assert "1 full turn: the driver counts" in arm.loop.stopped_by
    assert [bool(other_turns(2.0 * np.pi + x, "rad")) for x in (0.09, -0.09, 0.11)] == [True, True, False]
    assert "2 full turns" in other_turns(-4.0 * np.pi, "rad") and other_turns(2.0 * np.pi, "m") == ""
    assert arm.call().status not in (INVALID, FOLLOWING_ERROR)


@pytest.mark.parametrize(("force", "stops"), rows_in("forces_on_the_hand.txt"))
def test_distances_mean_forces(force, stops, robot):
    """Across what is driven, a push of 14 N at the hand is no reason to stop, 16.5 N is; along it 58 N and 62 N.

    Beside 50 N along it 16.5 N across are no reason, 27 N are. Down to 2 kg of weight are no push at all. The force
    that is told is the one that explains how far the servos gave way, less what friction and encoders leave.
    """
    q, tip, force = start_of(robot), default_tip(robot), np.array(force.split(), dtype=float)
    J = robot.jacobian(q, tip)[:3]
    along_x = np.linalg.pinv(J)[:, :1].T
    following = FollowingError(robot, Contact(stiffness=STIFFNESS), DT, np.full(7, 10.0), tip)
    away = J.T @ force / STIFFNESS
    for _ in range(40):
        following.compare(q, q + away, lambda _q: along_x)
    assert bool(following.tripped) == (stops == "yes"), following.tripped
    if stops == "no":
        pushed = force + [0.0, 0.0, min(19.62, max(0.0, -force[2]))]
        np.testing.assert_allclose(following.force, pushed, atol=0.6)
        assert following.largest == pytest.approx(np.abs(away).max(), rel=1e-3)
    np.testing.assert_allclose(following.distance, away, atol=1e-12)


@pytest.mark.parametrize(("force", "lacking", "free", "said"), rows_in("jams.txt"))
def test_a_jam_is_noticed_before_the_force_is_large(force, lacking, free, said, robot):
    """A hand that moved and stands still, to a fifth of its way, stops at the force of the motion and 15 N more."""
    q, tip, now, speed = start_of(robot), default_tip(robot), 0.0, 0.05
    force, lacking, free = map(float, (force, lacking, free))
    following = FollowingError(robot, Contact(stiffness=STIFFNESS), DT, np.full(7, 10.0), tip)
    for k in range(2500):
        J, pulls = robot.jacobian(q, tip)[:3], free + 0.8 * bool(force)
        u = speed * np.linalg.pinv(J)[:, 0]
        following.record_step(q, DT, u)
        q = robot.integrate(q, DT * u)
        stiffness = STIFFNESS / float(J[0] @ J[0])  # of the hand along x
        now = now + lacking * speed * DT * stiffness if k * DT >= pulls else force * np.clip(5 * (k * DT - free), 0, 1)
        following.compare(q, q - J[0] * now / STIFFNESS, lambda _q, u=u: u[None])
        if following.tripped:
            break
    assert re.search(said, following.tripped), following.tripped


def test_an_arm_that_does_not_begin_to_move_is_stopped(robot):
    """As soon as it is 16 times as far off as the largest force brings a joint, whatever its delay may be."""
    at = q = start_of(robot)
    following = FollowingError(robot, Contact(stiffness=STIFFNESS), DT, np.full(7, 10.0), default_tip(robot))
    while not following.tripped:
        following.record_step(q, DT, np.eye(7)[1])
        q = robot.integrate(q, DT * np.eye(7)[1])
        following.compare(q, at)
    assert following.tripped.startswith("the arm has not begun to move")
    assert np.max(np.abs(following.distance) / following.limit) == pytest.approx(16.1, abs=0.1)


@pytest.mark.parametrize(("share", "trips"), [(0.98, False), (1.02, True)])
def test_a_load_that_no_force_on_the_hand_explains(share, trips, robot):
    """A contact elsewhere on the arm: as much on a joint as 15 N on its longest lever; the joint is named."""
    q, tip = start_of(robot), default_tip(robot)
    following = FollowingError(robot, Contact(stiffness=STIFFNESS), DT, np.full(7, 10.0), tip)
    away = np.linalg.svd(robot.jacobian(q, tip)[:3])[2][-1]
    away *= share / np.max(np.abs(away) / following.limit)
    for _ in range(40):
        following.compare(q, q + away)
    j = int(np.argmax(np.abs(away) / following.limit))
    said = f"joint {robot.joint_names[j]} carries {abs(away[j]) * STIFFNESS:.0f} N m that no force on the hand explains"
    assert following.tripped.startswith(said) if trips else following.tripped == ""


def test_a_payload_that_is_told_is_no_push(robot):
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


# ---- the caller ----


def test_commands_belong_to_the_caller(robot):
    """Writing into a command, a posture or a position changes no later one, and later updates change no command."""
    law = law_of(robot, "sawyer")
    clean, spoiled, q = ml.ServoLoop(law), ml.ServoLoop(law), start_of(robot)
    kept = []
    for k in range(300):
        t = (k - k % 3) * DT  # every state twice more
        posture = q.copy()
        expected, command = clean.update(q, t), spoiled.update(posture, t)
        np.testing.assert_array_equal(command.velocity, expected.velocity)
        kept.append((expected, expected.velocity.copy()))
        for array in (posture, command.velocity, command.task_velocity, command.task_part, command.null_part):
            array[:] = 1e6
        spoiled.position[:] = np.nan
        q = robot.integrate(q, DT * expected.velocity)
    for command, velocity in kept:
        np.testing.assert_array_equal(command.velocity, velocity)
