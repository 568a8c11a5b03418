"""Velocities from recorded positions, on the configuration manifold and on the true time stamps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from manip_learn.errors import RecordingError
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.robot import Robot

VelocityMethod = Literal["auto", "midpoint", "smooth"]

# half widths of the smoothing window [samples] and degrees of its polynomial among which "auto" chooses
HALF_WIDTHS = (2, 3, 5, 7, 10, 15, 20, 30)
DEGREES = (2, 3, 5)
# noise averages out over the samples of a recording, bias does not
BIAS_WEIGHT = 4.0
# noise below this share of the motion's own step is what printing to 7 digits leaves: no smoothing needed
CLEAN_SHARE = 1e-3
# share of a window by which its time stamps may be off an even grid
EVEN = 1e-9
# windows among which degree and width are compared, spread over the trajectory
COMPARED = 150
# fewer samples leave no room for a window, or, if they are clean, for one that beats midpoints
SHORT, SHORT_AND_CLEAN = 8, 24


def derive_velocities(
    trajectory: Trajectory,
    robot: Robot,
    method: VelocityMethod = "auto",
    half_width: int | None = None,
    degree: int | None = None,
) -> Trajectory:
    """The same motion with velocities, at the configurations where they are best determined.

    Forward differences are not offered: on smooth motion at 50 Hz they put the learnt manipulability off by its own
    size, because they belong to a posture half a step later.

    Args:
        trajectory: Positions at increasing times; recorded velocities are not used.
        robot: The robot; its continuous joints may wrap.
        method: `"midpoint"`: ((q_t + q_t+1) / 2, dq / dt); `"smooth"`: a polynomial fitted to the samples of a window
            by least squares (Savitzky and Golay, 1964, here with true time stamps), value and slope at its centre;
            `"auto"`: smooth, but midpoint for very short trajectories and for short ones that are clean.
        half_width: Half width of the window [samples]; found from the data by default, together with the degree: those
            whose estimated variance plus squared bias (against a polynomial of two degrees more) is smallest.
        degree: Degree of the polynomial: 2, 3 or 5 by default.

    Returns:
        A trajectory with u; shorter by one sample (midpoint) or by a half width at both ends (smooth).

    Raises:
        RecordingError: Too few samples.
    """
    if len(trajectory) < 3:
        raise RecordingError(
            f"{trajectory.name}: at least 3 samples are needed to estimate velocities, got {len(trajectory)}",
            code="too-short",
        )
    if method not in ("auto", "midpoint", "smooth"):
        raise RecordingError(f"velocities must be 'auto', 'midpoint' or 'smooth', not {method!r}", code="method")
    x = positions_along(trajectory, robot)
    if x is None:  # a floating or planar base: differences on the manifold only
        return _manifold_midpoints(trajectory, robot)
    time, T = trajectory.time, len(trajectory)
    if method == "auto":
        midpoint = T < SHORT or (T < SHORT_AND_CLEAN and _is_clean(time, x))
        method = "midpoint" if midpoint and half_width is None else "smooth"
    if method == "midpoint":
        slope = np.diff(x, axis=0) / np.diff(time)[:, None]
        return Trajectory(
            0.5 * (time[1:] + time[:-1]), 0.5 * (x[1:] + x[:-1]), slope, trajectory.joint_names, trajectory.name
        )
    m, d = _window(trajectory, x, half_width, degree)
    value, slope = local_fit(time, x, m, d)
    return Trajectory(time[m : T - m], value, slope, trajectory.joint_names, trajectory.name)


def _window(trajectory: Trajectory, x: np.ndarray, half_width: int | None, degree: int | None) -> tuple[int, int]:
    T = len(trajectory)
    widths = HALF_WIDTHS if half_width is None else (half_width,)
    degrees = DEGREES if degree is None else (degree,)
    if half_width is not None and T < 2 * half_width + 1:
        raise RecordingError(
            f"{trajectory.name}: {T} samples are fewer than the smoothing window of {2 * half_width + 1}",
            code="too-short",
        )
    if half_width is not None and degree is not None and 1 <= degree <= 2 * half_width:
        return half_width, degree
    longest = max(5, T // 3) if half_width is None else T
    if T < 5 or not any(_fits(m, d, longest) for m in widths for d in degrees):
        raise RecordingError(
            f"{trajectory.name}: no window of degree {' or '.join(map(str, degrees))} and half width "
            f"{' or '.join(map(str, widths))} fits {T} samples: leave the choice to the data, or use 'midpoint'",
            code="too-short",
        )
    return best_window(trajectory.time, x, widths, degrees, longest)


def with_velocities(
    demonstrations: Demonstrations, robot: Robot | None, method: VelocityMethod = "auto"
) -> Demonstrations:
    """Demonstrations in which every trajectory has velocities: recorded ones are kept, missing ones are derived.

    Raises:
        RecordingError: A trajectory has no velocities and there is no robot to derive them with, or too few samples.
    """
    if demonstrations.has_velocities:
        return demonstrations
    if robot is None:
        raise RecordingError("trajectories without velocities need a robot: give features of one", code="no-velocities")
    derived = [t if t.u is not None else derive_velocities(t, robot, method) for t in demonstrations]
    return Demonstrations(derived, (*demonstrations.notes, _note(demonstrations, derived)))


def _note(before: Sequence[Trajectory], after: Sequence[Trajectory]) -> str:
    lost = sum(len(t) for t in before) - sum(len(t) for t in after)
    total, n = sum(len(t) for t in before), sum(t.u is None for t in before)
    return (
        f"velocities of {n} trajectory(ies) were derived from the positions; {lost} of {total} samples at the ends, "
        "where they are poorly determined, were left out"
    )


def positions_along(trajectory: Trajectory, robot: Robot) -> Float[np.ndarray, "T nv"] | None:
    """Joint positions without jumps: continuous joints unwrapped. None for a robot with a floating or planar base."""
    if any(b.kind in ("floating", "planar", "other") for b in robot.blocks):
        return None
    x = trajectory.q
    if x.shape[1] != robot.nv:
        x = np.array([robot.positions(row) for row in x])
    if robot.nq != robot.nv:
        x = x.copy()
        for b in robot.blocks:
            if b.kind == "continuous":
                x[:, b.v] = np.unwrap(x[:, b.v], axis=0)
    return x


def local_fit(
    time: Float[np.ndarray, " T"], x: Float[np.ndarray, "T nv"], half_width: int, degree: int
) -> tuple[Float[np.ndarray, "N nv"], Float[np.ndarray, "N nv"]]:
    """Value and slope at the centre of each window of 2 half_width + 1 samples, by least squares."""
    weights = local_weights(time, half_width, degree)
    windows = np.lib.stride_tricks.sliding_window_view(x, 2 * half_width + 1, axis=0)  # (N, nv, W)
    value, slope = np.einsum("ndw,njw->dnj", weights[:, :2], windows, optimize=True)
    return value, slope


def local_weights(time: np.ndarray, half_width: int, degree: int, stride: int = 1) -> Float[np.ndarray, "N d W"]:
    """Weights for the coefficients of the polynomial fitted to each window, in powers of the time from its centre.

    The coefficient of power 1 is a slope [1/s]; those of power k > 1 belong to time over the window's longest offset.
    """
    windows = np.lib.stride_tricks.sliding_window_view(time, 2 * half_width + 1)[::stride]
    offset = windows - windows[:, half_width : half_width + 1]
    scale = np.max(np.abs(offset), axis=1, keepdims=True)
    n = len(offset)
    if np.max(np.abs(offset - offset[0])) <= EVEN * np.min(scale):
        offset, scale = offset[:1], scale[:1]  # evenly sampled: one window serves for all
    powers = (offset / scale)[:, None, :] ** np.arange(degree + 1)[None, :, None]
    weights = np.linalg.solve(powers @ powers.transpose(0, 2, 1), powers)
    weights[:, 1] /= scale
    return np.broadcast_to(weights, (n, *weights.shape[1:]))


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
        for degree in degrees:
            if not _fits(m, degree, longest or x.shape[0]):
                continue
            slope = local_weights(time, m, degree, stride)[:, 1]
            richer = local_weights(time, m, degree + 2, stride)[:, 1] - slope
            difference = np.einsum("nw,njw->nj", richer, windows, optimize=True)
            # the difference of the two fits holds the bias and its own share of the noise: take that off again
            own = np.mean(np.sum(richer**2, axis=1)) * noise2
            bias2 = np.maximum(np.mean(difference**2, axis=0) - own, 0.0)
            error = float(np.sum(BIAS_WEIGHT * bias2 + np.mean(np.sum(slope**2, axis=1)) * noise2))
            if error < best_error:
                best, best_error = (m, degree), error
    return best


def _fits(half_width: int, degree: int, longest: int) -> bool:
    """Whether the window is short enough, and has samples enough for the richer polynomial that judges it."""
    return degree + 3 <= 2 * half_width + 1 <= longest


def noise_variance(time: np.ndarray, x: np.ndarray) -> Float[np.ndarray, " nv"]:
    """Variance of white noise on the samples from what a local parabola through five points leaves over."""
    windows_t = np.lib.stride_tricks.sliding_window_view(time, 5)
    offset = windows_t - windows_t[:, 2:3]
    powers = (offset / np.max(np.abs(offset), axis=1, keepdims=True))[:, None, :] ** np.arange(4)[None, :, None]
    fit = powers.transpose(0, 2, 1) @ np.linalg.solve(powers @ powers.transpose(0, 2, 1), powers)
    windows = np.lib.stride_tricks.sliding_window_view(x, 5, axis=0)
    left = windows - np.einsum("nvw,njw->njv", fit, windows, optimize=True)
    # a cubic leaves one degree of freedom of five; the median passes over the few places where the motion is not smooth
    return np.median(np.sum(left**2, axis=2), axis=0) / 0.455


def _is_clean(time: np.ndarray, x: np.ndarray) -> bool:
    steps = np.diff(x, axis=0)
    motion = float(np.sum(np.mean(steps**2, axis=0)))
    return float(np.sum(noise_variance(time, x))) <= CLEAN_SHARE**2 * motion


def _manifold_midpoints(trajectory: Trajectory, robot: Robot) -> Trajectory:
    dt = np.diff(trajectory.time)
    steps = np.array([robot.difference(a, b) for a, b in zip(trajectory.q[:-1], trajectory.q[1:], strict=True)])
    middles = np.array([robot.integrate(q, 0.5 * step) for q, step in zip(trajectory.q[:-1], steps, strict=True)])
    return Trajectory(
        trajectory.time[:-1] + 0.5 * dt, middles, steps / dt[:, None], trajectory.joint_names, trajectory.name
    )
