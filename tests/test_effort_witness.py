"""Efforts beside the motion: the contact's effort lies in the span of the rows that are held."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

import manip_learn as ml
from manip_learn.learning import effort_witness as module
from manip_learn.learning.effort_witness import EffortWitness, effort_witness
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.velocities import derive_velocities
from manip_learn.robot.dynamics import inverse_dynamics, torque_regressor

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
from make_recordings import kinematic_sets  # noqa: E402
from make_recordings.arms import load_arm  # noqa: E402

EFFORT_NOISE = 0.1  # of the recorded efforts [N m]
FRICTION = 0.8  # of each joint, dry [N m]; what a model of rigid bodies does not know


def recorded(kind: str = "table", push: float = 10.0, whole: bool = True, seed: int = 60100):
    """Recordings of a Panda with efforts: inverse dynamics, friction, noise, and in contact A^T f with force `push`."""
    arm = load_arm("panda")
    made, truth = kinematic_sets.make_set(kind, "panda", seed, 5, 1e-5, whole)
    features = ml.FrameJacobian(arm.robot, arm.tip, "xyz", "world")
    rows, rng, out = np.array(truth["mechanisms"][0]["rows"])[:, :3], np.random.default_rng(seed), []
    for i, (t, q) in enumerate(made):
        bare = derive_velocities(Trajectory(t, q, None, arm.robot.joint_names), arm.robot)
        du = np.gradient(bare.u, bare.time, axis=0)
        tau = inverse_dynamics(arm.robot, bare.q, bare.u, du) + FRICTION * np.tanh(bare.u / 0.02)
        tau += EFFORT_NOISE * rng.standard_normal(tau.shape)
        A, held = rows @ features.batch(bare.q), np.zeros(len(bare.time), dtype=bool)
        for start, end, _ in truth["windows"][i]:
            held |= (bare.time >= start) & (bare.time <= end)
        f = push * (1.0 + 0.3 * rng.standard_normal(len(rows)))
        tau[held] += np.einsum("nsv,s->nv", A[held], f)
        out.append(Trajectory(bare.time, bare.q, None, arm.robot.joint_names, f"demo_{i}", effort=tau))
    return features, Demonstrations(out), rows


@pytest.mark.parametrize("with_inertias", [True, False])
def test_learn_tells_the_share_of_the_contacts_effort(with_inertias: bool, monkeypatch):
    """Whole recordings of a table: most of the effort in contact is along its normal, beyond chance and free motion."""
    if not with_inertias:
        monkeypatch.setattr(module, "has_inertias", lambda robot: False)
    features, demos, _ = recorded()
    report = ml.ConstraintLearner(features).fit(demos).report_
    witness = report.effort
    assert witness is not None and report.n_constraints == 1
    assert witness.share > 0.9
    assert witness.chance < 0.5 < witness.high < witness.share
    assert witness.free is not None and witness.free < 0.5
    assert witness.stands_out is not None and witness.stands_out > 10.0
    assert report.to_dict()["effort"]["share"] == witness.share
    assert "of the contact's effort is along the held rows" in witness.sentence()


def test_the_sentence_says_each_share():
    """In per cent, of the contact, of rows at random and of free motion; and that chance alone confirms nothing."""
    witness = EffortWitness(0.914, 0.33, 0.62, 0.21, 9.0, 100)
    said = (
        "91 % of the contact's effort is along the held rows; rows drawn at random have 33 % (95 % of them below 62 %)"
    )
    assert witness.sentence() == f"{said}, 21 % of what is left in free motion"
    assert dataclasses.replace(witness, free=None).sentence() == said
    weak = dataclasses.replace(witness, share=0.62, free=None).sentence()
    assert weak.endswith("; that is no more than chance, so the efforts do not confirm the rows")


def test_wrong_rows_are_not_confirmed():
    """Rows across the true one hold none of the contact's effort, and the sentence says so."""
    features, demos, rows = recorded(whole=False)
    contact = [derive_velocities(t, features.robot) for t in demos]
    right = effort_witness(features, rows, contact)
    wrong = effort_witness(features, np.linalg.svd(rows)[2][1:2], contact)
    assert right is not None and wrong is not None
    assert right.free is None and right.share > right.high
    assert wrong.share < wrong.high
    assert "do not confirm the rows" in wrong.sentence() and "do not confirm" not in right.sentence()


def test_rows_of_a_place_are_compared_with_others_of_the_frame():
    """A hinge holds all of its two rows: rows drawn at random are those of the velocity of its frame."""
    features, demos, _ = recorded("door")
    learner = ml.ConstraintLearner(features).fit(demos)
    witness = learner.report_.effort
    assert learner.constraint_.features.n_rows == 2 and witness is not None
    assert witness.share > max(0.9, witness.chance)


def test_nothing_is_said_where_nothing_can_be_told():
    """No efforts, zeros, no push, all rows held: None."""
    features, demos, rows = recorded(push=0.0)
    report = ml.ConstraintLearner(features).fit(demos).report_
    assert report.effort is None and report.to_dict()["effort"] is None
    bare = [Trajectory(t.time, t.q, None, t.joint_names, t.name) for t in demos]
    assert effort_witness(features, rows, [derive_velocities(t, features.robot) for t in bare]) is None
    zeros = [Trajectory(t.time, t.q, None, t.joint_names, t.name, effort=np.zeros_like(t.effort)) for t in demos]
    assert effort_witness(features, rows, [derive_velocities(t, features.robot) for t in zeros]) is None
    pose = ml.FrameJacobian(features.robot, features.frame, "pose")
    assert effort_witness(pose, np.eye(6), [derive_velocities(t, features.robot) for t in demos]) is None


def test_the_regressor_is_that_of_the_inverse_dynamics(rng):
    """Y theta with the robot's own inertias is the inverse dynamics."""
    robot = load_arm("panda").robot
    q, u, du = (rng.uniform(-0.5, 0.5, (4, robot.nv)) for _ in range(3))
    theta = np.concatenate([inertia.toDynamicParameters() for inertia in list(robot.pinocchio_model.inertias)[1:]])
    np.testing.assert_allclose(torque_regressor(robot, q, u, du) @ theta, inverse_dynamics(robot, q, u, du), atol=1e-10)
