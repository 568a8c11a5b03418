"""Manipulability of a task and its gradient, finite at singularities.

mu(q) = sqrt(det(A A^T)), equation (4) of Manavalan and Howard, computed as the product of the singular values of A;
grad mu, equation (13), without a division.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.linalg.lapack import dgesdd  # pyright: ignore[reportAttributeAccessIssue]

from manip_learn.constraint.constraint import Constraint, Vjp
from manip_learn.errors import ConstraintError, an
from manip_learn.linalg import EPS

# below this ratio to the largest singular value the left singular vectors of zero and non-zero are mixed by rounding
SINGULAR_RATIO = 64.0 * EPS
LEAST_SINGULAR_RATIO = 0.04  # smallest over largest singular value of A that is taken as well-conditioned
# U, the singular values and V^T of A, all square
Decomposition = tuple[Float[np.ndarray, "s s"], Float[np.ndarray, " k"], Float[np.ndarray, "n n"]]


def manipulability(constraint: Constraint, q: ArrayLike) -> float:
    """mu(q) = sqrt(det(A A^T)) = prod_i sigma_i, equation (4) of Manavalan and Howard; 0 at a singularity, never NaN.

    Unit: product of the units of the constraint's rows.

    Raises:
        ConfigurationError: q has the wrong size or is not finite.
        ConstraintError: The arguments are in another order.

    Example:
        >>> import manip_learn as ml
        >>> constraint = ml.Constraint([[1, 0]], ml.FrameJacobian(ml.load_robot("planar3"), "tip", axes="x y"))
        >>> round(ml.manipulability(constraint, [0.3, 0.8, 0.4]), 2)  # x is held, the arm is bent
        3.05
        >>> round(ml.manipulability(constraint, [0.0, 0.0, 0.0]), 2)  # stretched along x: the task is singular
        0.0
    """
    return constraint_first(constraint, q).manipulability(q)


def constraint_first(constraint: Constraint, q: ArrayLike) -> Constraint:
    """The constraint, if it is one.

    Raises:
        ConstraintError: Something else stands in its place, e.g. the posture.
    """
    if not isinstance(constraint, Constraint):
        raise ConstraintError(f"the constraint comes first, then the posture: got {an(constraint)} and {an(q)}")
    return constraint


def manipulability_gradient(constraint: Constraint, q: ArrayLike) -> Float[np.ndarray, " nv"]:
    """Gradient of mu along the tangent coordinates, finite everywhere.

    At an exact singularity mu is a cone, |M step| to first order: what comes back there is its steepest ascent, the
    leading right singular vector of M times its singular value. (Both signs climb; the one whose largest entry is
    positive is chosen.) Where the rank drops by two or more mu grows with a higher power of the step, and the gradient
    is zero; `ManipulabilityAscent` leads out there.

    Raises:
        ConfigurationError: q has the wrong size or is not finite.
        ConstraintError: The arguments are in another order.
    """
    A, vjp = constraint_first(constraint, q).value_and_vjp(q)
    return gradient_from(A.shape, svd(A), vjp)[1]


def log_manipulability_gradient(constraint: Constraint, q: ArrayLike) -> Float[np.ndarray, " nv"]:
    """Gradient of log mu = grad mu / mu [1/rad or 1/m]: free of the constraint's units.

    At a singularity it is infinite in length; the direction of `manipulability_gradient` comes back there, with the
    length that it has at the edge of what rounding can tell from a singularity.

    Raises:
        ConfigurationError: q has the wrong size or is not finite.
        ConstraintError: The arguments are in another order.
    """
    A, vjp = constraint_first(constraint, q).value_and_vjp(q)
    mu, gradient, floor = gradient_from(A.shape, svd(A), vjp)
    return gradient / max(mu, floor, np.finfo(np.float64).tiny)


@final
class ManipulabilityBatch(NamedTuple):
    """mu and its gradient at n postures.

    Attributes:
        mu: shape (n,).
        gradient: shape (n, nv), finite; at singularities the steepest ascent, see `manipulability_gradient`.
        floor: shape (n,), the mu below which a singularity cannot be told from rounding; 0 where that is far away.
    """

    mu: Float[np.ndarray, " n"]
    gradient: Float[np.ndarray, "n nv"]
    floor: Float[np.ndarray, " n"]

    @property
    def log_gradient(self) -> Float[np.ndarray, "n nv"]:
        """Gradient of log mu, see `log_manipulability_gradient`."""
        return self.gradient / np.maximum(np.maximum(self.mu, self.floor), np.finfo(np.float64).tiny)[:, None]


def manipulability_batch(constraint: Constraint, q: ArrayLike) -> ManipulabilityBatch:
    """mu(q) and its gradient at n postures, the rows of q.

    Args:
        constraint: A(q).
        q: Configurations (nq) or joint positions (nv), one per row.

    Raises:
        ConfigurationError: Wrong size or not finite; names the first bad row and joint.
        ConstraintError: The arguments are in another order.
    """
    selection, features = constraint_first(constraint, q).selection, constraint.features
    postures, nv = np.asarray(q, dtype=np.float64), constraint.nv
    if constraint.robot is not None:
        constraint.robot.checked_postures(postures)  # here, where a row's number is that of the caller
    n, s = len(postures), len(selection)
    out = ManipulabilityBatch(np.zeros(n), np.zeros((n, nv)), np.zeros(n))
    for start in range(0, n if s <= nv else 0, 512):  # postures whose dA/dq are held at a time
        part = slice(start, start + 512)
        Phi, dPhi = features.batch_with_derivative(postures[part])
        U, sigma, Vt = np.linalg.svd(selection @ Phi, full_matrices=False)
        others = np.stack([np.prod(np.delete(sigma, i, axis=1), axis=1) for i in range(s)], axis=1)
        weights = selection.T @ (U * others[:, None]) @ Vt
        floor, lost = SINGULAR_RATIO * sigma[:, 0] * others[:, -1], sigma[:, -1] <= SINGULAR_RATIO * sigma[:, 0]
        out.mu[part], out.floor[part] = others[:, 0] * sigma[:, 0], np.where(lost, floor, 0.0)
        out.gradient[part] = np.einsum("nij,nijk->nk", weights, dPhi, optimize=True)
        for i in start + np.flatnonzero(lost):
            out.gradient[i] = manipulability_gradient(constraint, postures[i])
    return out


def gradient_from(shape: tuple[int, ...], decomposition: Decomposition, vjp: Vjp) -> tuple[float, np.ndarray, float]:
    """mu, its gradient, and the mu below which a singularity cannot be told from rounding.

    From the shape of A, its decomposition, and weights -> sum_ij weights_ij dA_ij / dq_k:

    d mu / d q_k = sum_i (prod_{j != i} sigma_j) u_i^T (dA / dq_k) v_i.
    """
    s, nv = shape
    if s > nv:
        return 0.0, np.zeros(nv), 0.0
    U, sigma, Vt = decomposition
    values = sigma.tolist()
    others = products_of_others(values)
    mu = others[0] * values[0]
    floor = SINGULAR_RATIO * values[0] * others[-1]
    if values[-1] <= SINGULAR_RATIO * values[0]:
        # a cone, mu(q + step) = |M step| prod_{j < s} sigma_j
        rate, direction = _steepest(U[:, -1:].T, Vt[s - 1 :], vjp)
        return mu, others[-1] * rate * direction, floor
    # W = sum_i others_i u_i v_i^T, so that the gradient is one vector-Jacobian product
    return mu, vjp((U * others).dot(Vt[:s])), floor


def smallest_gradient(decomposition: Decomposition, vjp: Vjp) -> Float[np.ndarray, " nv"]:
    """d sigma_min / dq = u_min^T (dA / dq) v_min, for a smallest singular value that is neither 0 nor double."""
    U, sigma, Vt = decomposition
    k = len(sigma)
    return vjp(U[:, k - 1 : k].dot(Vt[k - 1 : k]))


def products_of_others(sigma: Sequence[float]) -> list[float]:
    """Return prod_{j != i} sigma_j for each i, without a division."""
    return [math.prod((*sigma[:i], *sigma[i + 1 :]), start=1.0) for i in range(len(sigma))]


def _steepest(
    lost: Float[np.ndarray, "r s"], null: Float[np.ndarray, "k nv"], vjp: Vjp
) -> tuple[float, Float[np.ndarray, " nv"]]:
    """Rate and direction of the steepest ascent of |M step|, M_rk = u_i^T (dA / dq_k) v_j for r = (i, j).

    They are the leading singular value and the right singular vector of M (docs/mathematics.md, the gradient of mu); of
    two opposite directions the one whose largest entry is positive.
    """
    M = np.stack([vjp(np.outer(u, v)) for u in lost for v in null])
    _, rate, Wt = np.linalg.svd(M, full_matrices=False)
    direction = Wt[0]
    return float(rate[0]), -direction if direction[np.argmax(np.abs(direction))] < 0.0 else direction


def svd(A: Float[np.ndarray, "s n"]) -> Decomposition:
    """Return U, the singular values, and V^T, all square.

    By LAPACK's dgesdd without NumPy's wrapping, which takes longer than to decompose a matrix as small as a
    constraint's.
    """
    U, sigma, Vt, failed = dgesdd(A)
    return np.linalg.svd(A, full_matrices=True) if failed else (U, sigma, Vt)
