"""Kinematics, commands and rollouts of five robots at seeded postures."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from comparison import Cases

import manip_learn as ml

# robot -> joints held still, frame, axes, reference, number of rows of Lambda
ROBOTS: dict[str, tuple[tuple[str, ...], str, str, str, int]] = {
    "planar3": ((), "tip", "x y", "world", 2),
    "sawyer": ((), "right_gripper_tip", "xyz", "world", 2),
    "panda": (("panda_finger_joint1",), "panda_hand_tcp", "pose", "world", 4),
    "ur5": ((), "tool0", "pose", "local", 5),
    "xarm7": ((), "link_eef", "x y z rx ry rz", "world", 6),
}
# all joints at 0 is a singularity for planar3 and xarm7, and near one for panda; the sawyer stands upright, where it
# can hardly move its tip up or down; the ur5 with five rows stays regular there
SINGULAR = {"sawyer": (0.0, -np.pi / 2, 0.0, 0.0, 0.0, 0.0, 0.0)}
INVERSES = ("damped", "exact", "truncated")
TASKS = ("none", "hold", "point", "track")
POLICIES = ("zero", "ascent", "attractor")
# above this ratio of singular values an inverse that is not damped magnifies rounding to the size of the answer
SENSIBLE = 1e9


@cache
def constraint_of(name: str) -> ml.Constraint:
    """A hand-written constraint of the robot, rows not along the axes where there are fewer than features."""
    locked, frame, axes, reference, s = ROBOTS[name]
    robot = ml.load_robot(name, locked=locked)
    features = ml.FrameJacobian(robot, frame=frame, axes=axes, reference=reference)
    p = features(robot.neutral()).shape[0]
    rows = np.eye(p) if s == p else np.linalg.qr(np.random.default_rng(5).normal(size=(p, s)))[0].T
    if name == "sawyer":
        rows = np.array([[0.8, -0.6, 0.0], [0.0, 0.0, 1.0]])
    return ml.Constraint(rows, features)


def robot_of(name: str) -> ml.Robot:
    """The robot of `constraint_of`."""
    return constraint_of(name).features.robot


@cache
def postures(name: str) -> np.ndarray:
    """20 postures, shape (20, nv): 8 regular, 4 ever nearer to that of `SINGULAR`, 2 there, 3 at limits, 3 outside."""
    robot, rng = robot_of(name), np.random.default_rng(11)
    singular = np.array(SINGULAR.get(name, (0.0,) * robot.nv))
    low, high = np.maximum(robot.position_lower, -3.0), np.minimum(robot.position_upper, 3.0)
    inside = low + rng.uniform(0.1, 0.9, (20, robot.nv)) * (high - low)
    directions = rng.normal(size=(20, robot.nv))
    for i, size in zip(range(8, 12), (0.03, 0.01, 0.003, 0.001), strict=True):
        inside[i] = singular + size * directions[i]
    inside[12:14] = singular
    inside[13, 0] += 0.7
    for i in range(14, 20):  # some joints at a limit, or a little outside
        out = 0.0 if i < 17 else 0.05
        joints = rng.permutation(robot.nv)[: 1 + i % 3]
        upper = rng.random(robot.nv) < 0.5
        inside[i, joints] = np.where(upper, robot.position_upper + out, robot.position_lower - out)[joints]
    return inside


def kinematic_cases() -> Cases:
    """Phi, its derivative, mu and grad mu, posture by posture and in bulk."""
    cases: Cases = {}
    for name in ROBOTS:
        constraint, q = constraint_of(name), postures(name)
        # log mu has no gradient at a singularity
        regular = [sigma[-1] * SENSIBLE > sigma[0] for sigma in (np.linalg.svd(constraint(x))[1] for x in q)]
        batch = ml.manipulability_batch(constraint, q)
        cases[f"manipulability {name}"] = {
            "mu": np.array([ml.manipulability(constraint, x) for x in q]),
            "gradient": np.array([ml.manipulability_gradient(constraint, x) for x in q]),
            "log_gradient": np.array([ml.log_manipulability_gradient(constraint, x) for x in q[regular]]),
            "batch mu": batch.mu,
            "batch gradient": batch.gradient,
        }
        locked, frame, _, _, _ = ROBOTS[name]
        for axes, reference in (("pose", "world"), ("pose", "local"), ("planar", "world")):
            features = ml.FrameJacobian(robot_of(name), frame=frame, axes=axes, reference=reference)
            cases[f"features {name} {axes} {reference}"] = {
                "Phi": np.array([features(x) for x in q[[0, 1, 12, 18]]]),
                "derivative": np.array([features.derivative(x) for x in q[[2]]]),
            }
    return cases


def task_of(word: str, name: str) -> Any:
    """A task whose target is 0.1 off where the first posture is, and moves for `"track"`."""
    features = constraint_of(name).features
    target = features.coordinates(postures(name)[0]) + 0.1 * np.cos(np.arange(features.n_rows))
    if word == "point":
        return ml.PointAttractor(target, 1.5, max_speed=0.5)
    if word == "track":
        wave = np.sin(np.arange(features.n_rows) + 1.0)
        return ml.Track(lambda t: target + 0.1 * np.sin(t) * wave, lambda t: 0.1 * np.cos(t) * wave, 2.0)
    return ml.Hold() if word == "hold" else None


def policy_of(word: str, name: str) -> Any:
    """A null-space policy; the attractor pulls to the second posture."""
    if word == "ascent":
        return ml.ManipulabilityAscent(constraint_of(name), 0.8)
    if word == "attractor":
        return ml.JointAttractor(postures(name)[1], 0.7, robot_of(name))
    return ml.ZeroPolicy(robot_of(name).nv)


def command_cases() -> Cases:
    """Every inverse, task and policy at half of the postures, the other half for the next combination."""
    cases: Cases = {}
    for name in ROBOTS:
        turn = 0
        for inverse in INVERSES:
            for task in TASKS:
                for policy in POLICIES:
                    chosen = np.arange(turn % 2, 20, 2)
                    turn += 1
                    controller = ml.ResolvedRateController(
                        constraint_of(name), task_of(task, name), policy_of(policy, name), inverse
                    )
                    case = f"command {name} {inverse} {task} {policy}"
                    cases[case] = commands(controller, postures(name)[chosen], inverse)
            turn += 1
        cases[f"command {name} singular values"] = commands(
            ml.ResolvedRateController(constraint_of(name)), postures(name), "damped", ("manipulability", "smallest")
        )
    return cases


def commands(controller: Any, q: np.ndarray, inverse: str, keys: tuple[str, ...] = ("velocity", "scales")) -> dict:
    """The commands at some postures, at a time that is not 0; a refusal is named by its class."""
    found: dict[str, list] = {"velocity": [], "scales": [], "manipulability": [], "smallest": [], "status": []}
    for x in q:
        A = controller.constraint(x)
        sigma = np.linalg.svd(A, compute_uv=False)
        try:
            command = controller(x, 0.3)
        except ml.ManipLearnError as error:
            found["status"].append(type(error).__name__)
            continue
        sensible = inverse == "damped" or sigma[-1] * SENSIBLE > sigma[0]
        found["status"].append(str(command.status) if sensible or inverse == "truncated" else "not compared")
        if sensible:
            found["velocity"].append(command.velocity)
            found["scales"].append([command.task_scale, command.null_scale])
            found["manipulability"].append(command.manipulability)
            found["smallest"].append(command.smallest_singular_value)
    return {"status": found["status"], **{key: np.array(found[key]) for key in keys}}


def rollout_cases() -> Cases:
    """One start and a table of starts, away from singularities."""
    cases: Cases = {}
    for name in ROBOTS:
        robot, q = robot_of(name), postures(name)
        for task, policy in (("point", "ascent"), ("none", "attractor")):
            controller = ml.ResolvedRateController(constraint_of(name), task_of(task, name), policy_of(policy, name))
            case = f"rollout {name} {task} {policy} euler"
            cases[case] = summary([ml.simulate(robot, controller, q[0], 1.0, 0.02)])
            starts = q[0] + 0.02 * np.random.default_rng(3).normal(size=(40, robot.nv))
            cases[f"{case}, 40 starts"] = summary(ml.simulate(robot, controller, starts, 1.0, 0.02)[::8])
    return cases


def summary(rollouts: Any) -> dict:
    """Where they end, the mean of mu, and how often each status occurred."""
    return {
        "final q": np.array([r.q[-1] for r in rollouts]),
        "mean mu": np.array([r.manipulability.mean() for r in rollouts]),
        "status_counts": [{str(k): int(v) for k, v in r.status_counts.items()} for r in rollouts],
    }
