"""A point in the plane that is held on a curve: polynomials as features, so that A depends on the state.

A conic a x + b y + c x^2 + d x y + e y^2 = const has A(q) = Lambda Phi(q) with Phi the gradients of the monomials.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.features.custom_features import CustomFeatures
from manip_learn.linalg import orthonormal_rows
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.trajectory import Trajectory

MONOMIALS = ("x", "y", "x^2", "x y", "y^2")
# name -> coefficients of the monomials
CURVES = {
    "circle": np.array([[-0.6, 0.4, 1.0, 0.0, 1.0]]),
    "ellipse": np.array([[-0.3, -0.2, 1.0, 0.6, 2.5]]),
}
DEMONSTRATIONS, SAMPLES, STEP = 20, 40, 0.02


@cache
def curve_features() -> CustomFeatures:
    """Gradients of the monomials of degree 1 and 2."""
    return CustomFeatures(gradients, MONOMIALS, nv=2, derivative=hessians, coordinates=monomials)


def monomials(q: ArrayLike) -> Float[np.ndarray, " 5"]:
    """The monomials themselves: task coordinates whose rate is Phi u."""
    x, y = np.asarray(q, dtype=np.float64)
    return np.array([x, y, x * x, x * y, y * y])


def gradients(q: ArrayLike) -> Float[np.ndarray, "5 2"]:
    """Phi."""
    x, y = np.asarray(q, dtype=np.float64)
    return np.array([[1.0, 0.0], [0.0, 1.0], [2.0 * x, 0.0], [y, x], [0.0, 2.0 * y]])


def hessians(q: ArrayLike) -> Float[np.ndarray, "5 2 2"]:
    """dPhi/dq, constant."""
    out = np.zeros((5, 2, 2))
    out[2, 0, 0] = out[4, 1, 1] = 2.0
    out[3, 0, 1] = out[3, 1, 0] = 1.0
    return out


def curve_demonstrations(
    task: str, noise: float, rng: np.random.Generator
) -> tuple[Demonstrations, Float[np.ndarray, "1 5"]]:
    """Points that are pushed about at random while a curve of the family holds them (b = 0); and the true Lambda."""
    coefficients = CURVES[task]
    trajectories = []
    for i in range(DEMONSTRATIONS):
        q, push = rng.uniform(-1.0, 1.0, size=2) + [0.3, -0.2], 2.0 * rng.standard_normal(2)
        postures, actions = [], []
        for _ in range(SAMPLES):
            A = coefficients @ gradients(q)
            pi = push - 0.5 * q
            u = pi - A[0] * float(A[0] @ pi) / float(A[0] @ A[0])
            postures.append(q)
            actions.append(u)
            q = q + STEP * u
            push = push + 0.5 * rng.standard_normal(2)
        u = with_noise(np.array(actions), noise, rng)
        trajectories.append(Trajectory(STEP * np.arange(SAMPLES), np.array(postures), u, ("x", "y"), f"point {i}"))
    return Demonstrations(trajectories), orthonormal_rows(coefficients)


def with_noise(u: Float[np.ndarray, "T nv"], noise: float, rng: np.random.Generator) -> Float[np.ndarray, "T nv"]:
    """Actions with Gaussian noise relative to each column's root mean square."""
    return u + noise * np.sqrt(np.mean(u**2, axis=0)) * rng.standard_normal(u.shape) if noise > 0.0 else u


def drawn_level(
    ax: Any, row: Float[np.ndarray, " 5"], through: Float[np.ndarray, " 2"], colour: str, width: float
) -> None:
    """Draw the curve of a Lambda that passes through a point."""
    low, high = -2.2, 2.6
    x, y = np.meshgrid(np.linspace(low, high, 300), np.linspace(low, high, 300))
    level = row @ np.array([x, y, x * x, x * y, y * y]).reshape(5, -1)
    ax.contour(
        x, y, level.reshape(x.shape), levels=[float(row @ monomials(through))], colors=[colour], linewidths=width
    )
