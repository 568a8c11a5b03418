"""Where a compiled control step finds its constants, and where it writes its results."""

from __future__ import annotations

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
MU, SMALLEST, ERROR, TASK_SCALE, NULL_SCALE, PROGRESS, OUTSIDE, LIMITING_JOINT, HAS_ESCAPE, N_FACTS = range(10)
LEAST_WIDTH = 30  # columns of a row of scratch, `compiled_rows.MIX_WIDTH`; imported from there comes numba

# what `free_step` may return instead of a status: a limit binds, or A or the rows of a pose's error are ill-conditioned
LIMITED, ILL_CONDITIONED, ILL_POSED = -2, -3, -4
REFUSED = -1  # Python decides: what is not finite, and lost directions that "exact" inverts
OK = STATUSES.index(Status.OK)
DAMPED_STATUS = STATUSES.index(Status.DAMPED)
STALLED = STATUSES.index(Status.STALLED)
SINGULAR = STATUSES.index(Status.SINGULAR)
OUTSIDE_LIMITS = STATUSES.index(Status.OUTSIDE_LIMITS)
POSITION_LIMITED = STATUSES.index(Status.POSITION_LIMITED)
VELOCITY_LIMITED = STATUSES.index(Status.VELOCITY_LIMITED)
ACCELERATION_LIMITED = STATUSES.index(Status.ACCELERATION_LIMITED)
REROUTED = STATUSES.index(Status.REROUTED)
NULL_SCALED = STATUSES.index(Status.NULL_SCALED)
