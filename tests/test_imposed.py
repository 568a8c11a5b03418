"""The joint estimator: its likelihood written out, its error at the Cramer-Rao bound, rows that are not guessed."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from generated_motions import PLANAR_ROWS, arm_features, oblique, paper_motions

from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments.paper_setup import Setup, demonstrate, noise_deviations, planar_features
from manip_learn.learning import ConstraintLearner, imposed
from manip_learn.learning.imposed import Data, PolicyFit, learn_imposed
from manip_learn.learning.table import Settings, Table, View
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


def reaches(seed: int, noise: float, names: tuple[str, ...], n: int = 40) -> tuple[Data, np.ndarray]:
    """Short reaches, and the true rows in whitened coordinates, orthonormal."""
    demos, truth = paper_motions(PLANAR_ROWS["xy"], np.random.default_rng(seed), n, noise=noise)
    view = View(truth.features, Table(list(demos)))
    rows = orthonormal_rows(truth.selection @ np.linalg.pinv(view.W))
    return Data(view, names, 0, np.arange(len(view.table.q))), rows


def driven(fit: PolicyFit) -> tuple[np.ndarray, np.ndarray]:
    """The derivative of Z^T pi by Theta, and Z^T u, written out."""
    Z = np.linalg.svd(fit.rows @ fit.d.Phi)[2][:, len(fit.rows) :]
    K = np.einsum("nk,nzv->nzkv", fit.d.beta, Z).reshape(Z.shape[0] * Z.shape[1], -1)
    return K, np.einsum("nzv,nv->nz", Z, fit.d.u).reshape(-1)


def test_a_recording_is_left_out_in_closed_form():
    """What the policy leaves of a recording is that of the policy of the others: refitted, with and without a prior."""
    d, rows = reaches(34, 0.02, ("constant", "affine"))
    for fit in (PolicyFit(d, rows), PolicyFit(d, rows, exact=True)):
        prior = np.zeros((12, 12)) if fit.exact else np.diag(fit.precision)
        (K, target), left = driven(fit), 0.0
        for part in d.parts(10):
            rest = np.setdiff1d(np.arange(d.u.size), part)[::3] // 3
            part = part[::3] // 3
            theta = np.linalg.solve(K[rest].T @ K[rest] + prior, K[rest].T @ target[rest])
            left += float(np.sum((target[part] - K[part] @ theta) ** 2))
        assert fit.held_out == pytest.approx(left, rel=1e-6)


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
    refusal = learn_imposed([View(features, Table(demos))], Settings())
    assert isinstance(refusal, NotIdentifiableError) and refusal.code == "repeated-motion"


def told_noise(demos: Demonstrations, start: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Maximum likelihood from a start, told the standard deviation of the noise on each joint's action."""
    view = View(planar_features(), Table(list(demos)))
    mixing = np.diag(np.mean(deviations) / deviations)
    d = Data(view, ("constant", "affine"), 0, np.arange(len(view.table.q)), mixing)
    return view.selection(PolicyFit(d, orthonormal_rows(start @ np.linalg.pinv(view.W))).best().rows)


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


def test_an_uncertainty_beyond_thirty_degrees_is_no_answer(monkeypatch):
    """Rows that the recordings tell worse than that, here than a hundredth of a degree, are refused by name."""
    assert imposed.MOST_UNCERTAIN == 30.0
    setup = Setup("x y", trajectories=20, noise=0.01)
    demos = demonstrate(setup, setup.selection, np.random.default_rng(20100))
    learner = ConstraintLearner(planar_features(), 2, "joint", velocities="recorded")
    assert learner.fit(demos).report_.uncertainty_deg < 30.0
    monkeypatch.setattr(imposed, "MOST_UNCERTAIN", 0.01)
    with pytest.raises(NotIdentifiableError) as refusal:
        learner.fit(demos)
    assert refusal.value.code == "uncertain"


@pytest.mark.slow
def test_ten_long_trajectories_of_an_arm():
    """Two rows are commanded and a third is not answered, although the policy is curved and trajectories are few."""
    rng = np.random.default_rng([3, 0])
    demos, _ = noisy(motion_of("sawyer", "affine", 10, 100, rng), 0.0, 1.0, rng)
    assert ConstraintLearner(arm_features()).fit(demos).constraint_.n_constraints == 2


def most_likely(seed: int, noise: float) -> PolicyFit:
    """Of twelve short reaches with noise."""
    d, rows = reaches(seed, noise, ("constant", "affine", "quadratic", "cubic"), 12)
    return PolicyFit(d, rows).best()


def deviance(fit: PolicyFit, rows: np.ndarray) -> float:
    """- 2 log N(Z^T u; 0, sigma^2 I + K T K^T), with the covariance written out."""
    K, target = driven(PolicyFit(fit.d, rows, fit))
    covariance = fit.noise * (np.eye(len(K)) + (K / fit.precision) @ K.T)
    return float(np.linalg.slogdet(covariance)[1] + target @ np.linalg.solve(covariance, target))


def test_the_cost_is_the_deviance():
    """With the covariance of all samples written out."""
    fit = most_likely(51, 0.02)
    assert fit.cost == pytest.approx(deviance(fit, fit.rows), rel=1e-9)


def test_no_other_lambda_is_more_likely():
    """The deviance rises to all sides as the Hessian says: by 1 for one standard error."""
    fit = most_likely(51, 0.02)
    values, vectors = np.linalg.eigh(fit.noise * np.linalg.inv(fit.hessian))
    for value, vector in zip(values, vectors.T, strict=True):
        for step in (1.0, -1.0):
            turn = (step * np.sqrt(value) * vector).reshape(len(fit.rows), -1) @ complement_rows(fit.rows)
            rise = deviance(fit, orthonormal_rows(fit.rows + turn)) - deviance(fit, fit.rows)
            assert 0.6 < rise < 1.6


@pytest.mark.slow
def test_at_the_bound_and_inside_two_times_in_three():
    """A curved policy hidden by noise: at most 1.3 times the bound, but for the chance of 24 sets; its own seed."""
    line = measure("planar3", "quadratic", 0.01, (50, 20), 24, seed=4711)
    assert line.ratio < 1.5
    assert 0.45 <= line.coverage <= 0.9
