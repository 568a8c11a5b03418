"""Joint paths through the stations of a hand's motion: from recordings, and from a search.

A demonstrated grasp, configuration and approach are feasible, and familiar to people. Recordings whose grasp is nearest
to the start come first; the first with enough margin is followed, else the one with the largest. The search finds
larger margins:

1. Seeds: inverse kinematics from the start, from configurations near it, and from random configurations, at three
   stations.
2. Candidates: each seed is propagated along the motion in both directions, without null-space motion. The candidate
path
   whose smallest margin is largest is used; among candidates within 0.01 of it, the one with the largest mean log mu.
3. Relaxation: that path is improved as a whole, along the gradient of its smallest margins and towards straight joint
   motion.

A graph with edges between candidates gains nothing: of 80 drawers the same 51 were planned, none with a margin larger
by more than 0.02.
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
from manip_learn.planning.stations import Margins, Postures, Stations, node_margins, path_margins, slack, solve_ik
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import rotation_matrix, rotation_vector

SEED_STEPS, MARCH_STEPS = 40, 4  # Newton steps: from any posture, and from one station to the next
MAX_STEP = 0.5  # [rad or m] largest step of a joint between stations: longer ones lead to another kinematic branch
GOOD_MARGIN = 0.15  # sufficient margin of a recorded motion: with less, limits or a singularity affect the motion
Way = Float[np.ndarray, "L nv"]


@final
@dataclass(frozen=True, eq=False)
class Candidate:
    """Joint path for a motion of the hand.

    Attributes:
        motion: Motion of the hand, from the grasp.
        stations: The same motion, discretised.
        path: Joint positions (L, nv) at the stations [rad or m].
        take: Recording that is followed; None without one.
    """

    motion: FreeDirection
    stations: Stations
    path: Way
    take: Take | None = None

    @cached_property
    def margins(self) -> Margins:
        """Margins of the path."""
        return path_margins(self.stations, self.path)


def demonstrated_grasps(takes: Sequence[Take], shown: Shown, features: Any) -> list[Float[np.ndarray, "4 4"]]:
    """Return the grasp pose of each recording, moved with the fixtures if these were moved since.

    If all contacts began at one position, each grasp is moved there along the mechanism.

    Args:
        takes: Recordings of the motion.
        shown: Summary of the demonstrated motion.
        features: Feature map of the hand.

    Returns:
        One pose (4, 4) per recording, in the base frame or the reference frame of the features [m].
    """
    twist, mechanism = features.twist, shown.mechanism
    grasps = [take.moved @ twist.poses(take.along[:1])[0] for take in takes]
    if not shown.is_way:  # a path on a surface begins where it was demonstrated
        for grasp in grasps:
            grasp[:3, 3] = shown.begin
    lever = 1.0 if shown.unit == "m" else mechanism.radius if mechanism.radius is not None else 0.0
    if shown.hold is None or not shown.is_way or lever < ON_THE_AXIS:
        return grasps
    by_place, begin = replace(shown, mechanism=mechanism.by_place()), shown.chart.grasp
    ahead = np.array([by_place.along(np.array([begin, grasp]))[1, 0] for grasp in grasps])
    return [mechanism.at(grasp, np.inf).pose([-distance]) for grasp, distance in zip(grasps, ahead, strict=True)]


def nearest_turn(robot: Robot, q: Float[np.ndarray, "n nv"], near: Float[np.ndarray, " nv"]) -> np.ndarray:
    """Shift a joint path by whole turns of joints, so that its first configuration is nearest to a given one.

    The shifted path stays within the joint limits.

    Args:
        robot: The robot.
        q: Joint positions (n, nv) along the path [rad or m].
        near: Joint positions (nv,) that the first row should be near to [rad or m].

    Returns:
        Shifted joint positions (n, nv) [rad or m].
    """
    angles = np.array(robot.joint_units) == "rad"
    moved = q - np.where(angles, 2.0 * np.pi * np.round((q[:1] - near) / (2.0 * np.pi)), 0.0)
    beyond = np.any((moved < robot.position_lower) | (moved > robot.position_upper), axis=0)
    return np.where(beyond, q, moved)


def carry_hand(features: Any, q: Postures, moved: Float[np.ndarray, "4 4"]) -> Postures:
    """Move the hand in recorded configurations together with a fixture that was moved, by inverse kinematics.

    Args:
        features: Feature map of the hand.
        q: Recorded joint positions (n, nv) [rad or m].
        moved: Homogeneous matrix (4, 4) of the fixture's rigid motion p' = R p + t in the base frame [m].

    Returns:
        Joint positions (n, nv) with the moved hand [rad or m].
    """
    n_parts = 4  # parts of the rigid motion, each within the convergence of Newton's method
    robot, turn = features.robot, rotation_vector(moved[:3, :3])
    poses, rows = features.twist.poses(q), np.repeat(np.eye(6)[None], len(q), axis=0)
    for part in np.arange(1, n_parts + 1) / n_parts:
        R = rotation_matrix(part * turn)
        places, turns = poses[:, :3, 3] @ R.T + part * moved[:3, 3], R @ poses[:, :3, :3]
        q, _ = solve_ik(features.twist, robot, q, places, turns, rows, MARCH_STEPS)
    return q


def follow_recordings(
    motion: FreeDirection, takes: Sequence[Take], stations: Stations, positions: Float[np.ndarray, " nv"]
) -> Iterator[Candidate]:
    """Yield joint paths that follow recordings, and one from the current configuration if the hand is on the mechanism.

    Paths with enough margin come first, in the order of the recordings; the others follow, the largest margin first.

    Args:
        motion: The demonstrated motion.
        takes: Recordings of the motion.
        stations: The motion, discretised, with the limits and the joints that move the hand.
        positions: Joint positions (nv,) before the motion [rad or m].

    Yields:
        Candidates, at most one with enough margin for each recording.
    """
    others = list[Candidate]()
    for take, variant, at, ways in _attempts(motion, takes, stations, positions):
        for path in (path for way in ways if (path := way()) is not None):
            candidate = Candidate(variant, at, path, take)
            if candidate.margins.margin < GOOD_MARGIN:
                better = replace(candidate, path=relax(at, path, pinned=True))
                candidate = max(candidate, better, key=lambda one: one.margins.margin)
            if candidate.margins.margin >= GOOD_MARGIN:
                yield candidate
                break
            others.append(candidate)
    yield from sorted(others, key=lambda one: -one.margins.margin)


def _attempts(
    motion: FreeDirection, takes: Sequence[Take], stations: Stations, positions: Float[np.ndarray, " nv"]
) -> Iterator[tuple[Take | None, FreeDirection, Stations, list[Callable[[], Way | None]]]]:
    """Yield a recording, its motion and stations, and functions that return its joint path, see `follow_recordings`."""
    shown, features, robot = motion.learnt.shown, motion.learnt.features, stations.limits.robot
    start = robot.configuration(positions)
    if motion.hold(start) == 0.0:
        yield None, motion, stations, [partial(_plain_path, stations, positions)]
    if shown is None:
        return
    takes = [take for take in takes if _begins_in_contact(take, shown, features)] or takes
    both = list(zip(takes, demonstrated_grasps(takes, shown, features), strict=True))
    distances = [np.max(np.abs(nearest_turn(robot, take.along[:1], positions) - positions)) for take in takes]
    for k in np.argsort(distances, kind="stable").tolist():
        take, grasp = both[k]
        variant = motion.taking_hold(grasp)
        at, q = Stations.of(variant, start, stations.limits), np.where(stations.moving, take.along, positions)
        first = carry_hand(features, q[:1], take.moved)[0]
        yield take, variant, at, [partial(_from_take, shown, at, take, q, features), partial(_plain_path, at, first)]


def _begins_in_contact(take: Take, shown: Shown, features: Any) -> bool:
    """Return True if the hand was on the mechanism at the beginning of the contact, judged by its later motion."""
    tolerance = 5e-3  # [m] distance from the mechanism at which the hand is in contact
    poses = take.moved @ features.twist.poses(take.along)
    chart = shown.mechanism.at(poses[len(poses) // 2], np.inf)
    expected = chart.pose(chart.coordinates(poses[0]))
    return float(np.linalg.norm(expected[:3, 3] - poses[0, :3, 3])) <= tolerance


def _from_take(shown: Shown, at: Stations, take: Take, q: Postures, features: Any) -> Way | None:
    """Return the recorded joint path, smoothed along the way and brought onto its stations."""
    # weight of the grasp configuration in the fit, which keeps it; degree of the polynomials that smooth a joint path
    grasp_weight, most = 20.0, 5
    poses, times = take.moved @ features.twist.poses(q), take.time[(take.time >= 0.0) & (take.time <= take.end)]
    if shown.is_way:
        ways = np.abs(shown.along(poses)[:, 0])
        top = int(np.argmax(ways)) + 1
        shares, targets = np.maximum.accumulate(ways[:top]) / max(ways[top - 1], 1e-9), np.abs(at.distance)
    else:  # a path on a surface: the recording in its own time
        top, shares, targets = len(q), times / max(float(times[-1]), 1e-9), at.time
    if top < most:
        return None
    targets = targets / targets[-1]
    degree = min(most if shown.is_way else 2 * most, top // 4)
    weight = np.interp(shares, [0.0, 0.05], [grasp_weight, 1.0])
    fits = [np.polynomial.Polynomial.fit(shares, x, degree, w=weight, domain=[0.0, 1.0]) for x in q[:top].T]
    guess = carry_hand(features, np.column_stack([fit(targets) for fit in fits]), take.moved)
    path, there = at.onto(guess, np.arange(len(at)), 3 * MARCH_STEPS)
    near = np.max(np.abs(np.diff(path, axis=0))) <= MAX_STEP and np.max(np.abs(path - guess)) <= MAX_STEP
    return path if np.all(there) and near else None


def _plain_path(at: Stations, hold: Float[np.ndarray, " nv"]) -> Way | None:
    """Return the joint path from a grasp configuration, without null-space motion."""
    first, there = at.onto(hold[None], np.zeros(1, dtype=int), 5 * MARCH_STEPS)
    if not there[0]:
        return None
    table = np.full((1, len(at), len(hold)), np.nan)
    table[0, 0] = first[0]
    march(at, table, np.array([0]), 0, 1)
    return table[0] if np.all(np.isfinite(table)) else None


def join_approach(path: Postures, start: Float[np.ndarray, " nv"], end: Float[np.ndarray, " nv"]) -> Way | None:
    """Deform a recorded approach so that it leads from the current configuration to a grasp configuration.

    The deformation at each end fades along the path.

    Args:
        path: Recorded joint positions (k, nv) that lead to the grasp [rad or m].
        start: Current joint positions (nv,) [rad or m].
        end: Grasp configuration (nv,) [rad or m].

    Returns:
        Waypoints (n, nv) from `start` to `end`. The part of the recording before it is nearest to `start` is left out.
        None if the recording moves too little to be an approach.
    """
    # share of the approach along which the differences fade; number of knots; smallest motion of a joint [rad or m] in
    # an approach, since a cut recording has none
    blend, n_knots, least = 0.6, 24, 0.05
    if len(path) < 3 or np.max(np.abs(path - path[-1])) < least:
        return None
    distances = np.linalg.norm(path[: max(1, 3 * len(path) // 4)] - start, axis=1)  # its last quarter is always used
    some = path[int(np.argmin(distances)) :]
    at = np.linspace(0.0, 1.0, n_knots)
    knots = np.column_stack([np.interp(at, np.linspace(0.0, 1.0, len(some)), x) for x in some.T])
    x = np.minimum(at / blend, 1.0)
    share = (x * x * (3.0 - 2.0 * x))[:, None]
    return knots + (1.0 - share) * (start - knots[0]) + share * (end - knots[-1])


# ---- the search --------------------------------------------------------------------------------------------------


@final
@dataclass(frozen=True, eq=False)
class PathCandidates:
    """P candidate joint paths through L stations; each path ends at the first station that it cannot reach.

    Attributes:
        stations: The motion, discretised.
        start: Joint positions (nv,) before the motion [rad or m].
        q: Joint positions (P, L, nv) [rad or m]; not finite beyond the end of a path.
        least: Margin (P, L) of each configuration; -inf beyond the end of a path.
        log_mu: Log of the manipulability (P, L) of each configuration.
    """

    stations: Stations
    start: Float[np.ndarray, " nv"]
    q: Float[np.ndarray, "P L nv"]
    least: Float[np.ndarray, "P L"]
    log_mu: Float[np.ndarray, "P L"]

    def where(self, clear: Callable[[Float[np.ndarray, " nv"]], bool]) -> PathCandidates:
        """Cut each path off at its first configuration in collision.

        Args:
            clear: Function that returns True for joint positions (nv,) without collision.

        Returns:
            The shortened paths.
        """
        least = self.least.copy()
        for p, row in enumerate(self.q):
            k = 0
            while k < len(row) and np.isfinite(least[p, k]) and clear(row[k]):
                k += 1
            least[p, k:] = -np.inf
        return replace(self, least=least)

    @cached_property
    def along(self) -> Float[np.ndarray, "P L"]:
        """Smallest margin of each path between the first station and each station (P, L); -inf beyond its end."""
        speed = np.abs(np.diff(self.q, axis=1)) / self.stations.limits.velocity
        steps = 1.0 - speed.max(axis=2, initial=0.0) / np.diff(self.stations.time)
        steps = np.where(np.isfinite(steps), steps, -np.inf)
        return np.minimum.accumulate(np.minimum(self.least, np.insert(steps, 0, np.inf, axis=1)), axis=1)

    @property
    def reached(self) -> int:
        """Index of the last station that any path reaches from the first one; -1 if none reaches the first."""
        return int(np.isfinite(self.along).any(axis=0).sum()) - 1

    def begin_at_start(self, some: Int[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
        """Return whether the grasp configuration of paths is the start, so that no approach is needed.

        Args:
            some: Indices (k,) of the paths.

        Returns:
            Mask (k,).
        """
        return np.max(np.abs(self.q[some, 0] - self.start), axis=1, initial=0.0) < ARRIVED

    def choices(self, last: int) -> Int[np.ndarray, " k"]:
        """Return the paths that reach a station, the best first, without paths with similar grasp configurations.

        Paths with the demonstrated orientation of the grasp come first, and a path from the start before equal ones.

        Args:
            last: Index of the station.

        Returns:
            Indices (k,) of the paths.
        """
        # [rad or m] smallest difference of two choices, in one joint; margins that differ by less are equal, and the
        # manipulability decides
        apart, tie = 0.3, 0.01
        margins = self.along[:, last]
        some = np.flatnonzero(np.isfinite(margins))
        behind = np.floor((margins[some].max(initial=-np.inf) - margins[some]) / tie)
        stand, log_mu = self.begin_at_start(some), self.log_mu[some, : last + 1].mean(axis=1)
        otherwise = ~(stand | self.stations.grasps_as_shown(self.q[some, 0]))
        order = some[np.lexsort((-log_mu, ~stand, behind, otherwise))]
        out: list[int] = []
        for march in order.tolist():
            if not out or np.min(np.max(np.abs(self.q[out, 0] - self.q[march, 0]), axis=1)) > apart:
                out.append(march)
        return np.array(out, dtype=int)


def propagate_candidates(
    stations: Stations, start: Float[np.ndarray, " nv"], number: int, rng: np.random.Generator
) -> PathCandidates:
    """Draw random seeds and propagate each along the whole motion.

    Args:
        stations: The motion, discretised.
        start: Joint positions (nv,) before the motion [rad or m].
        number: Number of seeds.
        rng: Source of random numbers.

    Returns:
        One candidate path for each seed that inverse kinematics moves to its station.
    """
    q, station = draw_seeds(stations, start, number, rng)
    if stations.grip is not None:  # seeds at the first station: try the demonstrated orientation first
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
    return PathCandidates(stations, start, table, least, log_mu)


def draw_seeds(
    stations: Stations, start: np.ndarray, number: int, rng: np.random.Generator
) -> tuple[Postures, Int[np.ndarray, " n"]]:
    """Draw the initial configurations of the search: the start, configurations near it, and random ones.

    Configurations near the start are for an arm that is surrounded by obstacles.

    Args:
        stations: The motion, discretised.
        start: Joint positions (nv,) before the motion [rad or m].
        number: Number of seeds.
        rng: Source of random numbers.

    Returns:
        Joint positions (n, nv) [rad or m], and the index (n,) of the station to which each is to be moved.
    """
    spread = 0.5  # [rad or m] standard deviation of an eighth of the seeds, around the start
    robot = stations.limits.robot  # a joint without limits is within a turn
    span = np.nan_to_num(robot.position_lower, neginf=-np.pi), np.nan_to_num(robot.position_upper, posinf=np.pi)
    random = np.where(stations.moving, rng.uniform(*span, (number, len(start))), start)
    station, near = np.array([0, len(stations) // 2, len(stations) - 1])[np.arange(number) % 3], max(1, number // 8)
    random[:near] = start + stations.moving * rng.normal(0.0, spread, (near, len(start)))
    random[0], station[:near] = start, 0
    return random, station


def distance_to_grasp(stations: Stations, start: Float[np.ndarray, " nv"], rng: np.random.Generator) -> float:
    """Return how near the hand can come to the grasp, by inverse kinematics from 64 random configurations.

    Args:
        stations: The motion, discretised.
        start: Joint positions (nv,) before the motion [rad or m].
        rng: Source of random numbers.

    Returns:
        Smallest distance of the hand's position from the grasp [m].
    """
    q, station = draw_seeds(stations, start, 192, rng)
    q, _ = stations.onto(q[station == 0], station[station == 0], SEED_STEPS)
    return float(np.min(np.linalg.norm(stations.hand.poses(q)[:, :3, 3] - stations.places[0], axis=1)))


def march(
    stations: Stations, table: Float[np.ndarray, "P L nv"], some: Int[np.ndarray, " n"], k: int, sense: int
) -> None:
    """Propagate candidate paths from one station to the end of the motion, each as far as inverse kinematics succeeds.

    Args:
        stations: The motion, discretised.
        table: Joint positions (P, L, nv) of all paths [rad or m], filled in place; not finite beyond the end of a path.
        some: Indices (n,) of the paths to propagate; these have a configuration at station k.
        k: Index of the first station.
        sense: 1 for forward, -1 for backward along the motion.
    """
    while 0 <= k + sense < len(stations) and len(some):
        q, k = table[some, k], k + sense
        there_q, there = stations.onto(q, np.full(len(some), k), MARCH_STEPS)
        there &= np.max(np.abs(there_q - q), axis=1) <= MAX_STEP
        some = some[there]
        table[some, k] = there_q[there]


def relax(stations: Stations, q: Postures, *, pinned: bool = False) -> Postures:
    """Improve a joint path: increase its smallest margin and straighten the joint motion.

    Args:
        stations: The motion, discretised, or its beginning.
        q: Joint positions (k, nv), one row per station [rad or m].
        pinned: True to keep the first configuration.

    Returns:
        Improved joint positions (k, nv) at the same stations [rad or m].
    """
    # [rad or m] first step up the gradient, of the joint that moves most, and step at which the relaxation ends
    first_rise, least_rise = 0.05, 1e-3
    # largest number of steps, of which the first gain most; share of a knot's distance to the mean of its neighbours,
    # in one step
    most_steps, smoothing = 80, 0.25
    k = np.arange(len(q))
    (value, slope, within), rise = soft_margin(stations, q), first_rise
    for _ in range(most_steps):
        slope[0] *= not pinned
        largest = np.max(np.abs(slope))
        bent = np.zeros_like(q)
        bent[1:-1] = 0.5 * (q[2:] + q[:-2]) - q[1:-1]
        step = smoothing * bent + (rise / largest * slope if largest > 0.0 else 0.0)
        moved, there = stations.onto(q + step, k, MARCH_STEPS)
        if pinned:
            moved[0] = q[0]
        new = soft_margin(stations, moved)
        if np.all(there) and new[0] > value and new[2] >= min(within, 0.0):
            q, (value, slope, within), rise = moved, new, 1.5 * rise
            continue
        rise *= 0.4
        if rise < least_rise:
            break
    return q


def soft_margin(stations: Stations, q: Postures) -> tuple[float, Postures, float]:
    """Compute a smooth lower bound of the smallest margin of a joint path, and its gradient.

    With all margins m and a constant c, the bound is -log(sum of exp(-c m)) / c.

    Args:
        stations: The motion, discretised, or its beginning.
        q: Joint positions (k, nv), one row per station [rad or m].

    Returns:
        Bound, its gradient (k, nv), and the exact smallest margin of the joint ranges and speeds.
    """
    sharpness = 60.0  # sharpness of the soft minimum: margins a sixtieth apart differ e-fold in weight
    limits = stations.limits
    low, high = limits.robot.position_lower, limits.robot.position_upper
    W, U = stations.rows[: len(q)], limits.velocity
    J, H = stations.hand.batch_with_derivative(q)
    scale = 1.0 / stations.needs[: len(q)]
    leading, sigmas, right = np.linalg.svd((W @ J) * U * scale[:, :, None], full_matrices=False)
    u, v, sigma = leading[:, :, -1] * scale, right[:, -1] * U, sigmas[:, -1]
    weakest = sigma / (sigma + 1.0)
    d_sigma = np.einsum("nr,nrjk,nj->nk", np.einsum("ns,nsr->nr", u, W), H, v)
    room, bounded = slack(stations, q), np.isfinite(high - low) & stations.moving
    with np.errstate(invalid="ignore"):
        d_room = np.where(bounded, np.where(q - low < high - q, 2.0, -2.0) / (high - low), 0.0)
    dt = np.diff(stations.time[: len(q)])[:, None]
    step = np.diff(q, axis=0)
    speed = 1.0 - np.abs(step) / dt / U
    terms = np.concatenate([weakest, room[:, bounded].ravel(), speed.ravel()])
    least = terms.min()
    weight = np.exp(-sharpness * (terms - least))
    total = weight.sum()
    value = least - np.log(total) / sharpness
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
