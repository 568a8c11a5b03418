"""Separation of task and null-space part, and what is learnt from it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments.paper_setup import Setup, demonstrate, null_parts, planar_features
from manip_learn.experiments.table import fit_row_by_row, unit_vector
from manip_learn.learning.estimators.policy_model import PolynomialModel, RadialModel, TrajectoryOffsetModel
from manip_learn.learning.estimators.separation import (
    estimate_separate,
    residual_and_jacobian,
    separate,
    separate_null_motion,
)
from manip_learn.learning.learner import ConstraintLearner
from manip_learn.learning.samples import Samples
from manip_learn.linalg import row_space_angle


def samples_of(setup: Setup, rng: np.random.Generator) -> tuple[Samples, np.ndarray, np.ndarray]:
    """Samples of some demonstrations, the true Lambda, and the true null-space parts."""
    Lambda = setup.selection(rng)
    demos = demonstrate(setup, Lambda, rng)
    return Samples.collect(planar_features(), demos), Lambda, null_parts(planar_features(), demos, Lambda)


def test_jacobian_is_the_derivative_of_the_residual(rng):
    """Every entry of the analytic Jacobian agrees with central differences."""
    basis, weights, u = rng.standard_normal((7, 4)), rng.standard_normal((4, 3)), rng.standard_normal((7, 3))
    _, J = residual_and_jacobian(basis, weights, u)
    h = 1e-6
    for k in range(weights.size):
        step = np.zeros(weights.size)
        step[k] = h
        up = residual_and_jacobian(basis, weights + step.reshape(weights.shape), u)[0]
        down = residual_and_jacobian(basis, weights - step.reshape(weights.shape), u)[0]
        assert_allclose(J[:, k], (up - down) / (2 * h), rtol=1e-7, atol=1e-8)


def test_true_null_part_costs_nothing(rng):
    """Equation (8) is zero at the true w, whatever the task did."""
    samples, _, w = samples_of(Setup("x y", trajectories=20), rng)
    residual, _ = residual_and_jacobian(w, np.eye(3), samples.u)
    assert np.max(np.abs(residual)) < 1e-12


@pytest.mark.parametrize("rows", ["x y", "x rz", "y rz", "oblique"])
def test_separation_finds_the_null_part(rng, rows):
    """w~ is the true null-space part to 1e-3 (root mean square) on the paper's demonstrations."""
    samples, _, w = samples_of(Setup(rows), rng)
    separation, found = separate_null_motion(samples, rng)
    assert np.sqrt(np.mean((found.u - w) ** 2) / np.mean(w**2)) < 1e-3
    assert separation.cost < 1e-6 * samples.energy


def test_one_dimensional_data_and_vanishing_motion(rng):
    """No motion at all is separated into nothing, without a NaN or a warning."""
    x = rng.uniform(-1.0, 1.0, size=(60, 3))
    result = separate(x, np.zeros((60, 3)), RadialModel(x, 6, rng))
    assert result.cost == 0.0
    assert np.all(np.isfinite(result.weights))


@pytest.mark.parametrize("learner", ["gauss-newton", "row-by-row"])
@pytest.mark.parametrize("rows", ["x y", "x rz", "y rz"])
def test_paper_route_finds_the_rows(rng, rows, learner):
    """Both ways to learn from w~ find the row space within 0.05 degrees, ours with the number of rows."""
    samples, Lambda, _ = samples_of(Setup(rows), rng)
    if learner == "gauss-newton":
        estimate = estimate_separate(samples, None, rng)
        assert estimate.table.gap(2) > 100.0
        selection = samples.selection(estimate.whitened_selection)
    else:
        selection = samples.selection(fit_row_by_row(separate_null_motion(samples, rng)[1], 2))
    assert selection.shape == Lambda.shape
    assert np.degrees(row_space_angle(selection, Lambda)) < 0.05


def test_row_by_row_agrees_with_all_rows_at_once(rng):
    """From the true null-space part the reference finds the exact row space, in three and in two rows."""
    for rows in ("x y", "x rz", "oblique"):
        samples, Lambda, w = samples_of(Setup(rows, trajectories=30), rng)
        motion = Samples(
            samples.features, samples.q, w, samples.trajectory, samples.whitening, samples.centre, samples.spread
        )
        assert row_space_angle(samples.selection(fit_row_by_row(motion, 2)), Lambda) < 1e-9


def test_spherical_angles_make_unit_vectors(rng):
    """Any angles give a vector of length 1; zero angles give the first axis."""
    for k in (1, 2, 5):
        assert_allclose(np.linalg.norm(unit_vector(rng.uniform(-4.0, 4.0, size=k))), 1.0)
    assert_allclose(unit_vector(np.zeros(2)), [1.0, 0.0, 0.0])


def test_learner_offers_the_paper_route(rng):
    """estimator='separate' goes from demonstrations to a constraint, and says what it did."""
    setup = Setup("x y")
    Lambda = setup.selection(rng)
    learner = ConstraintLearner(planar_features(), estimator="separate").fit(demonstrate(setup, Lambda, rng))
    assert learner.report_.estimator == "separate"
    assert learner.report_.kind == "self-imposed"
    assert row_space_angle(learner.constraint_.selection, Lambda) < 1e-3


def test_nothing_to_separate_is_refused(rng):
    """Motion without a null-space part, and too few samples, are refused with a reason."""
    samples, _, _ = samples_of(Setup("x y", policy="zero"), rng)
    with pytest.raises(NotIdentifiableError, match="no null-space motion"):
        estimate_separate(samples, 2, rng)
    samples, _, _ = samples_of(Setup("x y", trajectories=3), rng)
    with pytest.raises(NotIdentifiableError, match="too few"):
        estimate_separate(samples, 2, rng)


def test_constant_of_each_trajectory(rng):
    """The offset model adds one indicator per trajectory, and leaves it out where no trajectory is given."""
    model = TrajectoryOffsetModel(PolynomialModel(1, 2), 3)
    beta = model(rng.standard_normal((4, 2)), np.array([0, 2, 2, 1]))
    assert beta.shape == (4, model.n_terms) == (4, 6)
    assert_allclose(beta[:, 3:], [[1, 0, 0], [0, 0, 1], [0, 0, 1], [0, 1, 0]])
    assert_allclose(model(rng.standard_normal((4, 2)))[:, 3:], 0.0)


@pytest.mark.parametrize("rows", ["x rz", *(pytest.param(rows, marks=pytest.mark.slow) for rows in ("x y", "y rz"))])
def test_demonstrators_with_postures_of_their_own(rng, rows):
    """Each demonstrator has another rest posture: told so or not, the learner finds the exact rows and their number.

    A place and an angle run with every change, the other pairs of rows with `make proofs`.
    """
    setup = Setup(rows, trajectories=40, policy="own")
    Lambda = setup.selection(rng)
    demos = demonstrate(setup, Lambda, rng)
    for policy_model in ("affine-offset", "auto"):
        learner = ConstraintLearner(planar_features(), policy_model=policy_model).fit(demos)
        assert row_space_angle(learner.constraint_.selection, Lambda) < 1e-9
        assert learner.report_.policy_model == "affine-offset"


def test_offsets_are_not_seen_where_there_are_none(rng):
    """Noise, or a policy that is not a polynomial, is not mistaken for individual rest postures."""
    for setup in (Setup("x rz", noise=0.1), Setup("x y", policy="sinusoidal"), Setup("y rz", trajectories=20)):
        demos = demonstrate(setup, setup.selection(rng), rng)
        learner = ConstraintLearner(planar_features(), estimator="joint").fit(demos)
        assert learner.report_.policy_model != "affine-offset"
