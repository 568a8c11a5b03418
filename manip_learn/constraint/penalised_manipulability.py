"""Manipulability of a task that also falls towards the joint limits, and its gradient, finite everywhere.

    mu_w(q) = sqrt(det(A_w A_w^T)),    A_w(q) = A(q) W(q),    W = diag(w_j(q_j))

with w_j from 1 in the middle of a joint's range to 0 at its limits, see `limit_weights`: a joint at a limit does not
count as a joint. After Vahrenkamp, Asfour, Metta, Sandini and Dillmann, "Manipulability analysis" (2012).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import Vjp
from manip_learn.constraint.manipulability import gradient_from, manipulability_of
from manip_learn.constraint.small_matrices import svd
from manip_learn.errors import ConstraintError
from manip_learn.robot.limit_potential import limit_weights
from manip_learn.robot.robot import Robot


def penalised_manipulability(constraint: Constraint, q: ArrayLike) -> float:
    """mu_w(q) = sqrt(det(A W^2 A^T)): at most mu, and 0 where the joints within their limits cannot do the task.

    Unit: product of the units of the constraint's rows.

    Raises:
        ConfigurationError: q has the wrong size or is not finite.
        ConstraintError: The constraint's features have no robot.
    """
    return manipulability_of(constraint(q) * limit_weights(limited_robot(constraint), q)[0])


def penalised_manipulability_gradient(constraint: Constraint, q: ArrayLike) -> Float[np.ndarray, " nv"]:
    """Gradient of mu_w along the tangent coordinates, finite; at a singularity see `manipulability_gradient`.

    Raises:
        ConfigurationError: q has the wrong size or is not finite.
        ConstraintError: The constraint's features have no robot.
    """
    A, vjp = penalised_value_and_vjp(constraint, q)
    return gradient_from(A.shape, svd(A), vjp)[1]


def log_penalised_manipulability_gradient(constraint: Constraint, q: ArrayLike) -> Float[np.ndarray, " nv"]:
    """Gradient of log mu_w [1/rad or 1/m]; at a singularity see `log_manipulability_gradient`.

    Raises:
        ConfigurationError: q has the wrong size or is not finite.
        ConstraintError: The constraint's features have no robot.
    """
    A, vjp = penalised_value_and_vjp(constraint, q)
    mu, gradient, floor = gradient_from(A.shape, svd(A), vjp)
    return gradient / max(mu, floor, np.finfo(np.float64).tiny)


def penalised_value_and_vjp(constraint: Constraint, q: ArrayLike) -> tuple[Float[np.ndarray, "s nv"], Vjp]:
    """A_w = A W and its vector-Jacobian product, dA_w_ij / dq_k = w_j dA_ij / dq_k + delta_jk A_ij dw_j / dq_j.

    Raises:
        ConfigurationError: q has the wrong size or is not finite.
        ConstraintError: The constraint's features have no robot.
    """
    w, slope = limit_weights(limited_robot(constraint), q)
    A, vjp = constraint.value_and_vjp(q)
    A_slope = A * slope

    def penalised_vjp(weights: Float[np.ndarray, "s nv"]) -> Float[np.ndarray, " nv"]:
        return vjp(weights * w) + np.einsum("ij,ij->j", weights, A_slope)

    return A * w, penalised_vjp


def limited_robot(constraint: Constraint) -> Robot:
    """The robot whose joint limits count.

    Raises:
        ConstraintError: The constraint's features have no robot.
    """
    if constraint.robot is None:
        raise ConstraintError(f"{constraint.features!r} belongs to no robot, whose joint limits could be penalised")
    return constraint.robot
