"""Moving along what a constraint leaves free: how far, how fast, and what is held meanwhile; hands on fixtures."""

from __future__ import annotations

import json

import numpy as np
import pytest
from case import rows_in
from numpy.testing import assert_allclose
from test_gradients import RobotOf

import manip_learn as ml
from manip_learn.robot.rotations import rotation_matrix, rotation_vector

TIP = "panda_hand_tcp"
READY = np.array([0.0, -0.3, 0.0, -2.0, 0.0, 1.8, 0.7])
AXIS = np.array([0.1, -0.2, 0.95]) / np.linalg.norm([0.1, -0.2, 0.95])


def run(task: ml.FreeDirection, q: np.ndarray, limits: bool | ml.Limits = True, climb: bool = False) -> ml.Rollout:
    policy = ml.ManipulabilityAscent(task.learnt, 0.3) if climb else None
    law = ml.ResolvedRateController(task.learnt, task, policy, limits=limits)
    return ml.simulate(task.learnt.robot, law, q, task.duration + 1.0, 0.01)


def places(rollout: ml.Rollout, robot: ml.Robot) -> np.ndarray:
    return np.array([robot.position(q, TIP) for q in rollout.q])


@pytest.mark.parametrize(("view", "distance"), [("world", 0.12), ("local", -0.12), ("relative", 0.12)])
def test_a_held_pose_along_an_oblique_line(robot_of: RobotOf, view: str, distance: float) -> None:
    """With five of six directions held, along the base, the hand or another link, the hand moves by the distance, does
    not turn, and leaves the line by less than 0.1 mm.
    """
    robot = robot_of("panda")
    f = np.concatenate([[0.6, 0.64, 0.48], np.zeros(3)])
    features = ml.RelativeFrameJacobian(robot, TIP, "panda_link1")
    features = features if view == "relative" else ml.FrameJacobian(robot, TIP, "pose", view)
    task = ml.FreeDirection(ml.Constraint(np.linalg.svd(f[None])[2][1:], features), distance, 0.08)
    rollout, start = run(task, READY), features.pose(READY)
    end, turn = features.pose(rollout.q[-1]), start[:3, :3] if view == "local" else np.eye(3)
    assert_allclose(end[:3, 3] - start[:3, 3], turn @ f[:3] * distance, rtol=0, atol=1e-4)
    assert_allclose(end[:3, :3], start[:3, :3], rtol=0, atol=1e-4)
    assert task.unit == "m" and task.progress(rollout.q[-1]) == pytest.approx(distance, abs=1e-4)
    task = ml.FreeDirection(ml.Constraint(np.eye(6)[:5], features), -0.8, 0.5)
    end = features.pose(run(task, READY).q[-1])
    Q = start[:3, :3].T @ end[:3, :3] if view == "local" else end[:3, :3] @ start[:3, :3].T
    assert task.unit == "rad"
    assert_allclose(rotation_vector(Q), [0.0, 0.0, -0.8], rtol=0, atol=1e-4)
    assert_allclose(end[:3, 3], start[:3, 3], rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("rows", "pitch", "off", "distance", "direction", "unit", "hand"), rows_in("ways_on_mechanisms.txt")
)
def test_on_a_mechanism(robot_of: RobotOf, rows, pitch, off, distance, direction, unit, hand) -> None:
    """A door turns, a screw moves along its axis by the pitch times the angle, in both senses of thread, also beyond
    half a turn; where several directions are free the named one is driven. What is held stays within 0.1 mm, however
    the hand is held.
    """
    robot, pitch, off, distance, direction = robot_of("panda"), *map(json.loads, (pitch, off, distance, direction))
    start = robot.pose(READY, TIP)
    point, ball = start[:3, 3] + off, rows in ("spherical", "slide-1 slide-2 slide")
    features = ml.MechanismRows(robot, TIP, rows, axis=AXIS, point=point, pitch=pitch)
    constraint = ml.Constraint(np.eye(features.n_rows), features)
    task = ml.FreeDirection(constraint, distance, 0.8 if pitch else 0.5, direction=direction)
    rollout = run(task, READY, climb=rows == "radial axial", limits=False)
    d = places(rollout, robot) - point
    z, rho = d @ AXIS, np.linalg.norm(d if ball else np.cross(d, AXIS), axis=1)
    assert task.unit == unit and task.progress(rollout.q[-1]) == pytest.approx(distance, abs=2e-3 if pitch else 1e-3)
    assert np.ptp(rho) < 1e-4 and (hand == "several ways" or pitch or np.ptp(z) < 1e-4)
    if unit == "m":
        assert z[-1] - z[0] == pytest.approx(distance, abs=1e-3)
    if hand != "several ways":
        end, turn = robot.pose(rollout.q[-1], TIP), rotation_matrix(distance * AXIS)
        there = turn @ -np.array(off) + pitch * distance * AXIS
        assert z[-1] - z[0] == pytest.approx(pitch * distance, abs=1e-4)
        assert_allclose(d[-1], there, rtol=0, atol=2e-4)
        if hand != "any":
            kept = (turn if hand == "carried" else np.eye(3)) @ start[:3, :3]
            assert_allclose(end[:3, :3], kept, rtol=0, atol=1e-3)


def test_limits_delay_but_do_not_bend(robot_of: RobotOf) -> None:
    """Asked for more speed than the joints have, the arm arrives late, on the line, and never faster than asked; where
    a joint limit ends the way it stays on the line and the status says so.
    """
    robot = robot_of("panda")
    line = ml.Constraint(np.eye(3)[1:], ml.FrameJacobian(robot, TIP))
    fast = ml.FreeDirection(line, -0.25, 3.0, ramp=0.05)
    strong = ml.Limits(robot, acceleration=100.0 * robot.velocity_limit)  # whose joints brake at once
    for limits, status in ((strong, ml.Status.VELOCITY_LIMITED), (True, ml.Status.ACCELERATION_LIMITED)):
        fast.reset()
        rollout = run(fast, READY, limits=limits)
        p = places(rollout, robot)
        assert status in rollout.status
        assert np.max(np.abs(p[:, 1:] - p[0, 1:])) < 1e-3
        assert p[-1, 0] - p[0, 0] == pytest.approx(-0.25, abs=1e-3)
        assert np.max(np.abs(np.diff(p[:, 0]))) / 0.01 < 3.0 * 1.001
        assert np.all(np.abs(rollout.u) <= robot.velocity_limit + 1e-9)
    far = ml.FreeDirection(line, 2.0, 0.5)
    rollout = run(far, READY)
    assert np.all((rollout.q <= robot.position_upper + 1e-9) & (rollout.q >= robot.position_lower - 1e-9))
    assert 0.05 < far.progress(rollout.q[-1]) < 1.0 < rollout.task_error[-1]
    assert set(rollout.status) - {ml.Status.OK, ml.Status.NULL_SCALED, ml.Status.REROUTED}


def test_start_reset_and_a_second_run(robot_of: RobotOf) -> None:
    """The start is the first call's, or the one that was given; a run that begins again at its first time, and reset,
    start anew.
    """
    robot = robot_of("panda")
    line = ml.Constraint(np.eye(3)[1:], ml.FrameJacobian(robot, TIP))
    task = ml.FreeDirection(line, 0.05, 0.1)
    assert task.progress(READY) == 0.0
    for start in (READY, READY + 0.1):
        p = places(run(task, start), robot)
        assert p[-1, 0] - p[0, 0] == pytest.approx(0.05, abs=1e-4)
    given = ml.FreeDirection(line, 0.05, 0.1, start=READY)
    here = READY + 0.02 * np.linalg.pinv(line.features(READY))[:, 0]
    assert given.progress(here) == pytest.approx(0.02, abs=1e-3)
    wanted = robot.position(READY, TIP) + [0.05, 0.0, 0.0]
    assert_allclose(places(run(given, here), robot)[-1], wanted, rtol=0, atol=1e-4)
