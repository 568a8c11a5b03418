"""Random arms and tasks: trees of one to nine joints of every kind, for tests that hold for any robot."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import manip_learn as ml
from manip_learn.control.tasks import Task
from manip_learn.robot.loading import load_robot
from manip_learn.robot.robot import Robot

KINDS = ("revolute", "revolute", "revolute", "continuous", "prismatic")


class Asks(Task):
    """A task that asks for one velocity everywhere."""

    def __init__(self, b: np.ndarray):
        self.b = b

    def velocity(self, constraint: ml.Constraint, q: np.ndarray, t: float) -> np.ndarray:
        """The same everywhere."""
        return self.b

    def error(self, constraint: ml.Constraint, q: np.ndarray, t: float) -> float:
        """Of no interest."""
        return 1.0


class Drives(Asks):
    """Some combination of the rows is driven, the others are held."""

    def __init__(self, b: np.ndarray, D: np.ndarray):
        super().__init__(b)
        self.D = D

    def driven_rows(self, constraint: ml.Constraint) -> np.ndarray:
        """The same everywhere."""
        return self.D


class Case(NamedTuple):
    """A law at a posture, what was commanded before, and the period."""

    law: ml.ResolvedRateController
    b: np.ndarray
    q: np.ndarray
    previous: np.ndarray | None
    dt: float


def random_tree(rng: np.random.Generator, folder: Path, base: str = "0 0 0", rpy: str = "0 0 0") -> Robot:
    """A tree whose tip is at the end of one branch; `base` and `rpy` place all of it."""
    n = int(rng.integers(1, 10))
    links = ['<link name="world"/>', '<link name="foot"/>', joint("fixed", "world", "foot", base, rpy)]
    for j in range(n):
        parent = "foot" if j == 0 else f"link{j - 1 if rng.random() < 0.85 else int(rng.integers(j))}"
        axis = rng.normal(size=3) if rng.random() < 0.6 else np.eye(3)[rng.integers(3)]
        kind = KINDS[rng.integers(len(KINDS))]
        bounds = f'lower="{-rng.uniform(0.3, 3.0)}" upper="{rng.uniform(0.3, 3.0)}"' if kind != "continuous" else ""
        limit = f'<limit {bounds} velocity="{rng.uniform(0.3, 3.0)}" effort="1"/>'
        turn = rng.uniform(-2.0, 2.0, 3) * (rng.random() < 0.5)
        links.append(f'<link name="link{j}"/>')
        inside = f'<axis xyz="{words(axis)}"/>{limit}'
        links.append(joint(kind, parent, f"link{j}", words(rng.uniform(-0.4, 0.4, 3)), words(turn), inside))
    links += ['<link name="tip"/>', joint("fixed", f"link{n - 1}", "tip", "0.2 0.1 0.3", "0 0 0")]
    path = folder / "tree.urdf"
    path.write_text(f'<robot name="tree">{"".join(links)}</robot>', encoding="utf-8")
    return load_robot(path)


def joint(kind: str, parent: str, child: str, xyz: str, rpy: str, inside: str = "") -> str:
    """One joint of a URDF."""
    return (
        f'<joint name="to_{child}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/>{inside}</joint>'
    )


def words(vector: np.ndarray) -> str:
    """Numbers with a space between."""
    return " ".join(repr(float(x)) for x in vector)


def random_posture(rng: np.random.Generator, robot: Robot) -> np.ndarray:
    """Inside the limits, at some of them, outside, exactly at zero (often singular), or 1e-9 beside it."""
    low, high = np.maximum(robot.position_lower, -3.0), np.minimum(robot.position_upper, 3.0)
    q = rng.uniform(low, high)
    kind = rng.integers(6)
    if kind == 0:
        return np.where(rng.random(robot.nv) < 0.5, np.where(rng.random(robot.nv) < 0.5, low, high), q)
    if kind == 1:
        return q + 0.3 * rng.normal(size=robot.nv)
    if kind == 2:
        return np.zeros(robot.nv)
    if kind == 3:
        return 1e-9 * rng.normal(size=robot.nv)
    return q


def random_case(seed: int, folder: Path, **settings: Any) -> Case:
    """A random tree with random rows, task, policy, posture, period and velocity before."""
    rng = np.random.default_rng(seed)
    robot = random_tree(rng, folder)
    features = ml.FrameJacobian(robot, "tip", "pose" if rng.random() < 0.5 else "xyz")
    constraint = ml.Constraint(rng.normal(size=(int(rng.integers(1, features.n_rows + 1)), features.n_rows)), features)
    b = 10.0 ** rng.uniform(-3.0, 2.0) * rng.normal(size=constraint.n_constraints)
    policy = ml.ManipulabilityAscent(constraint) if rng.random() < 0.7 else lambda q, t: np.full(robot.nv, 3.0)
    inverse = settings.pop("inverse", ("damped", "exact", "truncated")[rng.integers(3)])
    law = ml.ResolvedRateController(constraint, Asks(b), policy, inverse, **settings)
    previous = rng.uniform(-1.0, 1.0, robot.nv) * robot.velocity_limit if rng.random() < 0.6 else None
    return Case(law, b, random_posture(rng, robot), previous, float(10.0 ** rng.uniform(-3.0, -1.0)))
