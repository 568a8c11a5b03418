"""One trial of the learning experiments: draw demonstrations, learn Lambda in several ways, compare mu."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments.metrics import manipulability_along, nmie, scale_free_nmie
from manip_learn.experiments.paper_setup import Setup, demonstrate, null_parts, planar_features
from manip_learn.experiments.row_by_row import fit_row_by_row
from manip_learn.learning.estimators.joint_estimator import estimate_joint
from manip_learn.learning.estimators.null_space import fit_null_space, levels
from manip_learn.learning.estimators.separation import estimate_separate, separate_null_motion
from manip_learn.learning.learner import ConstraintLearner
from manip_learn.learning.samples import Samples
from manip_learn.linalg import orthonormal_rows, row_space_angle
from manip_learn.recordings.demonstrations import Demonstrations

Matrix = Float[np.ndarray, "s p"]
Learnt = tuple[np.ndarray, dict[str, Any]]
# (features, demonstrations, true Lambda, rng) -> learnt Lambda and remarks
Way = Callable[[FeatureMap, Demonstrations, np.ndarray, np.random.Generator], Learnt]


@final
class ScaledRows(FeatureMap):
    """diag(scales) Phi(q): centimetres instead of metres beside radians, for instance.

    Args:
        features: Phi.
        scales: One factor per row.
    """

    def __init__(self, features: FeatureMap, scales: ArrayLike):
        self.features = features
        self.scales: Float[np.ndarray, " p"] = np.array(scales, dtype=np.float64)
        self.nv = features.nv
        self.row_names = features.row_names
        self.row_units = tuple(f"{u} / {c:g}" for u, c in zip(features.row_units, self.scales, strict=True))

    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "p nv"]:
        """Phi(q), scaled."""
        return self.scales[:, None] * self.features(q)

    def derivative(self, q: ArrayLike) -> Float[np.ndarray, "p nv nv"]:
        """dPhi/dq, scaled."""
        return self.scales[:, None, None] * self.features.derivative(q)

    def batch(self, q: ArrayLike) -> Float[np.ndarray, "n p nv"]:
        """Phi at many postures, scaled."""
        return self.scales[:, None] * self.features.batch(q)

    def __repr__(self) -> str:
        return f"ScaledRows({self.features!r}, {self.scales.tolist()})"


@final
@dataclass(frozen=True)
class LearningCase:
    """What is learnt from what.

    Attributes:
        setup: The demonstrations.
        estimators: Names of `ESTIMATORS`.
    """

    setup: Setup
    estimators: tuple[str, ...]


def learning_trial(case: LearningCase, rng: np.random.Generator) -> dict[str, Any]:
    """Train on one set of demonstrations, judge on it and on another one.

    Returns:
        Estimator -> `train` and `test` NMIE, `scale_free` NMIE on the test set, `angle_deg` between the row spaces,
        `rows` found, `seconds`, and for `auto` whether it `warned`; or `refused`, the reason.
    """
    setup = case.setup
    Lambda = setup.selection(rng)
    train, test = demonstrate(setup, Lambda, rng), demonstrate(dataclasses.replace(setup, noise=0.0), Lambda, rng)
    features: FeatureMap = planar_features()
    if setup.length != 1.0:
        features = ScaledRows(features, [setup.length, setup.length, 1.0])
    seen = [np.concatenate([t.q for t in demos]) for demos in (train, test)]
    out: dict[str, Any] = {}
    for name in case.estimators:
        own = np.random.default_rng(rng.integers(2**63))
        started = time.perf_counter()
        try:
            learnt, remarks = ESTIMATORS[name](features, train, Lambda, own)
        except NotIdentifiableError as error:
            out[name] = {"refused": error.code}
            continue
        seconds = time.perf_counter() - started
        out[name] = _judged(features, Lambda, learnt, seen) | {"seconds": seconds} | remarks
    return out


def _judged(features: FeatureMap, true: Matrix, learnt: Matrix, seen: list[np.ndarray]) -> dict[str, Any]:
    out: dict[str, Any] = {"rows": len(learnt), "angle_deg": float(np.degrees(row_space_angle(true, learnt)))}
    for name, q in zip(("train", "test"), seen, strict=True):
        mu, other = manipulability_along(features, true, q), manipulability_along(features, learnt, q)
        out[name] = nmie(mu, other)
        out["scale_free"] = scale_free_nmie(mu, other)
    return out


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
    return learner.constraint_.selection, {"warned": bool(learner.report_.warnings)}


# name -> way to learn. All but `auto` are told the number of rows.
ESTIMATORS: dict[str, Way] = {
    "joint-affine": _joint("affine"),
    "joint-quadratic": _joint("quadratic"),
    "joint-cubic": _joint("cubic"),
    "joint-rbf": _joint("rbf"),
    "joint-own": _joint("affine-offset"),
    "separate": _separate,
    "separate-row-by-row": _separate_row_by_row,
    "true-w": _true_null_part,
    "auto": _auto,
}
