"""One trial of the learning experiments: draw demonstrations, learn Lambda in several ways, compare mu."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments.metrics import manipulability_along, nmie, scale_free_nmie
from manip_learn.experiments.paper_setup import Setup, demonstrate, planar_features
from manip_learn.experiments.scaled_rows import ScaledRows
from manip_learn.experiments.ways import ESTIMATORS
from manip_learn.linalg import row_space_angle

Matrix = Float[np.ndarray, "s p"]


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
        out[name] = judge(features, Lambda, learnt, seen) | {"seconds": seconds} | remarks
    return out


def judge(features: FeatureMap, true: Matrix, learnt: Matrix, seen: list[np.ndarray]) -> dict[str, Any]:
    """`rows`, `angle_deg` between the row spaces, NMIE on training and test postures, `scale_free` on the latter."""
    out: dict[str, Any] = {"rows": len(learnt), "angle_deg": float(np.degrees(row_space_angle(true, learnt)))}
    for name, q in zip(("train", "test"), seen, strict=True):
        mu, other = manipulability_along(features, true, q), manipulability_along(features, learnt, q)
        out[name] = nmie(mu, other)
        out["scale_free"] = scale_free_nmie(mu, other)
    return out
