"""Recombination test where the demonstrator moves the constrained rows on purpose: A(q) u = b, b unknown."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import FeatureError
from manip_learn.learning.evidence.recombination import RECOMBINATIONS, recombination_test
from manip_learn.learning.evidence.row_evidence import RowEvidence
from manip_learn.recordings.trajectory import Trajectory


@final
class DualFeatures(FeatureMap):
    """(Phi Phi^T)^-1 Phi: the rows whose product with A^T c = Phi^T Lambda^T c is Lambda^T c.

    Args:
        features: Phi, with independent rows at every posture that is asked for.
    """

    def __init__(self, features: FeatureMap):
        self._features = features
        self.nv = features.nv
        self.row_names = features.row_names
        self.row_units = tuple(f"1/({unit})" for unit in features.row_units)

    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "p nv"]:
        """The dual rows at q."""
        return self.batch(np.asarray(q, dtype=np.float64)[None])[0]

    def derivative(self, q: ArrayLike) -> Float[np.ndarray, "p nv nv"]:
        """Not offered.

        Raises:
            FeatureError: Always.
        """
        raise FeatureError("dual features serve a test and have no derivative")

    def batch(self, q: ArrayLike) -> Float[np.ndarray, "n p nv"]:
        """The dual rows at n postures; zero where Phi loses rank."""
        Phi = self._features.batch(q)
        return np.linalg.pinv(Phi.transpose(0, 2, 1))


def imposed_row_evidence(
    features: FeatureMap,
    trajectories: Sequence[Trajectory],
    rng: np.random.Generator,
    n_recombinations: int = RECOMBINATIONS,
) -> RowEvidence:
    """Evidence for b(q) != 0: the rows counted are those that are NOT imposed, so that s = p - n_rows.

    With u = A^+ b + N pi(q), what a regression of u on the posture leaves is A^+ times the part of b that differs
    between trajectories. It lies in the row space of A(q), where the dual rows give Lambda^T c: nothing along the p - s
    other directions, as if these were held. That is what the recombination test looks for. It needs a policy that a
    quadratic in q describes, many trajectories (20 and more) and p > s; it says nothing if every row of Phi is imposed.

    Args:
        features: Phi.
        trajectories: With velocities.
        rng: Of the recombinations.
        n_recombinations: How many.

    Raises:
        RecordingError: A trajectory lacks velocities, or acts on another number of joints.
    """
    usable = all(t.u is not None and t.u.shape[1] == features.nv for t in trajectories)
    unexplained = _unexplained(trajectories) if usable and len(trajectories) else trajectories
    return recombination_test(DualFeatures(features), unexplained, rng, n_recombinations)


def _unexplained(trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """The trajectories with what a quadratic in q leaves of their velocities."""
    q, u = (np.concatenate([np.asarray(getattr(t, name)) for t in trajectories]) for name in ("q", "u"))
    x = (q - q.mean(axis=0)) / np.maximum(q.std(axis=0), 1e-9)
    i, j = np.triu_indices(x.shape[1])
    beta = np.column_stack([np.ones(len(x)), x, x[:, i] * x[:, j]])
    left = u - beta @ np.linalg.lstsq(beta, u, rcond=None)[0]
    parts = np.split(left, np.cumsum([len(t) for t in trajectories])[:-1])
    return [Trajectory(t.time, t.q, part, t.joint_names, t.name) for t, part in zip(trajectories, parts, strict=True)]
