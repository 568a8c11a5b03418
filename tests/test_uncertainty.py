"""The stated uncertainty where the joints' zeros are off: constant offsets, the same in all trajectories."""

from __future__ import annotations

import numpy as np
from generated_motions import angle_deg, arm_features, guided_motions, oblique

from manip_learn.learning import ConstraintLearner
from manip_learn.learning.estimators.null_space import estimate_null_space
from manip_learn.learning.evidence.joint_offsets import JointOffsets
from manip_learn.learning.samples import Samples
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.trajectory import Trajectory


def held(seed: int, offset: float, noise: float = 0.005):
    """Ten motions of an arm with two held rows, and its joints' zeros off by Gaussian offsets [rad]."""
    rng = np.random.default_rng([61, seed])
    demos, truth = guided_motions(arm_features(), oblique(2, 3, rng), rng, 10, 20, 0.05, noise=noise)
    delta = offset * rng.standard_normal(7)
    shifted = [Trajectory(t.time, t.q + delta, t.u, t.joint_names, t.name) for t in demos]
    return Demonstrations(shifted), truth, delta


def inside(offset: float, sets: int) -> float:
    """How often the true angle is within the stated one."""
    found = 0
    for seed in range(sets):
        demos, truth, _ = held(seed, offset)
        learner = ConstraintLearner(truth.features, 2, "null-space", phases="off", mechanism="off").fit(demos)
        found += angle_deg(learner.constraint_, truth) <= learner.report_.uncertainty_deg
    return found / sets


def test_joint_offsets_are_part_of_the_stated_angle():
    """Offsets of 2e-3 rad: the truth is inside in at least 60 % of 25 sets; the bootstrap alone says 25 to 35 %."""
    assert inside(2e-3, 25) >= 0.6


def test_without_offsets_hardly_anything_is_added():
    """The interval of clean recordings grows by less than a quarter in the median."""
    growth = []
    for seed in range(8):
        demos, truth, _ = held(100 + seed, 0.0)
        samples = Samples.collect(truth.features, demos)
        estimate = estimate_null_space(samples, 2)
        covariance = np.linalg.inv(estimate.hessians.sum(axis=0)) * estimate.unexplained * samples.energy / 2
        offsets = JointOffsets.of(samples, estimate.whitened_selection)
        assert offsets is not None
        added = np.mean(np.sum(offsets.errors(400, np.random.default_rng(seed)) ** 2, axis=1))
        growth.append(np.sqrt(1.0 + added / np.trace(covariance)))
    assert np.median(growth) < 1.25


def test_the_error_of_lambda_is_linear_in_the_offsets():
    """Noise-free and with known small offsets, Lambda turns by what the response foretells, to first order."""
    demos, truth, delta = held(5, 1e-4, noise=0.0)
    samples = Samples.collect(truth.features, demos)
    estimate = estimate_null_space(samples, 2)
    offsets = JointOffsets.of(samples, estimate.whitened_selection)
    assert offsets is not None
    perp = np.linalg.svd(estimate.whitened_selection)[2][2:]
    true = truth.selection @ np.linalg.pinv(samples.whitening)
    # the truth beside the learnt rows: (1, B) with learnt + B perp
    B = np.linalg.solve(true @ estimate.whitened_selection.T, true @ perp.T).reshape(-1)
    foretold = offsets.response @ -delta
    assert np.linalg.norm(B - foretold) < 0.1 * np.linalg.norm(B)


def test_nothing_to_say_without_freedom_or_residual():
    """All rows held, or a residual that is rounding: None."""
    demos, truth, _ = held(6, 0.0, noise=0.0)
    samples = Samples.collect(truth.features, demos)
    whitened = truth.selection @ np.linalg.pinv(samples.whitening)
    assert JointOffsets.of(samples, np.linalg.qr(whitened.T)[0].T) is None
    assert JointOffsets.of(samples, np.eye(3)) is None
