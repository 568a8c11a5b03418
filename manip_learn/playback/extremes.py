"""A curve with fewer samples that looks the same: every minimum and maximum is kept."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def extremes(values: Float[np.ndarray, " T"], most: int) -> Int[np.ndarray, " K"]:
    """Which samples to keep of a curve: first, last, and the least and the largest of each of `most / 2` spans.

    Args:
        values: The curve; NaN is a gap, and a span without any number keeps its first sample.
        most: About how many samples may be kept; a shorter curve is kept whole.
    """
    if values.size <= most:
        return np.arange(values.size)
    edges = np.linspace(0, values.size, max(most // 2, 2)).astype(int)
    missing = np.isnan(values)
    low, high = np.where(missing, np.inf, values), np.where(missing, -np.inf, values)
    keep = {0, values.size - 1}
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        keep |= {a + int(np.argmin(low[a:b])), a + int(np.argmax(high[a:b]))}
    return np.array(sorted(keep))
