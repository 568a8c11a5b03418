"""What a demonstrator meant who moved the constrained rows on purpose: a target, and how fast it was approached."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import FeatureError

# share of the rows' motion that an attractor may leave unexplained to be what was meant: a third of it in amplitude
UNEXPLAINED = 0.1
# spread of the targets over the mean distance at which recordings began, up to which they are one target
ONE_TARGET = 0.1
FITTED_SAMPLES = 2000  # two numbers a row are fitted: more samples cost time and tell nothing new


@final
@dataclass(frozen=True, eq=False)
class Intention:
    """b = gain (r* - Lambda r(q)): a point towards which the constrained rows were moved.

    Attributes:
        target: shape (s,), r* along the rows of Lambda, the mean over the recordings [m or rad].
        gain: Rate at which the distance was taken back [1/s].
        targets: shape (n, s), of each recording.
        spread: Root mean square distance of these from their mean [m or rad].
        common: Whether they are one target.
        unexplained: Share of the rows' motion that is something else.
    """

    target: Float[np.ndarray, " s"]
    gain: float
    targets: Float[np.ndarray, "n s"]
    spread: float
    common: bool
    unexplained: float

    @property
    def sentence(self) -> str:
        """What was meant, in words."""
        where = "(" + ", ".join(f"{x:.3g}" for x in self.target) + ")"
        if not self.common:
            return f"The {len(self.targets)} recordings go to different targets, {self.spread:.2g} (m or rad) apart."
        return f"The recordings go to one target, {where} along the steered rows, at a rate of {self.gain:.2g} /s."

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists, for a constraint file."""
        return vars(self) | {name: getattr(self, name).tolist() for name in _ARRAYS}

    @staticmethod
    def from_dict(content: Any) -> Intention | None:
        """Return what `to_dict` wrote; None of anything else."""
        try:
            values: dict[str, Any] = {entry.name: content[entry.name] for entry in fields(Intention)}
            values |= {name: np.array(values[name], dtype=np.float64) for name in _ARRAYS}
            return Intention(**values)
        except (KeyError, TypeError, ValueError):
            return None


_ARRAYS = ("target", "targets")


def intention_of(
    features: FeatureMap,
    selection: Float[np.ndarray, "s p"],
    recordings: Sequence[tuple[Float[np.ndarray, "T n"], Float[np.ndarray, "T nv"]]],
) -> Intention | None:
    """The attractor that explains how the rows were moved; None where none does, or the features have no coordinates.

    One gain for all recordings, a target for each, by least squares of Lambda Phi(q) u on Lambda r(q).

    Args:
        features: Phi.
        selection: Lambda.
        recordings: Configurations and velocities of each recording.
    """
    step = max(1, sum(len(q) for q, _ in recordings) // FITTED_SAMPLES)
    try:
        places = [np.array([selection @ features.coordinates(row) for row in q[::step]]) for q, _ in recordings]
    except FeatureError:
        return None
    rates = [np.einsum("sp,npv,nv->ns", selection, features.batch(q[::step]), u[::step]) for q, u in recordings]
    x, y = (np.concatenate([part - part.mean(axis=0) for part in parts]) for parts in (places, rates))
    moved, energy = float(np.sum(x * x)), float(sum(np.sum(rate * rate) for rate in rates))
    gain = -float(np.sum(x * y)) / moved if moved > 0.0 else 0.0
    left = float(np.sum((y + gain * x) ** 2)) / energy if energy > 0.0 else 1.0
    if gain <= 0.0 or left > UNEXPLAINED:
        return None
    targets = np.array([r.mean(axis=0) + b.mean(axis=0) / gain for r, b in zip(places, rates, strict=True)])
    spread = float(np.sqrt(np.mean(np.sum((targets - targets.mean(axis=0)) ** 2, axis=1))))
    far = float(np.mean([np.linalg.norm(r[0] - r[-1]) for r in places]))
    return Intention(targets.mean(axis=0), gain, targets, spread, spread <= ONE_TARGET * far, left)
