"""Time per call: medians of interleaved rounds, so that a noisy neighbour meets every candidate; and a run's ratios.

Processor time of this process, not time on the wall: what a neighbour takes is not ours (all candidates run in one
thread and none of them waits for anything).

Needs nothing but the standard library: the peers' scripts import it from environments of their own.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import NamedTuple


class Timing(NamedTuple):
    """Seconds a call: median, best and the quarter marks of the rounds."""

    median: float
    best: float
    lower: float
    upper: float


def rounds_of(candidates: dict[str, Callable[[], object]], calls: int, rounds: int) -> dict[str, list[float]]:
    """Seconds a call of each candidate in each round; in a round every candidate has its turn."""
    for call in candidates.values():
        for _ in range(max(2, calls // 10)):
            call()
    seconds: dict[str, list[float]] = {name: [] for name in candidates}
    for _ in range(rounds):
        for name, call in candidates.items():
            start = time.process_time()
            for _ in range(calls):
                call()
            seconds[name].append((time.process_time() - start) / calls)
    return seconds


def summary(seconds: list[float]) -> Timing:
    """Median, best and quarter marks."""
    if len(seconds) < 2:
        return Timing(seconds[0], seconds[0], seconds[0], seconds[0])
    lower, median, upper = statistics.quantiles(seconds, n=4)
    return Timing(median, min(seconds), lower, upper)


class Ratio(NamedTuple):
    """A ratio, smaller is better, and the quarter marks of the rounds' own."""

    value: float
    lower: float = float("nan")
    upper: float = float("nan")


FOUND: dict[tuple[str, str], Ratio] = {}


def keep(benchmark: str, ratios: dict[str, Ratio] | dict[str, float]) -> None:
    """Keep ratios for the table at the end."""
    FOUND.update({(benchmark, name): x if isinstance(x, Ratio) else Ratio(float(x)) for name, x in ratios.items()})


def table() -> str:
    """Markdown: everything found in this run."""
    lines = ["| benchmark | what | ratio | quarter marks of the rounds |", "|---|---|---|---|"]
    for (benchmark, name), x in FOUND.items():
        spread = "" if x.lower != x.lower else f"{x.lower:.3g} .. {x.upper:.3g}"
        lines.append(f"| {benchmark} | {name} | {x.value:.3g} | {spread} |")
    return "\n".join(lines)
