"""The joint estimator: its likelihood written out, its error at the Cramer-Rao bound, rows that are not guessed."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
from generated_motions import PLANAR_ROWS, arm_features, oblique, paper_motions

from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments.paper_setup import Setup, demonstrate, noise_deviations, planar_features
from manip_learn.learning import ConstraintLearner
from manip_learn.learning.estimate import Estimate, GapTable
from manip_learn.learning.imposed import descended, estimate_imposed, whitened
from manip_learn.learning.policy import ExactPolicy, Posterior, Projections, Regressors, monomials, parts_of
from manip_learn.learning.samples import Samples
from manip_learn.learning.uncertainty import check_uncertainty
from manip_learn.linalg import complement_rows, orthonormal_rows, row_space_angle
from manip_learn.recordings.trajectory import Demonstrations, Trajectory

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
from efficiency import measure, motion_of, noisy  # noqa: E402


@pytest.mark.parametrize(
    ("arm", "policy", "noise", "size", "sets"),
    [
        pytest.param("planar3", "quadratic", 0.01, (100, 10), 5, marks=pytest.mark.slow),
        pytest.param("planar3", "fast-sinusoidal", 0.001, (100, 10), 5, marks=pytest.mark.slow),
        pytest.param("sawyer", "sinusoidal", 0.01, (50, 10), 2, marks=pytest.mark.slow),
    ],
)
def test_close_to_the_cramer_rao_bound(arm, policy, noise, size, sets):
    """The median error is the bound's but for chance, 1.75 of few sets; an affine model answers 3 times and more."""
    assert measure(arm, policy, noise, size, sets, seed=21).median < 1.75


def test_reaches_without_a_policy():
    """Exact reaches whose null space is at rest leave rounding of either sign; the rows are learnt from them too."""
    rng = np.random.default_rng([77, 1])
    setup = Setup("x rz", policy="zero")
    Lambda = setup.selection
    learner = ConstraintLearner(planar_features()).fit(demonstrate(setup, Lambda, rng))
    assert np.degrees(row_space_angle(Lambda, learner.constraint_.selection)) < 1e-6


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_one_exact_reach_has_no_noise_to_divide_by():
    """One noise-free reach, taken for a held motion, is answered with a warning and without a division by zero."""
    setup = Setup("y rz", trajectories=1)
    demos = demonstrate(setup, setup.selection, np.random.default_rng([77, 0]))
    assert ConstraintLearner(planar_features()).fit(demos).report_.warnings


AFFINE = [monomials(0), monomials(1)]


def reaches(seed: int, noise: float) -> tuple[Samples, np.ndarray]:
    """Forty short reaches, and the true rows in whitened coordinates, orthonormal."""
    demos, truth = paper_motions(PLANAR_ROWS["xy"], np.random.default_rng(seed), 40, noise=noise)
    samples = Samples.collect(truth.features, demos)
    return samples, orthonormal_rows(truth.selection @ np.linalg.pinv(samples.whitening))


def test_a_recording_is_left_out_in_closed_form():
    """What the policy leaves of a recording is that of the policy of the others: refitted, with and without a prior."""
    samples, Lambda = reaches(34, 0.02)
    regressors, parts = Regressors.of(samples, AFFINE), parts_of(samples, 10)
    posterior, exact = Posterior(samples, regressors, Lambda), ExactPolicy(samples, regressors, Lambda)
    N = Projections.of(samples, Lambda).N
    K = np.einsum("nk,nvw->nvkw", regressors.values, N).reshape(len(samples), 3, -1)
    target = np.einsum("nvw,nw->nv", N, samples.u)
    for fit, prior in ((posterior, np.diag(posterior.precision)), (exact, np.zeros((12, 12)))):
        left = 0.0
        for part in parts:
            rest = np.ones(len(samples), dtype=bool)
            rest[part] = False
            own, e = K[rest].reshape(-1, 12), target[rest].reshape(-1)
            theta = np.linalg.solve(own.T @ own + prior, own.T @ e)
            left += float(np.sum((target[part] - K[part] @ theta) ** 2))
        assert fit.held_out(parts) == pytest.approx(left / len(samples), rel=1e-6)


def one_row(policy: str, noise: float, size: tuple[int, int], seed: int, apart: float = 1.0):
    """Reaches of the planar arm along one oblique row."""
    rng = np.random.default_rng([seed, 1])
    motion = motion_of("planar3", policy, *size, rng, oblique(1, 3, rng))
    return motion, noisy(motion, noise, apart, rng)[0]


@pytest.mark.parametrize("policy", ["sinusoidal", "affine"])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_one_row_is_not_answered_with_two(policy: str, noise: float):
    """Two rows leave less of the motion than one with a policy model that is too small; one row is the answer."""
    motion, demos = one_row(policy, noise, (20, 20), 20100)
    learner = ConstraintLearner(motion.features, estimator="joint").fit(demos)
    assert learner.constraint_.n_constraints == 1
    assert np.degrees(row_space_angle(motion.selection, learner.constraint_.selection)) < (5.0 if noise else 1e-9)


def test_a_policy_alone_is_no_task():
    """Reaches to one rest posture, every joint a function of the posture: nothing is steered on purpose."""
    motion, _ = one_row("affine", 0.0, (20, 20), 20100)
    free = np.array([np.exp(-0.4 * np.arange(20) * 0.1)[:, None] * start for start in motion.q[:, 0]])
    t = 0.1 * np.arange(20)
    demos = Demonstrations([Trajectory(t, q, -0.4 * q, motion.features.robot.joint_names) for q in free])
    with pytest.raises(NotIdentifiableError) as refusal:
        ConstraintLearner(motion.features, estimator="joint").fit(demos)
    assert refusal.value.code == "no-task"


@pytest.mark.parametrize("rate", [0.7, -1.0])
def test_a_motion_that_is_replayed_is_one_motion(rate: float, rng):
    """One free motion six times, with noise, at another rate or backwards, is refused by name."""
    features, t = arm_features(), np.linspace(0.0, 2.0, 120)
    middle = 0.5 * (features.robot.position_lower + features.robot.position_upper)
    pace, phase = rng.uniform(1.0, 3.0, 7), rng.uniform(0.0, 6.0, 7)
    demos = []
    for k in range(6):
        own = (rate if k % 2 else 1.0) * t + (2.0 if rate < 0.0 and k % 2 else 0.0)
        q = middle + 0.4 * np.sin(own[:, None] * pace + phase) + 1e-3 * rng.standard_normal((120, 7))
        u = 0.4 * pace * np.cos(own[:, None] * pace + phase) * (rate if k % 2 else 1.0)
        demos.append(Trajectory(t, q, u + 0.01 * rng.standard_normal(u.shape), features.robot.joint_names))
    with pytest.raises(NotIdentifiableError, match="repeat"):
        ConstraintLearner(features, estimator="joint").fit(demos)
    with pytest.raises(NotIdentifiableError, match="repeat one motion") as refusal:
        estimate_imposed(Samples.collect(features, Demonstrations(demos)), None, rng)
    assert refusal.value.code == "repeated-motion"


def told_noise(demos: Demonstrations, start: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Maximum likelihood from a start, told the standard deviation of the noise on each joint's action."""
    samples = Samples.collect(planar_features(), demos)
    told = whitened(samples, np.diag(deviations / np.mean(deviations)) ** 2)
    Lambda = orthonormal_rows(start @ np.linalg.pinv(samples.whitening))
    return samples.selection(descended(Posterior(told, Regressors.of(told, AFFINE), Lambda)).Lambda)


@pytest.mark.parametrize("rows", [pytest.param("x y", marks=pytest.mark.slow), "y rz"])
def test_unequal_noise_does_not_bend_the_rows(rows: str):
    """Noise of 10 % of each joint's own motion: telling the noise hardly moves the answer; from equal weights it does.

    (There may be two optima as likely as each other, 10 degrees apart, of which the truth is near one.)
    """
    angles, told = [], []
    for seed in range(20100, 20106):
        rng = np.random.default_rng(seed)
        setup = Setup(rows, noise=0.1)
        Lambda = setup.selection
        demos = demonstrate(setup, Lambda, rng)
        learner = ConstraintLearner(planar_features(), 2, "joint", policy_model="affine").fit(demos)
        learnt = learner.constraint_.selection
        better = told_noise(demos, learnt, noise_deviations(demos, 0.1))
        angles.append(row_space_angle(Lambda, learnt))
        told.append(row_space_angle(Lambda, better))
    assert np.median(angles) < 2.0 * np.median(told)


def test_an_uncertainty_beyond_thirty_degrees_is_no_answer():
    """The joint estimate is refused; one of held rows, which other evidence supports, is not."""
    table = GapTable((1,), (12.0,), 1.3, 1)
    estimate = Estimate("joint", np.eye(1, 3), table, 0.0, 0.0, np.zeros((2, 2)), np.zeros((2, 2, 2)))
    check_uncertainty(estimate, 29.0)
    check_uncertainty(estimate, None)
    with pytest.raises(NotIdentifiableError) as refusal:
        check_uncertainty(estimate, 31.0)
    assert refusal.value.code == "uncertain"
    check_uncertainty(dataclasses.replace(estimate, name="null-space"), 31.0)


@pytest.mark.slow
def test_ten_long_trajectories_of_an_arm():
    """Two rows are commanded and a third is not answered, although the policy is curved and trajectories are few."""
    rng = np.random.default_rng([3, 0])
    demos, _ = noisy(motion_of("sawyer", "affine", 10, 100, rng), 0.0, 1.0, rng)
    assert ConstraintLearner(arm_features()).fit(demos).constraint_.n_constraints == 2


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
    """With the covariance of all samples written out."""
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
