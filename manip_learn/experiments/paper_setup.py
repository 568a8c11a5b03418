"""The simulated demonstrations of Manavalan and Howard, "Learning Singularity Avoidance", and their printed numbers.

A 3-link planar arm reaches for points: links 1 m, gains 1, explicit Euler steps of 0.02 s, no noise, every step kept.
The rows of Phi are x, y and the heading theta = q1 + q2 + q3 of the tip. The data file published by the authors' group
follows the same recipe.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.recordings.trajectory import Demonstrations, Trajectory
from manip_learn.robot.loading import load_robot
from manip_learn.robot.robot import Robot

STEP = 0.02  # [s]
REST = np.deg2rad([10.0, -10.0, 10.0])  # psi*, the goal of the null-space policy [rad]
AXES = "x y rz"
SELECTIONS = ("x y", "x rz", "y rz")

# NMIE of the learnt manipulability, mean and s.d. of 50 trials, as printed (ambiguous by a factor of 1e-3)
_PRINTED = (1e-6, 7e-6), (7e-6, 4e-5), (2e-8, 3e-8)
PAPER_NMIE = {rows: {"mean": mean, "sd": sd} for rows, (mean, sd) in zip(SELECTIONS, _PRINTED, strict=True)}
# x, y only: RMSE of pi_mu against the learnt one, 20 rollouts of 100 points [rad/s]
PAPER_RMSE: dict[str, float] = {"mean": 2.069e-4, "sd": 1.001e-4}
# a real Sawyer that opens a drawer; its data were not published
PAPER_SAWYER_MIE = 0.002
PAPER_SAWYER_RMSE: dict[str, float] = {"mean": 0.220, "sd": 0.094}  # error of the policy

Law = Callable[[Float[np.ndarray, "g n"]], Float[np.ndarray, "g k"]]  # positions -> velocities or task coordinates
Motions = tuple[Float[np.ndarray, "g T n"], Float[np.ndarray, "g T nv"]]  # positions [rad], velocities [rad/s]


@dataclass(frozen=True)
class Setup:
    """Settings of simulated demonstrations.

    Attributes:
        rows: Constrained rows, words of `"x y rz"`.
        trajectories: Number of demonstrations.
        points: Number of consecutive samples of each demonstration.
        noise: Standard deviation of the noise on the actions (joint velocities), relative to their root mean square in
            each joint.
        policy: Null-space policy: the paper's `"attractor"`; a `"sinusoidal"` function of the configuration; `"zero"`
            for none; `"own"` for an attractor to a different rest configuration for each demonstrator.
    """

    rows: str = "x y"
    trajectories: int = 100
    points: int = 10
    noise: float = 0.0
    policy: Literal["attractor", "sinusoidal", "zero", "own"] = "attractor"

    @property
    def selection(self) -> Float[np.ndarray, "s 3"]:
        """True Lambda (s, 3) with orthonormal rows."""
        return np.eye(3)[[AXES.split().index(name) for name in self.rows.split()]]  # type: ignore[arg-type]


@cache
def planar_arm() -> Robot:
    """Return the shipped planar arm with three links of 1 m."""
    return load_robot("planar3")


@cache
def planar_features() -> FrameJacobian:
    """Return the features Phi of the planar arm: velocity of the tip along x and y [m/s], and theta [rad/s]."""
    return FrameJacobian(planar_arm(), "tip", AXES)


def tip(q: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return position x, y [m] and heading theta [rad] of the tip, shape (n, 3); theta is not wrapped.

    Args:
        q: Joint positions (n, 3) [rad].
    """
    angles = np.cumsum(q, axis=1)
    return np.column_stack([np.cos(angles).sum(1), np.sin(angles).sum(1), angles[:, -1]])


def draw_starts(n: int, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Draw random start configurations as in the paper.

    Args:
        n: Number of starts.
        rng: Random generator.

    Returns:
        Joint positions (n, 3) [rad].
    """
    return rng.uniform(np.deg2rad([0.0, 90.0, 0.0]), np.deg2rad([10.0, 100.0, 10.0]), size=(n, 3))


def draw_targets(n: int, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Draw random targets that the tip can reach with the required heading.

    The wrist of the target lies within two link lengths of the base; 3 % of the draws do not, and are repeated.

    Args:
        n: Number of targets.
        rng: Random generator.

    Returns:
        Targets (n, 3): x, y [m] and theta [rad].
    """
    out, low, high = np.empty((0, 3)), np.array([-1.0, 0.0, 0.0]), np.array([1.0, 2.0, np.pi])
    while len(out) < n:
        tries = rng.uniform(low, high, size=(2 * n, 3))
        wrist = tries[:, :2] - np.column_stack([np.cos(tries[:, 2]), np.sin(tries[:, 2])])
        out = np.concatenate([out, tries[np.linalg.norm(wrist, axis=1) <= 2.0]])
    return out[:n]


def reach(
    constraint: Constraint,
    policy: Law,
    places: Law,
    q: Float[np.ndarray, "g n"],
    targets: Float[np.ndarray, "g p"],
    points: int,
    step: float = STEP,
    damping: float = 0.0,
) -> Motions:
    """Simulate g reaching motions u = A^+ b + N pi at once, by explicit Euler steps.

    Equation (2) of Manavalan and Howard, with b = Lambda (r* - r).

    Args:
        constraint: Constraint A = Lambda Phi.
        policy: Function from joint positions (g, n) to the null-space policy pi (g, n) [rad/s].
        places: Function from joint positions (g, n) to the task coordinates r (g, p), whose rates are the rows of Phi.
        q: Start configurations (g, n) [rad].
        targets: Target r* of each motion (g, p).
        points: Number of samples of each motion.
        step: Time between samples [s].
        damping: Damping d of the inverse A^T (A A^T + d^2 I)^-1, in the unit of A; 0 for the pseudo-inverse.

    Returns:
        Joint positions (g, T, n) [rad] and velocities (g, T, nv) [rad/s].
    """
    postures, velocities = [], []
    for _ in range(points):
        A, pi = constraint.selection @ constraint.features.batch(q), policy(q)
        residual = (targets - places(q)) @ constraint.selection.T - np.einsum("nsv,nv->ns", A, pi)
        if damping:
            gram = A @ A.transpose(0, 2, 1) + damping**2 * np.eye(A.shape[1])
            u = pi + np.einsum("nsv,ns->nv", A, np.linalg.solve(gram, residual[:, :, None])[:, :, 0])
        else:
            u = pi + np.einsum("nvs,ns->nv", np.linalg.pinv(A), residual)
        postures.append(q)
        velocities.append(u)
        q = q + step * u
    return np.stack(postures, axis=1), np.stack(velocities, axis=1)


def to_demonstrations(robot: Robot, step: float, motions: Motions) -> Demonstrations:
    """Convert motions to demonstrations with equal time steps, whose velocities count as exact.

    Args:
        robot: Robot with the names of the joints.
        step: Time between samples [s].
        motions: Positions (g, T, n) [rad] and velocities (g, T, nv) [rad/s].
    """
    time = step * np.arange(motions[0].shape[1])
    pairs = enumerate(zip(*motions, strict=True))
    return Demonstrations(Trajectory(time, *one, robot.joint_names, f"trajectory {i}", exact=True) for i, one in pairs)


def demonstrate(setup: Setup, Lambda: Float[np.ndarray, "s 3"], rng: np.random.Generator) -> Demonstrations:
    """Simulate reaching demonstrations as in the paper, u = A^+ b + N pi, equation (2).

    Args:
        setup: Settings of the demonstrations.
        Lambda: True selection (s, 3) of the rows x, y, theta.
        rng: Random generator for starts, targets and noise.
    """
    n = setup.trajectories
    starts, targets = draw_starts(n, rng), draw_targets(n, rng)
    rest = REST if setup.policy != "own" else REST + rng.uniform(-0.5, 0.5, size=(n, 3))

    def policy(q: np.ndarray) -> np.ndarray:
        """Return pi(q) [rad/s]."""
        if setup.policy == "sinusoidal":
            return np.column_stack([np.sin(q[:, 1]), np.cos(q[:, 0]) * np.sin(q[:, 2]), -np.sin(q[:, 0] + q[:, 2])])
        return np.zeros_like(q) if setup.policy == "zero" else rest - q

    motions = reach(Constraint(Lambda, planar_features()), policy, tip, starts, targets, setup.points)
    return add_noise(to_demonstrations(planar_arm(), STEP, motions), setup.noise, rng)


def null_parts(features: FeatureMap, demonstrations: Demonstrations, Lambda: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """Return the true null-space component N u of every sample, shape (n, 3) [rad/s].

    Args:
        features: Feature map Phi.
        demonstrations: Demonstrations with velocities, with n samples in total.
        Lambda: True selection matrix (s, 3).
    """
    q = np.concatenate([t.q for t in demonstrations])
    u = np.concatenate([t.u for t in demonstrations if t.u is not None])
    A = Lambda @ features.batch(q)
    return u - np.einsum("nvs,nsw,nw->nv", np.linalg.pinv(A), A, u)


def true_constraint(rows: str = "x y") -> Constraint:
    """Return the true constraint of the planar arm, whose Lambda selects whole rows.

    Args:
        rows: Constrained rows, words of `"x y rz"`.
    """
    return Constraint(Setup(rows).selection, planar_features())


def noise_deviations(demonstrations: Demonstrations, share: float) -> Float[np.ndarray, " 3"]:
    """Return the standard deviation of the noise of each joint's velocity (3,) [rad/s].

    Args:
        demonstrations: Demonstrations with velocities.
        share: Standard deviation divided by the root mean square velocity of each joint.
    """
    u = np.concatenate([t.u for t in demonstrations if t.u is not None])
    return share * np.sqrt(np.mean(u**2, axis=0))


def add_noise(demonstrations: Demonstrations, share: float, rng: np.random.Generator) -> Demonstrations:
    """Add Gaussian noise to the joint velocities.

    Args:
        demonstrations: Demonstrations with velocities.
        share: Standard deviation divided by the root mean square velocity of each joint; with 0 nothing changes, and no
            random numbers are drawn.
        rng: Random generator.

    Returns:
        Demonstrations with noisy velocities; positions are unchanged.
    """
    if share == 0.0:
        return demonstrations
    u = np.array([t.u for t in demonstrations])
    # draw the noise of one sample for all trajectories together, in the order of the simulation
    e = rng.standard_normal(u.transpose(1, 0, 2).shape).transpose(1, 0, 2)
    noisy = u + noise_deviations(demonstrations, share) * e
    return Demonstrations(replace(t, u=one) for t, one in zip(demonstrations, noisy, strict=True))
