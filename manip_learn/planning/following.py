"""The way that one recording shows: its grasp and its joint path, brought onto the mechanism; how it came, how it went.

A grasp, a posture and an approach that a person has shown can be had, and people know what they look like. Of the
recordings, those whose grasp is nearest to the start come first; the first with enough margin is followed, else that
with the most. The margin is what a search for the posture would have more of (`manip_learn.planning.search`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.mechanism import ON_THE_AXIS
from manip_learn.constraint.shown import Shown
from manip_learn.constraint.skill import Take
from manip_learn.control.tasks.motion import FreeDirection
from manip_learn.planning.search import JUMP, MARCH_STEPS, march, relaxed
from manip_learn.planning.stations import Margins, Postures, Stations, margins_of, onto_poses
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import rotation_matrix, rotation_vector

ENOUGH = 0.15  # margin of a way that is shown: with less, limits or a singularity are felt in the motion
ONE_PLACE = 5e-3  # [m] within which a hand is where contacts began
HELD = 20.0  # weight of the posture of hold in them beside each other: it is kept
ROUGH = 5  # degree of the polynomials that smooth a joint's path along a way
PARTS = 4  # of the motion by which fixtures have moved, each within reach of Newton's method
JOINS = 0.6  # share of a shown approach by which it is joined: what is left is gone as it was shown
KNOTS = 24  # of an approach
LEAST_APPROACH = 0.05  # [rad or m] that a joint goes in a recording that shows an approach: a cut one shows none
Way = Float[np.ndarray, "L nv"]


@final
@dataclass(frozen=True, eq=False)
class Candidate:
    """A way of the joints.

    Attributes:
        motion: What the hand does, from where it takes hold.
        stations: Its stations.
        path: shape (L, nv), joint positions there [rad or m].
        take: The recording that is followed; None if none is.
    """

    motion: FreeDirection
    stations: Stations
    path: Way
    take: Take | None = None

    @cached_property
    def margins(self) -> Margins:
        """What it leaves."""
        return margins_of(self.stations, self.path)


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
    poses, rows = features.twist.poses(q), np.repeat(np.eye(6)[None], len(q), axis=0)
    for part in np.arange(1, PARTS + 1) / PARTS:
        R = rotation_matrix(part * turn)
        places, turns = poses[:, :3, 3] @ R.T + part * moved[:3, 3], R @ poses[:, :3, :3]
        q, _ = onto_poses(features.twist, robot, q, places, turns, rows, MARCH_STEPS)
    return q


def followed(
    motion: FreeDirection, takes: Sequence[Take], stations: Stations, positions: Float[np.ndarray, " nv"]
) -> Iterator[Candidate]:
    """Return the way from where the arm stands, if it is on the mechanism, and the recordings brought onto that: those
    with enough margin as they come, then the others, the best first.

    Args:
        motion: The way, as it was shown.
        takes: The recordings.
        stations: Of that motion, for the limits and the joints that move the hand.
        positions: Joint positions before it [rad or m].
    """
    others = list[Candidate]()
    for take, own, at, ways in _tries(motion, takes, stations, positions):
        for path in (path for way in ways if (path := way()) is not None):
            found = Candidate(own, at, path, take)
            if found.margins.margin < ENOUGH:
                better = replace(found, path=relaxed(at, path, pinned=True))
                found = max(found, better, key=lambda one: one.margins.margin)
            if found.margins.margin >= ENOUGH:
                yield found
                break
            others.append(found)
    yield from sorted(others, key=lambda one: -one.margins.margin)


def _tries(
    motion: FreeDirection, takes: Sequence[Take], stations: Stations, positions: Float[np.ndarray, " nv"]
) -> Iterator[tuple[Take | None, FreeDirection, Stations, list[Callable[[], Way | None]]]]:
    """Return what is tried, in this order, see `followed`: a recording, its way, and how the joints may go that."""
    shown, features, robot = motion.learnt.shown, motion.learnt.features, stations.limits.robot
    start = robot.configuration(positions)
    if motion.hold(start) == 0.0:
        yield None, motion, stations, [partial(_marched, stations, positions)]
    if shown is None:
        return
    takes = [take for take in takes if _begins_held(take, shown, features)] or takes
    both = list(zip(takes, grasps_of(takes, shown, features), strict=True))
    far = [np.max(np.abs(nearest_turn(robot, take.along[:1], positions) - positions)) for take in takes]
    for k in np.argsort(far, kind="stable").tolist():
        take, grasp = both[k]
        own = motion.taking_hold(grasp)
        at, q = Stations.of(own, start, stations.limits), np.where(stations.moving, take.along, positions)
        first = carried(features, q[:1], take.moved)[0]
        yield take, own, at, [partial(_as_shown, shown, at, take, q, features), partial(_marched, at, first)]


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


def _marched(at: Stations, hold: Float[np.ndarray, " nv"]) -> Way | None:
    """Return the way from a posture of hold on, the spare joints at rest."""
    first, there = at.onto(hold[None], np.zeros(1, dtype=int), 5 * MARCH_STEPS)
    if not there[0]:
        return None
    table = np.full((1, len(at), len(hold)), np.nan)
    table[0, 0] = first[0]
    march(at, table, np.array([0]), 0, 1)
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
