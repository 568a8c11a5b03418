"""The descent that the estimators of Lambda share: Levenberg-Marquardt on the Grassmann manifold."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

import numpy as np
from jaxtyping import Float

from manip_learn.linalg import complement_rows, orthonormal_rows

# a step this short changes nothing but rounding (of rows of length 1), and so does one damped by this much
SHORTEST, MOST_DAMPED = 1e-12, 1e6
FIRST_DAMPING = 1e-3  # of the mean curvature, after the first step that gained nothing
CUTOFF = 1e-14  # curvatures below this share of the largest are none


class Iterate(Protocol):
    """Lambda, in whitened coordinates with orthonormal rows, and what a step from it needs."""

    @property
    def Lambda(self) -> Float[np.ndarray, "s r"]:
        """The rows."""
        ...

    @property
    def cost(self) -> float:
        """What is made small."""
        ...

    def equations(self) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
        """Gauss-Newton Hessian and gradient for dLambda = B Lambda_perp, m = s (r - s)."""
        ...


State = TypeVar("State", bound=Iterate)


def descend(
    here: State,
    at: Callable[[Float[np.ndarray, "s r"]], State],
    max_iterations: int,
    tolerance: float,
    gain: float,
    *,
    rise: float = 0.0,
    usable: Callable[[State], bool] | None = None,
    enough: Callable[[State], bool] | None = None,
) -> tuple[State, int]:
    """Each step solves for B and retracts by orthonormalising Lambda + B Lambda_perp; steps without gain are shortened.

    Args:
        here: The start.
        at: The state of given rows.
        max_iterations: Largest number of steps; 0 judges the start as it is.
        tolerance: Step length at which to stop.
        gain: Relative decrease of the cost below which to stop.
        rise: Relative rise of the cost that is rounding.
        usable: Whether the equations at a state may be solved; all are by default.
        enough: Whether to stop at a state that a step has led to.

    Returns:
        The best state, and the number of steps tried.
    """
    s, r = here.Lambda.shape
    damping, iterations = 0.0, 0
    while iterations < max_iterations and 0 < s < r and (usable is None or usable(here)):
        iterations += 1
        H, gradient = here.equations()
        scale = max(float(np.trace(H)) / len(H), np.finfo(np.float64).tiny)
        B = -np.linalg.lstsq(H + damping * scale * np.eye(len(H)), gradient, rcond=CUTOFF)[0].reshape(s, r - s)
        trial, length = at(orthonormal_rows(here.Lambda + B @ complement_rows(here.Lambda))), float(np.linalg.norm(B))
        if trial.cost <= here.cost * (1.0 + rise):
            done = length < tolerance or trial.cost >= here.cost * (1.0 - gain)
            here, damping = trial, damping * 0.1 if damping > 1e-9 else 0.0
            if done or (enough is not None and enough(here)):
                break
        elif length < SHORTEST or damping > MOST_DAMPED:
            break  # rounding is all that is left
        else:
            damping = max(FIRST_DAMPING, damping * 10.0)
    return here, iterations
