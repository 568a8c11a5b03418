"""A tether is found in whole recordings, free motion is not taken for one, and a held orientation is learnt."""

from __future__ import annotations

import importlib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from manip_learn.constraint.features import FrameJacobian
from manip_learn.learning.learner import ConstraintLearner
from manip_learn.learning.phases.distance_rows import DistanceRows
from manip_learn.learning.phases.find_tethers import find_tethers
from manip_learn.learning.phases.hypotheses import paired_hypotheses
from manip_learn.learning.phases.motion import PhaseMotion
from manip_learn.learning.phases.result import PhaseResult
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.velocities import derive_velocities
from manip_learn.robot.loading import load_robot
from manip_learn.robot.robot import Robot

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
LOCKED = {"panda": ("panda_finger_joint1", "panda_finger_joint2")}
MOVES = 0.01  # tip slower than this is at rest [m/s]


@cache
def recordings(
    kind: str, robot: str, seed: int, n: int, whole: bool = True
) -> tuple[Robot, list[Trajectory], dict[str, Any]]:
    """Generated recordings, with velocities, and their truth."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        make_set = importlib.import_module("make_recordings.kinematic_sets").make_set
        motions, truth = make_set(kind, robot, seed, n, whole=whole)
    arm = load_robot(robot, locked=LOCKED.get(robot, ()))
    made = [
        derive_velocities(Trajectory(t, q, None, arm.joint_names, f"demo_{i}"), arm) for i, (t, q) in enumerate(motions)
    ]
    return arm, made, truth


def searched(kind: str, robot: str, seed: int, n: int) -> tuple[DistanceRows, PhaseResult]:
    arm, made, truth = recordings(kind, robot, seed, n)
    found = find_tethers([FrameJacobian(arm, truth["tip"], "xyz")], made, np.random.default_rng(0))
    assert found is not None
    return found


@pytest.mark.parametrize(("robot", "seed", "n"), [("ur5", 2102, 4), ("xarm7", 3005, 8)])
def test_a_tether_is_learnt_from_whole_recordings(robot: str, seed: int, n: int):
    """Type, centre and radius within 0.5 mm, one row; 95 % of the contact's motion, at most 3 % of other motion.

    The second one's sphere is so large that parts of it pass for a soft plane.
    """
    arm, made, truth = recordings("tether", robot, seed, n)
    learner = ConstraintLearner([FrameJacobian(arm, truth["tip"], "xyz", r) for r in ("world", "local")]).fit(made)
    report, true = learner.report_, truth["mechanisms"][0]
    assert report.mechanism is not None
    assert report.mechanism.type == "ball"
    assert report.mechanism.point == pytest.approx(np.array(true["point"]), abs=5e-4)
    assert report.mechanism.radius == pytest.approx(true["radius"], abs=5e-4)
    assert learner.constraint_.n_constraints == 1
    inside = outside = total = 0
    for t, windows in zip(made, truth["windows"], strict=True):
        J = FrameJacobian(arm, truth["tip"], "xyz").batch(t.q)
        moving = np.linalg.norm(np.einsum("npv,nv->np", J, np.asarray(t.u)), axis=1) > MOVES
        (start, end, _), found = windows[0], np.zeros(len(t), dtype=bool)
        contact = moving & (t.time >= start) & (t.time <= end)
        for phase in report.phases:
            if phase.constraint == 0 and phase.trajectory == t.name:
                found |= moving & (t.time >= phase.start) & (t.time <= phase.end)
        inside, outside, total = (
            inside + np.sum(found & contact),
            outside + np.sum(found & ~contact),
            total + np.sum(contact),
        )
    assert inside >= 0.95 * total
    assert outside <= 0.03 * (inside + outside)


@pytest.mark.parametrize(
    ("kind", "robot", "seed"),
    [("free", "panda", 2103), ("free_one_joint", "sawyer", 127), ("free_few_joints", "ur5", 2104)],
)
def test_free_motion_is_no_tether(kind: str, robot: str, seed: int):
    """Joints that turn one by one keep the tip at its distance from their axes: no evidence of a contact."""
    assert searched(kind, robot, seed, 6)[1].constraints == ()


def test_features_without_the_frames_velocity_have_no_tether():
    """Rotations say nothing of a distance."""
    arm, made, truth = recordings("tether", "ur5", 2102, 4)
    assert find_tethers([FrameJacobian(arm, truth["tip"], "rotation")], made, np.random.default_rng(0)) is None


def test_two_recordings_together_determine_the_centre():
    """The best pair of windows puts the centre within 2 cm; windows of a single recording are not paired."""
    arm, made, truth = recordings("tether", "panda", 2101, 6)
    rows = DistanceRows(arm, truth["tip"], np.array([0.4, 0.1, 0.4]))
    motion = PhaseMotion.collect(rows, made).thinned()
    (proposed,) = paired_hypotheses(motion, 1)
    selections = [motion.selection(r)[0] for r in proposed.rows[:50]]
    centres = np.array([rows.middle - x[:3] / x[3] for x in selections])
    apart = np.linalg.norm(centres - np.array(truth["mechanisms"][0]["point"]), axis=1)
    assert np.min(apart) < 0.02
    assert paired_hypotheses(PhaseMotion.collect(rows, made[:1]), 1) == []


def test_distance_rows_are_the_rate_of_the_squared_distance():
    """[-(c - m), 1] Phi u = (p - c).v for any centre c, and dPhi/dq is that of central differences."""
    arm, made, truth = recordings("tether", "ur5", 2102, 4)
    middle, centre, q = np.array([0.1, -0.2, 0.3]), np.array([0.5, 0.2, -0.1]), made[0].q[50]
    rows = DistanceRows(arm, truth["tip"], middle)
    J = FrameJacobian(arm, truth["tip"], "xyz")(q)
    away = arm.position(q, rows.frame) - centre
    np.testing.assert_allclose(np.append(middle - centre, 1.0) @ rows(q), away @ J, atol=1e-12)
    np.testing.assert_allclose(rows.batch(q[None])[0], rows(q), atol=1e-12)
    h = 1e-5
    steps = [(rows(q + h * e) - rows(q - h * e)) / (2.0 * h) for e in np.eye(arm.nv)]
    np.testing.assert_allclose(rows.derivative(q), np.stack(steps, axis=2), atol=1e-8)


@pytest.mark.parametrize(("robot", "seed"), [("sawyer", 107)])
def test_an_orientation_that_is_held_softly_is_learnt_with_its_axis(robot: str, seed: int):
    """A glass that sways by a degree: its two rows, about the vertical within three stated standard deviations."""
    arm, made, truth = recordings("glass", robot, seed, 6, whole=False)
    learner = ConstraintLearner([FrameJacobian(arm, truth["tip"], "rotation", r) for r in ("world", "local")]).fit(made)
    mechanism = learner.report_.mechanism
    assert mechanism is not None
    assert mechanism.type == "held-orientation"
    assert mechanism.axis is not None
    tilt = np.degrees(np.arccos(min(1.0, abs(mechanism.axis[2]))))
    assert tilt < min(3.0 * mechanism.uncertainty["axis"], 6.0)
    q = made[0].q[100]
    A = learner.constraint_(q)
    assert A.shape == (2, arm.nv)
    turning = np.linalg.pinv(FrameJacobian(arm, truth["tip"], "rotation")(q)) @ mechanism.axis
    np.testing.assert_allclose(A @ turning, 0.0, atol=1e-9)
