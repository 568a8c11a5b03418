"""The servo loop: what an arm does between a real-time program's calls, whatever those bring."""

from __future__ import annotations

import gc
import tracemalloc

import numpy as np
import pytest
from servo_cases import BAD_TIMES, DT, Constantly, RobotOf, bad_postures, command_of, law_of, run, start_of

import manip_learn as ml
from manip_learn.control.following import FOLLOWING_ERROR
from manip_learn.errors import ConfigurationError, ManipLearnError

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


def test_a_following_error_trips_until_reset(robot_of: RobotOf) -> None:
    """A blocked arm: the loop brakes when the commanded posture is 0.1 rad ahead, and stands until `reset`."""
    robot = robot_of("sawyer")
    loop, q = ml.ServoLoop(law_of(robot, "sawyer", 3.0)), start_of(robot)
    for k in range(2000):
        command = loop.update(q, k * DT)
        if command.status is ml.Status.FOLLOWING_ERROR:
            break
    assert loop.position is not None
    assert command.following_error > FOLLOWING_ERROR
    assert np.max(np.abs(loop.position - q)) < FOLLOWING_ERROR + 0.05
    at = loop.position
    commands = [loop.update(at, 5.0 + i * DT) for i in range(300)]  # the block is gone: that is no reason to move
    assert {c.status for c in commands} == {ml.Status.FOLLOWING_ERROR}
    assert np.all(commands[-1].velocity == 0.0)
    loop.reset()
    assert np.linalg.norm([c.velocity for _, c in run(loop, q, 100)][-1]) > 0.01


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
    loop = ml.ServoLoop(law_of(robot, "sawyer"))
    *_, (q, last) = run(loop, start_of(robot), 300)
    loop.stop()
    stopping = list(run(loop, q, 400, 0.3))
    assert {c.status for _, c in stopping} == {ml.Status.STOPPED}
    speeds = np.array([last.velocity, *(c.velocity for _, c in stopping)])
    assert np.all(np.abs(np.diff(speeds, axis=0)) <= loop.acceleration_limit * DT * ROUNDING)
    assert np.all(speeds[-1] == 0.0)
    loop.start()
    going = [c.velocity for _, c in run(loop, stopping[-1][0], 200, 0.7)]
    assert np.linalg.norm(going[0]) <= np.linalg.norm(loop.acceleration_limit * DT) and np.linalg.norm(going[-1]) > 0.05


def test_loops_share_nothing(robot_of: RobotOf) -> None:
    """Two loops round one controller: interleaved they do what each does alone."""
    robot = robot_of("sawyer")
    law, q = law_of(robot, "sawyer"), start_of(robot)
    alone = [c.velocity for _, c in run(ml.ServoLoop(law), q, 200)]
    first, second = ml.ServoLoop(law), ml.ServoLoop(law, acceleration_limit=1.0, jerk_limit=100.0)
    pairs = zip(run(first, q, 200), run(second, q + 0.1, 200), strict=True)
    np.testing.assert_array_equal([c.velocity for (_, c), _ in pairs], alone)
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
    loop, before = ml.ServoLoop(Constantly(robot, 1e300 * robot.velocity_limit)), np.zeros(7)
    words = set()
    for q, command in run(loop, start_of(robot), 3000):
        assert np.all(np.abs(command.velocity - before) <= loop.acceleration_limit * DT * ROUNDING)
        assert np.all(q <= robot.position_upper + 1e-9)
        before = command.velocity
        words.add(command.status)
    assert ml.Status.OK not in words
    np.testing.assert_allclose(q, robot.position_upper, rtol=0, atol=1e-2)


def test_velocities_of_any_kind_are_numbers(robot_of: RobotOf) -> None:
    """A list of ints or a float32 array from a user's own controller becomes a float64 velocity of the loop's own."""
    robot = robot_of("sawyer")
    for velocity in ([0] * 7, np.full(7, 0.001, np.float32), (0.001,) * 7):
        loop = ml.ServoLoop(lambda q, t, dt, v=velocity: command_of(v), robot=robot)
        for _, command in run(loop, start_of(robot), 20):
            assert command.velocity.dtype == np.float64 and command.status is ml.Status.OK
            np.testing.assert_allclose(command.velocity, velocity, rtol=1e-6)


def test_the_compiled_controller_gives_the_same_commands(robot_of: RobotOf) -> None:
    """A loop round a `CompiledController` sends what a loop round its law sends."""
    pytest.importorskip("numba")
    robot = robot_of("sawyer")
    law, q = law_of(robot, "sawyer"), start_of(robot)
    by_law = run(ml.ServoLoop(law), q, 400)
    compiled = run(ml.ServoLoop(ml.CompiledController(law)), q, 400)
    for (_, expected), (_, command) in zip(by_law, compiled, strict=True):
        np.testing.assert_allclose(command.velocity, expected.velocity, rtol=0, atol=1e-9)
        assert command.status is expected.status


@pytest.mark.parametrize("jerk", [None, 200.0])
def test_irregular_periods(robot_of: RobotOf, rng: np.random.Generator, jerk: float | None) -> None:
    """Late calls, with commands that are held in between: the commanded posture is where the arm is, limits hold."""
    robot = robot_of("sawyer")
    law = law_of(robot, "sawyer")
    loop, q, t, before = ml.ServoLoop(law, jerk_limit=jerk), start_of(robot), 0.0, np.zeros(7)
    first, period = law.task_error(q), DT
    for k in range(2500):
        command = loop.update(q, t)
        assert np.all(np.abs(command.velocity - before) <= 1.5 * loop.acceleration_limit * max(period, DT))
        assert command.following_error == 0.0
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
    loop, before = ml.ServoLoop(law_of(robot, "sawyer", 2.0)), np.zeros(7)
    q = start_of(robot)
    for k in range(400):
        command = loop.update(None if k % 100 > 50 else q, k * DT)
        assert np.all(np.abs(command.velocity - before) <= loop.acceleration_limit * DT * ROUNDING)
        q, before = robot.integrate(q, DT * command.velocity), command.velocity


def test_without_acceleration_limits_a_stop_is_a_stop(robot_of: RobotOf) -> None:
    """Infinite acceleration: bad input stops the arm at once, and a following error still trips."""
    robot = robot_of("sawyer")
    loop = ml.ServoLoop(law_of(robot, "sawyer", 2.0), acceleration_limit=np.inf)
    *_, (q, last) = run(loop, start_of(robot), 50)
    assert np.any(last.velocity != 0.0)
    assert np.all(loop.update(None, 0.0).velocity == 0.0)
    commands = [loop.update(q, 0.05 + k * DT) for k in range(1500)]
    assert commands[-1].status is ml.Status.FOLLOWING_ERROR and np.all(commands[-1].velocity == 0.0)


@pytest.mark.parametrize("periods", [1_500, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_memory_does_not_grow(periods: int, robot_of: RobotOf) -> None:
    """Thousands of periods, good and bad, leave nothing behind."""
    robot = robot_of("sawyer")
    loop, q = ml.ServoLoop(law_of(robot, "sawyer"), jerk_limit=500.0), start_of(robot)

    def work(first: int, last: int, q: np.ndarray) -> np.ndarray:
        for k in range(first, last):
            command = loop.update(None if k % 500 > 450 else q, k * DT)
            q = robot.integrate(q, DT * command.velocity)
        return q

    q = work(0, 600, q)
    gc.collect()
    tracemalloc.start()
    try:
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


@pytest.mark.parametrize(
    "settings",
    [
        *({"dt": 0.0}, {"dt": np.nan}, {"dt": "fast"}, {"stale_after": -1.0}, {"latency": -0.1}, {"dt": True}),
        *({"acceleration_limit": 0.0}, {"acceleration_limit": [1.0]}, {"jerk_limit": -1.0}, {"jerk_limit": 1e-9}),
        *({"following_error_limit": [0.1, 0.1]}, {"following_error_limit": np.nan}, {"following_error_limit": 0.0}),
        {"acceleration_limit": np.inf, "jerk_limit": 10.0},
    ],
)
def test_wrong_settings_are_refused(settings: dict, robot_of: RobotOf) -> None:
    """Before the arm moves, with an error of the library's own."""
    with pytest.raises(ConfigurationError):
        ml.ServoLoop(law_of(robot_of("sawyer"), "sawyer"), **settings)


def test_step_raises_what_update_hides(robot_of: RobotOf) -> None:
    """`step` shows the error of a task, for finding out what is wrong with it."""
    robot = robot_of("sawyer")
    controller = ml.ResolvedRateController(law_of(robot, "sawyer").constraint, null_policy=lambda q, t: np.zeros(3))
    loop = ml.ServoLoop(controller)
    assert loop.update(start_of(robot), 0.0).status is ml.Status.INVALID_INPUT
    with pytest.raises(ManipLearnError, match="7 finite numbers"):
        loop.step(start_of(robot), 0.1)
