"""Velocities from recorded positions and poses, on the configuration manifold and on the true time stamps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from manip_learn.errors import RecordingError, counted
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.local_fit import best_windows, local_fit, local_weights, noise_variance
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.joints import JointBlock
from manip_learn.robot.robot import Robot

VelocityMethod = Literal["auto", "midpoint", "smooth"]

# noise below this share of the motion's own step is what printing to 7 digits leaves: no smoothing needed
CLEAN_SHARE = 1e-3
# fewer samples leave no room for a window, or, if they are clean, for one that beats midpoints
_SHORT, SHORT_AND_CLEAN = 8, 24
WINDOWS_AT_A_TIME = 2048  # relative rotations in memory


def derive_velocities(trajectory: Trajectory, robot: Robot, method: VelocityMethod = "auto") -> Trajectory:
    """A motion with velocities, at the configurations where they are best determined.

    Forward differences are not offered: on smooth motion at 50 Hz they put the learnt manipulability off by its own
    size, because they belong to a posture half a step later.

    Args:
        trajectory: Positions at increasing times; recorded velocities are not used.
        robot: The robot; its continuous joints may wrap. The velocity of a floating body is its twist in its own axes
            (Pinocchio's convention for free-flyer joints), see `smooth_pose`.
        method: `"midpoint"`: ((q_t + q_t+1) / 2, dq / dt); `"smooth"`: a polynomial fitted to the samples of a window
            by least squares (Savitzky and Golay, 1964, here with true time stamps), value and slope at its centre;
            `"auto"`: smooth, but midpoint for very short trajectories and for short ones that are clean. The half width
            of the window, 30 samples or 0.3 s at most, whichever is more, and the degree of the polynomial, 2, 3 or 5,
            are those whose estimated variance plus squared bias (against two degrees more) is smallest.

    Returns:
        A trajectory with u; shorter by one sample (midpoint) or by a half width at both ends (smooth). Efforts are kept
        as they were recorded, halfway between samples for midpoints.

    Raises:
        RecordingError: Too few samples, or no such method.
    """
    return derive_together([trajectory], robot, method)[0]


def derive_together(
    trajectories: Sequence[Trajectory], robot: Robot, method: VelocityMethod = "auto"
) -> list[Trajectory]:
    """`derive_velocities` of each; those recorded at the same times share the work.

    Raises:
        RecordingError: Too few samples, or no such method.
    """
    if method not in ("auto", "midpoint", "smooth"):
        raise RecordingError(f"velocities must be 'auto', 'midpoint' or 'smooth', not {method!r}", code="method")
    bodies = [b for b in robot.blocks if b.kind == "floating"]
    alike: dict[tuple[str, bytes], dict[int, np.ndarray]] = {}
    derived: dict[int, Trajectory] = {}
    for i, t in enumerate(trajectories):
        if (T := len(t)) < 3:
            text = f"{t.name}: at least 3 samples are needed to estimate velocities, got {T}"
            raise RecordingError(text, code="too-short")
        x, how = positions_along(t, robot), method
        if how == "auto":
            short = T < _SHORT or (T < SHORT_AND_CLEAN and x is not None and is_clean(t.time, x))
            how = "midpoint" if short else "smooth"
        if x is None or (how == "midpoint" and bodies):  # a planar base: differences on the manifold only
            dt = np.diff(t.time)
            steps = np.array([robot.difference(a, b) for a, b in zip(t.q[:-1], t.q[1:], strict=True)])
            middles = np.array([robot.integrate(q, 0.5 * step) for q, step in zip(t.q[:-1], steps, strict=True)])
            time, names, measured = t.time[:-1] + 0.5 * dt, t.joint_names, _measured(t, _between)
            derived[i] = Trajectory(time, middles, steps / dt[:, None], names, t.name, **measured)
        else:
            alike.setdefault((how, t.time.tobytes()), {})[i] = x
    for (how, _), some in alike.items():
        own = [trajectories[i] for i in some]
        if how == "midpoint":
            found = [_midpoints(t, x) for t, x in zip(own, some.values(), strict=True)]
        elif bodies:
            found = [_with_bodies(t, robot, x, bodies) for t, x in zip(own, some.values(), strict=True)]
        else:
            found = _smoothed(own, np.stack(list(some.values())))
        derived |= dict(zip(some, found, strict=True))
    return [derived[i] for i in range(len(trajectories))]


def _midpoints(trajectory: Trajectory, x: Float[np.ndarray, "T nv"]) -> Trajectory:
    slope, measured = np.diff(x, axis=0) / np.diff(trajectory.time)[:, None], _measured(trajectory, _between)
    names, name = trajectory.joint_names, trajectory.name
    return Trajectory(_between(trajectory.time), _between(x), slope, names, name, **measured)


def _smoothed(trajectories: Sequence[Trajectory], x: Float[np.ndarray, "e T nv"]) -> list[Trajectory]:
    """Polynomials fitted to trajectories with the same times, each in the windows that suit it."""
    time, (_, T, nv) = trajectories[0].time, x.shape
    windows = _windows(trajectories[0], x)
    out: dict[int, Trajectory] = {}
    for m, d in dict.fromkeys(windows):
        chosen = [i for i, window in enumerate(windows) if window == (m, d)]
        value, slope = local_fit(time, x[chosen].transpose(1, 0, 2).reshape(T, -1), m, d)
        for i, k in zip(chosen, range(0, value.shape[1], nv), strict=True):
            t, own = trajectories[i], slice(k, k + nv)
            measured = _measured(t, lambda a, m=m: a[m : T - m])
            out[i] = Trajectory(time[m : T - m], value[:, own], slope[:, own], t.joint_names, t.name, **measured)
    return [out[i] for i in range(len(trajectories))]


def _with_bodies(
    trajectory: Trajectory, robot: Robot, x: Float[np.ndarray, "T nv"], bodies: Sequence[JointBlock]
) -> Trajectory:
    """Joints and floating bodies, each with the window that its own noise asks for; as long as the widest allows."""
    from scipy.spatial.transform import Rotation

    T, time = len(trajectory), trajectory.time
    loose = {i for b in bodies for i in range(b.v.start, b.v.stop)}
    fixed = np.array([i for i in range(robot.nv) if i not in loose], dtype=int)
    parts: list[tuple[int, np.ndarray | slice, np.ndarray, np.ndarray]] = []
    if fixed.size:
        m, d = _windows(trajectory, x[None, :, fixed])[0]
        parts.append((m, fixed, *local_fit(time, x[:, fixed], m, d)))
    for b in bodies:
        m, d = _windows(trajectory, x[None, :, b.v])[0]
        position, rotation = x[:, b.v][:, :3], Rotation.from_rotvec(x[:, b.v][:, 3:])
        parts.append((m, b.v, *smooth_pose(time, position, rotation, m, d)))
    widest = max(m for m, *_ in parts)
    q, u = np.empty((T - 2 * widest, robot.nv)), np.empty((T - 2 * widest, robot.nv))
    for m, columns, value, slope in parts:
        inner = slice(widest - m, widest - m + len(q))
        q[:, columns], u[:, columns] = value[inner], slope[inner]
    for b in bodies:
        q[:, b.v.start + 3 : b.v.stop] = continuous_rotation_vectors(q[:, b.v.start + 3 : b.v.stop])
    measured = _measured(trajectory, lambda a: a[widest : T - widest])
    return Trajectory(time[widest : T - widest], q, u, trajectory.joint_names, trajectory.name, **measured)


def _windows(trajectory: Trajectory, x: Float[np.ndarray, "e T _"]) -> list[tuple[int, int]]:
    """Half width and degree for each of several recordings at the times of a trajectory."""
    if (T := len(trajectory)) < 5:
        text = f"{trajectory.name}: {counted(T, 'sample')} are fewer than a smoothing window has: use 'midpoint'"
        raise RecordingError(text, code="too-short")
    return best_windows(trajectory.time, x, max(5, T // 3))


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
    lost = sum(len(t) for t in demonstrations) - sum(len(t) for t in derived)
    total, n = sum(len(t) for t in demonstrations), sum(t.u is None for t in demonstrations)
    note = (
        f"velocities of {counted(n, 'recording')} derived from the positions; {lost:,} of {total:,} samples left out "
    )
    note += "at the ends, where they are poorly determined"
    return Demonstrations(derived, (*demonstrations.notes, note))


def positions_along(trajectory: Trajectory, robot: Robot) -> Float[np.ndarray, "T nv"] | None:
    """Joint positions without jumps: continuous joints and rotation vectors unwrapped. None with a planar base."""
    if any(b.kind in ("planar", "other") for b in robot.blocks):
        return None
    x = trajectory.q
    if x.shape[1] != robot.nv:
        x = np.array([robot.positions(row) for row in x])
    if robot.nq != robot.nv:
        x = x.copy()
        for b in robot.blocks:
            if b.kind == "continuous":
                x[:, b.v] = np.unwrap(x[:, b.v], axis=0)
            elif b.kind == "floating":
                x[:, b.v.start + 3 : b.v.stop] = continuous_rotation_vectors(x[:, b.v.start + 3 : b.v.stop])
    return x


def is_clean(time: np.ndarray, x: np.ndarray) -> bool:
    """Whether the noise on positions is what printing them leaves, a small share of the motion's own steps."""
    steps = np.diff(x, axis=0)
    motion = float(np.sum(np.mean(steps**2, axis=0)))
    return float(np.sum(noise_variance(time, x))) <= CLEAN_SHARE**2 * motion


def _measured(trajectory: Trajectory, cut: Callable[[np.ndarray], np.ndarray]) -> dict[str, Any]:
    """Efforts, where they were recorded, at the samples for which velocities are derived; these need no judge."""
    return {what: cut(array) for what, array in trajectory.beside.items() if what != "u"} | {"judged": True}


def _between(values: np.ndarray) -> np.ndarray:
    return 0.5 * (values[1:] + values[:-1])


def smooth_pose(
    time: Float[np.ndarray, " T"], position: Float[np.ndarray, "T 3"], rotation: Any, half_width: int, degree: int
) -> tuple[Float[np.ndarray, "N 6"], Float[np.ndarray, "N 6"]]:
    """Pose and LOCAL twist at the centre of each window of 2 half_width + 1 samples.

    Positions are fitted by polynomials in the world's axes; rotations by polynomials of v(t) = log(R_c^T R(t)), R_c the
    sample in the centre. With R = R_c exp(v) and the right Jacobian J_r of the rotation group, the twist in the axes of
    the thing is (R^T dp/dt, J_r(v) dv/dt), the velocity of a free-flyer joint in Pinocchio.

    Args:
        time: Increasing [s].
        position: Of the thing in the world [m].
        rotation: Its orientations, a SciPy `Rotation`, which is not loaded before it is needed.
        half_width: Half width of the windows [samples].
        degree: Of the polynomials.

    Returns:
        Position [m] and rotation vector [rad]; linear [m/s] and angular velocity [rad/s], in the axes of the thing.
    """
    p, dp = local_fit(time, position, half_width, degree)
    weights, n, width = local_weights(time, half_width, degree), len(p), 2 * half_width + 1
    v, dv = np.empty((n, 3)), np.empty((n, 3))
    for start in range(0, n, WINDOWS_AT_A_TIME):
        first = np.arange(start, min(n, start + WINDOWS_AT_A_TIME))
        samples = (first[:, None] + np.arange(width)).ravel()
        centre = rotation[np.repeat(first + half_width, width)]
        relative = (centre.inv() * rotation[samples]).as_rotvec().reshape(len(first), width, 3)
        v[first], dv[first] = np.einsum("ndw,nwj->dnj", weights[first, :2], relative)
    from scipy.spatial.transform import Rotation

    smooth = rotation[half_width : half_width + n] * Rotation.from_rotvec(v)
    linear = smooth.inv().apply(dp)
    a = np.linalg.norm(v, axis=1, keepdims=True)
    small = a < 1e-4  # where the quotients lose their digits
    safe = np.where(small, 1.0, a)
    first = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    once = np.cross(v, dv)
    return np.hstack([p, smooth.as_rotvec()]), np.hstack([linear, (dv - first * once + second * np.cross(v, once))])


def continuous_rotation_vectors(vectors: Float[np.ndarray, "T 3"]) -> Float[np.ndarray, "T 3"]:
    """Rotations, each by the rotation vector nearest to the one before: full turns are added."""
    out = np.array(vectors)
    for i in range(1, len(out)):
        before, angle = out[i - 1], float(np.linalg.norm(out[i]))
        axis = out[i] / angle if angle > 1e-12 else before / max(float(np.linalg.norm(before)), 1e-12)
        turns = np.round((before @ axis - angle) / (2.0 * np.pi))
        if turns != 0.0:
            out[i] = (angle + 2.0 * np.pi * turns) * axis
    return out
