"""A rollout as loops over plain numbers: `integration.next_posture` and the servo loop's rule, step by step."""

from __future__ import annotations

import math

import numpy as np

from manip_learn.control.compiled.control_step import control_step
from manip_learn.control.compiled.free_step import scratch
from manip_learn.control.compiled.outcome import next_slide
from manip_learn.control.compiled.step_table import (
    ERROR,
    FACTS,
    MU,
    N_CONSTRAINTS,
    N_JOINTS,
    PARTS,
    PROGRESS,
    REFUSED,
    VELOCITY,
)
from manip_learn.robot.batch.kernel_cache import compiled


@compiled
def rollout(constants, first, dt, rk4, motion, numbers, state):
    """From sample `first` on; returns the sample that Python must do, or T.

    Args:
        constants: The table, see `step_table`.
        first: Its posture is known.
        dt: [s].
        rk4: Whether the method is that of Runge and Kutta, otherwise Euler's.
        motion: Joint positions and velocities, shape (2, T, nv).
        numbers: mu, the error and the code of the status of each sample, shape (3, T).
        state: The velocity before, NaN for every step where no acceleration is bounded, and `slide`.
    """
    q, u = motion[0], motion[1]
    steps, nv = q.shape
    joints, s = int(constants[0, N_JOINTS]), int(constants[0, N_CONSTRAINTS])
    parts, work = np.empty((PARTS, nv)), scratch(joints, nv, s)
    point, slope = np.empty(nv), np.empty(nv)
    bounded = not math.isnan(state[0])
    for i in range(first, steps):
        for j in range(nv):
            point[j], slope[j] = q[i, j], 0.0
        for stage in range(4 if rk4 and i + 1 < steps else 1):
            if stage > 0:
                length = dt if stage == 3 else 0.5 * dt
                for j in range(nv):
                    point[j] = q[i, j] + length * parts[VELOCITY, j]
            done = control_step(constants, point, dt, state, state[nv], parts, work)
            if done == REFUSED:
                return i
            if stage == 0:
                numbers[0, i], numbers[1, i], numbers[2, i] = work[FACTS, MU], work[FACTS, ERROR], done
                for j in range(nv):
                    u[i, j] = parts[VELOCITY, j]
                    if bounded:
                        state[j] = u[i, j]
                if bounded:
                    state[nv] = next_slide(state[nv], done, work[FACTS, PROGRESS], dt)
            weight = 2.0 if stage == 1 or stage == 2 else 1.0
            for j in range(nv):
                slope[j] += weight * parts[VELOCITY, j]
        if i + 1 < steps:
            factor = dt / 6.0 if rk4 else dt
            for j in range(nv):
                q[i + 1, j] = q[i, j] + factor * slope[j]
    return steps
