"""The joint velocity within bounds that keeps most of a task, and the quadratic program behind it."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from operator import truediv
from typing import Literal, NamedTuple, final

import daqp
import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dgels  # pyright: ignore[reportAttributeAccessIssue]

from manip_learn.constraint.small_matrices import svd
from manip_learn.control.limits import Barrier, Bounds
from manip_learn.errors import ConstraintError

# how much a bound may be exceeded by rounding, in the unit of the bounds
TOLERANCE = 1e-11
# the same for DAQP, whose answer may be off by as much: commands are compared to 1e-12
FINE = 1e-13
# a least-distance program that leaves less than this of the 1 has no solution: its nearest point would be that far away
INSIDE = 1e-12
SMALL = 1e-300  # keeps a quotient of two zeros finite
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
    x: Float[np.ndarray, " k"], C: Float[np.ndarray, "m k"], low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"]
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
    x: Float[np.ndarray, " k"], C: Float[np.ndarray, "m k"], low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"]
) -> Float[np.ndarray, " k"] | None:
    """The nearest point y to x with low <= C y <= high; None if no point meets the bounds.

    With G z >= h for z = y - x, and the multipliers u >= 0 that bring (G^T u, h^T u) nearest to (0, 1), z is G^T u over
    what is left of the 1 (Lawson and Hanson, "Solving Least Squares Problems", 1974, chapter 23). Rows enter one by
    one, the one that is exceeded most first. SciPy's `nnls` would do, but takes 0.2 s to load.
    """
    G, bound = np.concatenate((C, -C)), np.concatenate((low, -high))
    lengths = np.sqrt(np.einsum("ij,ij->i", G, G))
    if np.any(bound[lengths == 0.0] > TOLERANCE):
        return None
    counts = (bound > -np.inf) & (lengths > 0.0)
    G, bound = G[counts] / lengths[counts, None], bound[counts] / lengths[counts]
    h = bound - G.dot(x)
    far, z, u = max(float(h.max(initial=0.0)), TOLERANCE), np.zeros(x.shape[0]), np.empty(0)
    E, aim, active = np.column_stack((G, h / far)), np.append(z, 1.0), np.empty(0, np.intp)
    for _ in range(8 * len(h)):
        excess = h - G.dot(z)
        excess[active] = 0.0
        if excess.max(initial=0.0) <= TOLERANCE:
            return _on_faces(x, G[active], bound[active]) if active.size else x
        active, u = np.append(active, excess.argmax()), np.append(u, 0.0)
        while active.size and (wanted := dgels(E[active].T, aim)[1][: active.size]).min() <= 0.0:
            shares = np.where(wanted <= 0.0, u / np.maximum(u - wanted, SMALL), np.inf)
            leaving = int(shares.argmin())
            u = np.delete(u + shares[leaving] * (wanted - u), leaving)
            active = np.delete(active, leaving)
        *pull, left = aim - (u := wanted).dot(E[active])
        if left < INSIDE:
            return None
        z = np.array(pull) * (-far / left)
    return None


def _on_faces(x: np.ndarray, rows: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """The nearest point to x with rows y = bounds, corrected once for its own rounding."""
    for _ in range(2):
        x = x + np.linalg.lstsq(rows, bounds - rows.dot(x), rcond=None)[0]
    return x


# weight of the task's scale against the null-space policy, in multiples of the task part
TASK_WEIGHT = 100.0
# the weight grows with the policy's speed up to this multiple of the task's
LARGEST_RATIO = 1e3
# weight of the task's velocity against joint velocities, where its direction cannot be kept
DEVIATION_WEIGHT = 1e2
NEGLIGIBLE = 1e-12
# [rad/s or m/s] by how much rounding may exceed a bound
ROUNDING = 1e-9


@final
class BoundedVelocity(NamedTuple):
    """A joint velocity within bounds.

    Attributes:
        velocity: shape (nv,) [rad/s or m/s].
        task_scale: Factor s on the task, A velocity = s b; above 1 where the arm cannot slow down fast enough.
        null_part: Its component in the null space of A.
    """

    velocity: Float[np.ndarray, " nv"]
    task_scale: float
    null_part: Float[np.ndarray, " nv"]


@final
class Desired(NamedTuple):
    """The parts of a command before bounds.

    Attributes:
        task: A^+ b.
        null: N pi.
        escape: Velocity out of a singularity; zero away from one.
    """

    task: Float[np.ndarray, " nv"]
    null: Float[np.ndarray, " nv"]
    escape: Float[np.ndarray, " nv"] | None


def bounded_velocity(
    A: Float[np.ndarray, "s nv"],
    desired: Desired,
    null: Float[np.ndarray, "nv k"],
    bounds: Bounds,
    fastest: Float[np.ndarray, " nv"],
    barrier: Barrier | None,
    project: Projection,
    slide: float = 0.0,
    damping: float = 0.05,
    decomposition: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
) -> BoundedVelocity:
    """The velocity within the bounds that keeps the direction of the task.

    With the null basis Z of A, v = A^+ b slowed down to the velocity limits and w = N pi, in the unknowns y and s

        min |Z y - w|^2 + TASK_WEIGHT^2 max(|v|, |w|)^2 (s* - s)^2  subject to  low <= s v + Z y <= high,  0 <= s <= 1

    This is saturation in the null space (Flacco, De Luca and Khatib, "Control of redundant robots under hard joint
    constraints: saturation in the null space", 2015) as a quadratic program: null-space motion makes room for the task
    before the task slows down. The program is strictly convex, so that its solution is continuous in all data. s* is 1,
    and less where v + w would approach a singularity too fast: null-space motion makes no room for that.

    Where no s is possible (the arm cannot brake fast enough along the task's direction), the direction is kept as well
    as possible: with u* = v + w, and P the projector across b,

        min (DEVIATION_WEIGHT / sigma_1)^2 |P A (u - u*)|^2 + |u - u*|^2    subject to    low <= u <= high

    With `slide`, P = I and the factor is 1 / damping: the arm comes as near to the task's velocity as the bounds allow.

    Args:
        A: Constraint matrix.
        desired: Parts of the command before bounds.
        null: Z with Z Z^T = N, or the projector N itself, which serves as well.
        bounds: Lowest and highest velocities allowed.
        fastest: Velocity limits.
        barrier: (G, least) for the constraints G u >= least, on the approach to a singularity first, where there is
            one, then on the speeds of frames; None without.
        project: Solver of the quadratic program.
        slide: 0 keeps the task's direction, 1 slides along what blocks it; in between their mean.
        damping: Singular value of A below which sliding is damped.
        decomposition: U, singular values and V^T of A, where they are known.
    """
    nv = null.shape[0]
    for barred in (barrier, None) if barrier is not None else (None,):
        # rows of the programs: joints, barrier, and the task's scale
        least = [] if barred is None else barred[1].tolist()
        m = nv + len(least) + 1
        low = np.fromiter([*bounds.low, *least, 0.0], np.float64, m)
        high = np.fromiter([*bounds.high, *[math.inf] * len(least), 1.0], np.float64, m)
        program = _Program(low, high, barred, project)
        found = _bounded(A, desired, null, fastest, program, slide, damping, decomposition)
        if found is not None:
            reached = found.velocity.tolist()
            joints = zip(reached, bounds.low, bounds.high, strict=True)
            within = [least if u < least else most if u > most else u for u, least, most in joints]
            if math.dist(within, reached) <= ROUNDING:
                return BoundedVelocity(np.array(within), found.task_scale, found.null_part)
    # a box always holds a point; this is for a solver that gave up
    u = np.clip(desired.task + desired.null, bounds.low, bounds.high)
    return BoundedVelocity(u, 0.0, np.zeros_like(u))


def _bounded(
    A: np.ndarray,
    desired: Desired,
    Z: np.ndarray,
    fastest: np.ndarray,
    program: _Program,
    slide: float,
    damping: float,
    decomposition: tuple[np.ndarray, np.ndarray, np.ndarray] | None,
) -> BoundedVelocity | None:
    v, w, e = desired
    too_fast = max(1.0, *map(truediv, map(abs, v.tolist()), fastest.tolist()))
    if too_fast > 1.0:  # slowed down to the velocity limits, before null-space motion makes room for it
        v = v / too_fast
    rest = w if e is None else w + e
    scale = approach_scale(v, rest, program.barrier)
    wish, along = scale * v + rest, program.along(v, scale, w, e, Z)
    if along is not None:
        u, s = along
    else:
        b = A @ v
        length = math.sqrt(b.dot(b))
        across = A if length < NEGLIGIBLE else A - np.outer(b / length, (b / length) @ A)
        decomposition = decomposition or svd(A)
        u = program.nearest(wish, svd(across), float(decomposition[1][0]) / DEVIATION_WEIGHT)
        if u is None:
            return None
        s = 0.0 if length < NEGLIGIBLE else max(0.0, float(b @ (A @ u)) / length**2)
    if slide > 0.0:
        slid = program.nearest(wish, decomposition or svd(A), damping)
        if slid is not None:
            u = u + slide * (slid - u)
    null_part = Z.dot(u) if Z.shape[0] == Z.shape[1] else Z.dot(u.dot(Z))
    return BoundedVelocity(u, s / too_fast, null_part)


def approach_scale(v: np.ndarray, rest: np.ndarray, barrier: Barrier | None) -> float:
    """Largest factor on v, 0 to 1, with which `v + rest` is no faster than the barrier allows."""
    scale = 1.0
    if barrier is not None:
        for g, least in zip(*barrier, strict=True):
            approach = -float(g.dot(v))
            if approach > 0.0:
                scale = min(scale, max(0.0, (float(g.dot(rest)) - least) / approach))
    return scale


@final
class _Program(NamedTuple):
    """Bounds on the joints, the barrier and, last, the task's scale; the barrier's rows, and who solves the program."""

    low: np.ndarray
    high: np.ndarray
    barrier: Barrier | None
    project: Projection

    def along(
        self, v: np.ndarray, scale: float, w: np.ndarray, e: np.ndarray | None, Z: np.ndarray
    ) -> tuple[np.ndarray, float] | None:
        """The first program: (u, s), or None if the bounds allow no s >= 0."""
        nv, at = Z.shape
        length, speed = math.sqrt(v.dot(v)), 0.0 if e is None else math.sqrt(e.dot(e))
        moves, escapes = length > NEGLIGIBLE, speed > NEGLIGIBLE
        # a slow task comes first beside a fast policy, too
        weight = TASK_WEIGHT * max(length, min(math.sqrt(w.dot(w)), LARGEST_RATIO * length))
        k, rows = at + moves + escapes, self.low.shape[0] - (not moves)
        # the unknowns are y, weight * s, and the escape's speed
        C, start = np.zeros((rows, k)), np.empty(k)
        basis = C[:nv]
        # the projector leaves a null-space motion as it is
        basis[:, :at], start[:at] = Z, w if at == nv else w.dot(Z)
        if moves:
            basis[:, at], start[at], C[-1, at] = v / weight, weight * scale, 1.0 / weight
        if e is not None and escapes:
            basis[:, -1], start[-1] = e / speed, speed
        if self.barrier is not None:
            C[nv : nv + self.barrier[0].shape[0]] = self.barrier[0].dot(basis)
        y = self.project(start, C, self.low[:rows], self.high[:rows])
        if y is None and moves:  # too fast to brake: farther along b is better than beside it
            y = self.project(start, C, self.low, np.append(self.high[:-1], math.inf))
        if y is None:
            return None
        return basis.dot(y), float(y[at]) / weight if moves else 1.0

    def nearest(
        self, wish: np.ndarray, decomposition: tuple[np.ndarray, np.ndarray, np.ndarray], damping: float
    ) -> np.ndarray | None:
        """The second program: the velocity within the bounds that is nearest, mostly in the rows decomposed."""
        _, sigma, Vt = decomposition
        nv, scale = Vt.shape[0], 1.0 / max(damping, 1e-300)
        root = np.array([math.hypot(1.0, scale * x) for x in sigma.tolist()] + [1.0] * (nv - sigma.shape[0]))
        rows = np.empty((self.low.shape[0] - 1, nv))
        C = np.divide(Vt.T, root, out=rows[:nv])  # u = C x
        if self.barrier is not None:
            rows[nv:] = self.barrier[0].dot(C)
        x = self.project(root * Vt.dot(wish), rows, self.low[:-1], self.high[:-1])
        return None if x is None else C.dot(x)
