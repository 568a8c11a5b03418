"""Several feature maps on top of each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import FeatureError


@final
class Stacked(FeatureMap):
    """Rows of several feature maps of one robot, in order: two hands, a hand and an elbow, ...

    Args:
        parts: At least one feature map; all act on the same velocities.

    Raises:
        FeatureError: None given, or sizes differ.
    """

    def __init__(self, parts: Sequence[FeatureMap]):
        self.parts = tuple(parts)
        sizes = {part.nv for part in self.parts}
        if len(sizes) != 1:
            raise FeatureError(f"stacked feature maps must act on one robot's velocities: nv is {sorted(sizes)}")
        robots = [r for r in (getattr(part, "robot", None) for part in self.parts) if r is not None]
        if any(r.fingerprint != robots[0].fingerprint for r in robots):
            raise FeatureError(f"stacked feature maps must share one robot, got {[r.name for r in robots]}")
        self.robot = robots[0] if robots else None
        self.nv = sizes.pop()
        self.row_names = tuple(f"{i}.{n}" for i, part in enumerate(self.parts) for n in part.row_names)
        self.row_units = tuple(u for part in self.parts for u in part.row_units)

    def __call__(self, q: ArrayLike) -> Float[np.ndarray, "p nv"]:
        """Phi(q): the parts' rows in order."""
        return np.concatenate([part(q) for part in self.parts])

    def derivative(self, q: ArrayLike) -> Float[np.ndarray, "p nv nv"]:
        """dPhi/dq: the parts' derivatives in order."""
        return np.concatenate([part.derivative(q) for part in self.parts])

    def value_and_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "p nv"], Float[np.ndarray, "p nv nv"]]:
        """Phi(q) and dPhi/dq of all parts."""
        values, derivatives = zip(*(part.value_and_derivative(q) for part in self.parts), strict=True)
        return np.concatenate(values), np.concatenate(derivatives)

    def batch(self, q: ArrayLike) -> Float[np.ndarray, "n p nv"]:
        """Phi at many configurations, each part in its own fast way."""
        return np.concatenate([part.batch(q) for part in self.parts], axis=1)

    def batch_with_derivative(self, q: ArrayLike) -> tuple[Float[np.ndarray, "n p nv"], Float[np.ndarray, "n p nv nv"]]:
        """Phi and dPhi/dq at many configurations, each part in its own fast way."""
        values, derivatives = zip(*(part.batch_with_derivative(q) for part in self.parts), strict=True)
        return np.concatenate(values, axis=1), np.concatenate(derivatives, axis=1)

    def coordinates(self, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Task coordinates of all parts."""
        return np.concatenate([part.coordinates(q) for part in self.parts])

    def error_to(self, target: ArrayLike, q: ArrayLike) -> Float[np.ndarray, " p"]:
        """Displacement to a target, part by part (see the parts)."""
        goal = np.asarray(target, dtype=np.float64)
        if goal.shape != (self.n_rows,):
            return super().error_to(goal, q)
        out, row = [], 0
        for part in self.parts:
            out.append(part.error_to(goal[row : row + part.n_rows], q))
            row += part.n_rows
        return np.concatenate(out)

    def coordinates_jacobian(self, q: ArrayLike) -> Float[np.ndarray, "p nv"] | None:
        """Rates of the coordinates, part by part."""
        return self._stack([part.coordinates_jacobian(q) for part in self.parts], q)

    def error_jacobian(self, target: ArrayLike, q: ArrayLike) -> Float[np.ndarray, "p nv"] | None:
        """E with d/dt `error_to(target, q)` = -E u, part by part."""
        goal = np.asarray(target, dtype=np.float64)
        if goal.shape != (self.n_rows,):
            return None  # no part knows what is meant: `error_to` says so
        ends = np.cumsum([part.n_rows for part in self.parts])
        parts = zip(self.parts, np.split(goal, ends[:-1]), strict=True)
        return self._stack([part.error_jacobian(own, q) for part, own in parts], q)

    def _stack(self, blocks: list[Float[np.ndarray, "k nv"] | None], q: ArrayLike) -> np.ndarray | None:
        if all(block is None for block in blocks):
            return None
        return np.concatenate([p(q) if b is None else b for p, b in zip(self.parts, blocks, strict=True)])

    def describe(self) -> dict[str, Any]:
        """The parts, as saved in a constraint file."""
        return {"kind": "stacked", "parts": [part.describe() for part in self.parts]}

    def __repr__(self) -> str:
        return f"Stacked([{', '.join(map(repr, self.parts))}])"
