"""The null-space estimator's evidence, against its definition written out sample by sample."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from generated_motions import arm_features, guided_motions, oblique

from manip_learn.learning.estimate import (
    held_out_share,
    levels,
    trajectory_moments,
)
from manip_learn.learning.samples import Samples


def held(n_trajectories: int, n_samples: int = 8) -> Samples:
    """Motions of an arm with two held rows, and noise."""
    rng = np.random.default_rng([4, n_trajectories])
    demos, truth = guided_motions(arm_features(), oblique(2, 3, rng), rng, n_trajectories, n_samples, 0.05, noise=0.1)
    return Samples.collect(truth.features, demos)


def rows(samples: Samples):
    """(Phi, u, trajectory) of each sample."""
    for block in samples.blocks():
        yield from zip(block.Phi, block.u, block.trajectory.tolist(), strict=True)


def moments_of(samples: Samples, chosen) -> np.ndarray:
    """sum Phi u u^T Phi^T over the samples of chosen trajectories."""
    return sum(np.outer(Phi @ u, Phi @ u) for Phi, u, t in rows(samples) if t in chosen)


@pytest.mark.parametrize("n", [2, 12])
def test_the_held_out_share_is_that_of_trajectories_that_were_not_seen(n):
    """Each trajectory is judged by the constraint of the others; beyond ten of them there are ten folds."""
    samples = held(n)
    folds = [{t for t in range(n) if t % min(n, 10) == fold} for fold in range(min(n, 10))]
    broken = energy = 0.0
    for fold in folds:
        Lambda = np.linalg.eigh(moments_of(samples, set(range(n)) - fold))[1][:, :2].T
        for Phi, u, t in rows(samples):
            if t in fold:
                A = Lambda @ Phi
                broken += float(u @ np.linalg.pinv(A) @ A @ u)
                energy += float(u @ u)
    assert held_out_share(samples, 2, trajectory_moments(samples)) == pytest.approx(broken / energy, rel=1e-9)


def test_levels_are_relative_to_a_motion_of_all_joints():
    """Ten times as fast, a motion has the same levels; they are root mean squares along whitened directions."""
    samples = held(4)
    sizes, directions = levels(samples)
    faster, _ = levels(dataclasses.replace(samples, u=10.0 * samples.u))
    np.testing.assert_allclose(faster, sizes, rtol=1e-9)
    energy = np.mean([u @ u for _, u, _ in rows(samples)])
    for size, direction in zip(sizes, directions, strict=True):
        square = np.mean([(direction @ Phi @ u) ** 2 for Phi, u, _ in rows(samples)])
        assert size == pytest.approx(math.sqrt(samples.nv * square / energy), rel=1e-9)
