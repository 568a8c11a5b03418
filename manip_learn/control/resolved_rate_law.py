"""The law u = A^+ b + N pi before limits, in every posture: NumPy runs it, and numba compiles the same source."""

from __future__ import annotations

import math
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import Vjp
from manip_learn.constraint.manipulability import SINGULAR_RATIO
from manip_learn.constraint.small_matrices import complement, dot, row_inverse, svd
from manip_learn.control.bounded_velocity import Desired
from manip_learn.control.limits import LimitTable, freer_sense
from manip_learn.control.singularity import (
    APPROACH_RATE,
    BRAKING_SHARE,
    Ascent,
    Decomposition,
    ascent_near_singularity,
    ascent_velocity,
    climbing_direction,
    escape_velocity,
    pressed_damping,
    smallest_gradient,
    smallest_gradient_of,
    stable_damping,
)
from manip_learn.linalg import damped_inverse
from manip_learn.robot.weighted_vjp import gradient

# width of the escape from a singularity, as a share of the singular value at which damping sets in
ESCAPE_WIDTH = 0.6
TINY = float(np.finfo(np.float64).tiny)
INVERSES = ("damped", "exact", "truncated")
DAMPED, EXACT, TRUNCATED = range(3)


@final
class LawSettings(NamedTuple):
    """What the law is told once.

    Attributes:
        inverse: Kind of A^+, its place in `INVERSES`.
        threshold: Singular value of A at which damping sets in.
        damping: Damping factor at a singular value of 0.
        climbs: Whether the null-space policy is an ascent of A's own mu, which the law computes itself.
        ascent: That policy.
        escapes: Whether singularities are left.
        limited: Whether commands are kept within limits.
        by_library: Whether programs are solved by DAQP where it is at hand.
    """

    inverse: int
    threshold: float
    damping: float
    climbs: bool
    ascent: Ascent
    escapes: bool
    limited: bool
    by_library: bool


@final
class Asked(NamedTuple):
    """What is asked of one posture.

    Attributes:
        A: Constraint matrix, whose mu is climbed.
        rows: Those whose velocity b is: A itself, or those of an error (`Task.error_jacobian`).
        own: Whether they are A itself.
        b: Task velocity.
        pi: Velocity of a null-space policy that does not climb A's own mu.
        q: Joint positions [rad or m].
        dt: Time for which the command is held [s].
    """

    A: Float[np.ndarray, "s nv"]
    rows: Float[np.ndarray, "s nv"]
    own: bool
    b: Float[np.ndarray, " s"]
    pi: Float[np.ndarray, " nv"]
    q: Float[np.ndarray, " nv"]
    dt: float


@final
class Law(NamedTuple):
    """Equation (2) at one posture, before limits.

    Attributes:
        A: The rows whose velocity b is.
        b: Task velocity.
        desired: A^+ b, N pi and the velocity out of a singularity.
        escapes: Whether there is a velocity out of singularities, be it zero.
        mu: Manipulability.
        smallest: Smallest singular value.
        singular: Whether a direction is lost.
        regular: Whether A is well-conditioned.
        basis: A^{+T} where it is, and otherwise Z^T with Z Z^T = N.
        sloped: Whether `slope` is known.
        slope: Gradient of the smallest singular value.
        barred: Whether the approach to the rows' singularities is bounded.
    """

    A: Float[np.ndarray, "s nv"]
    b: Float[np.ndarray, " s"]
    desired: Desired
    escapes: bool
    mu: float
    smallest: float
    singular: bool
    regular: bool
    basis: Float[np.ndarray, "k nv"]
    sloped: bool
    slope: Float[np.ndarray, " nv"]
    barred: bool


def law_at(settings: LawSettings, limits: LimitTable, asked: Asked, motion: Vjp) -> Law:
    """The parts of the law at a posture.

    Args:
        settings: Of the law.
        limits: Of the robot; of no meaning where there are none.
        asked: Rows and velocities.
        motion: Vector-Jacobian product of A.
    """
    A = asked.A
    X, mu, smallest = row_inverse(A)
    if not asked.own:
        return _of_error_rows(settings, limits, asked, motion, X, mu)
    if not is_regular(settings, mu, smallest):
        return _near_singularity(settings, limits, asked, motion, mu)
    # nothing to damp or to truncate, the case of nearly every step
    pi = ascent_velocity(settings.ascent, gradient(motion, X), mu, asked.dt) if settings.climbs else asked.pi
    return regular_law(asked, pi, X, mu, smallest)


def is_regular(settings: LawSettings, volume: float, smallest: float) -> bool:
    """Whether rows are inverted as they are, by what `row_inverse` says of them."""
    return volume > 0.0 and not (settings.inverse == DAMPED and smallest < settings.threshold)


def regular_law(
    asked: Asked, pi: Float[np.ndarray, " nv"], X: Float[np.ndarray, "s nv"], mu: float, smallest: float
) -> Law:
    """The law from X = A^{+T}: N pi = pi - A^+ (A pi)."""
    A, b = asked.rows, asked.b
    none = np.zeros(pi.shape[0])
    return Law(
        A=A,
        b=b,
        desired=Desired(dot(b, X), pi - dot(dot(A, pi), X), none),
        escapes=False,
        mu=mu,
        smallest=smallest,
        singular=False,
        regular=True,
        basis=X,
        sloped=False,
        slope=none,
        barred=asked.own,
    )


def _of_error_rows(
    settings: LawSettings, limits: LimitTable, asked: Asked, motion: Vjp, X: Float[np.ndarray, "s nv"], mu: float
) -> Law:
    """The law with the rows of an error in the place of A (see `Task.error_jacobian`); mu and its ascent are A's."""
    A, pi = asked.A, asked.pi
    if mu > 0.0 and settings.climbs:
        pi = ascent_velocity(settings.ascent, gradient(motion, X), mu, asked.dt)
    elif mu == 0.0:
        U, sigma, Vt = svd(A)
        if A.shape[0] <= A.shape[1]:
            mu = _volume(sigma)
            if settings.climbs:
                decomposition = Decomposition(U, sigma, Vt)
                climb = climbing_direction(decomposition, motion)
                pi = ascent_near_singularity(settings.ascent, decomposition, climb, motion, asked.dt)
    X, volume, smallest = row_inverse(asked.rows)
    if is_regular(settings, volume, smallest):
        return regular_law(asked, pi, X, mu, smallest)
    asked = Asked(A, asked.rows, False, asked.b, pi, asked.q, asked.dt)
    return _near_singularity(settings, limits, asked, motion, mu)


def _near_singularity(settings: LawSettings, limits: LimitTable, asked: Asked, motion: Vjp, mu: float) -> Law:
    """The law by the singular value decomposition; `mu` is that of other rows than A."""
    A, b, own, dt, threshold = asked.rows, asked.b, asked.own, asked.dt, settings.threshold
    U, sigma, Vt = svd(A)
    decomposition = Decomposition(U, sigma, Vt)
    s, nv, k = A.shape[0], A.shape[1], sigma.shape[0]
    smallest, fits, along = float(sigma[k - 1]), s <= nv, dot(b, U)
    singular = smallest <= SINGULAR_RATIO * sigma[0]
    pi, climb = asked.pi, np.zeros(nv)
    slope = climb
    if own and fits and (settings.climbs or settings.escapes):
        if settings.escapes or settings.ascent.logarithmic:
            climb = climbing_direction(decomposition, motion)
        if settings.climbs:
            pi = ascent_near_singularity(settings.ascent, decomposition, climb, motion, dt)
    brakes = settings.inverse == DAMPED and settings.limited
    task = task_part(settings, decomposition, along, settings.damping)
    stable = stable_damping(sigma, along, threshold, dt)
    presses = brakes and stable > settings.damping
    sloped = not singular and (presses or (own and fits and (brakes or settings.escapes)))
    if sloped:
        slope = smallest_gradient(decomposition, motion)
    if sloped and presses:
        damping = pressed_damping(settings.damping, stable, slope, task)
        task = task_part(settings, decomposition, along, damping)
    Z = Vt[rank_of(sigma, max(s, nv)) :]
    escape = np.zeros(nv)
    if settings.escapes and own:
        escape = escape_velocity(decomposition, climb, slope, dt, ESCAPE_WIDTH * threshold)
        if singular and settings.limited:
            # mu rises in both directions out of a singularity: a limit in one of them is no reason to stay
            escape = freer_sense(limits.lower, limits.upper, asked.q, escape)
    if own:
        mu = _volume(sigma) if fits else 0.0
    return Law(
        A=A,
        b=b,
        desired=Desired(task, dot(dot(Z, pi), Z), escape),
        escapes=settings.escapes and own,
        mu=mu,
        smallest=smallest,
        singular=singular,
        regular=False,
        basis=Z,
        sloped=sloped,
        slope=slope,
        barred=own,
    )


def task_part(
    settings: LawSettings, decomposition: Decomposition, along: Float[np.ndarray, " s"], damping: float
) -> Float[np.ndarray, " nv"]:
    """A^+ b = V diag(g) U^T b, see `ResolvedRateController`."""
    U, sigma, Vt = decomposition
    gains = np.zeros(sigma.shape[0])
    least = TINY if settings.inverse == EXACT else matlab_tolerance(sigma, max(U.shape[0], Vt.shape[0]))
    for i in range(sigma.shape[0]):
        if settings.inverse == DAMPED:
            gains[i] = damped_inverse(sigma[i], settings.threshold, damping) * along[i]
        elif sigma[i] > least:
            gains[i] = along[i] / sigma[i]
    return dot(gains, Vt[: sigma.shape[0]])


def rank_of(sigma: Float[np.ndarray, " k"], size: int) -> int:
    """Number of singular values above Matlab's tolerance, for the larger side of the matrix."""
    least, rank = matlab_tolerance(sigma, size), 0
    for i in range(sigma.shape[0]):
        rank += int(sigma[i] > least)
    return rank


def matlab_tolerance(sigma: Float[np.ndarray, " k"], size: int) -> float:
    """Matlab's pinv tolerance, the larger side of the matrix times eps(norm(A))."""
    return size * np.spacing(sigma[0])


def _volume(sigma: Float[np.ndarray, " k"]) -> float:
    volume = 1.0
    for i in range(sigma.shape[0]):
        volume *= sigma[i]
    return volume


def null_rows(law: Law) -> Float[np.ndarray, "k nv"]:
    """Z^T with Z Z^T = N, or N itself."""
    return complement(law.A, law.basis) if law.regular else law.basis


def approach(
    settings: LawSettings, limits: LimitTable, law: Law, motion: Vjp, u: Float[np.ndarray, " nv"]
) -> tuple[bool, Float[np.ndarray, " nv"]]:
    """Whether u could approach a singularity too fast, and the gradient of the smallest singular value there.

    Args:
        settings: Of the law.
        limits: Of the robot.
        law: At this posture.
        motion: Vector-Jacobian product of A.
        u: Joint velocity [rad/s or m/s].
    """
    A, smallest = law.A, law.smallest
    brakes = settings.inverse == DAMPED and settings.limited and law.barred
    if not brakes or law.singular or A.shape[0] > A.shape[1]:
        return False, law.slope
    flat = A.reshape(-1)
    if is_slow(limits, smallest, dot(u, u), dot(flat, flat)):
        return False, law.slope
    if law.sloped:
        return True, law.slope
    return True, smallest_gradient_of(A, law.basis, law.mu, smallest, motion)


def is_slow(limits: LimitTable, smallest: float, speed: float, size: float) -> bool:
    """Whether a velocity is too slow for a closer look at the approach to a singularity.

    Args:
        limits: Of the robot.
        smallest: Smallest singular value of A.
        speed: Square of the velocity's norm.
        size: Square of A's; |grad sigma| is about as large as A itself.
    """
    rate = min(APPROACH_RATE, 0.5 / limits.dt) * smallest
    return speed * size < min(2.0 * BRAKING_SHARE * limits.weakest * math.sqrt(size) * smallest, rate * rate)
