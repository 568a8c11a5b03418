"""What no recording can show, and what does show it: docs/troubleshooting.md."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from task_sets import DATA, sawyer_drawer

import manip_learn as ml
from manip_learn.linalg import row_space_angle
from manip_learn.robot.rotations import rotation_matrix

ROOT = Path(__file__).resolve().parents[1]
TIP = "right_gripper_tip"


def learnt(robot: ml.Robot, demos) -> ml.ConstraintLearner:
    """The drawer's rows."""
    return ml.ConstraintLearner(ml.FrameJacobian(robot, TIP)).fit(demos)


def longer(path: Path, joint: str) -> ml.Robot:
    """The arm with the origin of one joint 1.3 times as far away."""
    tree = ElementTree.parse(ROOT / "robots" / "sawyer.urdf")
    origin = tree.find(f"joint[@name='{joint}']/origin")
    assert origin is not None
    origin.set("xyz", " ".join(f"{1.3 * float(x):.12g}" for x in origin.get("xyz", "").split()))
    tree.write(path)
    return ml.load_robot(path)


def test_lengths_and_zeros_that_contradict_each_other_lower_the_gap(tmp_path):
    """One longer link, or the elbow's zero, bends what is held; the first joint's zero only turns it."""
    (arm, demos, drawer), one = sawyer_drawer(), longer(tmp_path / "long.urdf", "right_j4")
    bent = learnt(one, ml.load_demonstrations(sorted((DATA / "sawyer_drawer").glob("*.csv"))[:6], one)).report_
    assert bent.gap < 0.1 * drawer.report_.gap and any("another shape" in warning for warning in bent.warnings)
    elbow, turned = (
        learnt(arm, [ml.Trajectory(t.time, t.q + x, None, t.joint_names, t.name) for t in demos])
        for x in (0.2 * np.eye(7)[3], 0.5 * np.eye(7)[0])
    )
    assert elbow.report_.gap < 0.1 * drawer.report_.gap == pytest.approx(0.1 * turned.report_.gap, rel=1e-6)
    turn = rotation_matrix(np.array([0.0, 0.0, 0.5]))
    assert row_space_angle(turned.constraint_.selection, drawer.constraint_.selection @ turn.T) < 1e-9
