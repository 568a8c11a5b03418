"""Polynomials fitted to the samples of a window by least squares (Savitzky and Golay, 1964), with true time stamps."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

# half widths of the smoothing window [samples] and degrees of its polynomial among which "auto" chooses
HALF_WIDTHS = (2, 3, 5, 7, 10, 15, 20, 30)
DEGREES = (2, 3, 5)
# noise averages out over the samples of a recording, bias does not
BIAS_WEIGHT = 4.0
# share of a window by which its time stamps may be off an even grid
EVEN = 1e-9
# windows among which degree and width are compared, spread over the trajectory
COMPARED = 150


def local_fit(
    time: Float[np.ndarray, " T"], x: Float[np.ndarray, "T nv"], half_width: int, degree: int
) -> tuple[Float[np.ndarray, "N nv"], Float[np.ndarray, "N nv"]]:
    """Value and slope at the centre of each window of 2 half_width + 1 samples, by least squares."""
    weights = local_weights(time, half_width, degree)
    windows = np.lib.stride_tricks.sliding_window_view(x, 2 * half_width + 1, axis=0)  # (N, nv, W)
    value, slope = np.einsum("ndw,njw->dnj", weights[:, :2], windows, optimize=True)
    return value, slope


def local_weights(time: np.ndarray, half_width: int, degree: int) -> Float[np.ndarray, "N d W"]:
    """Weights for the coefficients of the polynomial fitted to each window, in powers of the time from its centre.

    The coefficient of power 1 is a slope [1/s]; those of power k > 1 belong to time over the window's longest offset.
    """
    weights = _weights(_offsets(time, half_width), degree)
    return np.broadcast_to(weights, (len(time) - 2 * half_width, *weights.shape[1:]))


def _offsets(time: Float[np.ndarray, " T"], half_width: int, stride: int = 1) -> Float[np.ndarray, "m W"]:
    """Time from the centre of each window [s]; of one window only where time is evenly sampled: it serves for all."""
    windows = np.lib.stride_tricks.sliding_window_view(time, 2 * half_width + 1)[::stride]
    offset = windows - windows[:, half_width : half_width + 1]
    shortest = np.min(np.max(np.abs(offset), axis=1))
    return offset[:1] if np.max(np.abs(offset - offset[0])) <= EVEN * shortest else offset


def _weights(offset: Float[np.ndarray, "m W"], degree: int) -> Float[np.ndarray, "m d W"]:
    return _even_weights(tuple(offset[0].tolist()), degree) if len(offset) == 1 else _solved_weights(offset, degree)


@functools.lru_cache(maxsize=512)
def _even_weights(offset: tuple[float, ...], degree: int) -> Float[np.ndarray, "1 d W"]:
    """Weights of one window; recordings of one rate share them."""
    weights = _solved_weights(np.array([offset]), degree)
    weights.setflags(write=False)
    return weights


def _solved_weights(offset: Float[np.ndarray, "m W"], degree: int) -> Float[np.ndarray, "m d W"]:
    scale = np.max(np.abs(offset), axis=1, keepdims=True)
    powers = (offset / scale)[:, None, :] ** np.arange(degree + 1)[None, :, None]
    weights = np.linalg.solve(powers @ powers.transpose(0, 2, 1), powers)
    weights[:, 1] /= scale
    return weights


def _applied(weights: Float[np.ndarray, "m W"], windows: Float[np.ndarray, "N nv W"]) -> Float[np.ndarray, "N nv"]:
    """Each window's own weighted sum, or with the same weights for all where there is one row of them only."""
    if len(weights) == 1:
        return windows @ weights[0]
    return np.einsum("nw,njw->nj", weights, windows, optimize=True)


def best_window(
    time: Float[np.ndarray, " T"],
    x: Float[np.ndarray, "T nv"],
    half_widths: Sequence[int] = HALF_WIDTHS,
    degrees: Sequence[int] = DEGREES,
    longest: int | None = None,
) -> tuple[int, int]:
    """Half width [samples] and degree whose slope has the smallest estimated error, all joints together."""
    noise2 = noise_variance(time, x)
    best, best_error = (half_widths[0], degrees[0]), np.inf
    for m in half_widths:
        if 2 * m + 1 > len(time):
            break
        stride = max(1, (len(time) - 2 * m) // COMPARED)
        windows = np.lib.stride_tricks.sliding_window_view(x, 2 * m + 1, axis=0)[::stride]
        offset = _offsets(time, m, stride)
        for degree in degrees:
            if not fits(m, degree, longest or x.shape[0]):
                continue
            slope = _weights(offset, degree)[:, 1]
            richer = _weights(offset, degree + 2)[:, 1] - slope
            difference = _applied(richer, windows)
            # the difference of the two fits holds the bias and its own share of the noise: take that off again
            own = np.mean(np.sum(richer**2, axis=1)) * noise2
            bias2 = np.maximum(np.mean(difference**2, axis=0) - own, 0.0)
            error = float(np.sum(BIAS_WEIGHT * bias2 + np.mean(np.sum(slope**2, axis=1)) * noise2))
            if error < best_error:
                best, best_error = (m, degree), error
    return best


def fits(half_width: int, degree: int, longest: int) -> bool:
    """Whether the window is short enough, and has samples enough for the richer polynomial that judges it."""
    return degree + 3 <= 2 * half_width + 1 <= longest


def noise_variance(time: Float[np.ndarray, " T"], x: Float[np.ndarray, "T nv"]) -> Float[np.ndarray, " nv"]:
    """Variance of white noise on the samples from what a local parabola through five points leaves over."""
    windows_t = np.lib.stride_tricks.sliding_window_view(time, 5)
    offset = windows_t - windows_t[:, 2:3]
    powers = (offset / np.max(np.abs(offset), axis=1, keepdims=True))[:, None, :] ** np.arange(4)[None, :, None]
    fit = powers.transpose(0, 2, 1) @ np.linalg.solve(powers @ powers.transpose(0, 2, 1), powers)
    windows = np.lib.stride_tricks.sliding_window_view(x, 5, axis=0)
    left = windows - np.einsum("nvw,njw->njv", fit, windows, optimize=True)
    # a cubic leaves one degree of freedom of five; the median passes over the few places where the motion is not smooth
    return np.median(np.sum(left**2, axis=2), axis=0) / 0.455
