"""Ways of the joints through the stations of a hand's way: those that recordings show, and those that a search finds.

A grasp, a posture and an approach that a person has shown can be had, and people know what they look like. Of the
recordings, those whose grasp is nearest to the start come first; the first with enough margin is followed, else that
with the most. The search has more margin to offer:

1. Seeds: inverse kinematics from the start, from beside it, and from random postures at three stations.
2. Marches: each seed is carried along the way in both directions, its spare joints at rest. The march whose least
   margin is largest is the way; of those within `TIE` of it, the one with the largest mean log mu.
3. Band: that march is relaxed as a whole, up the slope of its least margins and towards straight joint motion.

Marches that go over into each other on the way, as the nodes of a graph, gain nothing: of 80 drawers the same 51 were
planned, none with a margin larger by more than 0.02.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, final

import numpy as np
from jaxtyping import Bool, Float, Int

from manip_learn.constraint.mechanism import ON_THE_AXIS
from manip_learn.constraint.shown import Shown, Take
from manip_learn.control.joint_motion import ARRIVED
from manip_learn.control.tasks.motion import FreeDirection
from manip_learn.planning.stations import Margins, Postures, Stations, margins_of, node_margins, onto_poses, rooms
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import rotation_matrix, rotation_vector

SEED_STEPS, MARCH_STEPS = 40, 4  # of Newton's method: from anywhere, and from a station to the next
BESIDE = 0.5  # [rad or m] from the start of an eighth of the seeds, their standard deviation
APART = 0.3  # [rad or m] of the joint that differs most: nearer postures are one and the same choice
TIE = 0.01  # margins nearer to each other than a hundredth of the limits are alike: the manipulability decides
JUMP = 0.5  # [rad or m] of a joint from one station to the next: a longer step is another branch of the kinematics
SHARPNESS = 60.0  # of the soft minimum: margins a sixtieth apart count e-fold
BAND_STEPS = 80  # at most; the first ones gain most
SMOOTH = 0.25  # share of a knot's way to the middle of its neighbours, a step
FIRST_RISE = 0.05  # [rad or m] of the joint that moves most in the first step up the slope
LEAST_RISE = 1e-3  # and where the relaxation ends
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
    moved = q - np.where(angles, 2.0 * np.pi * np.round((q[:1] - near) / (2.0 * np.pi)), 0.0)
    beyond = np.any((moved < robot.position_lower) | (moved > robot.position_upper), axis=0)
    return np.where(beyond, q, moved)


def carried(features: Any, q: Postures, moved: Float[np.ndarray, "4 4"]) -> Postures:
    """Return postures with the hand carried along with its fixture, which moved by p' = R p + t, by Newton's method."""
    robot, turn = features.robot, rotation_vector(moved[:3, :3])
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


# ---- the search --------------------------------------------------------------------------------------------------


@final
@dataclass(frozen=True, eq=False)
class Marches:
    """Postures of P marches at L stations, as far as each of them comes.

    Attributes:
        stations: The way.
        start: shape (nv,), the posture before it.
        q: shape (P, L, nv), postures; not finite where a march did not come so far.
        least: shape (P, L), margin of each posture; -inf where there is none.
        log_mu: shape (P, L), log of the manipulability of each posture.
    """

    stations: Stations
    start: Float[np.ndarray, " nv"]
    q: Float[np.ndarray, "P L nv"]
    least: Float[np.ndarray, "P L"]
    log_mu: Float[np.ndarray, "P L"]

    def where(self, clear: Callable[[Float[np.ndarray, " nv"]], bool]) -> Marches:
        """These marches from the first station up to the last at which their postures are clear."""
        least = self.least.copy()
        for p, row in enumerate(self.q):
            k = 0
            while k < len(row) and np.isfinite(least[p, k]) and clear(row[k]):
                k += 1
            least[p, k:] = -np.inf
        return replace(self, least=least)

    @cached_property
    def along(self) -> Float[np.ndarray, "P L"]:
        """The least margin of each march from the first station up to each; -inf where it has not come so far."""
        speed = np.abs(np.diff(self.q, axis=1)) / self.stations.limits.velocity
        steps = 1.0 - speed.max(axis=2, initial=0.0) / np.diff(self.stations.time)
        steps = np.where(np.isfinite(steps), steps, -np.inf)
        return np.minimum.accumulate(np.minimum(self.least, np.insert(steps, 0, np.inf, axis=1)), axis=1)

    @property
    def reached(self) -> int:
        """The last station to which a march leads from the first; -1 where no posture takes hold."""
        return int(np.isfinite(self.along).any(axis=0).sum()) - 1

    def stand(self, some: Int[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
        """Which of some marches take hold where the arm stands."""
        return np.max(np.abs(self.q[some, 0] - self.start), axis=1, initial=0.0) < ARRIVED

    def choices(self, last: int) -> Int[np.ndarray, " k"]:
        """Numbers of the marches that lead from the first station to that one, the best first, each apart.

        Those that take hold as shown come first, and that of the start before others that leave as much.
        """
        margins = self.along[:, last]
        some = np.flatnonzero(np.isfinite(margins))
        behind = np.floor((margins[some].max(initial=-np.inf) - margins[some]) / TIE)
        stand, log_mu = self.stand(some), self.log_mu[some, : last + 1].mean(axis=1)
        otherwise = ~(stand | self.stations.takes_hold_as_shown(self.q[some, 0]))
        order = some[np.lexsort((-log_mu, ~stand, behind, otherwise))]
        out: list[int] = []
        for march in order.tolist():
            if not out or np.min(np.max(np.abs(self.q[out, 0] - self.q[march, 0]), axis=1)) > APART:
                out.append(march)
        return np.array(out, dtype=int)


def marches_of(stations: Stations, start: Float[np.ndarray, " nv"], number: int, rng: np.random.Generator) -> Marches:
    """Seeds, and their marches along the whole way.

    Args:
        stations: The way.
        start: Joint positions before the motion.
        number: Of seeds.
        rng: Random numbers.
    """
    q, station = seeds_of(stations, start, number, rng)
    if stations.grip is not None:  # seeds where the hand takes hold: first turned as in the recordings
        some = np.flatnonzero(station == 0)[1:]
        q[some], _ = stations.with_rows(np.eye(6), stations.grip[0]).onto(q[some], station[some], SEED_STEPS)
    q, there = stations.onto(q, station, SEED_STEPS)
    q, station = q[there], station[there]
    table = np.full((len(q), len(stations), q.shape[1]), np.nan)
    for k in np.unique(station):
        here = np.flatnonzero(station == k)
        table[here, k] = q[here]
        for sense in (1, -1):
            march(stations, table, here, int(k), sense)
    p, k = np.nonzero(np.isfinite(table[:, :, 0]))
    least, log_mu = np.full((2, *table.shape[:2]), -np.inf)
    weakest, room, log_mu[p, k] = node_margins(stations, table[p, k], k)
    least[p, k] = np.minimum(weakest, room)
    return Marches(stations, start, table, least, log_mu)


def seeds_of(
    stations: Stations, start: np.ndarray, number: int, rng: np.random.Generator
) -> tuple[Postures, Int[np.ndarray, " n"]]:
    """The start, postures beside it, to which it comes where it is shut in, and random ones; the station of each."""
    robot = stations.limits.robot  # a joint without limits is within a turn
    span = np.nan_to_num(robot.position_lower, neginf=-np.pi), np.nan_to_num(robot.position_upper, posinf=np.pi)
    random = np.where(stations.moving, rng.uniform(*span, (number, len(start))), start)
    station, near = np.array([0, len(stations) // 2, len(stations) - 1])[np.arange(number) % 3], max(1, number // 8)
    random[:near] = start + stations.moving * rng.normal(0.0, BESIDE, (near, len(start)))
    random[0], station[:near] = start, 0
    return random, station


def out_of_reach(stations: Stations, start: Float[np.ndarray, " nv"], rng: np.random.Generator) -> float:
    """Return how near the hand comes to where it should take hold [m], from 64 random postures."""
    q, station = seeds_of(stations, start, 192, rng)
    q, _ = stations.onto(q[station == 0], station[station == 0], SEED_STEPS)
    return float(np.min(np.linalg.norm(stations.hand.poses(q)[:, :3, 3] - stations.places[0], axis=1)))


def march(
    stations: Stations, table: Float[np.ndarray, "P L nv"], some: Int[np.ndarray, " n"], k: int, sense: int
) -> None:
    """Carry some marches from station k to the end of the way in one sense, as far as each of them comes."""
    while 0 <= k + sense < len(stations) and len(some):
        q, k = table[some, k], k + sense
        there_q, there = stations.onto(q, np.full(len(some), k), MARCH_STEPS)
        there &= np.max(np.abs(there_q - q), axis=1) <= JUMP
        some = some[there]
        table[some, k] = there_q[there]


def relaxed(stations: Stations, q: Postures, *, pinned: bool = False) -> Postures:
    """A path with a larger least margin and a straighter motion of the joints, from one that is on the way.

    Args:
        stations: The way, or its beginning.
        q: One posture a station.
        pinned: The first posture stays as it is.
    """
    k = np.arange(len(q))
    (value, slope, within), rise = soft_margin(stations, q), FIRST_RISE
    for _ in range(BAND_STEPS):
        slope[0] *= not pinned
        largest = np.max(np.abs(slope))
        bent = np.zeros_like(q)
        bent[1:-1] = 0.5 * (q[2:] + q[:-2]) - q[1:-1]
        step = SMOOTH * bent + (rise / largest * slope if largest > 0.0 else 0.0)
        moved, there = stations.onto(q + step, k, MARCH_STEPS)
        if pinned:
            moved[0] = q[0]
        new = soft_margin(stations, moved)
        if np.all(there) and new[0] > value and new[2] >= min(within, 0.0):
            q, (value, slope, within), rise = moved, new, 1.5 * rise
            continue
        rise *= 0.4
        if rise < LEAST_RISE:
            break
    return q


def soft_margin(stations: Stations, q: Postures) -> tuple[float, Postures, float]:
    """A smooth lower bound of the least margin, -log sum exp(-c m) / c over all of them, its gradient, and the least
    margin of the limits of joints.
    """
    limits = stations.limits
    low, high = limits.robot.position_lower, limits.robot.position_upper
    W, U = stations.rows[: len(q)], limits.velocity
    J, H = stations.hand.batch_with_derivative(q)
    scale = 1.0 / stations.needs[: len(q)]
    left, sigmas, right = np.linalg.svd((W @ J) * U * scale[:, :, None], full_matrices=False)
    u, v, sigma = left[:, :, -1] * scale, right[:, -1] * U, sigmas[:, -1]
    weakest = sigma / (sigma + 1.0)
    d_sigma = np.einsum("nr,nrjk,nj->nk", np.einsum("ns,nsr->nr", u, W), H, v)
    room, bounded = rooms(stations, q), np.isfinite(high - low) & stations.moving
    with np.errstate(invalid="ignore"):
        d_room = np.where(bounded, np.where(q - low < high - q, 2.0, -2.0) / (high - low), 0.0)
    dt = np.diff(stations.time[: len(q)])[:, None]
    step = np.diff(q, axis=0)
    speed = 1.0 - np.abs(step) / dt / U
    terms = np.concatenate([weakest, room[:, bounded].ravel(), speed.ravel()])
    least = terms.min()
    weight = np.exp(-SHARPNESS * (terms - least))
    total = weight.sum()
    value = least - np.log(total) / SHARPNESS
    weight /= total
    n = len(q)
    slope = (weight[:n] / (sigma + 1.0) ** 2)[:, None] * d_sigma
    by_room = np.zeros_like(q)
    by_room[:, bounded] = weight[n : n + n * bounded.sum()].reshape(n, -1)
    slope += by_room * d_room
    pushed = weight[n + n * bounded.sum() :].reshape(speed.shape) * np.sign(step) / dt / U
    slope[:-1] += pushed
    slope[1:] -= pushed
    return float(value), slope, float(min(np.min(room), np.min(speed)))
