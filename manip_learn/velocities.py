"""Velocities from recorded positions, on the configuration manifold and on the true time stamps."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

from manip_learn.demonstrations import Demonstrations, Trajectory
from manip_learn.errors import RecordingError
from manip_learn.robot.robot import Robot

VelocityMethod = Literal["auto", "midpoint", "smooth"]

# half widths of the smoothing window [samples] among which "auto" chooses
HALF_WIDTHS = (2, 3, 5, 7, 10, 15, 20, 30)
# noise below this share of the motion's own step is what printing to 7 digits leaves: no smoothing needed
CLEAN_SHARE = 1e-3


def derive_velocities(
    trajectory: Trajectory, robot: Robot, method: VelocityMethod = "auto", half_width: int | None = None
) -> Trajectory:
    """The same motion with velocities, at the postures where they are known best.

    Forward differences are not offered: on smooth motion at 50 Hz they put the learnt manipulability off by its own
    size, because they belong to a posture half a step later.

    Args:
        trajectory: Positions at increasing times; recorded velocities are not used.
        robot: The robot; its continuous joints may wrap.
        method: `"midpoint"`: ((q_t + q_t+1) / 2, dq / dt), for clean positions; `"smooth"`: a parabola fitted to the
            samples of a window by least squares (Savitzky and Golay, 1964, here with true time stamps), value and
            slope at its middle; `"auto"`: midpoint for clean positions, else smooth.
        half_width: Half width of the window [samples]; found from the data by default: the one whose estimated
            variance plus squared bias (against a quartic) is smallest.

    Returns:
        A trajectory with u; shorter by one sample (midpoint) or by a half width at both ends (smooth).

    Raises:
        RecordingError: Too few samples.
    """
    if len(trajectory) < 3:
        raise RecordingError(
            f"{trajectory.name}: {len(trajectory)} sample(s) are too few to derive velocities from; at least 3 are needed",
            code="too-short",
        )
    x = positions_along(trajectory, robot)
    if x is None:  # a floating or planar base: differences on the manifold only
        return _manifold_midpoints(trajectory, robot)
    if method == "auto":
        method = "midpoint" if len(trajectory) < 8 or _is_clean(trajectory.time, x) else "smooth"
    if method == "midpoint":
        dt = np.diff(trajectory.time)
        return Trajectory(
            0.5 * (trajectory.time[1:] + trajectory.time[:-1]),
            0.5 * (x[1:] + x[:-1]),
            np.diff(x, axis=0) / dt[:, None],
            trajectory.joint_names,
            trajectory.name,
        )
    if method != "smooth":
        raise RecordingError(f"velocities must be 'auto', 'midpoint' or 'smooth', not {method!r}", code="method")
    m = half_width or best_half_width(trajectory.time, x)
    if len(trajectory) < 2 * m + 1:
        raise RecordingError(
            f"{trajectory.name}: {len(trajectory)} samples are fewer than the smoothing window of {2 * m + 1}",
            code="too-short",
        )
    value, slope = local_fit(trajectory.time, x, m, degree=2)
    return Trajectory(trajectory.time[m : len(trajectory) - m], value, slope, trajectory.joint_names, trajectory.name)


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
    return Demonstrations(derived, (*demonstrations.notes, "velocities were derived from the positions"))


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
    """Value and slope at the middle of each window of 2 half_width + 1 samples, by least squares."""
    weights = _local_weights(time, half_width, degree)
    windows = np.lib.stride_tricks.sliding_window_view(x, 2 * half_width + 1, axis=0)  # (N, nv, W)
    value, slope = np.einsum("ndw,njw->dnj", weights[:, :2], windows, optimize=True)
    return value, slope


def _local_weights(time: np.ndarray, half_width: int, degree: int) -> Float[np.ndarray, "N d W"]:
    windows = np.lib.stride_tricks.sliding_window_view(time, 2 * half_width + 1)
    offset = windows - windows[:, half_width : half_width + 1]
    scale = np.max(np.abs(offset), axis=1, keepdims=True)
    powers = (offset / scale)[:, None, :] ** np.arange(degree + 1)[None, :, None]
    weights = np.linalg.solve(powers @ powers.transpose(0, 2, 1), powers)
    weights[:, 1] /= scale
    return weights


def best_half_width(time: Float[np.ndarray, " T"], x: Float[np.ndarray, "T nv"]) -> int:
    """Half width [samples] whose slope has the smallest estimated mean squared error, all joints together."""
    noise2 = _noise_variance(time, x)
    best, best_error = HALF_WIDTHS[0], np.inf
    for m in HALF_WIDTHS:
        if 2 * m + 1 > max(5, x.shape[0] // 3):
            break
        parabola = _local_weights(time, m, 2)[:, 1]
        quartic = _local_weights(time, m, 4)[:, 1]
        windows = np.lib.stride_tricks.sliding_window_view(x, 2 * m + 1, axis=0)
        difference = np.einsum("nw,njw->nj", quartic - parabola, windows, optimize=True)
        # the difference of the two fits holds the bias and its own share of the noise: take that off again
        own = np.mean(np.sum((quartic - parabola) ** 2, axis=1)) * noise2
        variance = np.mean(np.sum(parabola**2, axis=1)) * noise2
        error = float(np.sum(np.maximum(np.mean(difference**2, axis=0) - own, 0.0) + variance))
        if error < best_error:
            best, best_error = m, error
    return best


def _noise_variance(time: np.ndarray, x: np.ndarray) -> Float[np.ndarray, " nv"]:
    """Variance of white noise on the samples from what a local parabola through five points leaves over."""
    windows_t = np.lib.stride_tricks.sliding_window_view(time, 5)
    offset = windows_t - windows_t[:, 2:3]
    powers = (offset / np.max(np.abs(offset), axis=1, keepdims=True))[:, None, :] ** np.arange(4)[None, :, None]
    fit = powers.transpose(0, 2, 1) @ np.linalg.solve(powers @ powers.transpose(0, 2, 1), powers)
    windows = np.lib.stride_tricks.sliding_window_view(x, 5, axis=0)
    left = windows - np.einsum("nvw,njw->njv", fit, windows, optimize=True)
    # a cubic leaves one degree of freedom of five; the median does not see the few places where the motion is not smooth
    return np.median(np.sum(left**2, axis=2), axis=0) / 0.455


def _is_clean(time: np.ndarray, x: np.ndarray) -> bool:
    steps = np.diff(x, axis=0)
    motion = float(np.sum(np.mean(steps**2, axis=0)))
    return float(np.sum(_noise_variance(time, x))) <= CLEAN_SHARE**2 * motion


def _manifold_midpoints(trajectory: Trajectory, robot: Robot) -> Trajectory:
    dt = np.diff(trajectory.time)
    steps = np.array([robot.difference(a, b) for a, b in zip(trajectory.q[:-1], trajectory.q[1:], strict=True)])
    middles = np.array([robot.integrate(q, 0.5 * step) for q, step in zip(trajectory.q[:-1], steps, strict=True)])
    return Trajectory(
        trajectory.time[:-1] + 0.5 * dt, middles, steps / dt[:, None], trajectory.joint_names, trajectory.name
    )
