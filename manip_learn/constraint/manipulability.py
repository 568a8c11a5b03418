"""Manipulability of a task and its gradient, finite at singularities.

mu(q) = sqrt(det(A A^T)), equation (4) of Manavalan and Howard, computed as the product of the singular values of A;
grad mu, equation (13), without a division.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import Vjp
from manip_learn.constraint.small_matrices import dot, leading, put, svd
from manip_learn.linalg import EPS
from manip_learn.robot.weighted_vjp import gradient, vjps

# below this ratio to the largest singular value the left singular vectors of zero and non-zero are mixed by rounding
SINGULAR_RATIO = 64.0 * EPS


def manipulability(constraint: Constraint, q: ArrayLike) -> float:
    """mu(q) = sqrt(det(A A^T)) = prod_i sigma_i, equation (4) of Manavalan and Howard; 0 at a singularity, never NaN.

    Unit: product of the units of the constraint's rows.

    Raises:
        ConfigurationError: q has the wrong size or is not finite.

    Example:
        >>> import manip_learn as ml
        >>> constraint = ml.Constraint([[1, 0]], ml.FrameJacobian(ml.load_robot("planar3"), "tip", axes="x y"))
        >>> round(ml.manipulability(constraint, [0.3, 0.8, 0.4]), 2)  # x is held, the arm is bent
        3.05
        >>> round(ml.manipulability(constraint, [0.0, 0.0, 0.0]), 2)  # stretched along x: the task is singular
        0.0
    """
    return manipulability_of(constraint(q))


def manipulability_of(A: Float[np.ndarray, "s nv"]) -> float:
    """mu of a constraint matrix; 0 if it has more rows than columns."""
    if A.shape[0] > A.shape[1]:
        return 0.0
    return float(np.prod(np.linalg.svd(A, compute_uv=False)))


def manipulability_gradient(constraint: Constraint, q: ArrayLike) -> Float[np.ndarray, " nv"]:
    """Gradient of mu along the tangent coordinates, finite everywhere.

    At an exact singularity mu is a cone, |M step| to first order: what comes back there is its steepest ascent, the
    leading right singular vector of M times its singular value. (Both signs climb; the one whose largest entry is
    positive is chosen.) Where the rank drops by two or more mu grows with a higher power of the step, and the gradient
    is zero; `escape_direction` leads out there.

    Raises:
        ConfigurationError: q has the wrong size or is not finite.
    """
    A, vjp = constraint.value_and_vjp(q)
    return gradient_from(A.shape, svd(A), vjp)[1]


def log_manipulability_gradient(constraint: Constraint, q: ArrayLike) -> Float[np.ndarray, " nv"]:
    """Gradient of log mu = grad mu / mu [1/rad or 1/m]: free of the constraint's units.

    At a singularity it is infinite in length; the direction of `manipulability_gradient` comes back there, with the
    length that it has at the edge of what rounding can tell from a singularity.

    Raises:
        ConfigurationError: q has the wrong size or is not finite.
    """
    A, vjp = constraint.value_and_vjp(q)
    mu, gradient, floor = gradient_from(A.shape, svd(A), vjp)
    return gradient / max(mu, floor, np.finfo(np.float64).tiny)


def gradient_of(
    A: Float[np.ndarray, "s nv"], dA: Float[np.ndarray, "s nv nv"]
) -> tuple[float, Float[np.ndarray, " nv"], float]:
    """mu, its gradient, and the mu below which a singularity cannot be told from rounding, from A and dA/dq."""
    flat = dA.reshape(-1, A.shape[1])
    return gradient_from(A.shape, svd(A), lambda weights: weights.reshape(-1).dot(flat))


def gradient_from(
    shape: tuple[int, ...], decomposition: tuple[np.ndarray, np.ndarray, np.ndarray], vjp: Vjp
) -> tuple[float, Float[np.ndarray, " nv"], float]:
    """The same from the shape of A, its singular value decomposition, and weights -> sum_ij weights_ij dA_ij / dq_k.

    d mu / d q_k = sum_i (prod_{j != i} sigma_j) u_i^T (dA / dq_k) v_i.
    """
    s, nv = shape
    if s > nv:
        return 0.0, np.zeros(nv), 0.0
    U, sigma, Vt = decomposition
    others = products_of_others(sigma)
    mu, floor = others[0] * sigma[0], SINGULAR_RATIO * sigma[0] * others[s - 1]
    if sigma[s - 1] <= SINGULAR_RATIO * sigma[0]:
        return mu, cone_ascent(U[:, s - 1], Vt[s - 1 :], others[s - 1], vjp), floor
    # W = sum_i others_i u_i v_i^T, so that the gradient is one vector-Jacobian product
    return mu, gradient(vjp, dot(U * others, Vt[:s])), floor


def products_of_others(sigma: Float[np.ndarray, " s"]) -> Float[np.ndarray, " s"]:
    """prod_{j != i} sigma_j for each i, without a division."""
    s = sigma.shape[0]
    out, behind = np.ones(s), 1.0
    for i in range(1, s):
        out[i] = out[i - 1] * sigma[i - 1]
    for i in range(s - 1, -1, -1):
        out[i] *= behind
        behind *= sigma[i]
    return out


def escape_direction(decomposition: tuple[np.ndarray, np.ndarray, np.ndarray], vjp: Vjp) -> Float[np.ndarray, " nv"]:
    """Unit vector out of a singularity where the rank is short by two or more, where mu has no gradient.

    With U_0, V_0 spanning what A has lost, U_0^T A(q + step) V_0 is linear in the step; its Frobenius norm grows
    fastest along the direction that comes back (zero if it grows along none). A step along it finds directions again.
    """
    rate, direction = leading(lost_rates(decomposition, vjp))
    return direction if rate > 0.0 else np.zeros(direction.shape[0])


def lost_rates(decomposition: tuple[np.ndarray, np.ndarray, np.ndarray], vjp: Vjp) -> Float[np.ndarray, "k nv"]:
    """Rates of the entries of U_0^T A V_0 along each joint, one entry a row; U_0 and V_0 span what A has lost."""
    U, sigma, Vt = decomposition
    s, rank = U.shape[0], rank_at(sigma)
    Z = Vt[rank:]
    k, nv = Z.shape
    M = np.empty(((s - rank) * k, nv))
    for i in range(rank, s):
        put(M[(i - rank) * k : (i - rank + 1) * k], vjps(vjp, beside(U[:, i], Z), k))
    return M


def rank_at(sigma: Float[np.ndarray, " k"]) -> int:
    """Number of singular values that are not lost."""
    rank = 0
    for i in range(sigma.shape[0]):
        rank += int(sigma[i] > SINGULAR_RATIO * sigma[0])
    return rank


def cone_ascent(
    u_min: Float[np.ndarray, " s"], V_null: Float[np.ndarray, "k nv"], scale: float, vjp: Vjp
) -> Float[np.ndarray, " nv"]:
    """Steepest ascent of mu at a singularity, where it is a cone: mu(q + step) = |M step| to first order.

        M_rk = scale * u_min^T (dA / dq_k) v_r,  scale = prod_{j < s} sigma_j,  v_r spanning the null space of A

    The answer is the leading right singular vector of M times its singular value (docs/method.md, the gradient of mu).
    """
    rate, direction = leading(vjps(vjp, beside(u_min, V_null), V_null.shape[0]))
    return scale * rate * direction


def beside(u: Float[np.ndarray, " s"], rows: Float[np.ndarray, "k nv"]) -> Float[np.ndarray, "s m"]:
    """The matrices u v^T of all rows v, side by side."""
    return u.copy().reshape((-1, 1)) * rows.reshape(-1)
