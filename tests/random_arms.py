"""Random arms and tasks: trees of one to nine joints of every kind, for tests that hold for any robot."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from conftest import tip_of

import manip_learn as ml
from manip_learn.constraint.features.mechanism_rows import PlaceRows
from manip_learn.control.policies import RoomAscent
from manip_learn.errors import ConstraintError
from manip_learn.planning.clearance import links_of

KINDS = ("revolute", "revolute", "revolute", "continuous", "prismatic")


class Asks(ml.Task):
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


def random_tree(rng: np.random.Generator, folder: Path, base: str = "0 0 0", rpy: str = "0 0 0") -> ml.Robot:
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
    return ml.load_robot(path)


def joint(kind: str, parent: str, child: str, xyz: str, rpy: str, inside: str = "") -> str:
    """One joint of a URDF."""
    return (
        f'<joint name="to_{child}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/>{inside}</joint>'
    )


def words(vector: np.ndarray) -> str:
    """Numbers with a space between."""
    return " ".join(repr(float(x)) for x in vector)


def oblique(features: ml.FeatureMap, s: int, rng: np.random.Generator) -> ml.Constraint:
    """Return s orthonormal rows, none of them along one feature."""
    p = features.n_rows
    return ml.Constraint(np.linalg.qr(rng.normal(size=(p, p)))[0][:s], features)


def inside(robot: ml.Robot, rng: np.random.Generator, share: float = 0.8) -> np.ndarray:
    """Return a posture within the middle share of the ranges; joints without limits have 3 rad to either side."""
    low, high = np.maximum(robot.position_lower, -3.0), np.minimum(robot.position_upper, 3.0)
    return 0.5 * (low + high) + 0.5 * share * (high - low) * rng.uniform(-1.0, 1.0, robot.nv)


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
        lambda: ml.MechanismRows(robot, frame, "radial axial turn-1", axis=axis, point=place),
        lambda: ml.MechanismRows(robot, frame, "helical spherical", axis=axis, point=place, pitch=0.1),
        lambda: ml.MechanismRows(robot, frame, "radial helical slide", axis=axis, point=place, pitch=0.1, radius=0.4),
        lambda: PlaceRows(robot, frame, "surface", place),
        lambda: ml.CustomFeatures(ml.FrameJacobian(robot, frame, "xyz"), ("a", "b", "c"), robot.nv, robot=robot),
    ]
    if name == "tree":
        choices.append(lambda: ml.RelativeFrameJacobian(robot, frame, "arm_b", "xyz"))
    features = choices[int(rng.integers(len(choices)))]()
    return oblique(features, int(rng.integers(1, min(features.n_rows, 1 + robot.nv, 4) + 1)), rng)


def task_of(rows: ml.Constraint, robot: ml.Robot, frame: str, rng: np.random.Generator) -> ml.Task | None:
    """Rest, a target in reach or out of it, a pose, or a velocity of a task that is not known."""
    kind, f = int(rng.integers(5)), rows.features
    s, b = rows.n_constraints, rng.choice([0.1, 1.0]) * rng.normal(size=rows.n_constraints)
    D = np.linalg.qr(rng.normal(size=(s, s)))[0][: int(rng.integers(0, s + 1))]
    asked = Asks(b) if rng.random() < 0.5 else Drives(b, D)
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
    rest = ml.JointAttractor(robot.random_configuration(rng), 2.0, robot)
    ascent, middle = ml.ManipulabilityAscent(rows), ml.JointLimitAvoidance(robot, 0.5)
    w = rng.normal(size=robot.nv)
    choices: list[Callable[[], Any]] = [
        lambda: ascent,
        lambda: ascent,
        lambda: ml.ManipulabilityAscent(rows, max_speed=None),
        lambda: ml.ManipulabilityAscent(rows, logarithmic=False),
        lambda: RoomAscent(rows, 0.1),
        lambda: rest,
        lambda: middle,
        lambda: ml.ZeroPolicy(robot.nv),
        lambda: ml.WeightedPolicies([ascent, rest, middle], [1.0, 0.5, 2.0]),
        lambda: lambda q, t: w,
    ]
    return choices[int(rng.integers(len(choices)))]()


def limits_of(robot: ml.Robot, frame: str, rng: np.random.Generator) -> ml.Limits | bool:
    """None, the robot's own, without acceleration limits, those of the hand, and what the links keep clear of."""
    kind = int(rng.integers(6))
    if kind == 0:
        return False
    if kind == 1:
        return ml.Limits(robot, velocity=0.5, acceleration=np.inf)
    if kind == 2:
        place = robot.position(robot.random_configuration(rng), frame)
        walls = [[*rng.normal(size=3), 0.3], [0.0, 0.0, -1.0, -float(place[2]) + 0.05]]
        return ml.Limits(robot, tip_speed=0.2, tip_walls=walls, frames=frame)
    if kind == 3:
        place = robot.position(robot.random_configuration(rng), frame)
        ball = ml.Scene(spheres=[ml.Sphere(0.1, place, "ball")]).obstacles(robot)
        # from a ball alone distances have no kinks, at which rounding decides about a gradient
        return ml.Limits(robot, clear_of=links_of(robot)[0].with_obstacles(ball, own=False))
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
        except ConstraintError:  # more rows are held than there are joints
            continue


class State(NamedTuple):
    """Arguments of a call."""

    q: np.ndarray
    dt: float
    previous: np.ndarray | None
    slide: float


def state_of(robot: ml.Robot, special: np.ndarray | None, rng: np.random.Generator) -> State:
    """Inside, at limits to the last bit, beyond, singular and 1e-9 beside; at rest or moving; periods of any length."""
    q = inside(robot, rng, 0.95)
    kind, j = int(rng.integers(8)), rng.permutation(robot.nv)[: int(rng.integers(1, 3))]
    beyond = 10.0 ** rng.uniform(-13.0, -1.0)
    if kind == 1:
        q[j] = np.where(rng.random(len(j)) < 0.5, robot.position_lower[j], robot.position_upper[j])
    elif kind == 2:
        q[j] = robot.position_upper[j] + beyond
    elif kind == 3:
        q[j] = robot.position_lower[j] + beyond
    elif kind in (4, 5) and special is not None:
        q = special + (0.0 if kind == 4 else 1e-9) * rng.normal(size=robot.nv)
    fastest = np.where(np.isfinite(robot.velocity_limit), robot.velocity_limit, 1.0)
    before = (0.9, 0.1, 0.0)[int(rng.integers(3))] * fastest * rng.uniform(-1.0, 1.0, robot.nv)
    dt = float(rng.choice([0.001, 0.01, rng.uniform(5e-4, 0.03)]))
    slide = float(rng.choice([0.0, 1.0, rng.random()]))
    return State(np.where(np.isfinite(q), q, 0.3), dt, None if rng.random() < 0.3 else before, slide)


def random_case(seed: int, folder: Path, **settings: Any) -> tuple[ml.ResolvedRateController, State]:
    """A random tree with random rows, task and policy, and a state; at zero and 1e-9 beside it trees are singular."""
    rng = np.random.default_rng(seed)
    robot = random_tree(rng, folder)
    features = ml.FrameJacobian(robot, "tip", "pose" if rng.random() < 0.5 else "xyz")
    constraint = ml.Constraint(rng.normal(size=(int(rng.integers(1, features.n_rows + 1)), features.n_rows)), features)
    b = 10.0 ** rng.uniform(-3.0, 2.0) * rng.normal(size=constraint.n_constraints)
    policy = ml.ManipulabilityAscent(constraint) if rng.random() < 0.7 else lambda q, t: np.full(robot.nv, 3.0)
    inverse = settings.pop("inverse", ("damped", "exact", "truncated")[rng.integers(3)])
    law = ml.ResolvedRateController(constraint, Asks(b), policy, inverse, **settings)
    state = state_of(robot, np.zeros(robot.nv), rng)
    return law, state._replace(dt=float(10.0 ** rng.uniform(-3.0, -1.0)))
