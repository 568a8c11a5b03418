"""Real numbers of any kind as float64."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def float_array(values: np.ndarray) -> Float[np.ndarray, "..."]:
    """The values as native float64 in C order; whatever is no number becomes NaN, which the doctor finds."""
    with np.errstate(invalid="ignore", over="ignore"):  # signalling NaN in damaged files
        return np.ascontiguousarray(values, dtype=np.float64)
