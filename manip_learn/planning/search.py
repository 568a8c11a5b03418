"""The search for a way: postures at its stations, carried along all of it.

1. Seeds: the start, and inverse kinematics from random postures, at three stations.
2. Marches: each seed is carried along the way in both directions, its spare joints at rest. The march whose least
   margin is largest is the way; of those within `TIE` of it, the one with the largest mean log mu.
3. Band: that march is relaxed as a whole, up the slope of its least margins and towards straight joint motion.

Marches that go over into each other on the way, as the nodes of a graph, gain nothing: of 80 drawers the same 51 were
planned, none with a margin larger by more than 0.02.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np
from jaxtyping import Bool, Float, Int

from manip_learn.control.follow_motion import ARRIVED
from manip_learn.planning.stations import Postures, Stations, node_margins, rooms

SEED_STEPS, MARCH_STEPS = 40, 4  # of Newton's method: from anywhere, and from a station to the next
APART = 0.3  # [rad or m] of the joint that differs most: nearer postures are one and the same choice
TIE = 0.01  # margins nearer to each other than a hundredth of the limits are alike: the manipulability decides
JUMP = 0.5  # [rad or m] of a joint from one station to the next: a longer step is another branch of the kinematics
SHARPNESS = 60.0  # of the soft minimum: margins a sixtieth apart count e-fold
BAND_STEPS = 80  # at most; the first ones gain most
SMOOTH = 0.25  # share of a knot's way to the middle of its neighbours, a step
FIRST_RISE = 0.05  # [rad or m] of the joint that moves most in the first step up the slope
LEAST_RISE = 1e-3  # and where the relaxation ends


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
    # without those that inverse kinematics found twice, to a thousandth of a radian or a metre
    first = np.sort(np.unique(np.column_stack([np.round(q, 3), station]), axis=0, return_index=True)[1])
    q, station = q[first], station[first]
    P, L, nv = len(q), len(stations), q.shape[1]
    table = np.full((P, L, nv), np.nan)
    for k in np.unique(station):
        here = np.flatnonzero(station == k)
        table[here, k] = q[here]
        for sense in (1, -1):
            march(stations, table, here, int(k), sense)
    p, k = np.nonzero(np.isfinite(table[:, :, 0]))
    least, log_mu = np.full((P, L), -np.inf), np.full((P, L), -np.inf)
    weakest, room, log_mu[p, k] = node_margins(stations, table[p, k], k)
    least[p, k] = np.minimum(weakest, room)
    return Marches(stations, start, table, least, log_mu)


def seeds_of(
    stations: Stations, start: np.ndarray, number: int, rng: np.random.Generator
) -> tuple[Postures, Int[np.ndarray, " n"]]:
    """The start, and random postures; the station of each."""
    random = np.where(stations.moving, rng.uniform(*stations.span, (number, len(start))), start)
    random[0] = start
    return random, np.array([0, len(stations) // 2, len(stations) - 1])[np.arange(number) % 3]


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
