"""Motion near a singularity: the way out of it, and how fast it may be approached."""

from __future__ import annotations

import math
from operator import truediv
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dsyev  # pyright: ignore[reportAttributeAccessIssue]

from manip_learn.constraint.features.feature_map import Vjp
from manip_learn.constraint.manipulability import SINGULAR_RATIO
from manip_learn.constraint.small_matrices import svd
from manip_learn.robot.frame_kinematics import vjps

# [rad/s] speed at which a singularity is left
ESCAPE_SPEED = 0.2
# [rad/s] speed at which an exact singularity is left, where no sense is better than its opposite
SEED_SPEED = 5e-4
# singular value up to which the seed acts, as a share of the width of the escape
SEED_SHARE = 1e-3
# an explicit step of dt can follow a velocity field whose slope is at most this over dt: three of them add up to less
# than 1 / dt, from which on a step goes beyond where the field leads
STABLE_SLOPE = 0.25
# by how many times its distance from a singularity one step may carry the arm away from it: nothing lies there that a
# step could go beyond. Of 61 exactly singular starts of five arms, holding still, 0.25 leaves 61, 56 and 42 within a
# second at 1, 10 and 20 ms, 1 leaves 61, 61 and 58, 1.25 and more leave all; from 1.5 on arms that are pressed against
# a singularity turn to and fro now and then
GROWTH = 1.25
# [1/s] rate at which a wall is approached exponentially at the end of the braking distance: a singularity, where the
# smallest singular value falls, a position limit, a wall of the hand
APPROACH_RATE = 20.0
# [rad/s] speed at which a singularity may be crossed
CROSSING_SPEED = 5e-4
# share of the joints' acceleration that braking before a wall uses; the rest keeps the task on its way
BRAKING_SHARE = 0.5

# share of a policy's velocity up to which what is left of it in the null space is rounding
NOTHING = 1e-9
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


def smallest_gradient(decomposition: Decomposition, vjp: Vjp) -> Float[np.ndarray, " nv"]:
    """d sigma_min / dq = u_min^T (dA / dq) v_min, for a singular value that is neither 0 nor double."""
    U, sigma, Vt = decomposition
    k = sigma.shape[0]
    return vjp(U[:, k - 1 : k].dot(Vt[k - 1 : k]))


def smallest_gradient_of(
    A: Float[np.ndarray, "s nv"], X: Float[np.ndarray, "s nv"] | None, mu: float, smallest: float, vjp: Vjp
) -> Float[np.ndarray, " nv"]:
    """d sigma_min / dq away from singularities, from A and X = A^{+T}: weights u v^T, v = A^T u / sigma_min."""
    s = A.shape[0]
    if s == 1:
        return vjp(A) / smallest
    if s == 2 and X is not None:  # A^{+T} - A / sigma_1^2 has no part along v_1
        square = (mu / smallest) ** 2
        gap = square - smallest * smallest
        if gap > DOUBLE * square:
            return vjp(X - A * (1.0 / square)) * (smallest * square / gap)
    _, vectors, failed = dsyev(A.dot(A.T))
    u = vectors[:, 0] if not failed else np.linalg.svd(A)[0][:, -1]
    return vjp(u[:, None] * (u.dot(A) / smallest))


def seed_speed(smallest: float, width: float) -> float:
    """Speed that starts the motion out of a singularity [rad/s], see `escape_velocity`."""
    return SEED_SPEED * max(0.0, 1.0 - smallest / (SEED_SHARE * width))


def with_seed(null: Float[np.ndarray, " nv"], pi: Float[np.ndarray, " nv"], seed: float) -> Float[np.ndarray, " nv"]:
    """N pi at the speed of the seed at least, where it is not rounding alone.

    Beside a singularity the bound on pi vanishes with sigma; where mu is level along the lost direction, motion in the
    null space is the only way out.
    """
    speed = math.sqrt(null.dot(null))
    return null * (seed / speed) if NOTHING * math.sqrt(pi.dot(pi)) < speed < seed else null


def escape_velocity(
    decomposition: Decomposition,
    vjp: Vjp,
    dt: float,
    width: float,
    ascent: Float[np.ndarray, " nv"] | None = None,
    slope: Float[np.ndarray, " nv"] | None = None,
) -> Float[np.ndarray, " nv"]:
    """Joint velocity out of a singularity, along the directions v_i whose singular values are below `width`.

    The exact projector N leaves no motion along a direction that is nearly lost, and none that climbs out where mu is
    level along the null space. There the task is not exact either (it is damped), and this velocity is added:

        e = speed * d / sqrt(|d|^2 + r_d^2),   d = sum_i w_i v_i v_i^T g,   w_i = (1 - (sigma_i / width)^2)^2
        speed = ESCAPE_SPEED w sigma / sqrt(sigma^2 + r^2),   r = dt ESCAPE_SPEED |grad sigma| / GROWTH
        r_d = dt speed / STABLE_SLOPE sum_i ((1 - w_i) v_i^T g)^2 (sigma / width)^2,   g = grad log mu,

    with sigma the smallest singular value and w its weight. It vanishes at the singularity itself, so that it is
    continuous there and an explicit step of dt can follow it; it grows exponentially beside it, by a factor of
    GROWTH + 1 a step at most. With r_d it ends smoothly, too, where mu is highest along these directions: they turn by
    about the g of the others. At the singularity itself, `SEED_SPEED` along the steepest ascent of mu among the
    directions that A does not see starts the motion. It disturbs the task by A e, at most ESCAPE_SPEED sigma.

    Args:
        decomposition: Of A(q).
        vjp: weights -> sum_ij weights_ij dA_ij / dq_k.
        dt: Time for which the velocity is held [s].
        width: Singular value at which it ends, in the constraint's units.
        ascent: grad log mu, where it is known; at the singularity itself its steepest ascent.
        slope: Gradient of the smallest singular value, where it is known.
    """
    U, sigma, Vt = decomposition
    s, nv = U.shape[0], Vt.shape[0]
    smallest = float(sigma[-1])
    if smallest >= width or s > nv:
        return np.zeros(nv)
    values = sigma.tolist()
    seed = seed_speed(smallest, width)
    if smallest <= SINGULAR_RATIO * values[0]:
        return seed * (steepest_ascent(decomposition, vjp) if ascent is None else ascent)
    shares = [max(0.0, 1.0 - (x / width) ** 2) ** 2 for x in values]
    if ascent is None:
        ascent = vjp((U / sigma).dot(Vt[:s]))
    if slope is None:
        slope = smallest_gradient(decomposition, vjp)
    along, weights = Vt[:s].dot(ascent), np.array(shares)
    d, others = (weights * along).dot(Vt[:s]), (1.0 - weights) * along
    ramp = dt * ESCAPE_SPEED * math.sqrt(slope.dot(slope)) / GROWTH
    speed = max(seed, ESCAPE_SPEED * shares[-1] * smallest / math.hypot(smallest, ramp))
    turn = dt * speed * float(others.dot(others)) / STABLE_SLOPE * (smallest / width) ** 2
    length = math.hypot(math.sqrt(d.dot(d)), turn)
    return d * (speed / length) if length > 0.0 else d


def steepest_ascent(decomposition: Decomposition, vjp: Vjp) -> Float[np.ndarray, " nv"]:
    """Unit vector along which the lost singular values grow fastest, in the null space of A if they grow there.

    With U_0, V_0 spanning what A has lost, U_0^T A(q + step) V_0 is linear in the step, with matrix M; mu is a cone
    there, and the leading right singular vector of M its steepest ascent.
    """
    U, sigma, Vt = decomposition
    largest, *others = sigma.tolist()
    rank = 1 + sum(x > SINGULAR_RATIO * largest for x in others) if largest > 0.0 else 0
    Z = Vt[rank:]
    rows = [vjps(vjp, U[:, i : i + 1] * Z.reshape(-1), Z.shape[0]) for i in range(rank, U.shape[1])]
    M = rows[0] if len(rows) == 1 else np.concatenate(rows)
    flat = M.reshape(-1)
    square = float(flat.dot(flat))
    if square == 0.0:
        return np.zeros(M.shape[1])
    inside = M.dot(Z.T)
    squares, vectors, failed = dsyev(inside.T.dot(inside))
    # the largest rate of all is at most the root of `square`, and seldom less than half of it
    if not failed and squares[-1] > 1e-12 * square:
        direction = vectors[:, -1].dot(Z)
    else:
        direction = svd(M)[2][0]
    values = direction.tolist()
    return -direction if max(values) < -min(values) else direction


def approach_rate(
    distance: float, slope: Float[np.ndarray, " nv"], acceleration: Float[np.ndarray, " nv"], dt: float
) -> float:
    """Largest rate at which a distance may fall, so that the joints can stop where it is 0; negative beyond that.

        rate = min(kappa x, sqrt(2 a x)),   a = BRAKING_SHARE |g| min_j (a_j / |n_j|),   n = g / |g|

    Args:
        distance: x, e.g. the smallest singular value of A, or of a frame from a wall [m].
        slope: g, its gradient.
        acceleration: Acceleration limits a_j [rad/s2 or m/s2].
        dt: Time for which a velocity is held [s].
    """
    parts = slope.tolist()
    largest = max(map(truediv, map(abs, parts), acceleration.tolist()))
    length = math.hypot(*parts)
    deceleration = BRAKING_SHARE * length * length / largest if largest > 0.0 else math.inf
    return min(min(APPROACH_RATE, 0.5 / dt) * distance, math.sqrt(2.0 * deceleration * max(distance, 0.0)))


def is_fast(square: float, size: float, weakest: float, smallest: float, dt: float) -> bool:
    """Whether a velocity may approach a singularity too fast, so that a closer look is due.

    |grad sigma| is about as large as A itself.

    Args:
        square: |u|^2.
        size: |A|^2.
        weakest: Smallest acceleration limit of a joint [rad/s2 or m/s2].
        smallest: Smallest singular value of A.
        dt: Time for which the velocity is held [s].
    """
    rate = min(APPROACH_RATE, 0.5 / dt) * smallest
    return square * size >= min(2.0 * BRAKING_SHARE * weakest * math.sqrt(size) * smallest, rate * rate)


def approach_bound(
    smallest: float, slope: Float[np.ndarray, " nv"], acceleration: Float[np.ndarray, " nv"], dt: float
) -> float:
    """Largest rate at which the smallest singular value may fall, so that the arm can stop at the singularity.

    That of `approach_rate`, and |grad sigma| CROSSING_SPEED. A task whose target is out of reach presses the arm
    against a singularity (a stretched elbow), with joint velocities that grow as 1 / sigma until they flip from
    step to step; with the bound it comes to rest there.

    Args:
        smallest: sigma, the smallest singular value of A.
        slope: Its gradient.
        acceleration: Acceleration limits [rad/s2 or m/s2].
        dt: Time for which a velocity is held [s].
    """
    length = math.hypot(*slope.tolist())
    if length == 0.0:
        return math.inf
    return length * CROSSING_SPEED + approach_rate(smallest, slope, acceleration, dt)


def stable_damping(decomposition: Decomposition, along: list[float], threshold: float, dt: float, vjp: Vjp) -> float:
    """Damping lambda at which an explicit step of dt follows a task that presses into a singularity.

    The joint velocity A^T w / (sigma^2 + lambda^2), with w the part of b along the directions that are nearly lost, has
    at the singularity the slope d(A^T w) / dq / lambda^2:  lambda^2 = dt |d(A^T w) / dq| / (2 STABLE_SLOPE), in the
    Frobenius norm.

    Args:
        decomposition: Of A(q).
        along: U^T b.
        threshold: Singular value below which a direction counts as nearly lost.
        dt: Time for which a velocity is held [s].
        vjp: weights -> sum_ij weights_ij dA_ij / dq_k.
    """
    U, sigma, Vt = decomposition
    lost = np.zeros(U.shape[0])
    for i, value in enumerate(sigma.tolist()):
        lost[i] = along[i] if value < threshold else 0.0
    if not lost.any():
        return 0.0
    nv = Vt.shape[1]
    rates = vjps(vjp, np.outer(U.dot(lost), np.eye(nv)), nv).reshape(-1)
    return math.sqrt(dt * math.sqrt(rates.dot(rates)) / (2.0 * STABLE_SLOPE))


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
    size = math.sqrt(slope.dot(slope) * task_part.dot(task_part))
    pressing = -float(slope.dot(task_part)) / size if size > 0.0 else 0.0
    share = min(1.0, max(0.0, pressing / FULLY_PRESSING))
    return math.sqrt((1.0 - share) * damping**2 + share * stable**2)
