"""Separation of task and null-space part, and what is learnt from it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments.paper_setup import Setup, demonstrate, null_parts, planar_features
from manip_learn.experiments.table import fit_row_by_row
from manip_learn.learning import ConstraintLearner
from manip_learn.learning.imposed import residual_and_jacobian, separated
from manip_learn.learning.table import Table, View
from manip_learn.linalg import row_space_angle


def test_jacobian_is_the_derivative_of_the_residual(rng):
    """Every entry of the analytic Jacobian agrees with central differences."""
    basis, weights, u = rng.standard_normal((7, 4)), rng.standard_normal((4, 3)), rng.standard_normal((7, 3))
    _, J = residual_and_jacobian(weights, basis, u)
    h = 1e-6
    for k in range(weights.size):
        step = np.zeros(weights.size)
        step[k] = h
        up = residual_and_jacobian(weights + step.reshape(weights.shape), basis, u)[0]
        down = residual_and_jacobian(weights - step.reshape(weights.shape), basis, u)[0]
        assert_allclose(J[:, k], (up - down) / (2 * h), rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("rows", ["x y", "y rz"])
def test_the_papers_route_finds_the_rows(rng, rows):
    """w~ is the true null-space part to 1e-3 (root mean square) on the paper's demonstrations, and both ways to learn
    from it find the row space within 0.05 degrees, ours with the number of rows.
    """
    setup = Setup(rows)
    demos = demonstrate(setup, setup.selection, rng)
    view, w = View(planar_features(), Table(list(demos))), null_parts(planar_features(), demos, setup.selection)
    found = separated(view, 0)
    assert np.sqrt(np.mean((found - w) ** 2) / np.mean(w**2)) < 1e-3
    learner = ConstraintLearner(planar_features(), estimator="separate", velocities="recorded").fit(demos)
    report = learner.report_
    assert (report.estimator, report.policy_model, report.kind) == ("separate", "rbf96", "self-imposed")
    assert report.policy_residuals["rbf96"] < 1e-6 and report.gap > 100.0 and len(report.levels) == 3
    by_row = view.selection(fit_row_by_row(view.Phi, found, 2))
    for selection in (learner.constraint_.selection, by_row):
        assert selection.shape == setup.selection.shape
        assert np.degrees(row_space_angle(selection, setup.selection)) < 0.05


@pytest.mark.parametrize(
    ("setup", "reason"),
    [(Setup("x y", policy="zero"), "no null-space motion"), (Setup("x y", trajectories=3), "too few")],
)
def test_nothing_to_separate_is_refused(rng, setup, reason):
    """Motion without a null-space part, and too few samples, are refused with a reason."""
    demos = demonstrate(setup, setup.selection, rng)
    with pytest.raises(NotIdentifiableError, match=reason):
        ConstraintLearner(planar_features(), 2, "separate", velocities="recorded").fit(demos)


@pytest.mark.slow
@pytest.mark.parametrize("rows", ["x rz", "x y", "y rz"])
def test_demonstrators_with_postures_of_their_own(rng, rows):
    """Each demonstrator has another rest posture: told so or not, the learner finds the exact rows and their number.

    A place and an angle run with every change, the other pairs of rows with `make proofs`.
    """
    setup = Setup(rows, trajectories=40, policy="own")
    Lambda = setup.selection
    demos = demonstrate(setup, Lambda, rng)
    for policy_model in ("affine-offset", "auto"):
        learner = ConstraintLearner(planar_features(), policy_model=policy_model).fit(demos)
        assert row_space_angle(learner.constraint_.selection, Lambda) < 1e-9
        assert learner.report_.policy_model == "affine-offset"


def test_offsets_are_not_seen_where_there_are_none(rng):
    """Noise, or a policy that is not a polynomial, is not mistaken for individual rest postures."""
    for setup in (Setup("x rz", noise=0.1), Setup("x y", policy="sinusoidal")):
        demos = demonstrate(setup, setup.selection, rng)
        learner = ConstraintLearner(planar_features(), estimator="joint").fit(demos)
        assert learner.report_.policy_model != "affine-offset"
