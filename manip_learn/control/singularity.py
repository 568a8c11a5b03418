"""Motion near a singularity: the way out of it, and how fast it may be approached."""

from __future__ import annotations

import math
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import Vjp
from manip_learn.constraint.manipulability import (
    SINGULAR_RATIO,
    escape_direction,
    gradient_from,
    lost_rates,
    rank_at,
)
from manip_learn.constraint.small_matrices import dot, leading, svd
from manip_learn.robot.weighted_vjp import gradient

# [rad/s] speed at which a singularity is left
ESCAPE_SPEED = 0.2
# [rad/s] speed at which an exact singularity is left, where no sense is better than its opposite
SEED_SPEED = 5e-4
# singular value up to which the seed acts, as a share of the width of the escape
SEED_SHARE = 1e-3
# an explicit step of dt can follow a velocity field whose slope is at most this over dt
STABLE_SLOPE = 0.25
# [1/s] rate at which the smallest singular value may fall where it is nearly 0
APPROACH_RATE = 20.0
# [rad/s] speed at which a singularity may be crossed
CROSSING_SPEED = 5e-4
# share of the joints' acceleration that is kept for braking before a singularity
BRAKING_SHARE = 0.5

# two singular values whose squares differ by less than this share of them have no gradients of their own
DOUBLE = 1e-9
# share of the task part along -grad sigma from which on it presses fully into a singularity
FULLY_PRESSING = 0.1


@final
class Decomposition(NamedTuple):
    """A = U diag(sigma) V^T with square U (s, s) and V^T (nv, nv)."""

    U: Float[np.ndarray, "s s"]
    sigma: Float[np.ndarray, " k"]
    Vt: Float[np.ndarray, "nv nv"]


@final
class Ascent(NamedTuple):
    """How a null-space policy climbs mu, see `ManipulabilityAscent`.

    Attributes:
        gain: [rad^2/s] for log mu.
        logarithmic: Whether log mu is climbed.
        max_speed: [rad/s]; inf for no bound.
    """

    gain: float
    logarithmic: bool
    max_speed: float


def ascent_velocity(ascent: Ascent, slope: Float[np.ndarray, " nv"], mu: float, dt: float) -> Float[np.ndarray, " nv"]:
    """gain * grad mu, or gain * grad log mu shortened to the bound.

    Args:
        ascent: The policy.
        slope: grad log mu.
        mu: Manipulability.
        dt: Time for which the velocity is held [s].
    """
    return slope * ascent_gain(ascent, dot(slope, slope), mu, dt)


def ascent_gain(ascent: Ascent, square: float, mu: float, dt: float) -> float:
    """The factor on grad log mu, whose norm has this square."""
    if not ascent.logarithmic:
        return ascent.gain * mu
    if ascent.max_speed == math.inf:
        return ascent.gain
    steepness = math.sqrt(square)
    ramp = dt * ascent.max_speed * steepness / STABLE_SLOPE  # r / sigma
    longest = ascent.max_speed / math.sqrt(1.0 + ramp * ramp)
    return ascent.gain if ascent.gain * steepness <= longest else longest / steepness


def ascent_near_singularity(
    ascent: Ascent, decomposition: Decomposition, climb: Float[np.ndarray, " nv"], motion: Vjp, dt: float
) -> Float[np.ndarray, " nv"]:
    """The same by the singular value decomposition of A, for no more rows than joints, at a singularity too.

    Args:
        ascent: The policy.
        decomposition: Of A(q).
        climb: See `climbing_direction`.
        motion: Vector-Jacobian product of A.
        dt: Time for which the velocity is held [s].
    """
    sigma, Vt = decomposition.sigma, decomposition.Vt
    s = sigma.shape[0]
    singular = sigma[s - 1] <= SINGULAR_RATIO * sigma[0]
    if ascent.logarithmic and not singular:
        return ascent_velocity(ascent, climb, 0.0, dt)
    if ascent.logarithmic and ascent.max_speed < math.inf:
        return min(ascent.max_speed, SEED_SPEED) * climb
    if ascent.logarithmic and s > 1 and sigma[s - 2] <= SINGULAR_RATIO * sigma[0]:
        return escape_direction(decomposition, motion) * (ascent.gain / SINGULAR_RATIO)
    mu, slope, floor = gradient_from((s, Vt.shape[0]), decomposition, motion)
    return slope * (ascent.gain / max(mu, floor, 1e-300) if ascent.logarithmic else ascent.gain)


def climbing_direction(decomposition: Decomposition, motion: Vjp) -> Float[np.ndarray, " nv"]:
    """grad log mu; at a singularity itself `steepest_ascent`; for no more rows than joints."""
    U, sigma, Vt = decomposition
    s = sigma.shape[0]
    if sigma[s - 1] <= SINGULAR_RATIO * sigma[0]:
        return steepest_ascent(decomposition, motion)
    return gradient(motion, dot(U / sigma, Vt[:s]))


def smallest_gradient(decomposition: Decomposition, motion: Vjp) -> Float[np.ndarray, " nv"]:
    """d sigma_min / dq = u_min^T (dA / dq) v_min, for a singular value that is neither 0 nor double."""
    U, sigma, Vt = decomposition
    k = sigma.shape[0]
    return gradient(motion, U[:, k - 1].copy().reshape((-1, 1)) * Vt[k - 1])


def smallest_gradient_of(
    A: Float[np.ndarray, "s nv"], X: Float[np.ndarray, "s nv"], mu: float, smallest: float, motion: Vjp
) -> Float[np.ndarray, " nv"]:
    """The same away from singularities, from A, A^{+T} and mu."""
    s = A.shape[0]
    if s == 1:
        return gradient(motion, A) / smallest
    if s == 2:  # A^{+T} - A / sigma_1^2 has no part along v_1
        square = (mu / smallest) ** 2
        gap = square - smallest * smallest
        if gap > DOUBLE * square:
            return gradient(motion, X - A * (1.0 / square)) * (smallest * square / gap)
    U, sigma, Vt = svd(A)
    return smallest_gradient(Decomposition(U, sigma, Vt), motion)


def escape_velocity(
    decomposition: Decomposition,
    climb: Float[np.ndarray, " nv"],
    slope: Float[np.ndarray, " nv"],
    dt: float,
    width: float,
) -> Float[np.ndarray, " nv"]:
    """Joint velocity out of a singularity, along the directions v_i whose singular values are below `width`.

    The exact projector N leaves no motion along a direction that is nearly lost, and none that climbs out where mu is
    level along the null space. There the task is not exact either (it is damped), and this velocity is added:

        e = speed * d / |d|,   d = sum_i (1 - (sigma_i / width)^2)^2 v_i v_i^T grad log mu,   sum over sigma_i < width
        speed = ESCAPE_SPEED (1 - (sigma / width)^2)^2 sigma / sqrt(sigma^2 + r^2),  sigma the smallest,
        r = dt ESCAPE_SPEED |grad sigma| / STABLE_SLOPE

    It vanishes at the singularity itself, so that it is continuous there and an explicit step of dt can follow it; it
    grows exponentially beside it, in STABLE_SLOPE / dt per second at most. At the singularity itself, `SEED_SPEED`
    along the steepest ascent of mu among the directions that A does not see starts the motion. It disturbs the task by
    A e, at most ESCAPE_SPEED sigma. Where A has more rows than columns, every posture is singular: zero.

    Args:
        decomposition: Of A(q).
        climb: See `climbing_direction`.
        slope: Gradient of the smallest singular value; of no use at the singularity itself.
        dt: Time for which the velocity is held [s].
        width: Singular value at which it ends, in the constraint's units.
    """
    U, sigma, Vt = decomposition
    s, nv = U.shape[0], Vt.shape[0]
    smallest = sigma[sigma.shape[0] - 1]
    if s > nv or smallest >= width:
        return np.zeros(nv)
    seed = SEED_SPEED * max(0.0, 1.0 - smallest / (SEED_SHARE * width))
    if smallest <= SINGULAR_RATIO * sigma[0]:
        return seed * climb
    shares = np.maximum(0.0, 1.0 - (sigma / width) ** 2) ** 2
    V = Vt[:s]
    d = dot(shares * dot(V, climb), V)
    length = math.sqrt(dot(d, d))
    if length == 0.0:
        return np.zeros(nv)
    ramp = dt * ESCAPE_SPEED * math.sqrt(dot(slope, slope)) / STABLE_SLOPE
    speed = ESCAPE_SPEED * shares[s - 1] * smallest / math.hypot(smallest, ramp)
    return d * (max(speed, seed) / length)


def steepest_ascent(decomposition: Decomposition, motion: Vjp) -> Float[np.ndarray, " nv"]:
    """Unit vector along which the lost singular values grow fastest, in the null space of A if they grow there.

    With U_0, V_0 spanning what A has lost, U_0^T A(q + step) V_0 is linear in the step, with matrix M; mu is a cone
    there, and the leading right singular vector of M its steepest ascent.
    """
    M, Z = lost_rates(decomposition, motion), decomposition.Vt[rank_at(decomposition.sigma) :]
    flat = M.reshape(-1)
    square = dot(flat, flat)
    if square == 0.0:
        return np.zeros(M.shape[1])
    rate, inside = leading(dot(M, Z.T))
    # the largest rate of all is at most the root of `square`, and seldom less than half of it
    direction = dot(inside, Z) if rate > 1e-6 * math.sqrt(square) else leading(M)[1]
    largest = np.abs(direction).argmax()
    return -direction if direction[largest] < 0.0 else direction


def approach_bound(
    smallest: float, slope: Float[np.ndarray, " nv"], acceleration: Float[np.ndarray, " nv"], dt: float
) -> float:
    """Largest rate at which the smallest singular value may fall, so that the arm can stop at the singularity.

        rate = |grad sigma| CROSSING_SPEED + min(kappa sigma, sqrt(2 a sigma)),
        a = BRAKING_SHARE |grad sigma| min_j (a_j / |n_j|),  n = grad sigma / |grad sigma|

    A task whose target is out of reach presses the arm against a singularity (a stretched elbow), with joint
    velocities that grow as 1 / sigma until they flip from step to step; with the bound it comes to rest there.

    Args:
        smallest: sigma, the smallest singular value of A.
        slope: Its gradient.
        acceleration: Acceleration limits [rad/s2 or m/s2].
        dt: Time for which a velocity is held [s].
    """
    length = math.sqrt(dot(slope, slope))
    if length == 0.0:
        return math.inf
    largest = 0.0
    for j in range(slope.shape[0]):
        largest = max(largest, abs(slope[j]) / acceleration[j])
    deceleration = BRAKING_SHARE * length * length / largest if largest > 0.0 else math.inf
    rate = min(APPROACH_RATE, 0.5 / dt)
    return length * CROSSING_SPEED + min(rate * smallest, math.sqrt(2.0 * deceleration * smallest))


def stable_damping(
    sigma: Float[np.ndarray, " k"], along: Float[np.ndarray, " s"], threshold: float, dt: float
) -> float:
    """Damping lambda at which an explicit step of dt follows a task that presses into a singularity.

    The joint velocity beta sigma / (sigma^2 + lambda^2) has the slope |grad sigma| beta / lambda^2 at the singularity,
    |grad sigma| about as large as sigma_1:  lambda^2 = dt |beta| sigma_1 / (2 STABLE_SLOPE).

    Args:
        sigma: Singular values of A.
        along: U^T b; only as many of its numbers as there are singular values count.
        threshold: Singular value below which a direction counts as nearly lost.
        dt: Time for which a velocity is held [s].
    """
    beta = 0.0
    for i in range(sigma.shape[0]):
        if sigma[i] < threshold:
            beta = max(beta, abs(along[i]))
    return math.sqrt(beta * sigma[0] * dt / (2.0 * STABLE_SLOPE))


def pressed_damping(
    damping: float, stable: float, slope: Float[np.ndarray, " nv"], task_part: Float[np.ndarray, " nv"]
) -> float:
    """`stable` for a task part that presses into the singularity, `damping` for one that leads out of it.

    Args:
        damping: Damping of a task that leads out, or along.
        stable: See `stable_damping`.
        slope: Gradient of the smallest singular value.
        task_part: A^+ b.
    """
    size = math.sqrt(dot(slope, slope) * dot(task_part, task_part))
    pressing = -dot(slope, task_part) / size if size > 0.0 else 0.0
    share = min(1.0, max(0.0, pressing / FULLY_PRESSING))
    return math.sqrt((1.0 - share) * damping**2 + share * stable**2)
