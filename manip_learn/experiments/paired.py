"""Two learners on the same recordings: which is better, by how much, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import binom, wilcoxon


def median_interval(values: Sequence[float], level: float = 0.95) -> tuple[float | None, float | None]:
    """Interval that holds the median of what the values are drawn from, by order statistics; no law is assumed.

    The k-th smallest and the k-th largest of n, with k the largest number for which the binomial probability of fewer
    than k of n on one side is at most (1 - level) / 2. None where there are too few values for the level.
    """
    ordered = np.sort(np.array(values, dtype=np.float64))
    k = int(binom.ppf(0.5 * (1.0 - level), len(ordered), 0.5)) if len(ordered) else 0
    if k < 1:
        return None, None
    return float(ordered[k - 1]), float(ordered[len(ordered) - k])


def compare_pairs(ours: Sequence[float | None], theirs: Sequence[float | None]) -> dict[str, Any]:
    """Paired comparison of two errors on the same seeds.

    Args:
        ours: Error of our learner for each seed; None where it refused.
        theirs: Error of the other one.

    Returns:
        `ratio`, the median of theirs / ours, above 1 where ours is better; `low` and `high`, its 95 % interval over the
        seeds; `wins`, the seeds at which ours is lower; `n`, the seeds at which both answered; `p`, Wilcoxon's signed
        rank test (two-sided) on the logarithms, None for fewer than 6 pairs.
    """
    pairs = [(a, b) for a, b in zip(ours, theirs, strict=True) if a is not None and b is not None]
    floor = np.finfo(np.float64).tiny
    logs = np.array([np.log(max(b, floor) / max(a, floor)) for a, b in pairs])
    if not len(logs):
        return {"ratio": None, "low": None, "high": None, "wins": 0, "n": 0, "p": None}
    low, high = median_interval(logs.tolist())
    different = np.any(logs != 0.0) and len(logs) >= 6
    return {
        "ratio": float(np.exp(np.median(logs))),
        "low": None if low is None else float(np.exp(low)),
        "high": None if high is None else float(np.exp(high)),
        "wins": int(np.sum(logs > 0.0)),
        "n": len(logs),
        "p": float(wilcoxon(logs).pvalue) if different else None,
    }
