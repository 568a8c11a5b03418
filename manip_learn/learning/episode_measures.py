"""One episode measured against a constraint: distance to its singularity, violation, limits, jerk, rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.recordings.jerk import jerk
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.velocities import VelocityMethod, derive_velocities
from manip_learn.robot.robot import Robot

CHUNK = 4096  # samples whose Phi are held at a time
REST_SPEED = 0.02  # [rad/s or m/s] no joint faster: at rest
NOTABLE = 1e-6  # [rad or m, and of a speed limit] beyond a limit


@final
@dataclass(frozen=True)
class EpisodeAudit:
    """What the audit says of one episode. NaN where something is not defined (no limits, too few samples).

    Attributes:
        episode: Name of the trajectory.
        number: Its place among those audited, counted from 0.
        n_samples: Number of samples.
        duration: From the first to the last [s].
        rest_share: Share of the time in which no joint is faster than 0.02 rad/s or m/s.
        sigma_min: Smallest of the smallest singular values of A(q): the distance to the task's singularity, in the
            unit of the rows.
        sigma_median: Their median.
        manipulability_min: Smallest manipulability mu(q) = sqrt(det(A A^T)).
        residual: Share of the motion that breaks A(q) u = 0, sqrt(sum |A^+ A u|^2 / sum |u|^2).
        displacement_mm: Extent of the motion along the constrained rows, those in m [mm].
        displacement_deg: The same, rows in rad [degrees].
        limit_margin: Smallest distance to a position limit, as a share of the joint's range; negative beyond it.
        limit_joint: The joint that comes so close, or an empty string.
        beyond_limits: Share of the samples beyond a position limit.
        peak_speed: Largest speed as a share of the velocity limit.
        peak_speed_joint: The joint that is so fast, or an empty string.
        too_fast: Share of the samples faster than a velocity limit.
        jerk_rms: Root mean square of the jerk [rad/s^3].
        jerk_peak: Largest jerk [rad/s^3].
        score: Root of the sum of squares of the positive robust z-scores; the ranking's key.
        reasons: Why it should be left out, one sentence each; empty if it should stay.
    """

    episode: str
    number: int
    n_samples: int
    duration: float
    rest_share: float
    sigma_min: float
    sigma_median: float
    manipulability_min: float
    residual: float
    displacement_mm: float
    displacement_deg: float
    limit_margin: float
    limit_joint: str
    beyond_limits: float
    peak_speed: float
    peak_speed_joint: str
    too_fast: float
    jerk_rms: float
    jerk_peak: float
    score: float = 0.0
    reasons: tuple[str, ...] = ()

    @property
    def leave_out(self) -> bool:
        """Whether the audit says to leave it out."""
        return bool(self.reasons)


def measure(
    constraint: Constraint, trajectory: Trajectory, number: int, velocities: VelocityMethod = "auto"
) -> EpisodeAudit:
    """The measures of one episode, without its score, which depends on the others.

    Raises:
        RecordingError: Velocities are missing and cannot be derived.
        ConfigurationError: Postures of another robot.
    """
    robot: Robot | None = getattr(constraint.features, "robot", None)
    moving = (
        trajectory if trajectory.u is not None or robot is None else derive_velocities(trajectory, robot, velocities)
    )
    u = np.zeros((len(moving), constraint.nv)) if moving.u is None else moving.u
    sigma, mu, broken, held = _along(constraint, moving.q, u)
    total = float(np.sum(u * u))
    x, columns = _joint_positions(trajectory, robot)
    margin, limit_joint, beyond = _position_limits(robot, x, columns)
    peak, fastest, too_fast = _velocity_limits(robot, u, columns)
    rms, jerk_peak = jerk(trajectory.time, x)
    units = np.array(constraint.features.row_units)
    return EpisodeAudit(
        episode=trajectory.name,
        number=number,
        n_samples=len(trajectory),
        duration=trajectory.duration,
        rest_share=_rest_share(moving.time, u[:, columns]),
        sigma_min=float(sigma.min()),
        sigma_median=float(np.median(sigma)),
        manipulability_min=float(mu.min()),
        residual=float(np.sqrt(np.sum(broken) / total)) if total > 0.0 else float("nan"),
        displacement_mm=1000.0 * _extent(moving.time, held[:, units == "m/s"]),
        displacement_deg=float(np.degrees(_extent(moving.time, held[:, units == "rad/s"]))),
        limit_margin=margin,
        limit_joint=limit_joint,
        beyond_limits=beyond,
        peak_speed=peak,
        peak_speed_joint=fastest,
        too_fast=too_fast,
        jerk_rms=rms,
        jerk_peak=jerk_peak,
    )


def _along(
    constraint: Constraint, q: Float[np.ndarray, "T n"], u: Float[np.ndarray, "T nv"]
) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, " T"], Float[np.ndarray, " T"], Float[np.ndarray, "T p"]]:
    """Of each sample: the smallest singular value of A, mu, |A^+ A u|^2, and the constrained part of Phi u."""
    selection = constraint.selection
    sigma, mu, broken = (np.empty(len(q)) for _ in range(3))
    held = np.empty((len(q), selection.shape[1]))
    for start in range(0, len(q), CHUNK):
        part = slice(start, start + CHUNK)
        A = np.einsum("sp,npv->nsv", selection, constraint.features.batch(q[part]), optimize=True)
        _, singular, Vt = np.linalg.svd(A, full_matrices=False)
        sigma[part], mu[part] = singular[:, -1], np.prod(singular, axis=1)
        if A.shape[1] > A.shape[2]:  # more rows than joints: singular everywhere
            sigma[part] = mu[part] = 0.0
        used = singular > 1e-15 * singular[:, :1]  # as np.linalg.pinv
        broken[part] = np.sum((np.einsum("nkv,nv->nk", Vt, u[part]) * used) ** 2, axis=1)
        held[part] = np.einsum("nsv,nv->ns", A, u[part]) @ selection
    return sigma, mu, broken, held


def _extent(time: Float[np.ndarray, " T"], rate: Float[np.ndarray, "T k"]) -> float:
    """Length of the integrated rates along the direction in which they spread most; NaN without rows."""
    if rate.shape[1] == 0:
        return float("nan")
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time)[:, None]
    way = np.vstack([np.zeros(rate.shape[1]), np.cumsum(steps, axis=0)])
    _, directions = np.linalg.eigh(np.cov(way, rowvar=False, bias=True).reshape(rate.shape[1], -1))
    return float(np.ptp(way @ directions[:, -1]))


def _joint_positions(trajectory: Trajectory, robot: Robot | None) -> tuple[np.ndarray, np.ndarray]:
    """Positions of the joints with one coordinate, continuous ones without jumps, and their tangent coordinates."""
    if robot is None:
        return trajectory.q, np.arange(len(trajectory.joint_names))
    blocks = [b for b in robot.blocks if b.v.stop - b.v.start == 1]
    columns = np.array([b.v.start for b in blocks], dtype=int)
    q = trajectory.q
    x = q if q.shape[1] == robot.nv else np.array([robot.positions(row) for row in q])
    x = x[:, columns].copy()
    for i, b in enumerate(blocks):
        if b.kind == "continuous":
            x[:, i] = np.unwrap(x[:, i])
    return x, columns


def _position_limits(robot: Robot | None, x: np.ndarray, columns: np.ndarray) -> tuple[float, str, float]:
    """Smallest margin as a share of the range, its joint, and the share of samples beyond a limit."""
    if robot is None:
        return float("nan"), "", 0.0
    lower, upper = robot.position_lower[columns], robot.position_upper[columns]
    ranges = upper - lower
    if not np.any(np.isfinite(ranges)):
        return float("nan"), "", 0.0
    room = np.minimum(x - lower, upper - x)
    with np.errstate(invalid="ignore"):
        shares = np.where(np.isfinite(ranges), room.min(axis=0) / ranges, np.inf)
    closest = int(np.argmin(shares))
    beyond = float(np.mean(np.any(room < -NOTABLE, axis=1)))
    return float(shares[closest]), robot.joint_names[columns[closest]], beyond


def _velocity_limits(robot: Robot | None, u: np.ndarray, columns: np.ndarray) -> tuple[float, str, float]:
    """Largest speed as a share of its limit, its joint, and the share of samples beyond a limit."""
    if robot is None or not np.any(np.isfinite(robot.velocity_limit[columns])):
        return float("nan"), "", 0.0
    shares = np.abs(u[:, columns]) / robot.velocity_limit[columns]
    fastest = int(np.argmax(shares.max(axis=0)))
    too_fast = float(np.mean(np.any(shares > 1.0 + NOTABLE, axis=1)))
    return float(shares[:, fastest].max()), robot.joint_names[columns[fastest]], too_fast


def _rest_share(time: Float[np.ndarray, " T"], u: Float[np.ndarray, "T n"]) -> float:
    """Share of the time, sample by sample, in which no joint is faster than REST_SPEED."""
    if len(time) < 2:
        return float("nan")
    weights = np.gradient(time)
    return float(np.sum(weights[np.max(np.abs(u), axis=1, initial=0.0) < REST_SPEED]) / np.sum(weights))
