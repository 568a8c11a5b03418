"""Whether recorded velocities have earned their place beside the positions, which are the truth.

At several time scales the integral of a velocity is compared with the displacement of its joint. What the noise of the
positions does not explain is an error of the velocity; so is the velocity's own noise. A recording keeps its velocities
if at no time scale they are farther off than those that are derived from its positions. These are off by noise and bias
within a window, and over longer times by less and less, since they integrate to the positions.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.errors import RecordingError, advice, counted, listed
from manip_learn.recordings.clock import pieces
from manip_learn.recordings.local_fit import best_windows, noise_variance, slope_variance
from manip_learn.recordings.trajectory import Trajectory, evenly
from manip_learn.recordings.velocities import SHORT_AND_CLEAN, VelocityMethod, is_clean, positions_along
from manip_learn.robot.robot import Robot

Velocities = Literal["auto", "derive", "recorded"]

FEWEST_JUDGED = 8  # samples of a stretch without gaps that can be judged
_LONGEST, _MOST = 4096, 4  # samples in a stretch, and stretches, that are judged: any fault shows in so many
# share of the largest step by which a velocity that was held over each step may miss the next position: 6 digits
_HELD = 1e-6
_ROUNDED = 1.5  # quanta by which two rounded positions and a rounded velocity may miss each other
# The noise of the positions is known within a factor of 2; beyond it counts what is also beyond chance: the mean of n
# squares exceeds its estimate by 3 sqrt(2 / n) in 1 of 700 cases
_KNOWN, CHANCE = 2.0, 3.0
# Shares of the speed below which an error of recorded velocities does not matter: what integration leaves; and of fewer
# samples than leave room for windows, whose midpoints are off by up to half a step, what no noise explains
_FINE, _COARSE = 1e-4, 0.3
_GRID = 0.01  # share of a quantum by which values may miss its multiples
NO_MEASUREMENT = 1e50  # a finite number whose square would overflow

_Stretch = tuple[np.ndarray, np.ndarray, np.ndarray]  # time, positions, velocities


def used_and_derived(choice: VelocityMethod | Velocities) -> tuple[Velocities, VelocityMethod]:
    """Which recorded velocities are used and how others are derived, by the one word for both."""
    if choice == "midpoint" or choice == "smooth":
        return "auto", choice
    return choice, "auto"


class _Verdict(NamedTuple):
    """Errors at the time scale at which recorded velocities are worst beside derived ones, shape (n,) each.

    Attributes:
        recorded: Root mean square error of each joint's recorded velocity [rad/s or m/s].
        derived: Likewise of those that would be derived.
        least: What both must exceed, all joints together, to matter.
    """

    recorded: Float[np.ndarray, " n"]
    derived: Float[np.ndarray, " n"]
    least: float

    @property
    def fails(self) -> bool:
        """Whether the recorded ones are farther off, all joints together."""
        return float(np.sum(self.recorded**2)) > float(np.sum(self.derived**2)) + self.least**2

    @property
    def joints(self) -> list[int]:
        """Joints that are to blame, the worst first."""
        usual = max(float(np.mean(self.derived**2)), 1e-4 * float(np.max(self.recorded**2)))
        order = np.argsort(-self.recorded)
        return [int(j) for j in order if self.recorded[j] ** 2 > usual] or [int(order[0])]


def earned(
    trajectories: Sequence[Trajectory], robot: Robot | None, velocities: Velocities = "auto"
) -> tuple[list[Trajectory], list[tuple[str, str]]]:
    """Motions with their recorded velocities if these have earned their place, else without; and notes with names.

    There is one verdict for all: differences between recordings, some of which keep theirs, were differences of the
    method. Those with NaN among them have none.

    Args:
        trajectories: As recorded; their velocities may be NaN where none were measured.
        robot: Whose joints they are; without one, all that are numbers are kept. Floating bodies are not judged.
        velocities: `"auto"`; `"derive"`: none are kept; `"recorded"`: all are.

    Raises:
        RecordingError: Recorded velocities are insisted on, and some are not finite.
    """
    out, notes = list(trajectories), list[tuple[str, str]]()
    derived = "velocities of all joints derived from the positions"
    given = [i for i, t in enumerate(out) if t.u is not None and (not t.judged or velocities == "derive")]
    if velocities == "derive":
        faults = dict.fromkeys(given, f"{derived}, as asked; recorded ones are not used")
    else:
        faults = {i: f"{fault}; {derived}" for i in given if (fault := _not_numbers(out[i], velocities))}
        left = [i for i in given if i not in faults]
        if velocities == "auto" and robot is not None:
            with np.errstate(all="ignore"):  # what overflows is no reason to keep a velocity
                found = _faults({i: out[i] for i in left}, robot)
            others = f"{derived}, as those of {counted(len(found), 'other recording')} are: one method for all"
            faults |= {i: f"{found[i]}; {derived}" if i in found else others for i in left} if found else {}
    for i in given:
        out[i] = replace(out[i], judged=True, **({"u": None} if i in faults else {}))
        notes += [(out[i].name, faults[i])] if i in faults else []
    return out, notes


def judged_in_turn(
    trajectories: Iterable[Trajectory],
    robot: Robot | None,
    velocities: Velocities,
    notes: list[tuple[str, str]],
    *,
    together: bool,
) -> Iterator[Trajectory]:
    """Motions with the velocities that are `earned`, of all together, or one by one if they are never all in memory."""
    for some in [list(trajectories)] if together else ([one] for one in trajectories):
        kept, said = earned(some, robot, velocities)
        notes += said
        yield from kept


def _not_numbers(trajectory: Trajectory, velocities: Velocities) -> str:
    """Joints whose velocities are not finite, in words; nothing if all are."""
    u = np.asarray(trajectory.u)
    if np.max(u) < NO_MEASUREMENT and np.min(u) > -NO_MEASUREMENT:  # NaN is neither
        return ""
    missing = ~(np.abs(u) < NO_MEASUREMENT)
    n = np.count_nonzero(np.any(missing, axis=1))
    names = trajectory.joint_names or [str(j) for j in range(u.shape[1])]
    joints = [names[j] for j in np.flatnonzero(np.any(missing, axis=0))]
    fault = f"velocity of {listed(joints)} is not a number in {n:,} of {counted(len(u), 'sample')}"
    if velocities == "recorded":
        how = advice(": leave {} out", "velocities='recorded'", "--velocities recorded")
        raise RecordingError(f"{trajectory.name}: {fault}{how}", code="not-finite")
    return fault


def _faults(trajectories: Mapping[int, Trajectory], robot: Robot) -> dict[int, str]:
    """Recordings that are to blame, by their numbers, and joints whose velocities do not follow their positions, in
    words with the figures; nothing if all do.
    """
    floating = {i for b in robot.blocks if b.kind == "floating" for i in range(b.v.start, b.v.stop)}
    joints = [i for i in range(robot.nv) if i not in floating]
    stretches: dict[int, list[_Stretch]] = {}
    for i, t in trajectories.items():
        x, u = positions_along(t, robot), np.asarray(t.u)
        if x is not None and joints and u.shape[1] == robot.nv:
            x, u = (x[:, joints], u[:, joints]) if floating else (x, u)
            stretches[i] = [(t.time[s], x[s], u[s]) for s in _stretches(t.time)]
    together = [stretch for own in stretches.values() for stretch in own]
    if not together:
        return {}
    held = np.all([_held(*stretch) for stretch in together], axis=0)
    if np.any(held) and 2 * sum(is_clean(time, x) for time, x, _ in together) <= len(together):
        held[:] = False
    if np.all(held) or not (verdict := _judged(together, held)).fails:
        return {}
    alone = {i: _judged(own, held) for i, own in stretches.items() if own}
    names, units = ([words[i] for i in joints] for words in (robot.joint_names, robot.joint_units))
    alone = {i: found for i, found in alone.items() if found.fails} or dict.fromkeys(alone, verdict)
    return {i: _in_words(found, stretches[i], names, units) for i, found in alone.items()}


def _in_words(verdict: _Verdict, stretches: Sequence[_Stretch], names: Sequence[str], units: Sequence[str]) -> str:
    """Which joints are to blame, how far the worst is from its positions after how long, and both errors."""
    worst = verdict.joints
    j, apart, after = worst[0], 0.0, 0.0
    for t, y, v in stretches:
        rest = np.abs(y[:, j] - y[0, j] - _integral(t, v[:, j : j + 1])[:, 0])
        k = int(np.argmax(rest))
        if rest[k] >= apart:
            apart, after = float(rest[k]), float(t[k] - t[0])
    others = f" ({listed([names[i] for i in worst[1:]])} likewise)" if len(worst) > 1 else ""
    return (
        f"velocity of {names[j]} does not integrate to its position: {apart:.2g} {units[j]} apart after {after:.2g} s, "
        f"{verdict.recorded[j]:.2g} {units[j]}/s off where the positions give it to {verdict.derived[j]:.1g}{others}"
    )


def _stretches(time: Float[np.ndarray, " T"]) -> list[slice]:
    """Stretches without gaps that are judged, evenly chosen of many."""
    if len(time) < FEWEST_JUDGED:
        return []
    parts = [(k, min(k + _LONGEST, p.stop)) for p in pieces(time)[0] for k in range(p.start, p.stop, _LONGEST)]
    long = [slice(a, b) for a, b in parts if b - a >= FEWEST_JUDGED]
    return [long[i] for i in evenly(len(long), _MOST)]


def _held(
    time: Float[np.ndarray, " T"], x: Float[np.ndarray, "T n"], u: Float[np.ndarray, "T n"]
) -> Bool[np.ndarray, " n"]:
    """Joints whose velocity is what moves them from each sample to the next one, as simulations hold it.

    Differences of positions are such velocities too, but have none of its own for the last sample.
    """
    steps = np.diff(x, axis=0)
    missed = np.max(np.abs(steps - u[:-1] * np.diff(time)[:, None]), axis=0, initial=0.0)
    held = missed <= _HELD * np.max(np.abs(steps), axis=0, initial=0.0) + _ROUNDED * _quantum(x)
    return held & (np.any(u[-1] != u[-2]) and np.any(u[-1]))


def _integral(time: Float[np.ndarray, " T"], u: Float[np.ndarray, "T n"]) -> Float[np.ndarray, "T n"]:
    """Integral from the first sample on: trapezia, corrected by the slopes at their ends."""
    dt, slope = np.diff(time)[:, None], np.gradient(u, time, axis=0)
    area = dt * (0.5 * (u[1:] + u[:-1]) - dt / 12.0 * np.diff(slope, axis=0))
    return np.concatenate([np.zeros((1, u.shape[1])), np.cumsum(area, axis=0)])


def position_noise(time: Float[np.ndarray, " T"], x: Float[np.ndarray, "T n"]) -> Float[np.ndarray, " n"]:
    """Variance of the noise of positions: what is rough in them, or what their quantum leaves."""
    quantum = _quantum(x)
    quantum[np.ptp(x, axis=0) == 0.0] = np.max(quantum)  # a joint that stands still does not show its own
    rounding = 1e-12 * (1.0 + np.max(np.abs(x), axis=0))
    return np.maximum(noise_variance(time, x), quantum**2 / 12.0) + rounding**2


def _quantum(x: Float[np.ndarray, "T n"]) -> Float[np.ndarray, " n"]:
    """Of which all positions of a joint are multiples [rad or m]; 0 where there is none."""
    quantum = np.zeros(x.shape[1])
    for digits in range(2, 10):  # printed with so many
        if _is_multiple(x, 10.0**-digits):
            return quantum + 10.0**-digits
    for j, column in enumerate(x.T):
        step = min(np.diff(np.unique(column)).tolist(), default=np.inf)
        if np.isfinite(step) and _is_multiple(np.asarray(column - column[0]), step):
            quantum[j] = step
    return quantum


def _is_multiple(x: np.ndarray, step: float) -> bool:
    """Whether all numbers are multiples of a step, as far as their last digits can tell."""
    multiples = x / step
    missed, largest = np.max(np.abs(multiples - np.round(multiples))), np.max(np.abs(multiples))
    return bool(largest < 1e10 and missed < _GRID)


def _judged(stretches: Sequence[_Stretch], held: Bool[np.ndarray, " n"]) -> _Verdict:
    """Recorded beside derived velocities, at the time scale at which the recorded ones do worst."""
    noises = [position_noise(t, x) for t, x, _ in stretches]
    steps = [(t[-1] - t[0]) / (len(t) - 1) for t, _, _ in stretches]
    derived, width = np.zeros(len(held)), 1
    for (t, x, _), noise in zip(stretches, noises, strict=True):
        m, degree = best_windows(t, x[None], max(5, len(t) // 3))[0]
        derived += slope_variance(t, x, m, degree, noise) / len(stretches)
        width = max(width, 2 * m)
    noise = np.mean([n / step**2 for n, step in zip(noises, steps, strict=True)], axis=0)  # in steps, as the rests
    # mean square error of the velocity by the time scale [samples]; 0: its own noise
    errors = {0: np.mean([noise_variance(t, u) for t, _, u in stretches], axis=0)}
    rests = [(x - _integral(t, u)) / step for (t, x, u), step in zip(stretches, steps, strict=True)]
    for k in range(int(np.log2(max(map(len, rests)) - 1)) + 1):
        w = 2**k
        long = [rest for rest in rests if len(rest) > w]
        apart = np.mean(np.concatenate([rest[w:] - rest[:-w] for rest in long]) ** 2, axis=0)
        by_chance = _KNOWN + CHANCE * np.sqrt(2.0 / max(sum(len(rest) / w for rest in long), 1.0))
        errors[w] = np.where(apart > 2.0 * noise * by_chance, apart - 2.0 * noise, 0.0) / w**2
    moved = [np.mean(np.sum(np.diff(x, axis=0) ** 2, axis=1)) for _, x, _ in stretches]
    speed = float(np.sqrt(np.mean(np.array(moved) / np.square(steps))))
    share = _FINE if max(map(len, rests)) >= SHORT_AND_CLEAN else _COARSE
    verdicts = [
        _Verdict(np.sqrt(np.where(held, 0.0, e)), np.sqrt(derived) * min(1.0, width / max(w, 1)), share * speed)
        for w, e in errors.items()
    ]
    return max(verdicts, key=lambda v: float(np.sum(v.recorded**2) / max(np.sum(v.derived**2) + v.least**2, 1e-300)))
