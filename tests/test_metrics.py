"""Metrics, against their definitions."""

from __future__ import annotations

import numpy as np
import pytest

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FrameJacobian
from manip_learn.control.policies import JointAttractor
from manip_learn.experiments.metrics import mie, nmie, policy_rmse, row_space_error, scale_free_nmie


def test_definitions(robot_of, rng):
    """MIE, NMIE and its scale-free form on given postures, from mu = sqrt(det(A A^T)) written out."""
    robot = robot_of("sawyer")
    features = FrameJacobian(robot, "right_hand")
    true, learnt = (Constraint(rng.standard_normal((2, 3)), features) for _ in range(2))
    postures = [robot.random_configuration(rng) for _ in range(30)]
    mu, other = (np.array([np.sqrt(np.linalg.det(c(q) @ c(q).T)) for q in postures]) for c in (true, learnt))
    assert mie(true, learnt, postures) == pytest.approx(np.mean((mu - other) ** 2))
    assert nmie(true, learnt, iter(postures)) == pytest.approx(np.mean((mu - other) ** 2) / np.var(mu))
    scales = np.linspace(0.1, 10.0, 20001)
    best = min(np.mean((mu[:, None] - other[:, None] * scales) ** 2, axis=0))
    assert scale_free_nmie(true, learnt, postures) == pytest.approx(best / np.var(mu), rel=1e-3)


def test_what_does_not_matter(robot_of, rng):
    """The same row space in another basis has no error."""
    robot = robot_of("sawyer")
    features = FrameJacobian(robot, "right_hand")
    Lambda = np.linalg.qr(rng.standard_normal((3, 2)))[0].T
    true, turned = Constraint(Lambda, features), Constraint(np.array([[0.6, 0.8], [-0.8, 0.6]]) @ Lambda, features)
    postures = [robot.random_configuration(rng) for _ in range(10)]
    assert nmie(true, turned, postures) < 1e-28
    assert row_space_error(true, turned) < 1e-14


def test_row_space_error(robot_of):
    """The largest principal angle; a right angle where the numbers of rows differ."""
    features = FrameJacobian(robot_of("sawyer"), "right_hand")
    x, tilted = Constraint([[1.0, 0, 0]], features), Constraint([[np.cos(0.3), np.sin(0.3), 0]], features)
    assert row_space_error(x, tilted) == pytest.approx(0.3)
    assert row_space_error(x, Constraint(np.eye(3)[:2], features)) == pytest.approx(np.pi / 2)


def test_policy_rmse():
    """Root mean squared distance of two policies' velocities."""
    one, other = JointAttractor([1.0, 0.0]), JointAttractor([0.0, 2.0])
    assert policy_rmse(one, other, [np.zeros(2), np.ones(2)]) == pytest.approx(np.sqrt(5.0))
