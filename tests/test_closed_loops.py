"""Closed loops at 1 kHz in the places where controllers fail: singular starts, targets out of reach, noise."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import TIPS
from random_arms import inside, oblique
from servo_cases import DT, Arm

import manip_learn as ml

SMALL = 1e-3  # [rad/s] below this a change of sign is no motion


def arm_of(name):
    """The arm without its fingers, and the position of its tip, in its plane for the planar arm."""
    robot = ml.load_robot(name, locked=("panda_finger_joint1",) if name == "panda" else ())
    tip = {**TIPS, "xarm7": "link7"}[name]
    return robot, ml.FrameJacobian(robot, tip, "x y" if name == "planar3" else "xyz")


def run(law, q, periods):
    """Commands of a loop with a perfect servo, and its velocities; no limit is ever exceeded (`Arm`)."""
    commands = Arm(ml.ServoLoop(law, DT), q).calls(periods)
    return commands, np.array([command.velocity for command in commands])


def chatter(u) -> int:
    """How often a joint turns round and back again within 10 ms, above SMALL on both sides."""
    turns = (u[1:] * u[:-1] < 0.0) & (np.minimum(np.abs(u[1:]), np.abs(u[:-1])) > SMALL)
    return sum(int(np.count_nonzero(np.diff(np.flatnonzero(turns[:, j])) < 10)) for j in range(u.shape[1]))


@pytest.mark.parametrize("name", ["ur5", "planar3", "sawyer"])
def test_a_target_out_of_reach_ends_the_motion_quietly(name):
    """Nothing turns to and fro, the arm slows down, and the status says that it does not get there."""
    (robot, features), rng = arm_of(name), np.random.default_rng(1)
    rows, way = oblique(features, 1 + 1 % features.n_rows, rng), rng.normal(size=features.n_rows)
    task = ml.PointAttractor(5.0 * way / np.linalg.norm(way), gain=1.0)
    law = ml.ResolvedRateController(rows, task, ml.ManipulabilityAscent(rows, gain=3.0))
    commands, u = run(law, inside(robot, rng), 4000)
    assert chatter(u) <= 1 and chatter(u[3000:]) == 0  # a swing that is braked may turn round twice
    assert np.max(np.abs(u[-100:])) < 0.25 * np.max(np.abs(u))
    assert np.max(np.abs(np.diff(u[-500:], axis=0))) < 1e-3
    assert "ok" not in [command.status for command in commands[-100:]]


LOST = {  # arm -> rows of its pose that lose a direction at its straight posture, which null-space motion brings back
    "planar3": ([0], [0, 1]),
    "ur5": ([1], [3, 4], [1, 3, 5], [1, 3, 4, 5]),
    "xarm7": ([3], [0, 3, 5], [0, 1, 3, 5], [1, 2, 3, 4, 5]),
    "sawyer": ([0, 1, 3, 4, 5], [0, 1, 2, 3, 4, 5]),
}


@pytest.mark.parametrize(
    ("name", "reaching"), [("planar3", True), ("planar3", False), ("ur5", False), ("xarm7", True), ("sawyer", False)]
)
def test_exact_singularities_are_left(name, reaching):
    """From an exactly singular posture, one second leads to a smallest singular value of 0.01 or more."""
    robot, features = arm_of(name)
    features = ml.FrameJacobian(robot, features.frame, "x y" if name == "planar3" else "pose")
    q = np.array([0.0, -0.5, 0.0, -0.5, 0.0, 0.0]) * np.pi if name == "ur5" else np.zeros(robot.nv)
    for rows in LOST[name]:
        constraint = ml.Constraint(np.eye(features.n_rows)[rows], features)
        assert np.linalg.svd(constraint(q), compute_uv=False)[-1] < 1e-9
        goal = inside(constraint.robot, np.random.default_rng(8)) * 0.5
        reaches = reaching and constraint.features.n_rows <= 3
        task = ml.PointAttractor(constraint.features.coordinates(goal), gain=1.0) if reaches else None
        law = ml.ResolvedRateController(constraint, task, ml.ManipulabilityAscent(constraint))
        commands, u = run(law, q, 1000)
        assert max(c.smallest_singular_value for c in commands) >= 0.01, constraint.selection
        assert chatter(u[100:]) == 0, constraint.selection


@pytest.mark.parametrize("name", ["panda", "sawyer", "ur5"])
def test_a_circle_is_followed_at_speed(name):
    """At 100 Hz and 0.5 m/s a hand stays within 0.1 mm of a circle of 0.1 m; without c of the law 0.4 mm are left."""
    (robot, features), rng = arm_of(name), np.random.default_rng(0)
    constraint = ml.Constraint(np.eye(3), features)
    draws = (inside(robot, rng) for _ in range(99))
    q = next(q for q in draws if np.linalg.svd(constraint(q), compute_uv=False)[-1] > 0.15)
    start = constraint.features.coordinates(q)
    circle = ml.Track(lambda t: start + 0.1 * np.array([np.cos(5.0 * t) - 1.0, np.sin(5.0 * t), 0.0]), gain=5.0)
    law = ml.ResolvedRateController(constraint, circle, ml.ManipulabilityAscent(constraint))
    error = ml.simulate(robot, law, q, 4.0, 0.01).task_error
    assert error[250:].max() < 1e-4  # [m], when the start from rest is forgotten
