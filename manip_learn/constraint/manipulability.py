"""Manipulability of a task and its gradient, finite at singularities.

mu(q) = sqrt(det(A A^T)), equation (4) of Manavalan and Howard, is computed as the product of the singular values of A;
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

# below this ratio to the largest singular value, rounding mixes the left singular vectors of zero and nonzero values
SINGULAR_RATIO = 64.0 * EPS
LEAST_SINGULAR_RATIO = 0.04  # smallest over largest singular value of A: well-conditioned above
# U, the singular values and V^T of A, all square
Decomposition = tuple[Float[np.ndarray, "s s"], Float[np.ndarray, " k"], Float[np.ndarray, "n n"]]


def manipulability(constraint: Constraint, q: ArrayLike) -> float:
    """Compute mu(q) = sqrt(det(A A^T)) = prod_i sigma_i, equation (4) of Manavalan and Howard.

    Args:
        constraint: A(q).
        q: Joint configuration (nq,) or positions (nv,) [rad or m].

    Returns:
        mu, 0 at a singularity and never NaN; its unit is the product of the units of the constraint's rows.

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
    return require_constraint(constraint, q).manipulability(q)


def require_constraint(constraint: Constraint, q: ArrayLike) -> Constraint:
    """Return the first argument if it is a constraint, and refuse anything else.

    Args:
        constraint: Argument to check.
        q: The other argument, named in the error message.

    Returns:
        The constraint.

    Raises:
        ConstraintError: The first argument is something else, e.g. the configuration.
    """
    if not isinstance(constraint, Constraint):
        raise ConstraintError(f"the constraint comes first, then the posture: got {an(constraint)} and {an(q)}")
    return constraint


def manipulability_gradient(constraint: Constraint, q: ArrayLike) -> Float[np.ndarray, " nv"]:
    """Compute the gradient of mu along the tangent coordinates, equation (13) of Manavalan and Howard, finite
    everywhere.

    At an exact singularity mu is a cone, |M step| to first order. The result there is its direction of steepest ascent:
    the leading right singular vector of M times its singular value. (Both signs increase mu; the one whose largest
    entry is positive is returned.) If the rank drops by two or more, mu grows with a higher power of the step and the
    gradient is zero; `ManipulabilityAscent` leads out of such configurations.

    Args:
        constraint: A(q).
        q: Joint configuration (nq,) or positions (nv,) [rad or m].

    Returns:
        shape (nv,): d mu / d q_k [unit of mu per rad or m].

    Raises:
        ConfigurationError: q has the wrong size or is not finite.
        ConstraintError: The arguments are in another order.
    """
    A, vjp = require_constraint(constraint, q).value_and_vjp(q)
    return gradient_from(A.shape, svd(A), vjp)[1]


def log_manipulability_gradient(constraint: Constraint, q: ArrayLike) -> Float[np.ndarray, " nv"]:
    """Compute the gradient of log mu = grad mu / mu, which does not depend on the units of the constraint.

    At a singularity its length is infinite. The result there has the direction of `manipulability_gradient`, and the
    length at the distance where rounding no longer distinguishes it from a singularity.

    Args:
        constraint: A(q).
        q: Joint configuration (nq,) or positions (nv,) [rad or m].

    Returns:
        shape (nv,): d log mu / d q_k [1/rad or 1/m].

    Raises:
        ConfigurationError: q has the wrong size or is not finite.
        ConstraintError: The arguments are in another order.
    """
    A, vjp = require_constraint(constraint, q).value_and_vjp(q)
    mu, gradient, floor = gradient_from(A.shape, svd(A), vjp)
    return gradient / max(mu, floor, np.finfo(np.float64).tiny)


@final
class ManipulabilityBatch(NamedTuple):
    """mu and its gradient at n configurations.

    Attributes:
        mu: shape (n,).
        gradient: shape (n, nv), finite; at singularities the steepest ascent, see `manipulability_gradient`.
        floor: shape (n,), the mu below which rounding hides the distance to a singularity; 0 if the singularity is
            farther away.
    """

    mu: Float[np.ndarray, " n"]
    gradient: Float[np.ndarray, "n nv"]
    floor: Float[np.ndarray, " n"]

    @property
    def log_gradient(self) -> Float[np.ndarray, "n nv"]:
        """Gradient of log mu, see `log_manipulability_gradient`."""
        return self.gradient / np.maximum(np.maximum(self.mu, self.floor), np.finfo(np.float64).tiny)[:, None]


def manipulability_batch(constraint: Constraint, q: ArrayLike) -> ManipulabilityBatch:
    """Compute mu(q) and its gradient at n configurations.

    Args:
        constraint: A(q).
        q: Configurations (n, nq) or joint positions (n, nv) [rad or m], one per row.

    Returns:
        mu, gradients and floors, one per row.

    Raises:
        ConfigurationError: Wrong size or not finite; names the first bad row and joint.
        ConstraintError: The arguments are in another order.
    """
    selection, features = require_constraint(constraint, q).selection, constraint.features
    postures, nv = np.asarray(q, dtype=np.float64), constraint.nv
    if constraint.robot is not None:
        constraint.robot.checked_postures(postures)  # before slicing, so that errors name the caller's row
    n, s = len(postures), len(selection)
    out = ManipulabilityBatch(np.zeros(n), np.zeros((n, nv)), np.zeros(n))
    for start in range(0, n if s <= nv else 0, 512):  # 512 configurations at a time limit the memory of dA/dq
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
    """Compute mu, its gradient, and the mu below which rounding hides the distance to a singularity.

    d mu / d q_k = sum_i (prod_{j != i} sigma_j) u_i^T (dA / dq_k) v_i.

    Args:
        shape: (s, nv), the shape of A.
        decomposition: Singular value decomposition of A, see `svd`.
        vjp: Weights (s, nv) -> sum_ij weights_ij dA_ij / dq_k, shape (nv,).

    Returns:
        mu, its gradient (nv,), and the floor of mu; all are zero if s > nv.
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
    """Compute d sigma_min / dq = u_min^T (dA / dq) v_min for a smallest singular value that is neither 0 nor double.

    Args:
        decomposition: Singular value decomposition of A, see `svd`.
        vjp: Weights (s, nv) -> sum_ij weights_ij dA_ij / dq_k, shape (nv,).

    Returns:
        shape (nv,).
    """
    U, sigma, Vt = decomposition
    k = len(sigma)
    return vjp(U[:, k - 1 : k].dot(Vt[k - 1 : k]))


def products_of_others(sigma: Sequence[float]) -> list[float]:
    """Return prod_{j != i} sigma_j for each i, without a division.

    Args:
        sigma: Singular values.

    Returns:
        One product per singular value.
    """
    return [math.prod((*sigma[:i], *sigma[i + 1 :]), start=1.0) for i in range(len(sigma))]


def _steepest(
    lost: Float[np.ndarray, "r s"], null: Float[np.ndarray, "k nv"], vjp: Vjp
) -> tuple[float, Float[np.ndarray, " nv"]]:
    """Return rate and direction of the steepest ascent of |M step|, M_rk = u_i^T (dA / dq_k) v_j for r = (i, j).

    They are the leading singular value and right singular vector of M (docs/mathematics.md, the gradient of mu); of
    two opposite directions, the one whose largest entry is positive.
    """
    M = np.stack([vjp(np.outer(u, v)) for u in lost for v in null])
    _, rate, Wt = np.linalg.svd(M, full_matrices=False)
    direction = Wt[0]
    return float(rate[0]), -direction if direction[np.argmax(np.abs(direction))] < 0.0 else direction


def svd(A: Float[np.ndarray, "s n"]) -> Decomposition:
    """Compute the singular value decomposition of A.

    It calls LAPACK's dgesdd directly: NumPy's wrapper takes longer than the decomposition of a matrix as small as a
    constraint's.

    Args:
        A: shape (s, n).

    Returns:
        U (s, s), the singular values, and V^T (n, n).
    """
    U, sigma, Vt, failed = dgesdd(A)
    return np.linalg.svd(A, full_matrices=True) if failed else (U, sigma, Vt)
