"""The joint estimator with curved policies: the error is that of the Cramer-Rao bound, rows are not guessed."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from generated_motions import PLANAR_ROWS, angle_deg, arm_features, paper_motions

from manip_learn.experiments.paper_setup import Setup, demonstrate, planar_features
from manip_learn.learning import ConstraintLearner
from manip_learn.learning.estimators.estimate import GapTable
from manip_learn.learning.estimators.noise_covariance import whitened, whitening_factor
from manip_learn.learning.estimators.policy_equations import OrthonormalRegressors, Projections, Solver, curvature
from manip_learn.learning.estimators.policy_model import HarmonicModel, PolynomialModel, TrajectoryOffsetModel
from manip_learn.learning.estimators.projected_equations import fit_projected, held_out_by_fold
from manip_learn.learning.estimators.row_count import drop_doubtful_rows
from manip_learn.learning.estimators.variable_projection import fit_joint, held_out_costs
from manip_learn.learning.samples import Samples
from manip_learn.linalg import row_space_angle

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
from efficiency import measure, motion_of, noisy  # noqa: E402


@pytest.mark.parametrize(
    ("arm", "policy", "noise", "size", "sets"),
    [
        ("planar3", "quadratic", 0.01, (100, 10), 5),
        ("planar3", "fast-sinusoidal", 0.001, (100, 10), 5),
        ("sawyer", "sinusoidal", 0.01, (50, 10), 2),
    ],
)
def test_close_to_the_cramer_rao_bound(arm, policy, noise, size, sets):
    """The median error is the bound's but for chance, 1.75 of few sets; an affine model answers 3 times and more."""
    assert measure(arm, policy, noise, size, sets, seed=21).median < 1.75


@pytest.mark.parametrize("seed", [1, 3, 4, 6])
def test_reaches_without_a_policy(seed):
    """Exact reaches whose null space is at rest leave rounding of either sign; the rows are learnt from them too."""
    rng = np.random.default_rng([77, seed])
    setup = Setup("x rz", policy="zero")
    Lambda = setup.selection(rng)
    learner = ConstraintLearner(planar_features()).fit(demonstrate(setup, Lambda, rng))
    assert np.degrees(row_space_angle(Lambda, learner.constraint_.selection)) < 1e-6


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_one_exact_reach_has_no_noise_to_divide_by():
    """One noise-free reach, taken for a held motion, is answered with a warning and without a division by zero."""
    for seed in range(3):
        rng = np.random.default_rng([77, seed])
        setup = Setup("y rz", trajectories=1)
        demos = demonstrate(setup, setup.selection(rng), rng)
        assert ConstraintLearner(planar_features()).fit(demos).report_.warnings


def test_exact_where_nothing_disturbs():
    """Noise-free affine and quadratic policies are learnt to rounding."""
    for k, policy in enumerate((None, lambda q: 0.2 - q + 0.5 * q**2)):
        demos, truth = paper_motions(PLANAR_ROWS["xy"], np.random.default_rng(31 + k), 40, policy=policy)
        learner = ConstraintLearner(truth.features, 2, "joint").fit(demos)
        assert angle_deg(learner.constraint_, truth) < 1e-9


def test_normal_equations_find_what_the_qr_finds(monkeypatch):
    """The same Lambda and cost either way, but for combinations of regressors that hardly show."""
    demos, truth = paper_motions(PLANAR_ROWS["xy"], np.random.default_rng(33), 40, noise=0.01)
    samples, model = Samples.collect(truth.features, demos), PolynomialModel(2, 3)
    start = truth.selection @ np.linalg.pinv(samples.whitening)
    rows = fit_joint(samples, start, model)
    monkeypatch.setattr("manip_learn.learning.estimators.variable_projection.MANY_COLUMNS", 0)
    equations = fit_joint(samples, start, model)
    assert row_space_angle(rows.whitened_selection, equations.whitened_selection) < 1e-4
    assert equations.cost == pytest.approx(rows.cost, rel=1e-3)
    assert equations.energy == pytest.approx(rows.energy, rel=1e-3)


def test_noisy_motion_is_fitted_and_judged_alike_by_both_routes(monkeypatch):
    """Where normal equations are used for a small model they find the Lambda and the held-out costs of the QR."""
    demos, truth = paper_motions(PLANAR_ROWS["xy"], np.random.default_rng(34), 40, noise=0.02)
    samples, model = Samples.collect(truth.features, demos), PolynomialModel(1, 3)
    start = truth.selection @ np.linalg.pinv(samples.whitening)
    assert fit_projected(samples, start, model, 30, 1e-13, 1e-9) is not None
    equations = fit_joint(samples, start, model)
    costs = held_out_costs(samples, equations.whitened_selection, model, 5)
    module = "manip_learn.learning.estimators.variable_projection."
    monkeypatch.setattr(module + "fit_projected", lambda *_: None)
    monkeypatch.setattr(module + "held_out_by_fold", lambda *_: None)
    rows = fit_joint(samples, start, model)
    assert row_space_angle(rows.whitened_selection, equations.whitened_selection) < 1e-8
    assert equations.cost == pytest.approx(rows.cost, rel=1e-9)
    np.testing.assert_allclose(equations.theta, rows.theta, atol=1e-6 * np.abs(rows.theta).max())
    np.testing.assert_allclose(costs, held_out_costs(samples, equations.whitened_selection, model, 5), rtol=1e-7)


def test_ill_conditioned_models_are_left_to_the_qr():
    """Regressors that depend on each other, and motion that a model explains: no answer by normal equations."""
    demos, truth = paper_motions(PLANAR_ROWS["xy"], np.random.default_rng(35), 40, noise=0.02)
    samples = Samples.collect(truth.features, demos)
    start = truth.selection @ np.linalg.pinv(samples.whitening)
    dependent = TrajectoryOffsetModel(PolynomialModel(1, 3), samples.n_trajectories)
    assert fit_projected(samples, start, dependent, 30, 1e-13, 1e-9) is None
    assert held_out_by_fold(samples, start, dependent, samples.trajectory % 5) is None
    exact, truth = paper_motions(PLANAR_ROWS["xy"], np.random.default_rng(36), 40)
    samples = Samples.collect(truth.features, exact)
    start = truth.selection @ np.linalg.pinv(samples.whitening)
    assert held_out_by_fold(samples, start, PolynomialModel(1, 3), samples.trajectory % 5) is None


def test_curvature_is_the_sum_of_products(rng):
    """sum beta beta^T (x) N, written out; the solver inverts it; regressors are orthonormal."""
    beta, M = rng.standard_normal((30, 4)), rng.standard_normal((30, 3, 3))
    N = M @ M.transpose(0, 2, 1)
    H = curvature(beta, N)
    np.testing.assert_allclose(H, sum(np.kron(np.outer(b, b), n) for b, n in zip(beta, N, strict=True)), rtol=1e-10)
    right = rng.standard_normal((12, 2))
    np.testing.assert_allclose(H @ Solver(H)(right), right, atol=1e-8)
    demos, truth = paper_motions([0, 1], rng, 6)
    samples = Samples.collect(truth.features, demos)
    values = OrthonormalRegressors.of(samples, PolynomialModel(2, 3)).values
    np.testing.assert_allclose(values.T @ values / len(values), np.eye(values.shape[1]), atol=1e-6)


def test_harmonic_model_spans_waves_of_each_joint(rng):
    """sin(q + a) of any joint and any phase is linear in the regressors, whatever x was scaled by."""
    spread, x = np.array([0.7, 1.9]), rng.uniform(-1, 1, (50, 2))
    beta = HarmonicModel(spread, 2)(x)
    assert beta.shape == (50, HarmonicModel(spread, 2).n_terms)
    wave = np.sin(2.0 * spread[1] * x[:, 1] + 0.4) + np.cos(spread[0] * x[:, 0] - 1.0)
    assert np.linalg.norm(wave - beta @ np.linalg.lstsq(beta, wave, rcond=None)[0]) < 1e-10


def test_unequal_noise_is_seen_and_equal_noise_is_not():
    """Ten times the deviation in one direction: a factor near the truth; the same in all joints: None."""
    motion = motion_of("sawyer", "affine", 40, 15, np.random.default_rng(41))
    for anisotropy in (1.0, 10.0):
        demos, covariance = noisy(motion, 0.01, anisotropy, np.random.default_rng(42))
        samples = Samples.collect(motion.features, demos)
        Lambda = motion.selection @ np.linalg.pinv(samples.whitening)
        L = whitening_factor(samples, Lambda, samples.u - motion.policy(samples.q))
        assert (L is None) == (anisotropy == 1.0)
        if L is not None:
            truth = covariance * 7 / np.trace(covariance)
            assert np.linalg.norm(L @ L.T - truth) < 0.3 * np.linalg.norm(truth)
            # z^T u, z in the null space of A, is what the whitened samples are left with
            Z = np.linalg.svd(motion.selection @ motion.features(samples.q[0]))[2][2:].T
            other = whitened(samples, L)
            e = Projections.of(other, Lambda).N[0] @ other.u[0]
            expected = Z.T @ samples.u[0]
            assert e @ e == pytest.approx(expected @ np.linalg.solve(Z.T @ L @ L.T @ Z, expected))


def test_no_more_rows_than_the_trajectories_tell():
    """A row that helps in one fold only, or weakly where nothing explains the motion, is dropped with a warning."""
    table = GapTable((1, 2, 3), (2.0, 12.0, 1.6), 1.3, 3)
    residuals = {1: np.full(5, 9.0), 2: np.array([1.0, 1.1, 0.9, 1.0, 8.0]), 3: np.array([1.1, 1.0, 0.9, 1.1, 1.0])}
    explained = dict.fromkeys(range(4), 0.001)
    fewer, warnings = drop_doubtful_rows(table, residuals, explained, 0.0)
    assert fewer.best == 2 and len(warnings) == 1
    certain = residuals | {2: 2.5 + residuals[3]}
    assert drop_doubtful_rows(table, certain, explained, 0.0) == (table, ())
    assert drop_doubtful_rows(table, certain, explained | {3: 0.2}, 0.0)[0].best == 2


def test_ten_long_trajectories_of_an_arm():
    """Two rows are commanded and a third is not answered, although the policy is curved and trajectories are few."""
    for seed in (0, 2):
        rng = np.random.default_rng([3, seed])
        motion = motion_of("sawyer", "affine", 10, 100, rng)
        demos, _ = noisy(motion, 0.0, 1.0, rng)
        assert ConstraintLearner(arm_features()).fit(demos).constraint_.n_constraints == 2
