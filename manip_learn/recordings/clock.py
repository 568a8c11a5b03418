"""Time stamps, doubted by one rule: where they contradict the positions, the order and the number of samples count."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from manip_learn.errors import advice, counted

GAP_FACTOR = 10.0  # times the usual step: a break in a recording
# gaps of a recording that stopped and went on; more, and more than one in 200 samples, are how stamps come
FEW_GAPS = 2
_SHORT = 0.1  # of the usual step: stamped almost at once
_COARSE = 0.05  # of the usual step: stamps that are multiples of so much or more are rounded
FEWEST_STAMPS = 8  # samples whose stamps are doubted
_NEAR = 10  # messages within which a late one is followed by one that is where it would have been
SENDERS = 10  # changes between two clocks, at least; one that was set back changes once
TOO_MANY = 0.2  # of the steps lead back: the rows are in no order
_JUMP = 10.0  # times a usual step of the positions: another motion begins


class Run(NamedTuple):
    """Samples of one sender in the order of their times, by their numbers; a slice where all are in order."""

    samples: Int[np.ndarray, " T"] | slice
    time: Float[np.ndarray, " T"]


def usual_step(steps: Float[np.ndarray, " n"]) -> float:
    """Median of the steps between stamps [s]; for so short a question NumPy's own takes longer to start than to do."""
    ordered, half = np.sort(steps), len(steps) // 2
    return float(ordered[half] if len(steps) % 2 else 0.5 * (ordered[half - 1] + ordered[half]))


def pieces(time: Float[np.ndarray, " T"]) -> tuple[list[slice], Int[np.ndarray, " gaps"]]:
    """Runs of samples without a gap longer than ten times the usual step, and the samples before each gap."""
    steps = np.diff(time)
    gaps = np.flatnonzero(steps > GAP_FACTOR * usual_step(steps))
    bounds = [0, *(int(g) + 1 for g in gaps), time.shape[0]]
    return [slice(a, b) for a, b in zip(bounds, bounds[1:], strict=False)], gaps


def senders_in_order(
    time: Float[np.ndarray, " T"], q: Float[np.ndarray, "T n"], arrival: Float[np.ndarray, " T"] | None = None
) -> tuple[list[Run], list[str]]:
    """Samples as they arrived -> those of each sender in the order of their times, and notes.

    Stamps that lead back and forth between two clocks are those of two senders. After a late message the next stamp is
    where it would have been; after a clock was set back it is not, and all later stamps are moved on.

    Args:
        time: Stamps in the order of arrival [s].
        q: Positions.
        arrival: When each message was received [s]; None: one after the other.

    Returns:
        No run if the samples are in no order.
    """
    n, steps = len(time), np.diff(time)
    back = np.flatnonzero(steps < 0.0)
    if not back.size:
        return [Run(slice(None), time)], []
    if arrival is not None:
        own, theirs = np.quantile(np.abs(np.stack([steps, np.diff(arrival)])), 0.25, axis=1)
        arrival = arrival if 0.5 * theirs < own < 2.0 * theirs else None  # of a bag that was written later
    received = np.polyval(np.polyfit(np.arange(n), time, 1), np.arange(n)) if arrival is None else arrival
    ahead = _later_clock(time - received)
    if np.count_nonzero(np.diff(ahead)) >= SENDERS:
        apart = np.median((time - received)[ahead]) - np.median((time - received)[~ahead])
        runs, notes = [], [f"two senders, whose clocks are {apart:.3g} s apart, were told apart by their stamps"]
        for of_one in (~ahead, ahead):
            own = np.flatnonzero(of_one)
            found, said = senders_in_order(time[own], q[own], None if arrival is None else arrival[own])
            runs += [Run(own[run.samples], run.time) for run in found]
            notes += said
        return runs, notes
    if len(back) > TOO_MANY * n:
        return [], []
    step = usual_step(steps[steps > 0.0])
    expected = np.full(n - 1, step) if arrival is None else np.diff(arrival)
    late, moved, notes = np.zeros(n, dtype=bool), np.zeros(n), []
    typical = np.quantile(np.linalg.norm(np.diff(q, axis=0), axis=1), 0.95)
    for k in back.tolist():
        lost = float(expected[k] - steps[k])
        first = max(0, k - _NEAR)
        excess = (steps - expected)[first : k + 1 + _NEAR]
        made_good = first + np.flatnonzero((excess > 0.4 * lost) & (excess < 1.6 * lost))
        if made_good.size:
            j = int(made_good[np.argmin(np.abs(made_good - k))])
            late[min(j, k) + 1 : max(j, k) + 1] = True
            continue
        size = float(np.linalg.norm(q[k + 1] - q[k]))
        another = size > _JUMP * typical and size > 0.02  # [rad or m], more than noise
        moved[k + 1 :] += lost + (100.0 * step if another else 0.0)
        what = "another motion begins" if another else "as if it had gone on"
        notes.append(f"the clock was set back by {lost:.3g} s after {time[k]:.9g} s: {what}")
    time = time + moved
    if np.any(late):
        count = counted(np.count_nonzero(late), "sample")
        placed = np.interp(np.arange(n), np.flatnonzero(~late), time[~late])
        by_stamp = np.argsort(time, kind="stable")
        if _roughness(q[by_stamp]) <= _roughness(q):
            notes.append(f"{count} came late: sorted by their stamps")
            return [Run(by_stamp, time[by_stamp])], notes
        time = placed
        notes.append(f"{count} with stamps out of order: placed between their neighbours, where the positions fit")
    order = np.argsort(time, kind="stable")
    return [Run(order, time[order])], notes


def _later_clock(offset: Float[np.ndarray, " T"]) -> Bool[np.ndarray, " T"]:
    """Samples above the widest gap between the offsets of a clock."""
    ordered = np.sort(offset)
    i = int(np.argmax(np.diff(ordered)))
    return offset > 0.5 * (ordered[i] + ordered[i + 1])


def _roughness(q: Float[np.ndarray, "T n"]) -> float:
    return float(np.sum(np.abs(np.diff(q, 2, axis=0))))


def evenly_spread(time: Float[np.ndarray, " T"], q: Float[np.ndarray, "T n"]) -> tuple[Float[np.ndarray, " T"], str]:
    """Times of samples whose stamps come in bunches, are repeated or coarse, by their count; and a note.

    The positions decide: if samples were taken evenly, a step between bunches moves the arm no farther than one within;
    if stamps are right, as much farther as it takes longer. Gaps, which no bunch beside them makes up for, stay.

    Args:
        time: Stamps that do not lead back [s].
        q: Positions.
    """
    n, steps = len(time), np.diff(time)
    if n < FEWEST_STAMPS or time[-1] <= time[0]:
        return time, ""
    mean, usual = (time[-1] - time[0]) / (n - 1), usual_step(steps)
    grain = _grain(steps, mean)
    if not (np.min(steps) < _SHORT * mean or grain >= _COARSE * mean):
        return time, ""
    gaps, rates = _gaps(steps, usual)
    always = bool(np.count_nonzero(gaps) > max(FEW_GAPS, n / 200.0))
    if always:  # no gaps, but how the stamps come
        gaps, _ = _gaps(steps, usual_step(rates))
    inside = ~gaps
    step = float(np.sum(steps[inside]) / max(np.count_nonzero(inside), 1))
    grain = _grain(steps[inside], step) if step > 0.0 else mean
    if not (np.min(steps[inside]) < _SHORT * step or grain >= _COARSE * step):
        return time, ""
    spread, bounds = np.empty(n), [0, *(np.flatnonzero(gaps) + 1).tolist(), n]
    for a, b in zip(bounds, bounds[1:], strict=False):  # even times within each stretch, from the changes of its stamps
        own = time[a:b]
        begins = 1 + np.flatnonzero(np.diff(own) > 0.5 * step)
        anchor, rate = (int(begins[0]) if begins.size else 0), step
        if len(begins) > 1:
            rate = (own[begins[-1]] - own[begins[0]]) / (begins[-1] - begins[0])
        spread[a:b] = own[anchor] + rate * (np.arange(b - a) - anchor)
    if np.min(np.diff(spread)) <= 0.0 or not _taken_evenly(steps, q, step, inside, always=always):
        return time, ""
    short, apart = np.count_nonzero(steps < _SHORT * step), usual_step(np.diff(spread))
    what = f"{short:,} of {n - 1:,} steps between stamps are under a tenth of the usual one"
    if grain >= _COARSE * step and not short:
        what = f"the stamps are multiples of {grain:.3g} s"
    how = advice(" ({} overrules them)", "rate=", "--rate")
    return spread, f"{what}: samples are spread evenly over the time they took, {apart:.3g} s apart{how}"


def _grain(steps: Float[np.ndarray, " n"], mean: float) -> float:
    """What all uneven steps are multiples of, to a hundredth of the mean step; 0 where they are even [s]."""
    values = np.unique(np.round(steps / (0.01 * mean)))
    return 0.01 * mean * float(np.min(np.diff(values))) if 1 < len(values) < 1000 else 0.0


def _gaps(steps: Float[np.ndarray, " n"], usual: float) -> tuple[Bool[np.ndarray, " n"], Float[np.ndarray, " long"]]:
    """Steps longer than ten usual ones and than three times what samples crowded together beside them make up for; and
    of all that are longer than ten usual ones the time for each sample of the longer run beside it [s].
    """
    long = np.flatnonzero(steps > GAP_FACTOR * usual)
    ends = np.concatenate([[-1], np.flatnonzero(steps >= max(0.5 * usual, 1e-300)), [len(steps)]])
    at = np.searchsorted(ends, long)
    beside = np.maximum(ends[at] - ends[at - 1], ends[at + 1] - ends[at])
    out = np.zeros(len(steps), dtype=bool)
    out[long] = steps[long] > 3.0 * usual * beside
    # against the whole run between two such steps
    bounds = np.concatenate([[-1], long, [len(steps)]])
    runs = np.maximum(np.diff(bounds)[:-1], np.diff(bounds)[1:])
    return out, steps[long] / runs


def _taken_evenly(
    steps: Float[np.ndarray, " s"],
    q: Float[np.ndarray, "T n"],
    step: float,
    inside: Bool[np.ndarray, " s"],
    *,
    always: bool,
) -> bool:
    """Whether the arm moves as far in long steps as in their neighbours; if stamps always come so, also about as far as
    in all others, for at rest it moves nowhere.
    """
    moved = np.linalg.norm(np.diff(q, axis=0), axis=1)
    beside = 0.5 * (np.append(moved[1:2], moved[:-1]) + np.append(moved[1:], moved[-2:-1]))
    excess = np.where(inside, np.maximum(steps - step, 0.0), 0.0)
    total, longer = float(np.sum(excess)), float(np.sum(excess * steps))
    by_count = float(np.sum(excess * beside))
    if total <= 0.0 or by_count <= 0.0:
        return False
    ratio, by_stamps = float(np.sum(excess * moved)) / by_count, longer / (total * step)
    overall = by_count / (total * float(np.mean(moved[inside])))
    return bool(abs(np.log(max(ratio, 1e-9))) < 0.5 * np.log(by_stamps) and (not always or 0.3 < overall < 3.0))


def spread_repeats(time: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
    """Repeated stamps spread up to the next one."""
    first = np.concatenate([[True], np.diff(time) > 0.0])
    begins = np.flatnonzero(first)
    last = time[begins[-1]] + (time[begins[-1]] - time[begins[0]]) / max(begins[-1], 1) * (len(time) - begins[-1])
    return np.interp(np.arange(len(time)), np.append(begins, len(time)), np.append(time[begins], last))
