"""Metrics, against their definitions."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from manip_learn.constraint.features import FrameJacobian
from manip_learn.experiments.metrics import manipulability_along, mie, nmie, policy_rmse, scale_free_nmie


def test_definitions(robot_of, rng):
    """MIE, NMIE and its scale-free form on given postures, from mu = sqrt(det(A A^T)) written out."""
    robot = robot_of("sawyer")
    features = FrameJacobian(robot, "right_hand")
    true, learnt = rng.standard_normal((2, 2, 3))
    q = np.array([robot.random_configuration(rng) for _ in range(30)])
    mu, other = (
        np.array([np.sqrt(np.linalg.det(Lambda @ features(x) @ features(x).T @ Lambda.T)) for x in q])
        for Lambda in (true, learnt)
    )
    assert_allclose(manipulability_along(features, true, q), mu, rtol=1e-9)
    assert mie(mu, other) == pytest.approx(np.mean((mu - other) ** 2))
    assert nmie(mu, other) == pytest.approx(np.mean((mu - other) ** 2) / np.var(mu))
    scales = np.linspace(0.1, 10.0, 20001)
    best = min(np.mean((mu[:, None] - other[:, None] * scales) ** 2, axis=0))
    assert scale_free_nmie(mu, other) == pytest.approx(best / np.var(mu), rel=1e-3)


def test_a_learnt_constraint_without_manipulability_has_the_error_of_zero():
    """mu~ = 0 everywhere has no best factor: the scale-free error is that of zero, not NaN."""
    mu = np.array([1.0, 2.0, 4.0])
    assert scale_free_nmie(mu, np.zeros(3)) == pytest.approx(np.mean(mu**2) / np.var(mu))


def test_policy_rmse():
    """Root of the mean squared distance of two policies: summed over the joints, averaged over the time."""
    pi = np.array([[[1.0, 0.0], [0.0, 1.0]], [[3.0, 0.0], [0.0, 4.0]]])
    assert_allclose(policy_rmse(pi, np.zeros_like(pi)), [1.0, np.sqrt(12.5)])
    assert_allclose(policy_rmse(pi[1:], pi[:1]), [np.sqrt((2.0**2 + 3.0**2) / 2)])
    longer = np.concatenate([pi, pi], axis=1)
    assert_allclose(policy_rmse(longer, np.zeros_like(longer)), [1.0, np.sqrt(12.5)])
