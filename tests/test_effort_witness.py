"""Efforts beside the motion: the contact's effort lies in the span of the rows that are held."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import manip_learn as ml
from manip_learn.learning import effort_witness as module
from manip_learn.learning.effort_witness import ContactWitness, EffortWitness, contact_witness, effort_witness
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.velocities import derive_velocities
from manip_learn.robot.dynamics import inverse_dynamics, torque_regressor

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
from make_recordings import kinematic_sets  # noqa: E402
from make_recordings.arms import load_arm  # noqa: E402

EFFORT_NOISE = 0.1  # of the recorded efforts [N m]
FRICTION = 0.8  # of each joint, dry [N m]; what a model of rigid bodies does not know


def recorded(kind: str = "table", push: float = 10.0, whole: bool = True, seed: int = 60100, sensor: str = ""):
    """Recordings of a Panda with efforts: inverse dynamics, friction, noise, and in contact A^T f with force `push`.

    And with the wrench of a sensor if asked: `"turned"` somehow on the hand, or `"zeros"` of one that is off.
    """
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
        wrench = None
        if sensor:
            force = np.where(held[:, None], f @ rows, 0.0)
            wrench = (sensor == "turned") * measured(arm, bare.q, force, np.random.default_rng(seed + i))
        names = arm.robot.joint_names
        out.append(Trajectory(bare.time, bare.q, None, names, f"demo_{i}", effort=tau, wrench=wrench))
    return features, Demonstrations(out), rows


def measured(arm, q: np.ndarray, force: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Wrench of a sensor with an offset, turned by an unknown angle, that carries a tool of 8 N; noise of 0.5 N."""
    R = np.array([arm.robot.pose(posture, arm.tip)[:3, :3] for posture in q])
    contact, weight = np.einsum("nji,nj->ni", R, force), -8.0 * R[:, 2]
    torque = np.cross([0.0, 0.0, 0.1], contact) + np.cross([0.0, 0.02, 0.05], weight)
    turn = Rotation.from_euler("xyz", [0.4, -0.7, 1.1]).as_matrix()
    out = np.hstack([(contact + weight) @ turn.T, torque @ turn.T]) + [3.0, -2.0, 5.0, 0.1, 0.2, -0.1]
    return out + rng.standard_normal(out.shape) * np.repeat([0.5, 0.025], 3)


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


@pytest.mark.parametrize("sensor", ["turned", "zeros", ""])
def test_contact_by_force_agrees_with_contact_by_motion(sensor: str):
    """By a sensor whatever its offset, tool and turn; by the efforts where there is none or it was off."""
    features, demos, _ = recorded("door", sensor=sensor)
    report = ml.ConstraintLearner(features).fit(demos).report_
    contact = report.contact
    assert contact is not None and contact.by == ("force sensor" if sensor == "turned" else "efforts")
    assert contact.held is not None and contact.held > 0.95
    assert contact.free is not None and contact.free < 0.05
    assert report.to_dict()["contact"]["held"] == contact.held
    assert contact.sentence() in report._repr_html_()


def test_contact_that_force_does_not_show_is_not_made_up():
    """The rows are held without any push: one population of forces, and the sentence says so."""
    for sensor in ["turned", ""]:
        features, demos, _ = recorded("drawer", push=0.0, sensor=sensor)
        contact = ml.ConstraintLearner(features).fit(demos).report_.contact
        assert contact is not None and contact.held is None and contact.free is None
        assert "no contact that stands out of free motion" in contact.sentence()


def test_nothing_is_said_of_contact_without_free_motion_or_force():
    """None without a stretch of free motion, and where neither a wrench nor efforts were recorded."""
    features, demos, _ = recorded(whole=False, sensor="turned")
    assert ml.ConstraintLearner(features).fit(demos).report_.contact is None
    free = [derive_velocities(t, features.robot) for t in demos]
    bare = [Trajectory(t.time, t.q, t.u, t.joint_names, t.name) for t in free]
    assert contact_witness(features, bare, bare) is None


def test_the_sentence_tells_which_force_shows_contact():
    """Shares in per cent of the samples of each, by sensor or by efforts."""
    said = "contact in 92 % of the samples in which the rows are held and in 3 % of those of free motion"
    witness = ContactWitness("force sensor", 0.923, 0.031, 100, 50)
    assert witness.sentence() == f"the force sensor shows {said}"
    assert dataclasses.replace(witness, by="efforts").sentence() == f"the efforts show {said}"


def test_populations_are_parted_where_they_are(rng):
    """Two heaps of sizes are parted between them even where one is small; one heap of any shape is not parted."""
    weak, strong = rng.chisquare(6, 2000) ** 0.5, 30.0 + rng.chisquare(6, 200) ** 0.5
    least = module._parting(np.concatenate([weak, strong]))
    assert least is not None and weak.max() < least < strong.min()
    for degrees in (1, 3, 6, 13):
        assert module._parting(np.sqrt(rng.chisquare(degrees, 3000))) is None
