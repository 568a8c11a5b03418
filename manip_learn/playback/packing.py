"""Arrays as text that a page can hold."""

from __future__ import annotations

import base64

import numpy as np


def packed(array: np.ndarray, dtype: str) -> str:
    """The array's numbers in base64, row by row.

    Args:
        array: Any numbers, NaN too.
        dtype: As NumPy writes it, little-endian: `"<f8"`, `"<f4"`, `"<u4"` or `"<u2"`.
    """
    return base64.b64encode(np.ascontiguousarray(array, dtype=dtype).tobytes()).decode("ascii")


def unpacked(text: str, dtype: str) -> np.ndarray:
    """The numbers that `packed` was given."""
    return np.frombuffer(base64.b64decode(text), dtype)
