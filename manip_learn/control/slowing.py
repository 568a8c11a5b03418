"""How fast a task may be driven, before the program: motion in the null space makes no room for more."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.desired import Desired
from manip_learn.control.limits import Barrier, Limits
from manip_learn.linalg import unit
from manip_learn.robot.frame_kinematics import vjps

# [m or rad] by which a hand may leave what holds it while the joints brake: half of what counts as straying on a way.
# With twice as much 3 of 90 near-singular firm grips stray, by up to 3.4 mm, and 2 with this, by 2.1 mm
ASIDE = 1e-3
ROUNDING = 1e-9  # [rad/s or m/s] a joint that the task moves by less has no say in how much it is slowed down


def slowed_drive(
    law: Desired, D: Float[np.ndarray, "d s"], limits: Limits, barrier: Barrier | None
) -> tuple[Float[np.ndarray, " nv"], Float[np.ndarray, " nv"]]:
    """The rest of u*, and its part that drives the task, slowed down to velocity limits and a singularity's approach.

    Args:
        law: Before bounds.
        D: Rows that are driven.
        limits: Of the joints.
        barrier: (G, least) of the approach to a singularity, one row; None where it is far.
    """
    wish = law.velocity
    drive = law.task if len(D) == len(law.b) else D.T.dot(D.dot(law.b)).dot(law.gain)
    rest, fastest = wish - drive, float((np.abs(drive) / limits.velocity).max())
    if fastest > 1.0:  # as far as what else moves leaves no room for it
        moved = np.abs(drive) > ROUNDING
        left = (limits.velocity - np.sign(drive) * rest)[moved] / np.abs(drive)[moved]
        drive = drive * min(1.0, max(1.0 / fastest, float(left.min())))
    if barrier is not None:
        slope, least = barrier[0][0], float(barrier[1][0])
        toward = -float(slope.dot(drive))
        if toward > 0.0:
            drive = drive * min(1.0, max(0.0, (float(slope.dot(rest)) - least) / toward))
    return rest, drive


def may_leave(A: Float[np.ndarray, "s nv"], square: float, limits: Limits) -> bool:
    """Whether braking from a velocity may lead the hand off what holds it, so that a closer look is due.

    |dA[u] u| is at most about |A| |u| sum_j |u_j|, and `square` is |u|^2.
    """
    flat = A.reshape(-1)
    bend = math.sqrt(A.shape[1] * float(flat.dot(flat))) * square
    return bend * square > 8.0 * ASIDE * limits.weakest**2


def braking_share(
    constraint: Constraint,
    q: Float[np.ndarray, " n"],
    D: Float[np.ndarray, "d s"],
    wish: Float[np.ndarray, " nv"],
    previous: Float[np.ndarray, " nv"],
    limits: Limits,
) -> float:
    """The share of its speed at which the task is driven, so that the joints can brake with the hand on what holds it.

    All joints that brake together, each as hard as it can beside the slowest, move straight on by T u / 2,
    T = max_j |u_j| / a_j, while the rows that are held turn away by

        e(u) = |(1 - P) dA[u] u| T^2 / 8,    P the projector on the rows that are driven.

    Where the curve that holds the hand turns faster than the joints can, as while a wrist turns over, the hand would
    leave it. With the share e(u*), of power 4 in the speed, is at most ASIDE; and where the motion that there is
    exceeds it, the task waits in proportion.

    Args:
        constraint: Its rows are A.
        q: Posture.
        D: Rows that are driven.
        wish: u*, its drive slowed down [rad/s or m/s].
        previous: Velocity commanded in the step before [rad/s or m/s].
        limits: Of the joints.
    """
    _, vjp = constraint.value_and_vjp(q)
    s, share = constraint.n_constraints, 1.0
    for u, power in ((wish, 0.25), (previous, 1.0)):
        bend = vjps(vjp, np.kron(unit(s), u), s).dot(u)
        bend = bend - D.T.dot(D.dot(bend))
        time = limits.stopping_time(u)
        aside = 0.125 * time * time * math.sqrt(bend.dot(bend))
        if aside > ASIDE:
            share = min(share, (ASIDE / aside) ** power)
    return share
