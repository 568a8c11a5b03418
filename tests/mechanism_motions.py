"""Joint motions of an arm whose hand a mechanism carries, exact to 1e-9, then encoder noise; no velocities are used."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

import manip_learn as ml

T = 60
Path = Callable[[np.ndarray, np.random.Generator], tuple[np.ndarray, np.ndarray | None]]


def wave(rng: np.random.Generator, size: np.ndarray, shortest: float = 0.4) -> np.ndarray:
    """Smooth curves (T, len(size)) that begin at zero, of about the sizes given."""
    t = np.linspace(0.0, 1.0, T)[:, None]
    phase, rate = rng.uniform(0.0, 2 * np.pi, (2, len(size))), rng.uniform(0.5, 1.0 / shortest, (2, len(size)))
    curve = sum(np.sin(2 * np.pi * r * t + p) for p, r in zip(phase, rate, strict=True))
    return size * (curve - curve[0]) * 0.6


def stroke(rng: np.random.Generator, size: float) -> np.ndarray:
    """From 0 to 70-100 % of the size and half way back, at a speed that varies."""
    t = np.linspace(0.0, 1.0, T)
    far, back = size * rng.uniform(0.7, 1.0), rng.uniform(0.3, 0.7)
    s = np.where(t < 0.6, t / 0.6, 1.0 - (t - 0.6) / 0.4 * back)
    return far * (s + 0.05 * np.sin(2 * np.pi * rng.uniform(0.5, 1.5) * t) * t)


def follow(robot: ml.Robot, frame: str, q: np.ndarray, path: tuple, wander: np.ndarray) -> np.ndarray:
    """Postures (T, nv) whose tip is on the path; what the path leaves free wanders.

    Raises:
        RuntimeError: The arm does not get there.
    """
    tip, (p, R), out = robot.frame(frame), path, []
    for t, step in enumerate(np.diff(wander, axis=0, prepend=wander[:1])):
        q = q + step
        for _ in range(15):
            pose, J = robot.pose(q, tip), robot.jacobian(q, tip)
            error = p[t] - pose[:3, 3]
            if R is None:
                J = J[:3]
            else:
                error = np.append(error, Rotation.from_matrix(R[t] @ pose[:3, :3].T).as_rotvec())
            if np.linalg.norm(error) < 1e-9:
                break
            q = q + J.T @ np.linalg.solve(J @ J.T + 1e-12 * np.eye(len(J)), error)
        else:
            raise RuntimeError(f"the arm does not get to sample {t} of the path: {np.linalg.norm(error):.1e} m left")
        out.append(q)
    return np.array(out)


def demonstrate(
    robot: ml.Robot,
    frame: str,
    middle: np.ndarray,
    path: Path,
    rng: np.random.Generator,
    *,
    n: int = 5,
    grip: float = 0.2,
    noise: float = 1e-4,
) -> list[ml.Trajectory]:
    """n trajectories; each takes hold in another posture with the tip at the same place.

    Args:
        robot: The robot.
        frame: Its tip.
        middle: Posture about which the hand takes hold.
        path: (pose of the grip, rng) -> positions and orientations (or None) of the tip.
        rng: For everything.
        n: How many.
        grip: Standard deviation of the joints between grips [rad].
        noise: Of the encoders [rad].
    """
    tip = robot.frame(frame)
    handle = robot.position(middle, tip)
    out = []
    for number in range(n):
        q = middle + rng.normal(0.0, grip, robot.nv)
        for _ in range(20):
            q = q + np.linalg.pinv(robot.jacobian(q, tip)[:3]) @ (handle - robot.position(q, tip))
        exact = follow(robot, frame, q, path(robot.pose(q, tip), rng), wave(rng, np.full(robot.nv, 0.1)))
        noisy = exact + rng.normal(0.0, noise, exact.shape)
        out.append(ml.Trajectory(np.arange(T) * 0.02, noisy, None, robot.joint_names, f"demo_{number}"))
    return out


def about(
    axis: np.ndarray | None, point: np.ndarray, size: float, pitch: float = 0.0, slide: float = 0.0, firm: bool = True
) -> Path:
    """Path of a hand on something that turns about an axis, moves along it by the pitch, or slides as it likes; without
    an axis about a point as it likes, as on a cord or, held firmly, as a stick on a ball joint.
    """

    def path(pose: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray | None]:
        if axis is None:
            turns, along = wave(rng, np.full(3, size)), 0.0
        else:
            angle = stroke(rng, size) if not slide else wave(rng, np.array([size / 2]))[:, 0]
            turns, shift = np.outer(angle, axis), pitch * angle + (wave(rng, np.array([slide]))[:, 0] if slide else 0.0)
            along = np.outer(shift, axis)
        turn = Rotation.from_rotvec(turns)
        return point + turn.apply(pose[:3, 3] - point) + along, turn.as_matrix() @ pose[:3, :3] if firm else None

    return path


def along(directions: np.ndarray, size: float, firm: bool):
    """Path of a hand that moves along one direction, or along several as it likes."""

    def path(pose: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray | None]:
        way = stroke(rng, size)[:, None] if len(directions) == 1 else wave(rng, np.full(len(directions), size / 2))
        return pose[:3, 3] + way @ directions, np.tile(pose[:3, :3], (T, 1, 1)) if firm else None

    return path
