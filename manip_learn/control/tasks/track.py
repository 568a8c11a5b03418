"""The task of following a moving target."""

from __future__ import annotations

from collections.abc import Callable
from typing import final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.tasks.point_attractor import PointAttractor
from manip_learn.control.tasks.task import Task


@final
class Track(Task):
    """b = gain * Lambda (r*(t) - r(q)) + Lambda dr*/dt.

    Args:
        target: t [s] -> r*(t), as for `PointAttractor`.
        rate: t -> dr*/dt along the rows of the features, shape (p,); None for no feed-forward.
        gain: Rate [1/s].
    """

    def __init__(
        self, target: Callable[[float], ArrayLike], rate: Callable[[float], ArrayLike] | None = None, gain: float = 1.0
    ):
        self._target = target
        self._rate = rate
        self.gain = float(gain)

    def velocity(self, constraint: Constraint, q: np.ndarray, t: float) -> Float[np.ndarray, " s"]:
        """Pull towards the moving target, plus its own velocity."""
        b = PointAttractor(self._target(t), self.gain).velocity(constraint, q, t)
        if self._rate is not None:
            b = b + constraint.selection @ np.asarray(self._rate(t), dtype=np.float64)
        return b

    def error(self, constraint: Constraint, q: np.ndarray, t: float) -> float:
        """Distance to where the target is now."""
        return PointAttractor(self._target(t)).error(constraint, q, t)

    def __repr__(self) -> str:
        return f"Track(gain={self.gain:g})"
