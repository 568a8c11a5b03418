"""The point of a polytope that is nearest to another: the quadratic program behind bounded commands."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Literal

import daqp
import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dposv  # pyright: ignore[reportAttributeAccessIssue]

from manip_learn.errors import ConstraintError

# how much a bound may be exceeded by rounding, in the unit of the bounds
TOLERANCE = 1e-11
# a row whose part outside the active rows is shorter than this share of it depends on them
DEPENDENT = 1e-18
# ... and than this share, it is projected twice
REORTHOGONAL = 1e-2

# the same for DAQP, whose answer may be off by as much: commands are compared to 1e-12
FINE = 1e-13
SOLVED, INFEASIBLE = 1, -1  # exit flags of DAQP
Solver = Literal["qp", "active-set", "compiled"]
Projection = Callable[
    [Float[np.ndarray, " k"], Float[np.ndarray, "m k"], Float[np.ndarray, " m"], Float[np.ndarray, " m"]],
    "Float[np.ndarray, ' k'] | None",
]


def projection_by(solver: Solver) -> Projection:
    """A solver by its name; "compiled" (see `CompiledLimits`) has DAQP where it does not serve.

    Raises:
        ConstraintError: Unknown name.
    """
    if solver not in ("qp", "active-set", "compiled"):
        raise ConstraintError(f"solver must be 'qp', 'active-set' or 'compiled', not {solver!r}")
    return project_by_active_set if solver == "active-set" else project_by_daqp


def project_by_daqp(
    x: Float[np.ndarray, " k"],
    C: Float[np.ndarray, "m k"],
    low: Float[np.ndarray, " m"],
    high: Float[np.ndarray, " m"],
) -> Float[np.ndarray, " k"] | None:
    """argmin |y - x|^2 subject to low <= C y <= high, or None if no point meets the bounds.

    By DAQP, a dual active-set solver in C (Arnstrom, Bemporad and Axehill, "A dual active-set solver for embedded
    quadratic programming using recursive LDL^T updates", 2022); where it gives up, by `project_by_active_set`.
    """
    y, _, exit_flag, _ = daqp.solve(_unit(x.shape[0]), -x, C, high, low, _inequalities(low.shape[0]), primal_tol=FINE)
    if exit_flag == SOLVED:
        return np.asarray(y)
    # where 0 is the only point, or one of few, DAQP may not see it
    if exit_flag == INFEASIBLE and not (low.max() <= 0.0 <= high.min()):
        return None
    return project_by_active_set(x, C, low, high)


@cache
def _unit(size: int) -> np.ndarray:
    return np.eye(size)  # DAQP takes no array that may not be written to, and does not write


@cache
def _inequalities(size: int) -> np.ndarray:
    return np.zeros(size, dtype=np.int32)


def project_by_active_set(
    x: Float[np.ndarray, " k"],
    C: Float[np.ndarray, "m k"],
    low: Float[np.ndarray, " m"],
    high: Float[np.ndarray, " m"],
) -> Float[np.ndarray, " k"] | None:
    """The same by the dual active-set method of Goldfarb and Idnani (1983), without another library.

    Starts from x itself, and brings the row that is exceeded most to its bound, one after another; rows whose
    multiplier would change its sign are let go. The answer depends continuously on all arguments.

    Args:
        x: The point.
        C: One row per constraint.
        low: Lower bounds.
        high: Upper bounds.

    Returns:
        The nearest point; None if no point meets the bounds.
    """
    active: list[int] = []
    bounds: list[float] = []
    rows = np.empty((0, x.shape[0]))  # outward normals of the active rows
    multipliers = np.empty(0)
    y = x
    for _ in range(8 * C.shape[0]):
        reached = C.dot(y)
        beyond = np.maximum(reached - high, low - reached)
        beyond[active] = 0.0
        worst = int(beyond.argmax())
        excess = float(beyond[worst])
        if excess <= TOLERANCE:
            return y if not active else _on_faces(x, y, rows, np.array(bounds))
        above = reached[worst] > high[worst]
        normal, bound = (C[worst], float(high[worst])) if above else (-C[worst], -float(low[worst]))
        square, multiplier = float(normal.dot(normal)), 0.0
        while True:
            r, direction = _across(rows, normal, square) if active else (multipliers, normal)
            slope = float(direction.dot(direction))
            full = excess / slope if slope > DEPENDENT * square else np.inf
            falling = np.flatnonzero(r > 0.0)
            partial, leaving = np.inf, -1
            if falling.size:
                ratios = multipliers[falling] / r[falling]
                leaving = int(falling[ratios.argmin()])
                partial = float(ratios.min())
            step = min(full, partial)
            if step == np.inf:
                return None
            multipliers = multipliers - step * r
            multiplier += step
            if full < np.inf:
                y = y - step * direction
                excess -= step * slope
            if step == full:
                active.append(worst)
                bounds.append(bound)
                rows = np.vstack((rows, normal))
                multipliers = np.append(multipliers, multiplier)
                break
            del active[leaving], bounds[leaving]
            rows = np.delete(rows, leaving, axis=0)
            multipliers = np.delete(multipliers, leaving)
    return None


def _across(rows: np.ndarray, normal: np.ndarray, square: float) -> tuple[np.ndarray, np.ndarray]:
    """(r, normal - r rows): a normal without its part along the active rows."""
    gram = rows.dot(rows.T)
    _, r, failed = dposv(gram, rows.dot(normal))
    if failed:
        r = np.linalg.lstsq(rows.T, normal, rcond=None)[0]
    direction = normal - r.dot(rows)
    if failed or direction.dot(direction) > REORTHOGONAL * square:
        return r, direction
    # the square of the condition number is in the Gram matrix: once more, for what rounding has left
    _, more, failed = dposv(gram, rows.dot(direction))
    return (r, direction) if failed else (r + more, direction - more.dot(rows))


def _on_faces(x: np.ndarray, y: np.ndarray, rows: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """The nearest point to x with rows y = bounds, without the rounding of the steps that led to y."""
    gram = rows.dot(rows.T)
    _, multipliers, failed = dposv(gram, rows.dot(x) - bounds)
    if failed:
        return y
    nearest = x - multipliers.dot(rows)
    _, more, _ = dposv(gram, rows.dot(nearest) - bounds)
    return nearest - more.dot(rows)
