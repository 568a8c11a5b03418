"""The compiled law gives the numbers of the one in Python, state by state and run by run; without it Python does."""

from __future__ import annotations

import copy
import pickle
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import tip_of
from random_arms import Asks
from test_gradients import RobotOf

import manip_learn as ml
from manip_learn.constraint.features import CustomFeatures, MechanismRows, RelativeFrameJacobian
from manip_learn.constraint.features.mechanism_rows import PlaceRows
from manip_learn.control import engine
from manip_learn.control.command import SCALED_BELOW, STALLED_BELOW, Command
from manip_learn.control.policies import (
    JointAttractor,
    JointLimitAvoidance,
    ManipulabilityAscent,
    PenalisedManipulabilityAscent,
    RoomAscent,
    WeightedPolicies,
    ZeroPolicy,
)

built = pytest.mark.skipif(
    engine.version_found() != engine.LAW_VERSION, reason="NO manip_learn_fast: THE COMPILED LAW IS NOT TESTED (make fast)"
)
ARMS = ["planar3", "sawyer", "panda", "ur5", "kinova", "gantry", "wrist", "tree", "mimic", "humanoid"]
LAWS, STATES = 50, 40  # of each arm: 20,000 in all
AGREED = 1e-9  # [rad/s or m/s] and of the speed
EPS = float(np.finfo(float).eps)


def rows_of(robot: ml.Robot, name: str, rng: np.random.Generator) -> ml.Constraint:
    """Oblique rows of the features that there are."""
    frame, place = tip_of(name), rng.normal(size=3)
    axis = rng.normal(size=3)
    choices: list[Callable[[], Any]] = [
        lambda: ml.FrameJacobian(robot, frame, "x y"),
        lambda: ml.FrameJacobian(robot, frame, "xyz"),
        lambda: ml.FrameJacobian(robot, frame, "pose"),
        lambda: ml.FrameJacobian(robot, frame, "pose", "local"),
        lambda: ml.FrameJacobian(robot, frame, "planar"),
        lambda: MechanismRows(robot, frame, "radial axial turn-1", axis=axis, point=place),
        lambda: MechanismRows(robot, frame, "helical spherical", axis=axis, point=place, pitch=0.1),
        lambda: MechanismRows(robot, frame, "radial helical slide", axis=axis, point=place, pitch=0.1, radius=0.4),
        lambda: PlaceRows(robot, frame, "surface", place),
        lambda: CustomFeatures(ml.FrameJacobian(robot, frame, "xyz"), ("a", "b", "c"), robot.nv, robot=robot),
    ]
    if name == "tree":
        choices.append(lambda: RelativeFrameJacobian(robot, frame, "arm_b", "xyz"))
    features = choices[int(rng.integers(len(choices)))]()
    p = features.n_rows
    s = int(rng.integers(1, min(p, 1 + robot.nv, 4) + 1))
    return ml.Constraint(np.linalg.qr(rng.normal(size=(p, p)))[0][:s], features)


def task_of(rows: ml.Constraint, robot: ml.Robot, frame: str, rng: np.random.Generator) -> ml.Task | None:
    """Rest, a target in reach or out of it, a pose, or a velocity of a task that is not known."""
    kind, f = int(rng.integers(5)), rows.features
    asked = Asks(0.3 * rng.normal(size=rows.n_constraints))
    if kind == 0:
        return None
    if kind == 1 or not isinstance(f, ml.FrameJacobian):
        return asked
    q = robot.random_configuration(rng)
    settings = {"gain": float(rng.uniform(0.5, 5.0)), "max_speed": rng.choice([None, 0.3])}  # type: ignore[arg-type]
    settings["driven"] = rng.choice(["held", "all"]) if f.n_rows <= robot.nv else "held"
    if kind == 2:
        return ml.PointAttractor(robot.pose(q, frame), **settings)
    if kind == 3 and f.own_axes:
        return asked
    return ml.PointAttractor(f.coordinates(q) + rng.choice([0.0, 0.5]) * rng.normal(size=f.n_rows), **settings)


def policy_of(rows: ml.Constraint, robot: ml.Robot, rng: np.random.Generator) -> Any:
    """The library's policies, sums of them, and a function."""
    rest = JointAttractor(robot.random_configuration(rng), 2.0, robot)
    ascent, middle = ManipulabilityAscent(rows), JointLimitAvoidance(robot, 0.5)
    w = rng.normal(size=robot.nv)
    choices: list[Callable[[], Any]] = [
        lambda: ascent,
        lambda: ascent,
        lambda: ManipulabilityAscent(rows, max_speed=None),
        lambda: ManipulabilityAscent(rows, logarithmic=False),
        lambda: RoomAscent(rows, 0.1),
        lambda: rest,
        lambda: middle,
        lambda: ZeroPolicy(robot.nv),
        lambda: WeightedPolicies([ascent, rest, middle], [1.0, 0.5, 2.0]),
        lambda: PenalisedManipulabilityAscent(rows),
        lambda: (lambda q, t: w),
    ]
    return choices[int(rng.integers(len(choices)))]()


def limits_of(robot: ml.Robot, frame: str, rng: np.random.Generator) -> ml.Limits | bool:
    """None, the robot's own, without acceleration limits, and those of the hand."""
    kind = int(rng.integers(6))
    if kind == 0:
        return False
    if kind == 1:
        return ml.Limits(robot, velocity=0.5, acceleration=np.inf)
    if kind == 2:
        place = robot.position(robot.random_configuration(rng), frame)
        walls = [[*rng.normal(size=3), 0.3], [0.0, 0.0, -1.0, -float(place[2]) + 0.05]]
        return ml.Limits(robot, tip_speed=0.2, tip_walls=walls, frames=frame)
    return True


def law_of(robot: ml.Robot, name: str, rng: np.random.Generator) -> ml.ResolvedRateController:
    """A controller of anything."""
    while True:
        rows = rows_of(robot, name, rng)
        task = task_of(rows, robot, tip_of(name), rng)
        driven = rows if task is None else task.rows(rows)
        settings = {"limits": limits_of(robot, tip_of(name), rng), "threshold": rng.choice([0.05, 0.3])}
        inverse = rng.choice(["damped"] * 6 + ["exact", "truncated"])
        try:
            return ml.ResolvedRateController(rows, task, policy_of(driven, robot, rng), inverse, **settings)
        except ml.ConstraintError:  # more rows are held than there are joints
            continue


def singular(rows: ml.Constraint, q: np.ndarray) -> np.ndarray | None:
    """A posture at which the rows lose a direction, to the last bit that Newton's method finds; None if it does not."""
    for _ in range(60):
        A, vjp = rows.value_and_vjp(q)
        U, sigma, Vt = np.linalg.svd(A)
        k = len(sigma) - 1
        if sigma[k] <= 1e-15 * sigma[0]:
            break
        slopes = np.array([vjp(np.outer(U[:, k], v)) for v in Vt[k:]])
        step = -np.linalg.pinv(slopes, rcond=1e-3) @ np.array([sigma[k]] + [0.0] * (len(slopes) - 1))
        q = q + step * min(1.0, 0.3 / max(float(np.linalg.norm(step)), 1e-12))
    return q if sigma[k] <= 1e-13 * sigma[0] else None
