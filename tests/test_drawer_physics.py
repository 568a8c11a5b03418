"""The drawer of example 07 in physics: with what force it is pulled, and what stops an arm that goes wrong."""

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
STIFFNESS, PERIOD, WAY, SPEED = 2000.0, 0.001, 0.18, 0.06  # [N m/rad], [s], [m], [m/s]


@pytest.fixture(scope="module")
def example():
    """What example 07 defines."""
    sys.path.insert(0, str(EXAMPLES))
    yield runpy.run_path(str(EXAMPLES / "07_open_the_drawer.py"))
    sys.path.remove(str(EXAMPLES))


@pytest.fixture(scope="module")
def robot():
    return ml.load_robot("panda", locked=("panda_finger_joint1", "panda_finger_joint2"))


def driven(example, law, mechanism, seconds, **options):
    """The record of a loop with its own settings on a used arm, and per period way and force; 1.1 s more for what comes
    after a stop.
    """
    loop = ml.ServoLoop(law, PERIOD)
    loop.reset(GRASP)
    arm = example["ArmPhysics"](
        "panda", GRASP, mechanism, STIFFNESS, np.random.default_rng(7), **example["USED"], **options
    )
    record = ml.run(loop, arm, seconds)
    for _ in range(1100):
        arm.command(loop.position)
    return record, np.array(arm.history)


@pytest.mark.parametrize(
    ("degrees", "turn", "options", "most"),
    [(0.0, 0.0, {}, None), (3.0, 0.75, {}, 30.0), (8.0, 0.25, {}, 30.0), (8.0, 1.25, {}, 30.0),
     (0.0, 0.0, {"jammed_at": 0.09}, 55.0)],
)  # fmt: skip
def test_by_default_what_goes_wrong_costs_little_force(example, robot, degrees, turn, options, most):
    """The right axis opens the drawer; 3 and 8 degrees off, to some sides, the arm is stopped with 30 N at most, and
    lets go to 5 N within a second.

    At 60 mm/s into a stop 20 N come from the arm's momentum and its drives' dampers before anything can be seen: 30 N
    cannot be kept there at that speed; measured 40 N of an ideal arm, 50 N of a used one that follows 10 ms late, and
    1,022 N with a limit of 0.1 rad. It is over 30 N for 70 ms at the most.
    """
    axis = example["true_axis"](example["RECORDINGS"])
    aside = np.linalg.svd(axis[None])[2][1:]
    wrong = axis + np.tan(np.deg2rad(degrees)) * (np.cos(turn * np.pi) * aside[0] + np.sin(turn * np.pi) * aside[1])
    rows = ml.Constraint(np.linalg.svd(wrong[None])[2][1:], ml.FrameJacobian(robot, FRAME))
    task, chest = ml.FreeDirection(rows, WAY, SPEED), example["drawer"](robot.position(GRASP, FRAME), axis)
    law = ml.ResolvedRateController(rows, task, ml.ManipulabilityAscent(rows))
    record, signals = driven(example, law, chest, task.duration, **options)
    if most is None:
        assert record.ordered and signals[-1, 0] == pytest.approx(WAY, abs=2e-3)
        return
    assert record.rollout.status[-1] == "following-error" and signals[:, 1].max() <= most
    assert signals[record.rollout.status.index("following-error") + 1000, 1] <= 5.0
    if options:
        assert signals[-1, 0] == pytest.approx(0.09, abs=1e-3) and np.count_nonzero(signals[:, 1] > 30.0) <= 70


@pytest.mark.parametrize(
    ("payload", "way"), [(2.0, [-0.1, 0.2, 0.1]), (0.0, [-0.2, -0.25, 0.1]), (0.0, [0.05, 0.3, -0.1])]
)
def test_by_default_a_payload_and_fast_motion_do_not_stop_the_arm(example, robot, payload, way):
    """2 kg that the drives know nothing of, and accelerations as hard as the limits allow."""
    rows = ml.Constraint(np.eye(3), ml.FrameJacobian(robot, FRAME))
    task = ml.PointAttractor(robot.position(GRASP, FRAME) + way, gain=3.0)
    law = ml.ResolvedRateController(rows, task, ml.ManipulabilityAscent(rows))
    record, _ = driven(example, law, None, 2.0, payload=payload)
    assert record.ordered, record.ended
