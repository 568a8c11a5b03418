"""One whitening of the features for all that looks at recordings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

# rows of Phi below this share of the largest (after scaling each to its own size) are linear copies or identically
# zero: rounding leaves 1e-15 of a row, a real arm moves the least of its independent rows by 1e-3 or more
PRUNE_RATIO = 1e-6


def whitening(S: Float[np.ndarray, "p p"], units: Sequence[str]) -> Float[np.ndarray, "r p"]:
    """W with W S W^T = I, without the combinations of rows that are zero throughout; no rows if all are.

    Args:
        S: Mean of Phi Phi^T.
        units: Of each row; rows of one unit are compared with each other before they are scaled.
    """
    size = np.sqrt(np.diag(S))
    if not np.any(size > 0.0):
        return np.zeros((0, len(size)))
    for unit in set(units):
        same = [i for i, other in enumerate(units) if other == unit]
        size[same] = np.where(size[same] > PRUNE_RATIO * np.max(size[same]), size[same], 0.0)
    scale = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0.0)
    values, vectors = np.linalg.eigh(scale[:, None] * S * scale)
    kept = values > PRUNE_RATIO**2 * values[-1] + 1e-15 * len(size)
    return (vectors[:, kept] / np.sqrt(values[kept])).T * scale
