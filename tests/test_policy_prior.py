"""The policy's parameters integrated out: Lambda of the largest marginal likelihood, and its stated angle."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from generated_motions import PLANAR_ROWS, paper_motions

from manip_learn.learning.imposed import Posterior, Regressors, descended, monomials
from manip_learn.learning.samples import Samples
from manip_learn.linalg import complement_rows, orthonormal_rows

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
from efficiency import measure  # noqa: E402

GRADES = [monomials(degree) for degree in range(4)]


def most_likely(seed: int, noise: float) -> Posterior:
    """Of twelve short reaches with noise."""
    demos, truth = paper_motions(PLANAR_ROWS["xy"], np.random.default_rng(seed), 12, noise=noise)
    samples = Samples.collect(truth.features, demos)
    start = orthonormal_rows(truth.selection @ np.linalg.pinv(samples.whitening))
    return descended(Posterior(samples, Regressors.of(samples, GRADES), start))


def deviance(fit: Posterior, Lambda: np.ndarray) -> float:
    """- 2 log N(Z^T u; 0, sigma^2 I + K T K^T), with the covariance written out."""
    samples, beta = fit.samples, fit.regressors.values
    Phi = np.concatenate([block.Phi for block in samples.blocks()])
    Z = np.linalg.svd(Lambda @ Phi)[2][:, len(Lambda) :]
    K = np.einsum("nk,nzv->nzkv", beta, Z).reshape(-1, len(fit.precision))
    target = np.einsum("nzv,nv->nz", Z, samples.u).reshape(-1)
    covariance = fit.noise * (np.eye(len(K)) + (K / fit.precision) @ K.T)
    return float(np.linalg.slogdet(covariance)[1] + target @ np.linalg.solve(covariance, target))


def rises(fit: Posterior, steps: tuple[float, ...]) -> np.ndarray:
    """How much the deviance rises by some standard errors along each axis of the stated covariance, over their square,
    shape (axes, steps).
    """
    _, hessians = fit.scores()
    total, c = hessians.sum(axis=0), len(fit.precision)
    total[:c, :c] += np.diag(fit.precision)
    values, vectors = np.linalg.eigh(fit.noise * np.linalg.inv(total)[c:, c:])
    Lambda, least, out = fit.Lambda, deviance(fit, fit.Lambda), []
    for value, vector in zip(values, vectors.T, strict=True):
        turns = [(step * np.sqrt(value) * vector).reshape(len(Lambda), -1) @ complement_rows(Lambda) for step in steps]
        out.append([deviance(fit, orthonormal_rows(Lambda + turn)) - least for turn in turns])
    return np.array(out) / np.square(steps)


def test_the_cost_is_the_deviance():
    """With the covariance of all samples written out, at Lambda and beside it."""
    fit = most_likely(51, 0.02)
    assert fit.cost == pytest.approx(deviance(fit, fit.Lambda), rel=1e-9)


def test_no_other_lambda_is_more_likely():
    """The deviance rises to all sides as the Hessian says: by 1 for one standard error."""
    found = rises(most_likely(51, 0.02), (1.0, -1.0))
    assert np.all(found > 0.6) and np.all(found < 1.6)


def test_the_hessian_holds_no_noise_of_its_own():
    """At 20 % noise it is the curvature of the deviance to 12 %; with the noise of its regressors 30 and 70 % more."""
    np.testing.assert_allclose(rises(most_likely(52, 0.2), (0.3, -0.3)).mean(axis=1), 1.0, atol=0.12)


@pytest.mark.slow
def test_at_the_bound_and_inside_two_times_in_three():
    """A curved policy hidden by noise: at most 1.3 times the bound, but for the chance of 24 sets; its own seed."""
    line = measure("planar3", "quadratic", 0.01, (50, 20), 24, seed=4711)
    assert line.ratio < 1.5
    assert 0.45 <= line.coverage <= 0.9
