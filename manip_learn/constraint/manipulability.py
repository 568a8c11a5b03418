"""Manipulability of a task and its gradient, finite at singularities.

The manipulability mu(q) = sqrt(det(A A^T)), equation (4) of Manavalan and Howard, is computed as the product of the
singular values of A. Its gradient, equation (13), is computed without a division.
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
    r"""Compute the manipulability of a task, the distance from its singularities.

    Equation (4) of Manavalan and Howard, with the singular values sigma of A(q):

    .. math::

        \mu(q) = \sqrt{\det(A A^T)} = \prod_i \sigma_i

    Args:
        constraint: Constraint A(q).
        q: Joint configuration (nq,) or positions (nv,) [rad or m].

    Returns:
        The manipulability, 0 at a singularity and never NaN; its unit is the product of the units of the constraint's
        rows.

    Raises:
        ConfigurationError: q has the wrong size or is not finite.
        ConstraintError: The arguments are in the wrong order.

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
    """Return the first argument if it is a `Constraint`; raise an error otherwise.

    Args:
        constraint: Argument to check.
        q: Second argument of the calling function; the error message says if the two are swapped.

    Returns:
        The constraint.

    Raises:
        ConstraintError: The first argument is no constraint, e.g. because it is the configuration.
    """
    if not isinstance(constraint, Constraint):
        raise ConstraintError(f"the constraint comes first, then the posture: got {an(constraint)} and {an(q)}")
    return constraint


def manipulability_gradient(constraint: Constraint, q: ArrayLike) -> Float[np.ndarray, " nv"]:
    r"""Compute the gradient of the manipulability mu with respect to the joint positions, finite everywhere.

    Equation (13) of Manavalan and Howard, with the singular value decomposition of A (sigma, left vectors u, right
    vectors v):

    .. math::

        \frac{\partial \mu}{\partial q_k}
            = \sum_i \Big(\prod_{j \ne i} \sigma_j\Big) \, u_i^T \frac{\partial A}{\partial q_k} v_i

    At an exact singularity, mu is not differentiable: for a small step it grows as :math:`|M \, \mathrm{step}|`, with a
    matrix M made from dA/dq. The function then returns the direction of steepest ascent: the leading right singular
    vector of M times its singular value. Both signs of this vector increase mu; the one whose largest entry is positive
    is returned. If the rank of A drops by two or more, the gradient is zero; `ManipulabilityAscent` leads out of such
    configurations.

    Args:
        constraint: Constraint A(q).
        q: Joint configuration (nq,) or positions (nv,) [rad or m].

    Returns:
        Gradient (nv,) [unit of mu per rad or m].

    Raises:
        ConfigurationError: q has the wrong size or is not finite.
        ConstraintError: The arguments are in the wrong order.
    """
    A, vjp = require_constraint(constraint, q).value_and_vjp(q)
    return gradient_from(A.shape, svd(A), vjp)[1]


def log_manipulability_gradient(constraint: Constraint, q: ArrayLike) -> Float[np.ndarray, " nv"]:
    r"""Compute the gradient of log mu, which does not depend on the units of the constraint.

    .. math::

        \nabla \log \mu = \frac{\nabla \mu}{\mu}

    At a singularity this vector has no finite length. The function then returns a vector in the direction of
    `manipulability_gradient`, divided by the smallest mu that rounding can distinguish from 0.

    Args:
        constraint: Constraint A(q).
        q: Joint configuration (nq,) or positions (nv,) [rad or m].

    Returns:
        Gradient (nv,) [1/rad or 1/m].

    Raises:
        ConfigurationError: q has the wrong size or is not finite.
        ConstraintError: The arguments are in the wrong order.
    """
    A, vjp = require_constraint(constraint, q).value_and_vjp(q)
    mu, gradient, floor = gradient_from(A.shape, svd(A), vjp)
    return gradient / max(mu, floor, np.finfo(np.float64).tiny)


@final
class ManipulabilityBatch(NamedTuple):
    """Manipulability mu and its gradient at n configurations.

    Attributes:
        mu: Manipulability, shape (n,).
        gradient: Gradient of mu, shape (n, nv), finite; at singularities the steepest ascent, see
            `manipulability_gradient`.
        floor: shape (n,). At a configuration that rounding cannot distinguish from a singularity: the smallest mu that
            could be distinguished from 0. Elsewhere 0.
    """

    mu: Float[np.ndarray, " n"]
    gradient: Float[np.ndarray, "n nv"]
    floor: Float[np.ndarray, " n"]

    @property
    def log_gradient(self) -> Float[np.ndarray, "n nv"]:
        """Gradient of log mu, shape (n, nv), see `log_manipulability_gradient`."""
        return self.gradient / np.maximum(np.maximum(self.mu, self.floor), np.finfo(np.float64).tiny)[:, None]


def manipulability_batch(constraint: Constraint, q: ArrayLike) -> ManipulabilityBatch:
    """Compute the manipulability mu(q) and its gradient at n configurations.

    Args:
        constraint: Constraint A(q).
        q: Configurations (n, nq) or joint positions (n, nv) [rad or m], one per row.

    Returns:
        mu, its gradient and its floor at each configuration.

    Raises:
        ConfigurationError: q has the wrong size or is not finite; names the first bad row and joint.
        ConstraintError: The arguments are in the wrong order.
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
    """Compute the manipulability mu, its gradient (see `manipulability_gradient`) and the floor of mu.

    Args:
        shape: (s, nv), the shape of A.
        decomposition: Singular value decomposition of A, see `svd`.
        vjp: Vector-Jacobian product of A, see `Constraint.value_and_vjp`.

    Returns:
        mu, its gradient (nv,), and the smallest mu that rounding can distinguish from 0; all are zero if s > nv.
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
    """Compute the gradient of the smallest singular value sigma of A, u^T (dA / dq) v with its singular vectors u and
    v.

    The formula holds if sigma is not 0 and no other singular value equals it.

    Args:
        decomposition: Singular value decomposition of A, see `svd`.
        vjp: Vector-Jacobian product of A, see `Constraint.value_and_vjp`.

    Returns:
        d sigma / dq, shape (nv,).
    """
    U, sigma, Vt = decomposition
    k = len(sigma)
    return vjp(U[:, k - 1 : k].dot(Vt[k - 1 : k]))


def products_of_others(sigma: Sequence[float]) -> list[float]:
    """Return for each singular value the product of all others, without a division.

    Args:
        sigma: Singular values.

    Returns:
        One product per singular value, 1 if there are no others.
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
    """Compute the full singular value decomposition of a small matrix.

    LAPACK's dgesdd is called directly, because NumPy's wrapper takes longer than the decomposition itself.

    Args:
        A: Matrix (s, n).

    Returns:
        U (s, s), the min(s, n) singular values in descending order, and V^T (n, n).
    """
    U, sigma, Vt, failed = dgesdd(A)
    return np.linalg.svd(A, full_matrices=True) if failed else (U, sigma, Vt)
