"""Evidence where the demonstrator moves the constrained rows on purpose."""

from __future__ import annotations

import numpy as np
import pytest
from generated_motions import PLANAR_ROWS, paper_motions, planar_features

from manip_learn.errors import FeatureError, RecordingError
from manip_learn.learning.evidence.imposed_rows import DualFeatures, imposed_row_evidence


@pytest.mark.parametrize("rows", PLANAR_ROWS)
def test_the_papers_reaching_leaves_one_row_alone(rows):
    """Two of three rows are imposed: the evidence names one that is not, even with 3 % of noise on the velocities."""
    demos, truth = paper_motions(PLANAR_ROWS[rows], np.random.default_rng(0), noise=0.03)
    found = imposed_row_evidence(planar_features(), list(demos), np.random.default_rng(0))
    assert found.n_rows == 3 - truth.n_constraints


def test_dual_rows_undo_the_transpose():
    """(Phi Phi^T)^-1 Phi maps Phi^T c back to c; the derivative is not available."""
    features = planar_features()
    dual, q, c = DualFeatures(features), np.array([0.3, 0.9, -0.4]), np.array([1.0, -2.0, 0.5])
    np.testing.assert_allclose(dual(q) @ features(q).T @ c, c, atol=1e-12)
    with pytest.raises(FeatureError, match="no derivative"):
        dual.derivative(q)


def test_velocities_are_needed():
    """Positions alone are refused as everywhere."""
    demos, _ = paper_motions([0, 1], np.random.default_rng(0), 2)
    bare = [type(t)(t.time, t.q, None, t.joint_names, t.name) for t in demos]
    with pytest.raises(RecordingError, match="no velocities"):
        imposed_row_evidence(planar_features(), bare, np.random.default_rng(0))
