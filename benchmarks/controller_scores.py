"""What is measured of each motion in `peer_controllers.py`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from controller_cases import Tasks

import manip_learn as ml

RAMP = 0.2  # [s] in which a joint may reach its full speed: the acceleration limit is velocity limit / RAMP
JUMP = 0.2  # part of the velocity limit by which a velocity may change in a step
TREMOR = 1e-3  # [rad/s] below which a change of sign does not count
AFTER = 1.0  # [s] before which the least mu does not count: near-singular starts begin with a small one


class Scores(NamedTuple):
    """One motion.

    Attributes:
        least: Least mu after one second.
        mean: Mean mu.
        miss: Distance to the target along the rows, in the end [m].
        deviation: Largest distance from the straight line to the target along the rows [m].
        jump: Largest change of a joint velocity in a step, relative to its limit.
        exceeded: Largest acceleration relative to its limit.
        flips: Changes of sign per second in the last second, of the worst joint.
        microseconds: Time per step.
        failed: Steps without an answer.
        over_velocity: Largest velocity that was commanded, less its limit, as a share of it; 0 if within.
        over_position: How far a command led beyond a position limit within its step [rad]; 0 if within.
    """

    least: float
    mean: float
    miss: float
    deviation: float
    jump: float
    exceeded: float
    flips: float
    microseconds: float
    failed: int
    over_velocity: float
    over_position: float


def scores(
    tasks: Tasks,
    i: int,
    q: np.ndarray,
    u: np.ndarray,
    dt: float,
    seconds: float,
    failed: int,
    excess: tuple[float, float] = (0.0, 0.0),
    settle: float = 1.0,
) -> Scores:
    """All of them, for one motion of case i.

    Args:
        tasks: The cases of the robot.
        i: Which one.
        q: Postures, shape (T, nv).
        u: Velocities that the arm made, shape (T, nv) [rad/s].
        dt: Step [s].
        seconds: Time per step [s].
        failed: Steps without an answer.
        excess: By what the commands exceed velocity limits, as a share of them, and position limits [rad].
        settle: How much of the end is looked at for changes of sign [s].
    """
    constraint = tasks.constraint(i)
    mu = ml.manipulability_batch(constraint, q).mu
    kinematics = np.array([tasks.robot.position(x, tasks.tip) for x in q[::5]])
    place, goal = kinematics @ constraint.selection.T, constraint.selection @ tasks.targets[i]
    way = goal - place[0]
    along = way / max(float(np.linalg.norm(way)), 1e-12)
    aside = place - place[0] - np.outer((place - place[0]) @ along, along)
    miss = float(np.linalg.norm(constraint.selection @ tasks.robot.position(q[-1], tasks.tip) - goal))
    change = np.abs(np.diff(u, axis=0)) / tasks.robot.velocity_limit
    tail = u[-round(settle / dt) :]
    large = (np.abs(tail[1:]) > TREMOR) & (np.abs(tail[:-1]) > TREMOR)
    flips = np.sum(large & (np.sign(tail[1:]) != np.sign(tail[:-1])), axis=0).max() / settle
    return Scores(
        float(mu[round(AFTER / dt) :].min()),
        float(mu.mean()),
        miss,
        float(np.linalg.norm(aside, axis=1).max()),
        float(change.max()),
        float(change.max() * RAMP / dt),
        float(flips),
        1e6 * seconds,
        failed,
        *excess,
    )
