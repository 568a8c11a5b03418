"""The search for a way: postures at its stations, joined into the path whose least margin is largest.

1. Seeds: inverse kinematics from random postures, and steps along the self-motion from the start, at three stations.
2. Marches: each seed is carried along the way in both directions. Some let the spare joints rest, some pull them to the
   middle of their ranges, some up the manipulability.
3. Ladder: the postures of all marches are the nodes of a graph, a layer a station; joints can go from a node to one of
   the next layer within their speeds. The path whose least margin is largest is found layer by layer; of those that
   come within `TIE` of it, the one with the largest mean log mu.
4. Band: that path is relaxed as a whole, up the slope of its least margins and towards straight joint motion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.manipulability_batch import manipulability_batch
from manip_learn.control.policies import ASCENT_GAIN
from manip_learn.planning.stations import Postures, Stations, node_margins, rooms

SEED_STEPS, MARCH_STEPS = 40, 4  # of Newton's method: from anywhere, and from a station to the next
SELF_MOTION = 0.25  # [rad or m] of the largest joint's step along the self-motion: a circle of it has 25 such steps
SHARE = 0.125  # of the seeds: those along the self-motion of the start
PULL = 0.3  # share of the joints' speeds that spare joints may use while the way is marched along
TIE = 0.01  # margins nearer to each other than a hundredth of the limits are alike: the manipulability decides
TURN = 2.0 * np.pi
JUMP = 0.5  # [rad or m] of a joint from one station to the next: a longer step is another branch of the kinematics
SHARPNESS = 60.0  # of the soft minimum: margins a sixtieth apart count e-fold
BAND_STEPS = 80  # at most; the first ones gain most
SMOOTH = 0.25  # share of a knot's way to the middle of its neighbours, a step
FIRST_RISE = 0.05  # [rad or m] of the joint that moves most in the first step up the slope
LEAST_RISE = 1e-3  # and where the relaxation ends
ROUGH = 1.0  # log mu that a node may lose for a step at full speed, when ties are decided: straight joint motion


@final
@dataclass(frozen=True, eq=False)
class Ladder:
    """Postures of P marches at L stations, and the best paths to each of them.

    Attributes:
        stations: The way.
        q: shape (P, L, nv), postures; not finite where a march did not come so far.
        grasp: shape (P, 3, 3), orientation of the hand at the start of each march's way.
        family: shape (P,), marches of the same number may go over into each other.
        allowed: shape (P, L), nodes that may be used.
        least: shape (P, L), margin of each node.
        log_mu: shape (P, L), log of the manipulability of each node.
        is_as_shown: Whether paths have to begin with the hand turned as in the recordings.
    """

    stations: Stations
    q: Float[np.ndarray, "P L nv"]
    grasp: Float[np.ndarray, "P 3 3"]
    family: Int[np.ndarray, " P"]
    allowed: Bool[np.ndarray, "P L"]
    least: Float[np.ndarray, "P L"]
    log_mu: Float[np.ndarray, "P L"]
    is_as_shown: bool = False

    @property
    def as_shown(self) -> Ladder:
        """This ladder with those first nodes only whose hand is turned as in the recordings."""
        allowed = self.allowed.copy()
        first = np.flatnonzero(allowed[:, 0])
        allowed[first, 0] = self.stations.takes_hold_as_shown(self.q[first, 0])
        return replace(self, allowed=allowed, is_as_shown=True)

    def where(self, clear: Callable[[Float[np.ndarray, " nv"]], bool]) -> Ladder:
        """This ladder with those nodes only whose postures are clear."""
        allowed = self.allowed.copy()
        for p, k in np.argwhere(allowed).tolist():
            allowed[p, k] = clear(self.q[p, k])
        return replace(self, allowed=allowed)

    @cached_property
    def whole(self) -> Float[np.ndarray, " P"]:
        """`margins_to` the end of the way."""
        return self.margins_to(len(self.stations) - 1)

    def margins_to(self, last: int) -> Float[np.ndarray, " P"]:
        """The largest least margin of a path from each march's first node to a station; -inf where there is none."""
        ahead = np.where(self.allowed[:, last], self.least[:, last], -np.inf)
        for k in range(last - 1, -1, -1):
            i, j, edge = self._edges(k, self.allowed[:, k], np.isfinite(ahead))
            on = np.minimum(edge, ahead[j]).max(axis=1, initial=-np.inf)
            ahead = np.full(len(self.q), -np.inf)
            ahead[i] = np.minimum(self.least[i, k], on)
        return ahead

    def reached(self) -> int:
        """The last station to which a path leads from the first; -1 where no posture takes hold."""
        on = self.allowed[:, 0]
        for k in range(len(self.stations) - 1):
            if not on.any():
                return k - 1
            _, j, edge = self._edges(k, on, self.allowed[:, k + 1])
            ahead = np.zeros_like(on)
            ahead[j] = np.isfinite(edge).any(axis=0)
            on = ahead
        return len(self.stations) - 1 if on.any() else len(self.stations) - 2

    def path(self, first: int, last: int, floor: float) -> Int[np.ndarray, " k"]:
        """The marches that a path goes through, station by station: of those above a floor that of the largest mu.

        Args:
            first: Number of its march.
            last: Station at which it ends.
            floor: A margin that one path at least has.
        """
        best: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        high = self.allowed & (self.least >= floor)
        ahead = np.where(high[:, last], self.log_mu[:, last], -np.inf)
        for k in range(last - 1, -1, -1):
            i, j, edge = self._edges(k, high[:, k], np.isfinite(ahead))
            gain = np.where(edge >= floor, ahead[j] - ROUGH * (1.0 - edge) ** 2, -np.inf)
            choice = gain.argmax(axis=1)
            best.append((i, j, choice))
            ahead = np.full(len(self.q), -np.inf)
            ahead[i] = self.log_mu[i, k] + gain[np.arange(len(i)), choice]
        marches = [first]
        for i, j, choice in reversed(best):
            marches.append(int(j[choice[np.flatnonzero(i == marches[-1])[0]]]))
        return np.array(marches)

    def _edges(
        self, k: int, here: Bool[np.ndarray, " P"], ahead: Bool[np.ndarray, " P"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Some nodes of layer k, some of the next, and what the step between them leaves of the joints' speeds."""
        i, j = np.flatnonzero(here), np.flatnonzero(ahead)
        before, after, wound = self.q[i, k].T, self.q[j, k + 1].T, self._wound
        fastest, longest = np.zeros((len(i), len(j))), np.zeros((len(i), len(j)))
        for joint, (speed, turns) in enumerate(zip(self.stations.limits.velocity, wound, strict=True)):
            step = after[joint] - before[joint][:, None]
            if turns:
                step -= TURN * np.round(step / TURN)
            step = np.abs(step)
            np.maximum(longest, step, out=longest)
            np.maximum(fastest, step / speed, out=fastest)
        left = 1.0 - fastest / (self.stations.time[k + 1] - self.stations.time[k])
        far = (longest > JUMP) | (self.family[i][:, None] != self.family[j])
        return i, j, np.where(far, -np.inf, left)

    def postures(self, marches: Int[np.ndarray, " k"]) -> Postures:
        """The postures of a path; joints without limits go on from station to station by less than half a turn."""
        path = self.q[marches, np.arange(len(marches))]
        steps = np.diff(path, axis=0)
        steps -= np.where(self._wound, TURN * np.round(steps / TURN), 0.0)
        return np.vstack([path[:1], path[0] + np.cumsum(steps, axis=0)])

    @property
    def _wound(self) -> Bool[np.ndarray, " nv"]:
        """Joints that turn without limits."""
        robot = self.stations.limits.robot
        return (np.array(robot.joint_units) == "rad") & ~np.isfinite(robot.position_upper - robot.position_lower)


def ladder_of(
    stations: Stations,
    rows: Constraint,
    start: Float[np.ndarray, " nv"],
    number: int,
    rng: np.random.Generator,
    grasps: Float[np.ndarray, "g 3 3"],
    weighed: Stations | None = None,
) -> Ladder:
    """Seeds, and their marches along the whole way.

    Args:
        stations: The way.
        rows: The rows held and driven, whose manipulability some marches climb.
        start: Joint positions before the motion.
        number: Of seeds.
        rng: Random numbers.
        grasps: Orientations in which the hand may take hold, where the rows hold orientations; tried in turn.
        weighed: The same way with the rows whose margins count, where the search holds others too; None for the same.
    """
    q, station, family = seeds_of(stations, start, number, rng, len(grasps))
    if stations.grip is not None:  # seeds where the hand takes hold: first those turned as in the recordings
        some = np.flatnonzero(station == 0)
        q[some], _ = stations.posed().onto(q[some], station[some], stations.grips(len(some), rng), SEED_STEPS)
    q, there = stations.onto(q, station, grasps[family], SEED_STEPS)
    q, station, family = q[there], station[there], family[there]
    # without those that inverse kinematics found twice, to a thousandth of a radian or a metre
    first = np.sort(np.unique(np.column_stack([np.round(q, 3), station, family]), axis=0, return_index=True)[1])
    q, station, family = q[first], station[first], family[first]
    P, L, nv = len(q), len(stations), q.shape[1]
    table, kind = np.full((P, L, nv), np.nan), np.arange(P) % 3
    for k in np.unique(station):
        here = np.flatnonzero(station == k)
        table[here, k] = q[here]
        for sense in (1, -1):
            _march(stations, rows, table, here, grasps[family], kind, int(k), sense)
    alive = np.isfinite(table[:, :, 0])
    p, k = np.nonzero(alive)
    nodes = node_margins(weighed or stations, table[p, k], k)
    least, log_mu = np.full((P, L), -np.inf), np.full((P, L), -np.inf)
    least[p, k], log_mu[p, k] = nodes.least, nodes.log_mu
    return Ladder(weighed or stations, table, grasps[family], family, alive, least, log_mu)


def seeds_of(
    stations: Stations, start: np.ndarray, number: int, rng: np.random.Generator, n_grasps: int
) -> tuple[Postures, Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """The start, postures along its self-motion, and random ones; the station and the grasp of each."""
    low, high = stations.span
    random = np.where(stations.moving, rng.uniform(low, high, (number, len(start))), start)
    station = np.array([0, len(stations) // 2, len(stations) - 1])[np.arange(number) % 3]
    walked = max(1, round(SHARE * number))
    # in a row along a direction that leaves the hand where it is, half of them one way, half the other
    A = stations.matrices(start[None], np.zeros(1, dtype=int))[0]
    direction = rng.normal(size=len(start)) * stations.moving
    direction -= np.linalg.pinv(A) @ (A @ direction)
    size, half = np.max(np.abs(direction)), walked // 2
    step = SELF_MOTION * direction / size if size > 1e-9 else np.zeros_like(start)
    places = np.concatenate([np.arange(1, half + 1), -np.arange(walked - half)])[:, None]
    random[1:walked], station[:walked] = (start + places * step)[1:], 0
    random[0] = start
    family = np.arange(number) // 3 % n_grasps
    family[:walked] = 0
    return random, station, family


def _march(
    stations: Stations,
    rows: Constraint,
    table: Float[np.ndarray, "P L nv"],
    some: Int[np.ndarray, " n"],
    grasp: Float[np.ndarray, "P 3 3"],
    kind: Int[np.ndarray, " P"],
    k: int,
    sense: int,
) -> None:
    """Carry some marches from station k to the end of the way in one sense, as far as each of them comes."""
    while 0 <= k + sense < len(stations) and len(some):
        q = table[some, k]
        time = abs(stations.time[k + sense] - stations.time[k])
        pull = _pulls(stations, rows, q, kind[some]) * time
        k += sense
        there_q, there = stations.onto(q, np.full(len(some), k), grasp[some], MARCH_STEPS, pull)
        there &= np.max(np.abs(there_q - q), axis=1) <= JUMP
        some = some[there]
        table[some, k] = there_q[there]


def _pulls(stations: Stations, rows: Constraint, q: Postures, kind: Int[np.ndarray, " n"]) -> Postures:
    """Where the spare joints are drawn to: nowhere, to the middle of their ranges, or up mu [rad/s or m/s]."""
    out, most = np.zeros_like(q), PULL * stations.limits.velocity
    low, high = stations.limits.robot.position_lower, stations.limits.robot.position_upper
    middle, climbs = kind == 1, kind == 2
    if middle.any():
        with np.errstate(invalid="ignore"):
            off = np.where(np.isfinite(high - low), (2.0 * q[middle] - low - high) / (high - low), 0.0)
        out[middle] = -most * off**3 * stations.moving
    if climbs.any():
        slope = ASCENT_GAIN * manipulability_batch(rows, q[climbs]).log_gradient
        out[climbs] = slope * np.minimum(1.0, np.min(most / np.maximum(np.abs(slope), 1e-12), axis=1))[:, None]
    return out


def relaxed(stations: Stations, q: Postures, grasp: Float[np.ndarray, "3 3"]) -> Postures:
    """A path with a larger least margin and a straighter motion of the joints, from one that is on the way.

    Args:
        stations: The way, or its beginning.
        q: One posture a station.
        grasp: Orientation of the hand at the start.
    """
    k, grasps = np.arange(len(q)), np.repeat(grasp[None], len(q), axis=0)
    (value, slope, within), rise = soft_margin(stations, q), FIRST_RISE
    for _ in range(BAND_STEPS):
        largest = np.max(np.abs(slope))
        bent = np.zeros_like(q)
        bent[1:-1] = 0.5 * (q[2:] + q[:-2]) - q[1:-1]
        step = SMOOTH * bent + (rise / largest * slope if largest > 0.0 else 0.0)
        moved, there = stations.onto(q + step, k, grasps, MARCH_STEPS)
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
    J, H = stations.hand.derivative(q)
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
