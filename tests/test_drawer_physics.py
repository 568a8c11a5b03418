"""The drawer of example 07 in physics: what is opened, with what force, and what stops an arm with a wrong axis."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

import manip_learn as ml

pytest.importorskip("mujoco")
EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
FRAME = "panda_hand_tcp"
GRASP = np.array([0.56, -0.27, 0.40, -2.14, 0.14, 1.68, 0.62])  # near that of the recordings
STIFFNESS = 2000.0  # [N m/rad]


@pytest.fixture(scope="module")
def example():
    """What example 07 defines."""
    sys.path.insert(0, str(EXAMPLES))
    yield runpy.run_path(str(EXAMPLES / "07_open_the_drawer.py"))
    sys.path.remove(str(EXAMPLES))


def across(axis: np.ndarray) -> ml.Constraint:
    """The two rows that hold a hand on a line."""
    robot = ml.load_robot("panda", locked=("panda_finger_joint1", "panda_finger_joint2"))
    features = ml.FrameJacobian(robot, frame=FRAME, axes="xyz", reference="world")
    return ml.Constraint(np.linalg.svd(axis[None])[2][1:], features)


def test_the_drawer_opens(example):
    """With the right axis, 178 of 180 mm or more are opened with at most 2 N of side force, and the arm rests."""
    constraint = across(example["true_axis"](example["RECORDINGS"]))
    rollout, signals = example["open_drawer"](constraint, GRASP, STIFFNESS)
    way, force, error, limit = signals.T
    assert 0.178 <= way[-1] <= 0.182
    assert force.max() <= 2.0
    assert np.all(error < limit)
    assert rollout.status[-1] == "stopped"
    assert np.all(rollout.u[-1] == 0.0)


@pytest.mark.parametrize("turn", [0.25 * np.pi, 1.5 * np.pi])
def test_the_following_error_stops_the_arm(example, turn):
    """With an axis 5 degrees off, the following error stops the arm, and side force never comes to 30 N."""
    axis = example["true_axis"](example["RECORDINGS"])
    aside = np.linalg.svd(axis[None])[2][1:]
    wrong = axis + np.tan(np.deg2rad(5.0)) * (np.cos(turn) * aside[0] + np.sin(turn) * aside[1])
    rollout, signals = example["open_drawer"](across(wrong / np.linalg.norm(wrong)), GRASP, STIFFNESS)
    assert rollout.status[-1] == "following-error"
    assert np.all(rollout.u[-1] == 0.0)
    assert signals[-1, 0] < 0.05
    assert signals[:, 1].max() < 30.0


def test_the_grip_force_is_that_of_the_drawer(example):
    """At a steady speed the grip pulls with the drawer's friction: 1 N and 4 N s/m."""
    axis, rng = example["true_axis"](example["RECORDINGS"]), np.random.default_rng(1)
    physics = example["DrawerPhysics"]("panda", GRASP, axis, STIFFNESS, rng)
    robot = across(axis).robot
    assert robot is not None
    q, speed = GRASP.copy(), 0.06
    for k in range(600):
        J = robot.jacobian(q, robot.frame(FRAME))[:3]
        q = q + 0.001 * min(k / 200.0, 1.0) * np.linalg.pinv(J) @ (speed * axis)
        physics.send(q)
    assert physics.way == pytest.approx(speed * 0.497, abs=5e-4)
    assert physics.force @ axis == pytest.approx(1.0 + 4.0 * speed, rel=0.05)
