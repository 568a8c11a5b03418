"""Where a compiled control step finds its constants, and where it writes its results."""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.control.command import STATUSES, Status

# The constants of a controller are one table of twelve columns: two rows of settings, the chain's table, one row per
# degree of freedom (velocity limit, lower, upper, rest posture, whether it wraps, acceleration limit), Lambda's table
# (`compiled_form`), and the limits of frames where there are any: a row of numbers, the walls (n, d), the chains.
WIDTH = 12
N_JOINTS, NV, N_CONSTRAINTS, POLICY, POLICY_GAIN, INVERSE, THRESHOLD, LIMITS, TASK, GAIN, MAX_SPEED, LONGEST = range(12)
DAMPING, ESCAPES, ESCAPE_WIDTH, GOAL = range(4)  # columns of the second row, the last of them nine of a rotation
CHAIN = 2
# columns of a chain's second row, after the tool's position, sign and reference: of a limited frame's its number of
# joints; of the constraint's, in TIPS, the row where the limits of frames begin, 0 for none
LENGTH, TARGET_POINT, FORM, TIPS = 5, 6, 9, 10
N_FRAMES, N_WALLS, TIP_SPEED = range(3)
LIMIT, LOWER, UPPER, REST_AT, WRAPS, ACCELERATION = range(6)
HOLD, POINT, POSE, GIVEN = range(4)  # kinds of tasks; b of the last is in the parts before the step
NO_POLICY, ASCENT, LOG_ASCENT, REST = range(4)
DAMPED, EXACT, TRUNCATED = range(3)
INVERSES = ("damped", "exact", "truncated")

# Rows of the parts of a command, each as long as there are degrees of freedom; b takes the first s of them.
VELOCITY, TASK_PART, NULL_PART, ESCAPE_PART, TASK_VELOCITY, PARTS = range(6)
# Rows of the work space: numbers of the command, then scratch.
FACTS, PI, MATRICES = range(3)
MU, SMALLEST, ERROR, TASK_SCALE, NULL_SCALE, PROGRESS, OUTSIDE, LIMITING_JOINT, HAS_ESCAPE, RANK, N_FACTS = range(11)
LEAST_WIDTH = 30  # columns of a row of scratch, `compiled_rows.MIX_WIDTH`; imported from there comes numba

# Rows of the space that the programs of the bounds share. From SLOPE on come those of the barrier, the gradient of the
# smallest singular value first, with their lower bounds behind them; then the program's rows, and what `project` needs.
LOW, HIGH, TASK_AIM, WISH, START, FOUND, SLID, ANSWER, LOW_CAUSE, HIGH_CAUSE, SLOPE = range(11)

# what `free_step` may return instead of a status: a limit binds, or A or the rows of a pose's error are ill-conditioned
LIMITED, ILL_CONDITIONED, ILL_POSED = -2, -3, -4
REFUSED = -1  # Python decides: what is not finite, and lost directions that "exact" inverts
(
    OUTSIDE_LIMITS, SINGULAR, STALLED, POSITION_LIMITED, VELOCITY_LIMITED, ACCELERATION_LIMITED,
    DAMPED_STATUS, REROUTED, NULL_SCALED, OK,
) = range(STATUSES.index(Status.OUTSIDE_LIMITS), len(STATUSES))  # fmt: skip


@final
class Step(NamedTuple):
    """One call of a controller: what is known, and where its command goes.

    Attributes:
        constants: The controller's table.
        q: Joint positions [rad or m].
        dt: Time for which the command is held [s].
        previous: Velocity in the step before [rad/s or m/s], NaN where no acceleration is bounded; what is behind its
            first nv numbers is not read.
        slide: See `ResolvedRateController`.
        parts: The velocity, its parts [rad/s or m/s] and b [units of the rows per second].
        work: Its row FACTS holds the numbers of the command.
    """

    constants: Float[np.ndarray, "rows 12"]
    q: Float[np.ndarray, " nv"]
    dt: float
    previous: Float[np.ndarray, " nv_or_more"]
    slide: float
    parts: Float[np.ndarray, "5 nv"]
    work: Float[np.ndarray, "rows width"]


@final
class Rows(NamedTuple):
    """The rows that are driven, A or those of a pose's error, with their decomposition sum_i sigma_i u_i v_i^T.

    The rank of A is among the numbers of the command.

    Attributes:
        A: In public columns.
        Ut: Left singular vectors in its rows.
        sigma: Singular values, largest first; the first is negative while they and Ut are unknown.
        Vt: Orthonormal rows that span those of A, the right singular vectors where they are known; behind them the
            null space, where something needs it.
        weights: Scratch for the weights of a gradient sum_ij weights_ij dA_ij / dq.
    """

    A: Float[np.ndarray, "s nv"]
    Ut: Float[np.ndarray, "s s"]
    sigma: Float[np.ndarray, " s"]
    Vt: Float[np.ndarray, "nv nv"]
    weights: Float[np.ndarray, "s nv"]
