"""Motions with known truth, made as the tests need them: nothing here was used to tune the library."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp

import manip_learn as ml
from manip_learn.experiments.paper_setup import AXES, Setup, demonstrate, planar_features

PLANAR_ROWS = {"xy": [0, 1], "x-theta": [0, 2], "y-theta": [1, 2]}


def arm_features(axes: str = "xyz", reference: str = "world") -> ml.FrameJacobian:
    """Rows of the Sawyer-like arm's tip."""
    return ml.FrameJacobian(ml.load_robot("sawyer"), "right_gripper_tip", axes, reference)


def paper_motions(
    rows: list[int], rng: np.random.Generator, n_trajectories: int = 100, n_points: int = 10, noise: float = 0.0
) -> tuple[ml.Demonstrations, ml.Constraint]:
    """The paper's planar reaching: u = A^+ b + N pi, Euler steps of 0.02 s."""
    setup = Setup(" ".join(np.array(AXES.split())[rows]), n_trajectories, n_points, noise)
    return demonstrate(setup, setup.selection, rng), ml.Constraint(setup.selection, planar_features())


def random_posture(robot: ml.Robot, rng: np.random.Generator, share: float = 0.5) -> np.ndarray:
    """A posture in the middle part of the joint ranges."""
    middle = 0.5 * (robot.position_lower + robot.position_upper)
    half = 0.5 * (robot.position_upper - robot.position_lower)
    return middle + share * half * rng.uniform(-1.0, 1.0, robot.nv)


def smooth_drive(n: int, rng: np.random.Generator, speed: float = 0.6) -> Callable[[float], np.ndarray]:
    """Sums of three slow sines per joint [rad/s]: what an operator's hand does to an arm."""
    rate = 2 * np.pi * rng.uniform(0.1, 0.7, (3, n))
    phase = rng.uniform(0, 2 * np.pi, (3, n))
    size = speed * rng.uniform(0.3, 1.0, (3, n))
    return lambda t: np.sum(size * np.sin(rate * t + phase), axis=0)


def guided_motions(
    features: ml.FeatureMap,
    selection: np.ndarray,
    rng: np.random.Generator,
    n_trajectories: int = 12,
    n_points: int = 60,
    dt: float = 0.02,
    noise: float = 0.0,
) -> tuple[ml.Demonstrations, ml.Constraint]:
    """An arm pushed about while the world holds the rows Lambda Phi.

    Integrated so that positions and velocities belong together to 1e-8.
    """
    robot = features.robot
    truth, time, trajectories = ml.Constraint(selection, features), dt * np.arange(n_points), []
    for k in range(n_trajectories):
        push = smooth_drive(robot.nv, rng)
        rng.uniform(size=(9, truth.n_constraints))  # not used; without it all motions would be others

        def velocity(t: float, q: np.ndarray, push=push) -> np.ndarray:
            A, pi = truth(q), push(t)
            return pi - A @ pi @ np.linalg.solve(A @ A.T, A)

        q = solve_ivp(velocity, time[[0, -1]], random_posture(robot, rng), "DOP853", time, rtol=1e-9, atol=1e-10).y.T
        u = np.array([velocity(*at) for at in zip(time, q, strict=True)])
        u = u + noise * np.sqrt(np.mean(u**2)) * rng.standard_normal(u.shape)
        trajectories.append(ml.Trajectory(time, q, u, robot.joint_names, f"motion {k}", exact=True))
    return ml.Demonstrations(trajectories), truth


def oblique(s: int, p: int, rng: np.random.Generator) -> np.ndarray:
    """s random orthonormal rows of length p."""
    return np.linalg.qr(rng.standard_normal((p, s)))[0].T


def angle_deg(learnt: ml.Constraint, truth: ml.Constraint) -> float:
    """Largest principal angle between two row spaces [deg], written down anew."""
    P = truth.selection
    if learnt.selection.shape != P.shape:
        return 90.0
    outside = learnt.selection - (learnt.selection @ P.T) @ P
    return float(np.degrees(np.arcsin(min(1.0, np.linalg.norm(outside, 2)))))
