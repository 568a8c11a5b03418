"""Closed loops at 1 kHz in the places where controllers fail: singular starts, targets out of reach, noise."""

from __future__ import annotations

from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import pytest
from conftest import TIPS
from servo_cases import DT

import manip_learn as ml
from manip_learn.constraint.features import FrameJacobian
from manip_learn.robot.loading import load_robot
from manip_learn.robot.robot import Robot

# [rad/s] below this a change of sign is no motion
SMALL = 1e-3


class Run(NamedTuple):
    """Velocities (T, nv), postures (T, nv), smallest singular values and words of a run."""

    u: np.ndarray
    q: np.ndarray
    sigma: np.ndarray
    words: list[str]


def features_of(robot: Robot, name: str) -> FrameJacobian:
    """Position of the tip; in its plane for the planar arm."""
    tips = {**TIPS, "xarm7": "link7"}
    return FrameJacobian(robot, tips[name], "x y" if name == "planar3" else "xyz")


def arm(name: str) -> Robot:
    """The arm without its fingers."""
    return load_robot(name, locked=("panda_finger_joint1",) if name == "panda" else ())


def posture(robot: Robot, rng: np.random.Generator) -> np.ndarray:
    """Inside the limits."""
    low, high = np.maximum(robot.position_lower, -3.0), np.minimum(robot.position_upper, 3.0)
    return low + (high - low) * rng.uniform(0.1, 0.9, robot.nv)


def oblique(features: FrameJacobian, rng: np.random.Generator, s: int) -> ml.Constraint:
    """Rows in no axis's direction."""
    p = features.n_rows
    return ml.Constraint(np.linalg.qr(rng.normal(size=(p, p)))[0][:s], features)


def run(law: ml.ResolvedRateController, q: np.ndarray, periods: int, noise: float = 0.0, **settings: Any) -> Run:
    """A loop with a perfect servo; `noise` on the measured posture. No limit is ever exceeded."""
    robot, rng = law.robot, np.random.default_rng(1)
    assert robot is not None
    loop, before = ml.ServoLoop(law, DT, **settings), np.zeros(robot.nv)
    rows = []
    for k in range(periods):
        command = loop.update(q + noise * rng.normal(size=q.size) if noise else q, k * DT)
        u = command.velocity
        assert np.all(np.abs(u - before) <= loop.acceleration_limit * DT * (1.0 + 1e-9))
        assert np.all(np.abs(u) <= robot.velocity_limit * (1.0 + 1e-9))
        assert np.all(q <= robot.position_upper + 1e-9) and np.all(q >= robot.position_lower - 1e-9)
        rows.append((u, q, command.smallest_singular_value, str(command.status)))
        q, before = q + DT * u, u
    u, postures, sigma, words = zip(*rows, strict=True)
    return Run(np.array(u), np.array(postures), np.array(sigma), list(words))


def chatter(u: np.ndarray) -> int:
    """How often a joint turns round and back again within 10 ms, above SMALL on both sides."""
    turns = (u[1:] * u[:-1] < 0.0) & (np.minimum(np.abs(u[1:]), np.abs(u[:-1])) > SMALL)
    return sum(int(np.count_nonzero(np.diff(np.flatnonzero(turns[:, j])) < 10)) for j in range(u.shape[1]))


def out_of_reach(name: str, gain: float, seed: int) -> tuple[ml.ResolvedRateController, np.ndarray]:
    """A law whose target is metres beyond the arm's reach, and a start."""
    robot, rng = arm(name), np.random.default_rng(seed)
    features = features_of(robot, name)
    constraint = oblique(features, rng, 1 + seed % features.n_rows)
    way = rng.normal(size=features.n_rows)
    task = ml.PointAttractor(5.0 * way / np.linalg.norm(way), gain=1.0)
    law = ml.ResolvedRateController(constraint, task, ml.ManipulabilityAscent(constraint, gain=gain))
    return law, posture(robot, rng)


@pytest.mark.parametrize("name", ["ur5", "planar3", "sawyer"])
def test_a_target_out_of_reach_ends_the_motion_quietly(name):
    """Nothing turns to and fro, the arm slows down, and the status says that it does not get there."""
    law, q = out_of_reach(name, 3.0, 1)
    done = run(law, q, 4000)
    assert chatter(done.u) <= 1 and chatter(done.u[3000:]) == 0  # a swing that is braked may turn round twice
    assert np.max(np.abs(done.u[-100:])) < 0.25 * np.max(np.abs(done.u))
    assert np.max(np.abs(np.diff(done.u[-500:], axis=0))) < 1e-3
    assert "ok" not in done.words[-100:]


def singular_cases(name: str) -> list[tuple[ml.Constraint, np.ndarray]]:
    """Constraints that are exactly singular at an arm's straight posture, which null-space motion leaves.

    With all six rows of a pose, the UR5 and the xArm7 leave only by motion along the rows, which `Hold` forbids.
    """
    robot = arm(name)
    features = FrameJacobian(robot, features_of(robot, name).frame, "x y" if name == "planar3" else "pose")
    p, cases = features.n_rows, []
    q = np.array([0.0, -0.5, 0.0, -0.5, 0.0, 0.0]) * np.pi if name == "ur5" else np.zeros(robot.nv)
    selections = [np.eye(p)[list(rows)] for s in range(1, 7) for rows in combinations(range(p), s)]
    for selection in [oblique(features, rng_of(p), p).selection, *selections]:
        constraint = ml.Constraint(selection, features)
        _, sigma, Vt = np.linalg.svd(constraint(q))
        if sigma[-1] < 1e-9 and len(selection) <= robot.nv:
            free = Vt[np.count_nonzero(sigma > 1e-9) :]
            beside = [np.linalg.svd(constraint(q + 1e-4 * z), compute_uv=False)[-1] for z in free]
            if max(beside) > 1e-5:
                cases.append((constraint, q))
    return cases[:: max(1, len(cases) // 3)]


def rng_of(seed: int) -> np.random.Generator:
    """The same numbers every time."""
    return np.random.default_rng(seed)


@pytest.mark.parametrize(
    ("name", "reaching"), [("planar3", True), ("planar3", False), ("ur5", False), ("xarm7", True), ("sawyer", False)]
)
def test_exact_singularities_are_left(name, reaching):
    """From an exactly singular posture, one second leads to a smallest singular value of 0.01 or more."""
    cases = singular_cases(name)
    assert cases
    for constraint, q in cases:
        robot = constraint.robot
        assert robot is not None
        goal = posture(robot, np.random.default_rng(8)) * 0.5
        reaches = reaching and constraint.features.n_rows <= 3
        task = ml.PointAttractor(constraint.features.coordinates(goal), gain=1.0) if reaches else None
        law = ml.ResolvedRateController(constraint, task, ml.ManipulabilityAscent(constraint))
        done = run(law, q, 1000)
        assert np.max(done.sigma) >= 0.01 and chatter(done.u[100:]) == 0, (constraint.selection, done.sigma[-1])


def test_a_singularity_at_a_joint_limit_is_left():
    """Folded at the upper end of a joint: what leads out and the null-space motion turn to the free side together."""
    robot = arm("planar3")
    constraint = ml.Constraint(np.eye(2), FrameJacobian(robot, "tip", "x y"))
    q = np.array([0.0, 0.0, np.pi])
    limits = ml.Limits(robot)
    limits.lower.setflags(write=True)
    limits.upper.setflags(write=True)
    limits.lower[:], limits.upper[:] = -np.pi, np.pi
    limits = limits.with_rates(limits.acceleration, None)
    law = ml.ResolvedRateController(constraint, null_policy=ml.ManipulabilityAscent(constraint), limits=limits)
    loop, smallest = ml.ServoLoop(law, DT), 0.0
    for k in range(300):
        command = loop.update(q, k * DT)
        q, smallest = q + DT * command.velocity, max(smallest, command.smallest_singular_value)
        assert np.all(np.abs(q) <= np.pi + 1e-9)
    assert smallest >= 0.01


@pytest.mark.parametrize(("name", "seeds"), [("panda", (16, 19, 21)), ("sawyer", (4, 10, 15))])
def test_an_arm_that_has_arrived_stays(name, seeds):
    """Null-space motion that ends at a joint limit does not lead the hand off the target that it came to."""
    robot = arm(name)
    features, arrived = features_of(robot, name), 0
    for seed in seeds:
        rng = np.random.default_rng(seed)
        low, high = np.maximum(robot.position_lower, -3.0), np.minimum(robot.position_upper, 3.0)
        constraint = oblique(features, rng, 2)
        start, goal = (low + (high - low) * rng.uniform(0.05, 0.95, robot.nv) for _ in range(2))
        task = ml.PointAttractor(robot.position(goal, features.frame))
        law = ml.ResolvedRateController(constraint, task, ml.ManipulabilityAscent(constraint))
        error = ml.simulate(robot, law, start, 20.0, 0.01).task_error
        arrived += bool(error.min() < 1e-3)
        assert error[int(np.argmin(error)) :].max() < 1e-3
    assert arrived == len(seeds)


@pytest.mark.parametrize("name", ["panda", "sawyer", "ur5"])
def test_a_circle_is_followed_at_speed(name):
    """At 100 Hz and 0.5 m/s a hand stays within 0.1 mm of a circle of 0.1 m; without c of the law 0.4 mm are left."""
    robot, rng = arm(name), np.random.default_rng(0)
    constraint = ml.Constraint(np.eye(3), features_of(robot, name))
    while True:
        q = posture(robot, rng)
        if np.linalg.svd(constraint(q), compute_uv=False)[-1] > 0.15:
            break
    start = constraint.features.coordinates(q)

    def circle(t: float) -> np.ndarray:
        return start + 0.1 * np.array([np.cos(5.0 * t) - 1.0, np.sin(5.0 * t), 0.0])

    law = ml.ResolvedRateController(constraint, ml.Track(circle, gain=5.0), ml.ManipulabilityAscent(constraint))
    error = ml.simulate(robot, law, q, 4.0, 0.01).task_error
    assert error[250:].max() < 1e-4  # [m], when the start from rest is forgotten
