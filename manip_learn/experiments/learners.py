"""The ways to learn Lambda that the paper's experiments compare, each by the name that tables and pictures give it.

The paper's own route is `separate-row-by-row`: the null-space part of the motion by Towell, Howard and Vijayakumar
(2010), then `fit_row_by_row`, as Lin, Howard and Vijayakumar (2015) describe it: each new row is the unit vector,
orthogonal to the rows before, that lowers equation (10) of the rows so far most; its spherical angles are found by
Levenberg-Marquardt from several starts. All but `auto` are told the number of rows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.experiments.paper_setup import null_parts
from manip_learn.learning.estimators.joint_estimator import estimate_joint
from manip_learn.learning.estimators.null_space import fit_null_space, levels
from manip_learn.learning.estimators.separation import estimate_separate, separate_null_motion
from manip_learn.learning.learner import ConstraintLearner
from manip_learn.learning.samples import Samples
from manip_learn.linalg import batch_row_spaces, complement_rows, orthonormal_rows
from manip_learn.recordings.demonstrations import Demonstrations

# name -> what tables and pictures call it
SAID: dict[str, str] = {
    "joint-affine": "joint, affine policy",
    "joint-quadratic": "joint, quadratic policy",
    "joint-cubic": "joint, cubic policy",
    "joint-rbf": "joint, 32 radial functions",
    "separate": "separate, then all rows at once",
    "separate-row-by-row": "separate, then row by row",
    "true-w": "true null-space part",
    "auto": "as shipped",
}
Learnt = tuple[np.ndarray, dict[str, Any]]  # Lambda, and remarks
Matrix = Float[np.ndarray, "s p"]


def fit_row_by_row(samples: Samples, n_rows: int) -> Float[np.ndarray, "s r"]:
    """Lambda in whitened coordinates, one row after the other.

    Args:
        samples: The velocities of these samples are null-space motion.
        n_rows: Number of rows s.
    """
    Phi = np.concatenate([block.Phi for block in samples.blocks()])
    Lambda = np.zeros((0, samples.n_rows))
    for _ in range(n_rows):
        # the new row lives in the complement of the others: a unit vector there is a point on a smaller sphere
        frame, rest = np.eye(samples.n_rows), Phi
        if s := len(Lambda):
            frame = complement_rows(Lambda)
            along = batch_row_spaces(np.einsum("sr,nrv->nsv", Lambda, Phi, optimize=True))[0][:, :, :s]
            rest = Phi - np.einsum("nrv,nvs,nws->nrw", Phi, along, along, optimize=True)  # Phi N
        Lambda = np.concatenate([Lambda, _best_row(rest, samples.u, frame)[None]])
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

    # the search has local minima; more than three starts an angle found no lower ones on the paper's reaches: a grid
    # over the half sphere where that is small, its diagonals where it is not
    values = np.pi * (np.arange(3) + 0.5) / 3
    grid = np.stack(np.meshgrid(*[values] * k), -1).reshape(-1, k) if k <= 2 else None
    starts = [np.roll(np.resize(values, k), shift) for shift in range(3)] if grid is None else list(grid)
    stop: dict[str, float] = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-15)  # relative: at rounding
    fits = [least_squares(residuals, start, method="lm", **stop) for start in starts]
    return unit_vector(min(fits, key=lambda fit: fit.cost).x) @ frame


def _of_samples(learn: Callable[[Samples, int, np.random.Generator], np.ndarray]) -> Callable[..., Learnt]:
    """A way that takes samples and a number of rows, and answers in whitened coordinates."""

    def way(features: FeatureMap, demos: Demonstrations, true: Matrix, rng: np.random.Generator) -> Learnt:
        samples = Samples.collect(features, demos)
        return samples.selection(learn(samples, len(true), rng)), {}

    return way


def _joint(model: str) -> Callable[..., Learnt]:
    return _of_samples(lambda samples, s, rng: estimate_joint(samples, s, rng, model).whitened_selection)


def _true_null_part(features: FeatureMap, demos: Demonstrations, true: Matrix, rng: np.random.Generator) -> Learnt:
    samples = Samples.collect(features, demos)
    motion = dataclasses.replace(samples, u=null_parts(features, demos, true))
    return samples.selection(fit_null_space(motion, levels(motion)[1][: len(true)]).whitened_selection), {}


def _auto(features: FeatureMap, demos: Demonstrations, true: Matrix, rng: np.random.Generator) -> Learnt:
    learner = ConstraintLearner(features, seed=int(rng.integers(2**31))).fit(demos)
    return learner.constraint_.selection, {"warned": bool(learner.report_.warnings)}


# name -> (features, demonstrations, true Lambda, rng) -> Lambda
ESTIMATORS: dict[str, Callable[..., Learnt]] = {
    "joint-affine": _joint("affine"),
    "joint-quadratic": _joint("quadratic"),
    "joint-cubic": _joint("cubic"),
    "joint-rbf": _joint("rbf"),
    "separate": _of_samples(lambda samples, s, rng: estimate_separate(samples, s, rng).whitened_selection),
    "separate-row-by-row": _of_samples(
        lambda samples, s, rng: orthonormal_rows(fit_row_by_row(separate_null_motion(samples, rng)[1], s))
    ),
    "true-w": _true_null_part,
    "auto": _auto,
}
