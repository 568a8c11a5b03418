"""Levenberg-Marquardt, once: the descent of the estimators and of the fit of a place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

import numpy as np
from jaxtyping import Float

from manip_learn.linalg import whitener

FIRST_DAMPING, MOST_DAMPED = 1e-3, 1e6  # shares of the curvatures, after a step that gained nothing
CUTOFF = 1e-14  # curvatures below this share of the largest are none


class State(Protocol):
    """A point of the descent."""

    @property
    def cost(self) -> float:
        """The quantity that the descent lowers."""
        ...

    def equations(self) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
        """Gauss-Newton Hessian and gradient."""
        ...


Point = TypeVar("Point", bound=State)


def descend(
    here: Point,
    moved: Callable[[Point, Float[np.ndarray, " m"]], Point],
    max_iterations: int,
    *,
    settled: Callable[[Point, Float[np.ndarray, " m"], Float[np.ndarray, "m m"]], bool] = lambda point, step, H: False,
    tolerance: float = 0.0,
    stop: Callable[[Point], bool] = lambda point: False,
    gain: float = 0.0,
    rise: float = 0.0,
) -> Point:
    """Each step solves the Gauss-Newton equations; steps without gain are shortened.

    Args:
        here: The start.
        moved: The point after a step.
        max_iterations: Largest number of steps; 0 judges the start as it is.
        settled: Whether a step is so short that it is not taken, by the point, the step and the Hessian.
        tolerance: Length of a step that is the last.
        stop: Whether to go no further from a point.
        gain: Relative decrease of the cost below which to stop.
        rise: Relative rise of the cost that is rounding.

    Returns:
        The best point.
    """
    damping = 0.0
    for _ in range(max_iterations):
        if damping > MOST_DAMPED or stop(here):
            break
        H, gradient = here.equations()
        W = whitener(H + damping * np.diag(np.diag(H)), CUTOFF)
        step = -W.T @ (W @ gradient)
        if settled(here, step, H):
            break
        trial, length = moved(here, step), float(np.linalg.norm(step))
        if trial.cost <= here.cost * (1.0 + rise):
            is_last = trial.cost >= here.cost * (1.0 - gain) or length < tolerance
            here, damping = trial, damping * 0.1 if damping > 1e-9 else 0.0
            if is_last:
                break
        elif length < tolerance:
            break  # rounding is all that is left
        else:
            damping = max(FIRST_DAMPING, damping * 10.0)
    return here
