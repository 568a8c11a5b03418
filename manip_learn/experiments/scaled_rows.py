"""Features in other units."""

from __future__ import annotations

from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.feature_map import FeatureMap


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
