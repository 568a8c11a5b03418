"""Jerk of recorded positions, with what encoder noise alone would leave taken off."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from manip_learn.recordings.local_fit import local_weights, noise_variance

HALF_WIDTHS = (3, 4, 5, 7, 10, 15, 20, 30, 45)  # [samples]
CLEAR = 5.0  # times the jerk that noise alone would leave: its peak is then that of the motion
CUBIC = 3


def jerk(time: Float[np.ndarray, " T"], x: Float[np.ndarray, "T nv"]) -> tuple[float, float]:
    """Root mean square and peak of the norm of the third derivative, all joints together.

    The third derivative of a cubic fitted by least squares to a window of samples (Savitzky and Golay, 1964), the
    narrowest window in which it is clear of noise. White noise of variance v on the positions adds v sum(w^2) to its
    square, w the weights of the fit: that is subtracted, v being estimated from the same samples.

    Returns:
        rms and peak [rad/s^3, of prismatic joints m/s^3]; NaN for fewer than seven samples.
    """
    if len(time) < 2 * HALF_WIDTHS[0] + 1:
        return float("nan"), float("nan")
    variance = float(np.sum(noise_variance(time, x)))
    squared = np.zeros(1)
    for half_width in HALF_WIDTHS:
        if 2 * half_width + 1 > len(time):
            break
        third = _weights(time, half_width)
        windows = np.lib.stride_tricks.sliding_window_view(x, 2 * half_width + 1, axis=0)
        squared = np.sum(np.einsum("nw,njw->nj", third, windows) ** 2, axis=1)
        noise = np.sum(third**2, axis=1) * variance
        squared = squared - noise
        if np.mean(squared) >= CLEAR**2 * np.mean(noise):
            break
    return float(np.sqrt(max(np.mean(squared), 0.0))), float(np.sqrt(max(np.max(squared), 0.0)))


def _weights(time: np.ndarray, half_width: int) -> Float[np.ndarray, "N W"]:
    """Weights of the third derivative at the centre of each window [1/s^3]."""
    stamps = np.lib.stride_tricks.sliding_window_view(time, 2 * half_width + 1)
    longest = np.max(np.abs(stamps - stamps[:, half_width : half_width + 1]), axis=1)
    return local_weights(time, half_width, CUBIC)[:, CUBIC] * (6.0 / longest**3)[:, None]
