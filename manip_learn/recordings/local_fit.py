"""Polynomials fitted to the samples of a window by least squares (Savitzky and Golay, 1964), with true time stamps."""

from __future__ import annotations

import functools

import numpy as np
from jaxtyping import Float

# half widths of the smoothing window [samples] and degrees of its polynomial among which "auto" chooses
HALF_WIDTHS = (2, 3, 5, 7, 10, 15, 20, 30)
# the same where samples are so close that 30 of them are less than _LONGEST; 1 kHz at most, for the time it takes
_WIDER = (45, 60, 75, 100, 125, 150, 200, 250, 300)
_LONGEST = 0.3  # half width [s]: 30 samples at 100 Hz, for which a polynomial of degree 5 follows people's motion
DEGREES = (2, 3, 5)
# Noise averages out over the samples of the recordings, bias does not. Where wider windows are among the choice, noise
# is weak in all that come near the best, and bias is what several recordings have in common: 100 windows, as in ten
# recordings of 3 s. Weights of 4, 20 and 100: errors over what is stated 1.4, 1.3, 1.1 (doors, 500 Hz, 1e-3 rad, 30
# recordings, 16 sets from 41000), 1.7 and 1.3 for 4 and 100 at 250 Hz.
BIAS_WEIGHT, FAST_BIAS_WEIGHT = 4.0, 100.0
# share of a step by which time stamps may be off an even grid
EVEN = 1e-9
# windows among which degree and width are compared, spread over the trajectory
_COMPARED = 150
# weights [numbers] and stamps of one recording that are kept for the next one that is sampled alike
KEPT_NUMBERS, KEPT_STAMPS = 20_000, 5_000
# numbers that are worked on at once where each window has its own equations: 4 MB
BLOCK_NUMBERS = 500_000
JERK_HALF_WIDTHS = (3, 4, 5, 7, 10, 15, 20, 30, 45)  # [samples]
CLEAR_JERK = 5.0  # times the jerk that noise alone would leave: its peak is then that of the motion
_CUBIC = 3

# step of evenly spaced stamps [s], or all stamps as bytes
Grid = float | bytes


def local_fit(
    time: Float[np.ndarray, " T"], x: Float[np.ndarray, "T nv"], half_width: int, degree: int
) -> tuple[Float[np.ndarray, "N nv"], Float[np.ndarray, "N nv"]]:
    """Value and slope at the centre of each window of 2 half_width + 1 samples, by least squares."""
    W = 2 * half_width + 1
    if not isinstance(_grid(time), bytes) or len(time) * W <= KEPT_NUMBERS:
        weights = local_weights(time, half_width, degree)
        windows = np.lib.stride_tricks.sliding_window_view(x, W, axis=0)  # (N, nv, W)
        value, slope = np.einsum("ndw,njw->dnj", weights[:, :2], windows, optimize=True)
        return value, slope
    # each window has its own equations, a few windows at a time: no weights are kept
    offsets = np.lib.stride_tricks.sliding_window_view(time, W)
    windows = np.lib.stride_tricks.sliding_window_view(np.ascontiguousarray(x), W, axis=0).transpose(0, 2, 1)
    value, slope = np.empty((2, len(offsets), x.shape[1]))
    at_once = max(1, BLOCK_NUMBERS // (W * (degree + 1)))
    for first in range(0, len(offsets), at_once):
        part = slice(first, first + at_once)
        offset = offsets[part] - offsets[part, half_width, None]
        scale = np.max(np.abs(offset), axis=1, keepdims=True)
        powers = _powers(offset / scale, degree)
        found = np.linalg.solve(powers @ powers.transpose(0, 2, 1), powers @ windows[part])
        value[part], slope[part] = found[:, 0], found[:, 1] / scale
    return value, slope


def local_weights(time: np.ndarray, half_width: int, degree: int) -> Float[np.ndarray, "N d W"]:
    """Weights for the coefficients of the polynomial fitted to each window, in powers of the time from its centre.

    The coefficient of power 1 is a slope [1/s]; those of power k > 1 belong to time over the window's longest offset.
    """
    weights = _weights if len(time) * (2 * half_width + 1) <= KEPT_NUMBERS else _weights.__wrapped__
    found = weights(np.ascontiguousarray(time).tobytes(), half_width, degree)
    return np.broadcast_to(found, (len(time) - 2 * half_width, *found.shape[1:]))


def _grid(time: Float[np.ndarray, " T"]) -> Grid:
    """What a choice of windows depends on, the same for all recordings that are sampled alike."""
    stamps = np.ascontiguousarray(time - time[0], dtype=np.float64)
    step = float(f"{stamps[-1] / max(len(stamps) - 1, 1):.13g}")  # without the rounding of the stamps themselves
    even = np.max(np.abs(stamps - step * np.arange(len(stamps)))) <= 0.5 * EVEN * step
    return step if even else stamps.tobytes()


def _offsets(grid: Grid, half_width: int, stride: int = 1) -> Float[np.ndarray, "m W"]:
    """Time from the centre of each window [s]; of one window only where time is evenly sampled: it serves for all."""
    if not isinstance(grid, bytes):
        return grid * np.arange(-half_width, half_width + 1.0)[None]
    windows = np.lib.stride_tricks.sliding_window_view(np.frombuffer(grid), 2 * half_width + 1)[::stride]
    return windows - windows[:, half_width : half_width + 1]


@functools.lru_cache(maxsize=16)
def _weights(stamps: bytes, half_width: int, degree: int) -> Float[np.ndarray, "m d W"]:
    """Weights of each window, or of the one that serves for all; kept for the next recording with the same stamps."""
    offset = _offsets(stamps, half_width)
    shortest = np.min(np.max(np.abs(offset), axis=1))
    if np.max(np.abs(offset - offset[0])) <= EVEN * shortest:
        return _even_weights(offset[0].tobytes(), degree)
    return _read_only(_solved_weights(offset, degree))


def _read_only(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array


@functools.lru_cache(maxsize=512)
def _even_weights(offset: bytes, degree: int) -> Float[np.ndarray, "1 d W"]:
    """Weights of one window; recordings of one rate share them."""
    return _read_only(_solved_weights(np.frombuffer(offset)[None], degree))


def _solved_weights(offset: Float[np.ndarray, "m W"], degree: int) -> Float[np.ndarray, "m d W"]:
    scale = np.max(np.abs(offset), axis=1, keepdims=True)
    powers = _powers(offset / scale, degree)
    weights = np.linalg.solve(powers @ powers.transpose(0, 2, 1), powers)
    weights[:, 1] /= scale
    return weights


def _powers(x: Float[np.ndarray, "m W"], degree: int) -> Float[np.ndarray, "m d W"]:
    powers = np.empty((len(x), degree + 1, x.shape[1]))
    powers[:, 0] = 1.0
    for d in range(1, degree + 1):
        np.multiply(powers[:, d - 1], x, out=powers[:, d])
    return powers


def _is_short(grid: Grid) -> bool:
    """Whether it is worth keeping what depends on a grid."""
    return not isinstance(grid, bytes) or len(grid) <= 8 * KEPT_STAMPS


@functools.lru_cache(maxsize=32)
def _trial(
    grid: Grid, half_width: int, degrees: tuple[int, ...], stride: int
) -> tuple[Float[np.ndarray, "m W d"], Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
    """Polynomials of some degrees fitted to windows of one width; recordings that are sampled alike share them.

    Returns:
        What a polynomial of two degrees more adds to the weights of each slope [1/s]; the mean sum of squares of these;
        and that of the weights of the slopes themselves.
    """
    offset = _offsets(grid, half_width, stride)
    slopes = {d: _solved_weights(offset, d)[:, 1] for d in {*degrees, *(degree + 2 for degree in degrees)}}
    richer = np.stack([slopes[d + 2] - slopes[d] for d in degrees], axis=2)
    own = np.mean(np.sum(richer**2, axis=1), axis=0)
    return richer, own, np.array([np.mean(np.sum(slopes[d] ** 2, axis=1)) for d in degrees])


def half_widths_of(time: Float[np.ndarray, " T"]) -> tuple[int, ...]:
    """Half widths [samples] among which to choose at some times [s]."""
    step = float(time[-1] - time[0]) / max(len(time) - 1, 1)
    return (*HALF_WIDTHS, *(m for m in _WIDER if m * step <= _LONGEST * (1.0 + EVEN)))


def best_windows(
    time: Float[np.ndarray, " T"], x: Float[np.ndarray, "e T nv"], longest: int | None = None
) -> list[tuple[int, int]]:
    """Half width [samples] and degree whose slope has the smallest estimated error, all joints together.

    Args:
        time: Of all the recordings [s].
        x: One recording after the other.
        longest: Samples in the longest window; all by default.
    """
    n, T, nv = x.shape
    beside = np.ascontiguousarray(x.transpose(0, 2, 1)).reshape(n * nv, T)
    noise2, grid = noise_variance(time, beside.T), _grid(time)
    half_widths = half_widths_of(time)
    weight = BIAS_WEIGHT if len(half_widths) == len(HALF_WIDTHS) else FAST_BIAS_WEIGHT
    best, least = [(half_widths[0], DEGREES[0])] * n, np.full(n, np.inf)
    for m in half_widths:
        if 2 * m + 1 > min(longest or T, T):
            break
        # samples enough for the richer polynomial that judges it
        usable = tuple(degree for degree in DEGREES if degree + 3 <= 2 * m + 1)
        if not usable:
            continue
        stride = max(1, (len(time) - 2 * m) // _COMPARED)
        windows = np.lib.stride_tricks.sliding_window_view(beside, 2 * m + 1, axis=1)[:, ::stride]
        trial = _trial if _is_short(grid) else _trial.__wrapped__
        richer, own, spread = trial(grid, m, usable, stride if isinstance(grid, bytes) else 1)
        if len(richer) == 1:
            difference = (windows.reshape(-1, 2 * m + 1) @ richer[0]).reshape(*windows.shape[:2], -1)
            square = np.einsum("jnd,jnd->dj", difference, difference) / windows.shape[1]
        else:
            difference = windows.transpose(1, 0, 2) @ richer
            square = np.einsum("njd,njd->dj", difference, difference) / windows.shape[1]
        # the difference of the two fits holds the bias and its own share of the noise: take that off again
        bias2 = np.maximum(square - own[:, None] * noise2, 0.0)
        errors = np.sum((weight * bias2 + spread[:, None] * noise2).reshape(len(usable), n, nv), axis=2)
        for k in np.flatnonzero(errors.min(axis=0) < least):
            i = int(np.argmin(errors[:, k]))
            best[k], least[k] = (m, usable[i]), errors[i, k]
    return best


def slope_variance(
    time: Float[np.ndarray, " T"], x: Float[np.ndarray, "T nv"], half_width: int, degree: int, noise2: np.ndarray
) -> Float[np.ndarray, " nv"]:
    """Mean square error of the slopes that `local_fit` finds, from positions with noise of these variances."""
    grid, m = _grid(time), half_width
    stride = max(1, (len(time) - 2 * m) // _COMPARED)
    windows = np.lib.stride_tricks.sliding_window_view(x, 2 * m + 1, axis=0)[::stride]
    trial = _trial if _is_short(grid) else _trial.__wrapped__
    richer, own, spread = trial(grid, m, (degree,), stride if isinstance(grid, bytes) else 1)
    difference = np.einsum("njw,nw->nj", windows, np.broadcast_to(richer[:, :, 0], (len(windows), 2 * m + 1)))
    return np.maximum(np.mean(difference**2, axis=0) - own * noise2, 0.0) + spread * noise2


def noise_variance(time: Float[np.ndarray, " T"], x: Float[np.ndarray, "T nv"]) -> Float[np.ndarray, " nv"]:
    """Variance of white noise on the samples from what a local cubic through five points leaves over."""
    grid = _grid(time)
    fit = (_cubics if _is_short(grid) else _cubics.__wrapped__)(grid)
    windows = np.lib.stride_tricks.sliding_window_view(x, 5, axis=0)
    left = windows - windows @ (fit[0] if len(fit) == 1 else fit)
    # a cubic leaves one degree of freedom of five; the median passes over the few places where the motion is not smooth
    return np.median(np.einsum("njw,njw->nj", left, left), axis=0) / 0.455


@functools.lru_cache(maxsize=8)
def _cubics(grid: Grid) -> Float[np.ndarray, "m w w"]:
    """Projections of five values on the cubics in their times, symmetric; shared like the trials."""
    offset = _offsets(grid, 2)
    powers = (offset / np.max(np.abs(offset), axis=1, keepdims=True))[:, None, :] ** np.arange(4)[None, :, None]
    return powers.transpose(0, 2, 1) @ np.linalg.solve(powers @ powers.transpose(0, 2, 1), powers)


def jerk(time: Float[np.ndarray, " T"], x: Float[np.ndarray, "T nv"]) -> tuple[float, float]:
    """Root mean square and peak of the norm of the third derivative, all joints together.

    The third derivative of a cubic fitted by least squares to a window of samples (Savitzky and Golay, 1964), the
    narrowest window in which it is clear of noise. White noise of variance v on the positions adds v sum(w^2) to its
    square, w the weights of the fit: that is subtracted, v being estimated from the same samples.

    Returns:
        rms and peak [rad/s^3, of prismatic joints m/s^3]; NaN for fewer than seven samples.
    """
    if len(time) < 2 * JERK_HALF_WIDTHS[0] + 1:
        return float("nan"), float("nan")
    variance = float(np.sum(noise_variance(time, x)))
    squared = np.zeros(1)
    for half_width in JERK_HALF_WIDTHS:
        if 2 * half_width + 1 > len(time):
            break
        stamps = np.lib.stride_tricks.sliding_window_view(time, 2 * half_width + 1)
        longest = np.max(np.abs(stamps - stamps[:, half_width : half_width + 1]), axis=1)
        third = local_weights(time, half_width, _CUBIC)[:, _CUBIC] * (6.0 / longest**3)[:, None]  # weights [1/s^3]
        windows = np.lib.stride_tricks.sliding_window_view(x, 2 * half_width + 1, axis=0)
        squared = np.sum(np.einsum("nw,njw->nj", third, windows) ** 2, axis=1)
        noise = np.sum(third**2, axis=1) * variance
        squared = squared - noise
        if np.mean(squared) >= CLEAR_JERK**2 * np.mean(noise):
            break
    return float(np.sqrt(max(np.mean(squared), 0.0))), float(np.sqrt(max(np.max(squared), 0.0)))
