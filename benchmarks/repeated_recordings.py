"""Copies, replays and pieces of recordings that are not noticed, and recordings of their own that are called repeats.

    PYTHONPATH=examples:benchmarks python benchmarks/repeated_recordings.py --sets 2 --first-seed 20000

Prints a markdown table: one line per noise, one column per way of repeating.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable

import numpy as np
from make_recordings.arms import ROBOTS
from make_recordings.kinds import FREE, TASKS
from recording_cases import Case
from scipy.interpolate import CubicSpline

from manip_learn.learning.repeats import IndependentRecordings
from manip_learn.recordings.trajectory import Demonstrations, Trajectory

NOISES = (0.0, 1e-4, 1e-3, 3e-3)  # of the encoders [rad]
Change = Callable[[Trajectory, np.random.Generator, float], list[Trajectory]]


def copied(t: Trajectory, _rng: np.random.Generator, _noise: float) -> list[Trajectory]:
    """Four of one."""
    return [t, t, t]


def reversed_in_time(t: Trajectory, _rng: np.random.Generator, _noise: float) -> list[Trajectory]:
    """Backwards."""
    return [Trajectory(t.time[-1] - t.time[::-1], t.q[::-1], name="reversed")]


def resampled(t: Trajectory, _rng: np.random.Generator, _noise: float) -> list[Trajectory]:
    """Chords at 40 Hz and at 15 Hz on a clock that is late, and a slower motion at 130 Hz."""
    out = []
    for rate, slower, late in ((40.0, 1.0, 7.3), (15.0, 1.0, 0.0), (130.0, 1.7, 0.0)):
        at = np.arange(t.time[0], t.time[-1], 1.0 / rate / slower)
        q = np.column_stack([np.interp(at, t.time, c) for c in t.q.T])
        out.append(Trajectory(slower * at + late, q, name=f"{rate:g} Hz"))
    return out


def replayed(t: Trajectory, rng: np.random.Generator, noise: float) -> list[Trajectory]:
    """The same path at another speed, with noise of its own on top."""
    at = np.linspace(t.time[0], t.time[-1], int(0.8 * len(t)))
    return [Trajectory(0.8 * at, CubicSpline(t.time, t.q)(at) + rng.normal(0.0, noise, (len(at), t.q.shape[1])))]


def pieces(t: Trajectory, n: int = 8, *, clock: bool = True) -> list[Trajectory]:
    """Even parts, each from 0 s on if the clock is lost."""
    parts = [t.part(slice(int(a[0]), int(a[-1]) + 1)) for a in np.array_split(np.arange(len(t)), n)]
    return [Trajectory(p.time - (0.0 if clock else p.time[0]), p.q, name=f"piece_{i}") for i, p in enumerate(parts)]


def whole_and_pieces(t: Trajectory, _rng: np.random.Generator, _noise: float) -> list[Trajectory]:
    """Eight pieces beside the whole."""
    return pieces(t, clock=False)


CHANGES: dict[str, Change] = {c.__name__: c for c in (copied, reversed_in_time, resampled, replayed, whole_and_pieces)}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=1, help="of each kind, arm and noise")
    parser.add_argument("--first-seed", type=int, default=20_000)
    args = parser.parse_args()
    columns = (*CHANGES, "8 pieces, one clock", "8 pieces, clocks of their own")
    print("| noise [rad] | sets | called repeats wrongly | " + " | ".join(columns) + " | ms |")
    print("|---" * (len(columns) + 4) + "|")
    for noise in NOISES:
        wrong, seconds, missed, sets = 0, [], dict.fromkeys(columns, 0), 0
        cases = itertools.product((*TASKS, *FREE), (True, False), range(4 * args.sets))
        for kind, whole, i in cases:
            case = Case(kind, ROBOTS[i % 4], args.first_seed + i, n=6, noise=noise, whole=whole)
            demos = [Trajectory(t.time, t.q, name=t.name) for t in case.make()[1]]
            rng = np.random.default_rng(i)
            started = time.perf_counter()
            wrong += bool(IndependentRecordings.of(Demonstrations(demos)).warnings)
            seconds.append(time.perf_counter() - started)
            for name, change in CHANGES.items():
                found = IndependentRecordings.of(Demonstrations([*demos, *change(demos[2], rng, noise)]))
                missed[name] += len(found.demonstrations) != len(demos)
            for name, clock in zip(columns[-2:], (True, False), strict=True):
                given = [*demos[:2], *pieces(demos[2], clock=clock), *demos[3:]]
                missed[name] += len(IndependentRecordings.of(Demonstrations(given)).demonstrations) != len(demos)
            sets += 1
        told = " | ".join(f"{missed[c]}" for c in columns)
        print(f"| {noise:g} | {sets} | {wrong} | {told} | {1e3 * np.median(seconds):.1f} |", flush=True)


if __name__ == "__main__":
    main()
