"""The way that one recording shows: its grasp and its joint path, brought onto the mechanism; how it came, how it went.

A grasp, a posture and an approach that a person has shown can be had, and people know what they look like. Of the
recordings, those whose grasp is nearest to the start come first; the first with enough margin is followed, else that
with the most. The margin is what a search for the posture would have more of (`manip_learn.planning.search`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.mechanism import ON_THE_AXIS
from manip_learn.constraint.shown import Shown
from manip_learn.constraint.skill import Take
from manip_learn.control.tasks.motion import FreeDirection
from manip_learn.planning.search import JUMP, MARCH_STEPS, march, relaxed
from manip_learn.planning.stations import Margins, Postures, Stations, margins_of
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import rotation_matrix, rotation_vector

ENOUGH = 0.15  # margin of a way that is shown: with less, limits or a singularity are felt in the motion
ONE_PLACE = 5e-3  # [m] within which a hand is where contacts began
HELD = 20.0  # weight of the posture of hold in them beside each other: it is kept
ROUGH = 5  # degree of the polynomials that smooth a joint's path along a way
CARRIED_STEPS, PARTS = 20, 4  # of Newton's method in each part of the motion by which fixtures have moved
FAINT = 1e-5  # [m2 or rad2] of damping in them
TOO_SLOW = -1.0  # margin of speed of a way that takes twice its time: another way of going is tried first
JOINS = 0.6  # share of a shown approach by which it is joined: what is left is gone as it was shown
KNOTS = 24  # of an approach
LEAST_APPROACH = 0.05  # [rad or m] that a joint goes in a recording that shows an approach: a cut one shows none
Way = Float[np.ndarray, "L nv"]


@final
@dataclass(frozen=True, eq=False)
class Followed:
    """One recording, brought onto the mechanism.

    Attributes:
        take: The recording.
        grasp: shape (4, 4), where the hand takes hold [m].
        motion: The way from there.
        stations: Its stations.
        path: shape (L, nv), joint positions there [rad or m].
        margins: What these leave.
    """

    take: Take
    grasp: Float[np.ndarray, "4 4"]
    motion: FreeDirection
    stations: Stations
    path: Way
    margins: Margins


def grasps_of(takes: Sequence[Take], shown: Shown, features: Any) -> list[Float[np.ndarray, "4 4"]]:
    """Return where the hand takes hold as in each recording, where the fixtures stand now [m].

    That is its own grasp, along the way where all contacts began, if that is one place.
    """
    twist, mechanism = features.twist, shown.mechanism
    own = [take.moved @ twist.poses(take.along[:1])[0] for take in takes]
    if not shown.is_way:  # a path on a surface is where it was shown
        for grasp in own:
            grasp[:3, 3] = shown.begin
    lever = 1.0 if shown.unit == "m" else mechanism.radius if mechanism.radius is not None else 0.0
    if shown.hold is None or not shown.is_way or lever < ON_THE_AXIS:
        return own
    by_place, begin = replace(shown, mechanism=mechanism.by_place()), shown.chart.grasp
    ahead = np.array([by_place.along(np.array([begin, grasp]))[1, 0] for grasp in own])
    return [mechanism.at(grasp, np.inf).pose([-far]) for grasp, far in zip(own, ahead, strict=True)]


def nearest_turn(robot: Robot, q: Float[np.ndarray, "n nv"], near: Float[np.ndarray, " nv"]) -> np.ndarray:
    """Return the same postures by whole turns of joints, the first next to another, as far as the limits let them."""
    angles = np.array(robot.joint_units) == "rad"
    moved = q - np.where(angles, 2.0 * np.pi * np.round((q[0] - near) / (2.0 * np.pi)), 0.0)
    beyond = np.any((moved < robot.position_lower) | (moved > robot.position_upper), axis=0)
    return np.where(beyond, q, moved)


def carried(features: Any, q: Postures, moved: Float[np.ndarray, "4 4"]) -> Postures:
    """Return postures with the hand carried along with its fixture, which moved by p' = R p + t, by Newton's method."""
    robot, turn = features.robot, rotation_vector(moved[:3, :3])
    if np.allclose(moved, np.eye(4), atol=1e-12):
        return q
    q, poses, low, high = q.copy(), features.twist.poses(q), robot.position_lower, robot.position_upper
    for part in np.arange(1, PARTS + 1) / PARTS:
        R = rotation_matrix(part * turn)
        places = poses[:, :3, 3] @ R.T + part * moved[:3, 3]
        for _ in range(CARRIED_STEPS // PARTS):
            now, J = features.twist.poses(q), features.twist.batch(q)
            turned = [rotation_vector(R @ x[:3, :3] @ y[:3, :3].T) for x, y in zip(poses, now, strict=True)]
            error = np.hstack([places - now[:, :3, 3], turned])
            gram = J @ J.transpose(0, 2, 1) + FAINT * np.eye(6)
            q = np.clip(q + np.einsum("nij,ni->nj", J, np.linalg.solve(gram, error[..., None])[..., 0]), low, high)
    return q


def followed(
    motion: FreeDirection, rows: Any, takes: Sequence[Take], stations: Stations, positions: Float[np.ndarray, " nv"]
) -> Iterator[Followed]:
    """Return the recordings on the mechanism: those with enough margin as they come, then the others, the best first.

    Args:
        motion: The way, as it was shown.
        rows: The rows held and driven.
        takes: The recordings.
        stations: Of that motion, for the limits and the joints that move the hand.
        positions: Joint positions before it [rad or m].
    """
    shown, features, robot = motion.learnt.shown, motion.learnt.features, stations.limits.robot
    if shown is None or not takes:
        return
    takes = [take for take in takes if _begins_held(take, shown, features)] or takes
    both = list(zip(takes, grasps_of(takes, shown, features), strict=True))
    far = [np.max(np.abs(nearest_turn(robot, take.along[:1], positions) - positions)) for take in takes]
    others = list[Followed]()
    for k in np.argsort(far, kind="stable").tolist():
        take, grasp = both[k]
        own = motion.taking_hold(grasp)
        at = Stations.of(own, robot.configuration(positions), stations.limits)
        q = np.where(stations.moving, take.along, positions)
        for way in (partial(_as_shown, shown), partial(_marched, rows)):
            if (path := way(at, take, q, features)) is None:
                continue
            margins = margins_of(at, path)
            if margins.margin < ENOUGH:
                better = relaxed(at, path, pinned=True)
                if (left := margins_of(at, better)).margin > margins.margin:
                    path, margins = better, left
            found = Followed(take, grasp, own, at, path, margins)
            if margins.margin >= ENOUGH:
                yield found
                break
            others.append(found)
            if margins.speed > TOO_SLOW:
                break
    yield from sorted(others, key=lambda one: -one.margins.margin)


def _begins_held(take: Take, shown: Shown, features: Any) -> bool:
    """Whether the hand was on the mechanism already where the contact is said to begin, by what it did later."""
    poses = take.moved @ features.twist.poses(take.along)
    chart = shown.mechanism.at(poses[len(poses) // 2], np.inf)
    meant = chart.pose(chart.coordinates(poses[0]))
    return float(np.linalg.norm(meant[:3, 3] - poses[0, :3, 3])) <= ONE_PLACE


def _as_shown(shown: Shown, at: Stations, take: Take, q: Postures, features: Any) -> Way | None:
    """Return the recorded joint path, smoothed along the way and brought onto its stations."""
    poses, times = take.moved @ features.twist.poses(q), take.time[(take.time >= 0.0) & (take.time <= take.end)]
    if shown.is_way:
        ways = np.abs(shown.along(poses)[:, 0])
        top = int(np.argmax(ways)) + 1
        shares, wanted = np.maximum.accumulate(ways[:top]) / max(ways[top - 1], 1e-9), np.abs(at.distance)
    else:  # a path on a surface: the recording in its own time
        top, shares, wanted = len(q), times / max(float(times[-1]), 1e-9), at.time
    if top < ROUGH:
        return None
    wanted = wanted / wanted[-1]
    degree = min(ROUGH if shown.is_way else 2 * ROUGH, top // 4)
    weight = np.interp(shares, [0.0, 0.05], [HELD, 1.0])
    fits = [np.polynomial.Polynomial.fit(shares, x, degree, w=weight, domain=[0.0, 1.0]) for x in q[:top].T]
    guess = carried(features, np.column_stack([fit(wanted) for fit in fits]), take.moved)
    path, there = at.onto(guess, np.arange(len(at)), 3 * MARCH_STEPS)
    near = np.max(np.abs(np.diff(path, axis=0))) <= JUMP and np.max(np.abs(path - guess)) <= JUMP
    return path if np.all(there) and near else None


def _marched(rows: Any, at: Stations, take: Take, q: Postures, features: Any) -> Way | None:
    """Return the way from the recorded posture of hold on, the spare joints at rest."""
    first = carried(features, q[:1], take.moved)
    held, there = at.onto(first, np.zeros(1, dtype=int), 5 * MARCH_STEPS)
    if not there[0]:
        return None
    table = np.full((1, len(at), q.shape[1]), np.nan)
    table[0, 0] = held[0]
    march(at, rows, table, np.array([0]), np.zeros(1, dtype=int), 0, 1)
    return table[0] if np.all(np.isfinite(table)) else None


def joined(path: Postures, start: Float[np.ndarray, " nv"], end: Float[np.ndarray, " nv"]) -> Way | None:
    """Return a recorded approach from where it comes nearest to a start; what is left at both ends fades along it.

    Args:
        path: Joint positions that lead to a posture of hold, as recorded.
        start: Where the arm is.
        end: The posture of hold.

    Returns:
        Knots from the start to the end; None where the recording moves too little to be an approach.
    """
    if len(path) < 3 or np.max(np.abs(path - path[-1])) < LEAST_APPROACH:
        return None
    far = np.linalg.norm(path[: max(1, 3 * len(path) // 4)] - start, axis=1)  # its last quarter is always gone
    some = path[int(np.argmin(far)) :]
    at = np.linspace(0.0, 1.0, KNOTS)
    knots = np.column_stack([np.interp(at, np.linspace(0.0, 1.0, len(some)), x) for x in some.T])
    x = np.minimum(at / JOINS, 1.0)
    share = (x * x * (3.0 - 2.0 * x))[:, None]
    return knots + (1.0 - share) * (start - knots[0]) + share * (end - knots[-1])
