"""A recorded motion is played within the limits, with its gaps and jumps, as closely and as early as these let it."""

from __future__ import annotations

import numpy as np
import pytest
from servo_cases import Arm

import manip_learn as ml
from manip_learn.errors import ConfigurationError

DT = 0.01


def swaying(robot: ml.Robot, rng: np.random.Generator, duration: float, period: float = 0.01) -> ml.Trajectory:
    """Slow waves of all joints about the middle of their ranges, with encoder noise."""
    time = np.arange(0.0, duration, period)
    middle = np.clip(0.5 * (robot.position_lower + robot.position_upper), -1.0, 1.0)
    waves = [0.15 / k * np.sin(0.44 * k * time[:, None] + rng.uniform(0.0, 6.0, robot.nv)) for k in (1, 2, 3)]
    q = middle + sum(waves) + rng.normal(0.0, 1e-4, (len(time), robot.nv))
    return ml.Trajectory(time, q, None, robot.joint_names)


def play(robot: ml.Robot, motion: ml.Trajectory, seconds: float, **limits) -> tuple[ml.ServoLoop, ml.Rollout]:
    """Play a motion from its first posture."""
    loop = ml.ServoLoop(ml.FollowMotion(robot, motion, ml.Limits(robot, **limits)), DT)
    return loop, ml.simulate(robot, loop, motion.q[0], seconds, DT)


def kept(limits: ml.Limits, u: np.ndarray, period: float) -> bool:
    """Whether velocities keep to the limits of velocity, acceleration and jerk."""
    changes = np.diff(u, axis=0, prepend=np.zeros((1, u.shape[1]))) / period
    jerks = np.diff(changes, axis=0) / period
    within = np.all(np.abs(u) <= limits.velocity + 1e-9) and np.all(np.abs(changes) <= limits.acceleration * (1 + 1e-9))
    return bool(within and (limits.jerk is None or np.all(np.abs(jerks) <= limits.jerk * (1 + 1e-9))))


@pytest.mark.parametrize(("jerk", "allowed"), [(None, 0.3), (200.0, 0.45)])
def test_many_jumps(panda, jerk, allowed):
    """With 12 jumps of 0.2 rad all limits are kept, nothing is delayed, and the tip is within 5 mm of the recording but
    for 0.3 s after each jump; with jerk limits, whose average takes 0.11 s longer, but for 0.45 s.
    """
    rng = np.random.default_rng(7)
    motion = swaying(panda, rng, 20.0)
    q, sense = motion.q.copy(), np.ones(7)
    indices = np.sort(rng.choice(np.arange(100, len(q) - 100, 100), 12, replace=False))  # at least a second apart
    for i in indices:  # one joint after another, to and fro
        j = rng.integers(7)
        q[i:, j] += 0.2 * sense[j]
        sense[j] *= -1.0
    loop, played = play(panda, ml.Trajectory(motion.time, q, None, panda.joint_names), 20.0, jerk=jerk)
    tips = [np.array([panda.position(x, "panda_hand_tcp") for x in some[: len(q)]]) for some in (played.q, q)]
    off, time, at = np.linalg.norm(tips[0] - tips[1], axis=1), motion.time, motion.time[indices]
    calm = ~np.any((time[:, None] >= at - (jerk is not None) * 0.06) & (time[:, None] < at + allowed), axis=1)
    assert kept(loop.limits, played.u, DT) and loop.controller.delay == 0.0
    assert np.max(off[calm]) < 0.005 and np.max(off) > 0.05


@pytest.mark.parametrize(("jerk", "most"), [(None, 1e-6), (100.0, 2e-3)])
def test_smooth_motion_is_followed_exactly(panda, jerk, most):
    """Without jumps the joints are where the recording is, to a microradian or less, from the second period on, and to
    2e-3 rad with jerk limits: these delay nothing, since the motion is known ahead.
    """
    time = np.arange(0.0, 6.0, 0.02)
    waves = 0.4 * (1.0 - np.cos(np.pi / 2.99 * time))[:, None] * np.linspace(-0.5, 1.0, 7)
    motion = ml.Trajectory(time, panda.neutral() + waves, None, panda.joint_names)
    loop, played = play(panda, motion, 6.5, jerk=jerk)
    wanted = np.array([loop.controller.at(t) for t in played.time])
    assert np.max(np.abs(played.q - wanted)[2:]) < most
    assert np.max(np.abs(played.q[-1] - motion.q[-1])) < 1e-6 and np.max(np.abs(played.u[-1])) < 1e-5


def test_tip_limit_slows_the_clock_and_keeps_the_path(panda):
    """A motion at twice the tip's limit takes longer, by as much as it was too fast, and stays on its path."""
    time = np.arange(0.0, 4.0, 0.01)
    turn = 1.2 * (1.0 - np.cos(np.pi * time / 4.0)) / 2.0
    q = np.tile(panda.neutral(), (len(time), 1))
    q[:, 3] = -1.8
    q[:, 0] = turn
    motion = ml.Trajectory(time, q, None, panda.joint_names)
    radius = np.linalg.norm(panda.jacobian(q[0], "panda_hand_tcp")[:3, 0])
    half = 0.5 * radius * 1.2 * np.pi / 8.0  # of its largest speed [m/s]
    loop, played = play(panda, motion, 12.0, tip_speed=half, frames="panda_hand_tcp")
    states = zip(played.q, played.u, strict=True)
    speeds = [np.linalg.norm(panda.jacobian(x, "panda_hand_tcp")[:3] @ u) for x, u in states]
    assert max(speeds) < 1.001 * half and loop.controller.delay > 0.5
    assert np.max(np.abs(played.q[:, 1:] - q[0, 1:])) < 1e-5  # only the first joint moved
    assert abs(played.q[-1, 0] - turn[-1]) < 1e-6


def test_goes_on_after_a_stop(panda):
    """While the loop is stopped the motion waits, and goes on from where it was: no joint hurries after it."""
    motion = swaying(panda, np.random.default_rng(6), 4.0)
    arm = Arm(ml.ServoLoop(ml.FollowMotion(panda, motion), DT), motion.q[0])
    arm.loop.reset(motion.q[0])
    arm.calls(100)
    arm.loop.stop()
    arm.calls(200)
    arm.loop.start()
    fastest = max(np.max(np.abs(command.velocity)) for command in arm.calls(500)[11:])
    natural = float(np.max(np.abs(np.diff(motion.q, axis=0)))) / 0.01
    assert fastest < 1.5 * natural and np.max(np.abs(arm.q - motion.q[-1])) < 1e-6


def test_joints_that_turn_for_ever_and_other_orders():
    """Postures of joints without limits may be configurations or wrapped angles, columns may come in any order."""
    robot, time = ml.load_robot("kinova"), np.arange(0.0, 3.0, 0.01)
    endless = np.isinf(robot.position_upper)
    middle = np.where(endless, np.pi, 0.5 * (np.nan_to_num(robot.position_lower) + np.nan_to_num(robot.position_upper)))
    turning = middle + np.outer(np.sin(time), np.where(endless, 0.3, 0.05))
    configurations = np.array([robot.configuration(x) for x in turning])
    wrapped = np.where(endless, (turning + np.pi) % (2.0 * np.pi) - np.pi, turning)
    names = robot.joint_names
    for q, joints in ((configurations, names), (wrapped, names), (turning[:, ::-1], names[::-1])):
        loop = ml.ServoLoop(ml.FollowMotion(robot, ml.Trajectory(time, q, None, joints)), DT)
        played = ml.simulate(robot, loop, turning[0], 3.0, DT)
        off = [robot.difference(a, b) for a, b in zip(played.q[5:300], turning[5:300], strict=True)]
        assert np.max(np.abs(off)) < 0.02


def test_what_is_no_motion_is_refused(panda):
    """One sample, other joints, a call without a period: a sentence each."""
    names = panda.joint_names

    def motion(time: list[float], joints: tuple[str, ...]) -> ml.FollowMotion:
        return ml.FollowMotion(panda, ml.Trajectory(time, np.zeros((len(time), 7)), None, joints))

    for call, words in (
        (lambda: motion([0.0], names), "two or more samples"),
        (lambda: motion([0.0, 1.0], (*names[:6], "elbow")), "also has panda_joint7"),
        (lambda: motion([0.0, 1.0], names)(panda.neutral()), "needs the period"),
    ):
        with pytest.raises(ConfigurationError, match=words):
            call()


def test_jumps_are_told() -> None:
    """A joint that steps faster than its limit is named with how far and when; an even motion has nothing to tell."""
    robot = ml.load_robot("planar3")
    time = np.linspace(0.0, 2.0, 41)
    q = np.outer(0.1 * time, np.ones(3))
    assert ml.FollowMotion(robot, ml.Trajectory(time, q)).jumps == ()
    q[20:, 1] += 0.8
    loop = ml.ServoLoop(ml.FollowMotion(robot, ml.Trajectory(time, q)), dt=0.01)
    (note,) = [note for note in loop.notes if "jumps" in note]
    assert note.startswith(f"joint {robot.joint_names[1]} of the motion jumps 1 time, at most by 0.805 rad at 0.95 s")
