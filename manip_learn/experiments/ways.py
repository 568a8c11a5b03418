"""The ways to learn Lambda that the experiments compare, each by the name that tables and pictures give it.

Among them are published learners, written anew from their papers, on the same recordings:

- Row by row in spherical angles (Lin, Howard and Vijayakumar, 2015): `fit_row_by_row`, from the null-space part of the
  motion, which the separation of Towell, Howard and Vijayakumar (2010) comes before. Each new row is the unit vector,
  orthogonal to the rows before, that lowers equation (10) of the rows so far most; its angles are found by
  Levenberg-Marquardt from several starts. `learning.estimators.null_space.fit_null_space` moves all rows at once.
- Closed form (Armesto, Bosga, Ivan and Vijayakumar, Efficient Learning of Constraints and Generic Null Space Policies,
  2017; Armesto, Moura, Ivan, Erden, Sala and Vijayakumar, Constraint-aware learning of policies by demonstration,
  2018): A(q) u - b(q) = 0 is linear in the parameters of A and b, so that they are the left singular vectors of the
  stacked regressors with the smallest singular values. Here A = Lambda Phi, and b is told to be W (r* - r(q)) with an
  unknown target r* of each trajectory; or b = 0.
- Line or plane through the tip's places (the kinematic part of Subramani, Zinn and Gleicher, Inferring geometric
  constraints in human demonstrations, 2018; what practitioners do): principal axes of the places about each
  trajectory's mean. Only for b = 0 and translational rows in the base frame.

These are told the number of rows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.other_features import CustomFeatures
from manip_learn.experiments.paper_setup import null_parts, tip
from manip_learn.learning.estimators.joint_estimator import estimate_joint
from manip_learn.learning.estimators.null_space import fit_null_space, levels
from manip_learn.learning.estimators.policy_equations import whitened
from manip_learn.learning.estimators.policy_model import PolynomialModel
from manip_learn.learning.estimators.separation import estimate_separate, separate_null_motion
from manip_learn.learning.estimators.variable_projection import fit_joint
from manip_learn.learning.learner import ConstraintLearner
from manip_learn.learning.samples import Samples
from manip_learn.linalg import batch_row_spaces, complement_rows, orthonormal_rows
from manip_learn.recordings.demonstrations import Demonstrations


def scaled_rows(features: FeatureMap, scales: Sequence[float]) -> CustomFeatures:
    """diag(scales) Phi(q): rows in other units, centimetres instead of metres beside radians for instance."""
    factors = np.array(scales, dtype=np.float64)
    return CustomFeatures(
        lambda q: factors[:, None] * features(q),
        features.row_names,
        features.nv,
        derivative=lambda q: factors[:, None, None] * features.derivative(q),
        row_units=[f"{unit} / {scale:g}" for unit, scale in zip(features.row_units, scales, strict=True)],
    )


STARTS_AN_ANGLE = 3  # the search has local minima; more starts found no lower ones on the paper's reaches
TOLERANCE = 1e-15  # of the search, relative: it stops at rounding


def fit_row_by_row(samples: Samples, n_rows: int) -> Float[np.ndarray, "s r"]:
    """Lambda in whitened coordinates, one row after the other.

    Args:
        samples: The velocities of these samples are null-space motion.
        n_rows: Number of rows s.
    """
    Phi = np.concatenate([block.Phi for block in samples.blocks()])
    w = samples.u
    Lambda = np.zeros((0, samples.n_rows))
    for _ in range(n_rows):
        # the new row lives in the complement of the others: a unit vector there is a point on a smaller sphere
        frame = complement_rows(Lambda) if len(Lambda) else np.eye(samples.n_rows)
        Lambda = np.concatenate([Lambda, _best_row(_beside(Phi, Lambda), w, frame)[None]])
    return Lambda


def unit_vector(angles: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k+1"]:
    """The point of the unit sphere with these spherical angles [rad]."""
    sines = np.concatenate([[1.0], np.cumprod(np.sin(angles))])
    return sines * np.append(np.cos(angles), 1.0)


def _best_row(Phi: np.ndarray, w: np.ndarray, frame: np.ndarray) -> Float[np.ndarray, " r"]:
    k = len(frame) - 1
    if k == 0:
        return frame[0]
    rows = np.einsum("kr,nrv->nkv", frame, Phi, optimize=True)

    def residuals(angles: np.ndarray) -> np.ndarray:
        # what the new row adds to |A^+ A w|^2: the part of w along the row, beside the rows before
        a = np.einsum("k,nkv->nv", unit_vector(angles), rows)
        return np.einsum("nv,nv->n", a, w) / np.linalg.norm(a, axis=1)

    fits = [
        least_squares(residuals, start, method="lm", xtol=TOLERANCE, ftol=TOLERANCE, gtol=TOLERANCE)
        for start in _starts(k)
    ]
    best = min(fits, key=lambda fit: fit.cost)
    return unit_vector(best.x) @ frame


def _beside(Phi: np.ndarray, Lambda: np.ndarray) -> Float[np.ndarray, "n r v"]:
    """Phi N: each row of Phi without its part along the rows so far."""
    s = len(Lambda)
    if s == 0:
        return Phi
    Q, _ = batch_row_spaces(np.einsum("sr,nrv->nsv", Lambda, Phi, optimize=True))
    along = Q[:, :, :s]
    return Phi - np.einsum("nrv,nvs,nws->nrw", Phi, along, along, optimize=True)


def _starts(k: int) -> list[np.ndarray]:
    """Angles spread over the half sphere: a grid where it is small, its diagonals where it is not."""
    values = np.pi * (np.arange(STARTS_AN_ANGLE) + 0.5) / STARTS_AN_ANGLE
    if k <= 2:
        return [np.array(point) for point in np.stack(np.meshgrid(*[values] * k), -1).reshape(-1, k)]
    return [np.roll(np.resize(values, k), shift) for shift in range(STARTS_AN_ANGLE)]


def closed_form(
    task_velocity: Float[np.ndarray, "g T p"], place: Float[np.ndarray, "g T p"], n_rows: int
) -> Float[np.ndarray, "s p"]:
    """Lambda from Lambda Phi u = W (r* - r), r* unknown and constant in a trajectory (Armesto et al., 2017 and 2018).

    Within a trajectory Lambda Phi u + W r is constant, so that (Lambda, W) has no product with the centred (Phi u, r):
    its rows are the left singular vectors of these with the smallest singular values.

    Args:
        task_velocity: Phi u of each sample.
        place: r of each sample, the coordinates whose rate is Phi u.
        n_rows: Number of rows s.
    """
    stacked = np.concatenate([task_velocity, place], axis=2)
    centred = (stacked - stacked.mean(axis=1, keepdims=True)).reshape(-1, stacked.shape[2])
    scale = np.sqrt(np.mean(centred**2, axis=0)) + np.finfo(np.float64).tiny
    rows = np.linalg.svd(centred / scale, full_matrices=False)[2][-n_rows:] / scale
    return orthonormal_rows(rows[:, : task_velocity.shape[2]])


def closed_form_held(task_velocity: Float[np.ndarray, "n p"], n_rows: int) -> Float[np.ndarray, "s p"]:
    """Lambda from Lambda Phi u = 0 (b = 0): the left singular vectors of Phi u with the smallest singular values."""
    return np.linalg.svd(task_velocity, full_matrices=False)[2][-n_rows:]


def fit_places(places: list[np.ndarray], n_rows: int) -> Float[np.ndarray, "s p"]:
    """Rows across the line (s = p - 1) or the plane (s = p - 2) that the tip's places lie on, total least squares.

    Args:
        places: Of each trajectory, shape (T, p); they may lie on parallel lines or planes.
        n_rows: Number of rows s.
    """
    centred = np.concatenate([r - r.mean(axis=0) for r in places])
    return np.linalg.svd(centred, full_matrices=False)[2][-n_rows:]


Learnt = tuple[np.ndarray, dict[str, Any]]
# (features, demonstrations, true Lambda, rng) -> learnt Lambda and remarks
Way = Callable[[FeatureMap, Demonstrations, np.ndarray, np.random.Generator], Learnt]
# (samples, true Lambda, rng) -> learnt Lambda in whitened coordinates
WhitenedWay = Callable[[Samples, np.ndarray, np.random.Generator], np.ndarray]
Matrix = Float[np.ndarray, "s p"]
FITS = 3  # one after the other: each stops when its steps are small


def _of_samples(way: WhitenedWay) -> Way:
    def learn(features: FeatureMap, demos: Demonstrations, true: Matrix, rng: np.random.Generator) -> Learnt:
        samples = Samples.collect(features, demos)
        return samples.selection(way(samples, true, rng)), {}

    return learn


def _joint(model: str) -> Way:
    return _of_samples(lambda samples, true, rng: estimate_joint(samples, len(true), rng, model).whitened_selection)


def _separate_row_by_row(samples: Samples, true: Matrix, rng: np.random.Generator) -> Float[np.ndarray, "s r"]:
    return orthonormal_rows(fit_row_by_row(separate_null_motion(samples, rng)[1], len(true)))


def _true_null_part(features: FeatureMap, demos: Demonstrations, true: Matrix, rng: np.random.Generator) -> Learnt:
    samples = Samples.collect(features, demos)
    motion = dataclasses.replace(samples, u=null_parts(features, demos, true))
    return samples.selection(fit_null_space(motion, levels(motion)[1][: len(true)]).whitened_selection), {}


def _auto(features: FeatureMap, demos: Demonstrations, true: Matrix, rng: np.random.Generator) -> Learnt:
    learner = ConstraintLearner(features, seed=int(rng.integers(2**31))).fit(demos)
    report = learner.report_
    return learner.constraint_.selection, {"warned": bool(report.warnings), "stated_deg": report.uncertainty_deg}


def _closed_form(features: FeatureMap, demos: Demonstrations, true: Matrix, rng: np.random.Generator) -> Learnt:
    return closed_form(np.array(task_rates(features, demos)), np.array([tip(t.q) for t in demos]), len(true)), {}


def task_rates(features: FeatureMap, demos: Demonstrations) -> list[Float[np.ndarray, "T p"]]:
    """Phi u of each recording with velocities."""
    return [np.einsum("npv,nv->np", features.batch(t.q), t.u) for t in demos if t.u is not None]


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
    "separate": _of_samples(lambda samples, true, rng: estimate_separate(samples, len(true), rng).whitened_selection),
    "separate-row-by-row": _of_samples(_separate_row_by_row),
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
