"""The ways to learn Lambda that the experiments compare, each by the name that tables and pictures give it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.experiments.paper_setup import null_parts, tip
from manip_learn.experiments.peers import closed_form
from manip_learn.experiments.row_by_row import fit_row_by_row
from manip_learn.experiments.scaled_rows import ScaledRows
from manip_learn.learning.estimators.joint_estimator import estimate_joint
from manip_learn.learning.estimators.null_space import fit_null_space, levels
from manip_learn.learning.estimators.policy_equations import whitened
from manip_learn.learning.estimators.policy_model import PolynomialModel
from manip_learn.learning.estimators.separation import estimate_separate, separate_null_motion
from manip_learn.learning.estimators.variable_projection import fit_joint
from manip_learn.learning.learner import ConstraintLearner
from manip_learn.learning.samples import Samples
from manip_learn.linalg import orthonormal_rows
from manip_learn.recordings.demonstrations import Demonstrations

Learnt = tuple[np.ndarray, dict[str, Any]]
# (features, demonstrations, true Lambda, rng) -> learnt Lambda and remarks
Way = Callable[[FeatureMap, Demonstrations, np.ndarray, np.random.Generator], Learnt]
Matrix = Float[np.ndarray, "s p"]
FITS = 3  # one after the other: each stops when its steps are small


def _joint(model: str) -> Way:
    def learn(features: FeatureMap, demos: Demonstrations, true: Matrix, rng: np.random.Generator) -> Learnt:
        samples = Samples.collect(features, demos)
        return samples.selection(estimate_joint(samples, len(true), rng, model).whitened_selection), {}

    return learn


def _separate(features: FeatureMap, demos: Demonstrations, true: Matrix, rng: np.random.Generator) -> Learnt:
    samples = Samples.collect(features, demos)
    return samples.selection(estimate_separate(samples, len(true), rng).whitened_selection), {}


def _separate_row_by_row(features: FeatureMap, demos: Demonstrations, true: Matrix, rng: np.random.Generator) -> Learnt:
    samples = Samples.collect(features, demos)
    _, null_motion = separate_null_motion(samples, rng)
    return samples.selection(orthonormal_rows(fit_row_by_row(null_motion, len(true)))), {}


def _true_null_part(features: FeatureMap, demos: Demonstrations, true: Matrix, rng: np.random.Generator) -> Learnt:
    samples = Samples.collect(features, demos)
    motion = dataclasses.replace(samples, u=null_parts(features, demos, true))
    return samples.selection(fit_null_space(motion, levels(motion)[1][: len(true)]).whitened_selection), {}


def _auto(features: FeatureMap, demos: Demonstrations, true: Matrix, rng: np.random.Generator) -> Learnt:
    learner = ConstraintLearner(features, seed=int(rng.integers(2**31))).fit(demos)
    report = learner.report_
    return learner.constraint_.selection, {"warned": bool(report.warnings), "stated_deg": report.uncertainty_deg}


def _closed_form(features: FeatureMap, demos: Demonstrations, true: Matrix, rng: np.random.Generator) -> Learnt:
    length = float(features.scales[0]) if isinstance(features, ScaledRows) else 1.0
    rates = np.array([np.einsum("npv,nv->np", features.batch(t.q), t.u) for t in demos if t.u is not None])
    return closed_form(rates, np.array([tip(t.q, length) for t in demos]), len(true)), {}


def fit_told_noise(
    features: FeatureMap, demos: Demonstrations, start: Matrix, deviations: Float[np.ndarray, " nv"]
) -> Matrix:
    """Maximum likelihood with an affine policy for noise of known standard deviation in each joint, from a start.

    Args:
        features: Phi.
        demos: With recorded velocities.
        start: Lambda to begin with.
        deviations: Of the noise on each joint's action; their common factor does not matter.
    """
    samples = Samples.collect(features, demos)
    told = whitened(samples, np.diag(deviations / np.mean(deviations)))
    Lambda = orthonormal_rows(start @ np.linalg.pinv(samples.whitening))
    for _ in range(FITS):
        Lambda = fit_joint(told, Lambda, PolynomialModel(1, samples.q.shape[1])).whitened_selection
    return samples.selection(Lambda)


# name -> way to learn. All but `auto` are told the number of rows.
ESTIMATORS: dict[str, Way] = {
    "joint-affine": _joint("affine"),
    "joint-quadratic": _joint("quadratic"),
    "joint-cubic": _joint("cubic"),
    "joint-rbf": _joint("rbf"),
    "joint-own": _joint("affine-offset"),
    "separate": _separate,
    "separate-row-by-row": _separate_row_by_row,
    "closed-form": _closed_form,
    "true-w": _true_null_part,
    "auto": _auto,
}
# name -> what tables and pictures call it
SAID: dict[str, str] = {
    "joint-affine": "joint, affine policy",
    "joint-quadratic": "joint, quadratic policy",
    "joint-cubic": "joint, cubic policy",
    "joint-rbf": "joint, 32 radial functions",
    "joint-own": "joint, affine policy with offsets",
    "joint-told": "joint, told the noise",
    "separate": "separate, then all rows at once",
    "separate-row-by-row": "separate, then row by row",
    "closed-form": "closed form, told b",
    "true-w": "true null-space part",
    "auto": "as shipped",
    "held": "closed form, b = 0",
    "row-by-row": "row by row, b = 0",
    "line": "line through the places",
}
