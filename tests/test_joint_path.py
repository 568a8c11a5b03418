"""Joint paths round what is in the way: clear by our own distances, repeatable, for robots from any file."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from random_arms import random_tree

import manip_learn as ml
from manip_learn.control.limits import Limits
from manip_learn.errors import MissingExtraError
from manip_learn.planning.clearance import Clearance, self_collision
from manip_learn.planning.joint_path import JointPlanner
from manip_learn.planning.surroundings import Surroundings
from manip_learn.robot.collision import Obstacle, SelfCollision

CLEARANCE = 0.005  # [m]
STATIONS = 200  # at which a straight motion is checked
NO_ROBOPLAN = "NO ROBOPLAN: PATHS ROUND WHAT IS IN THE WAY ARE NOT TESTED (the extra 'plan')"


def around(robot: ml.Robot, size: float = 1.0) -> tuple[Obstacle, ...]:
    """A box before the arm, a ball and a tube beside it."""
    return ml.Scene(
        boxes=[ml.Box((0.3 * size, 0.5 * size, 0.6 * size), (0.5 * size, 0.0, 0.3 * size), "box")],
        spheres=[ml.Sphere(0.1 * size, (-0.4 * size, 0.4 * size, 0.6 * size), "ball")],
        cylinders=[ml.Cylinder(0.05 * size, 0.8 * size, (-0.3 * size, -0.5 * size, 0.4 * size), "tube")],
    ).obstacles(robot)


def planner_of(robot, collision, obstacles, limits, clearance, moving=None) -> JointPlanner:
    """Of a clearance that is given."""
    start = robot.positions(robot.neutral())
    clear = Clearance(robot, False if collision is None else collision, Surroundings(tuple(obstacles)), start)
    clear.least = clearance
    return JointPlanner(clear, limits, moving)


def distances(robot: ml.Robot) -> SelfCollision:
    return self_collision(robot) or SelfCollision(robot, shapes="links")


def blocked(planner: JointPlanner, robot: ml.Robot, seed: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Clear postures between which the straight motion is not clear."""
    rng = np.random.default_rng(seed)
    postures = (robot.positions(robot.random_configuration(rng)) for _ in range(4000))
    clear = (q for q in postures if planner.clear(q))
    return ((a, b) for a, b in zip(clear, clear, strict=False) if not planner.clear.of_line(a, b))


def nearest(collision: SelfCollision, path: list[np.ndarray]) -> float:
    """The least distance on straight motions through postures [m]."""
    least = np.inf
    for a, b in zip(path[:-1], path[1:], strict=True):
        for s in np.linspace(0.0, 1.0, STATIONS):
            pair = collision.nearest(a + s * (b - a))
            least = least if pair is None else min(least, pair.distance)
    return least


@pytest.fixture(scope="module")
def roboplan():
    return pytest.importorskip("roboplan.rrt", reason=NO_ROBOPLAN)


@pytest.fixture(scope="module")
def sawyer() -> ml.Robot:
    return ml.load_robot("sawyer")


@pytest.mark.parametrize("name", ["sawyer", "panda", "kinova", "ur10", *range(4)])
def test_paths_are_clear_and_repeated(roboplan, name, tmp_path: Path):
    """Shapes of every kind, mimic, continuous and sliding joints, trees, and robots whose links are capsules."""
    robot = random_tree(np.random.default_rng(name), tmp_path) if isinstance(name, int) else ml.load_robot(name)
    collision, limits = distances(robot), Limits(robot)
    planner, again = (planner_of(robot, collision, around(robot), limits, CLEARANCE) for _ in range(2))
    known = collision.with_obstacles(around(robot))
    found = 0
    for number, (start, goal) in zip(range(4), blocked(planner, robot, 1), strict=False):
        path = planner.path(start, goal, number)
        assert (path is None) == bool(planner.why)
        if path is None:
            continue
        found += 1
        assert len(path) > 2 and np.array_equal(path[0], start) and np.array_equal(path[-1], goal)
        assert all(np.all(robot.position_lower - 1e-6 <= q) and np.all(q <= robot.position_upper + 1e-6) for q in path)
        assert nearest(known, path) > 0.9 * CLEARANCE  # between the postures that were looked at
        same = again.path(start, goal, number)
        assert same is not None and np.array_equal(path, same)
    assert found >= 1


def test_a_joint_without_end_keeps_its_turns(roboplan):
    """The goal is reached as it is given, not a whole turn beside it."""
    robot = ml.load_robot("kinova")
    planner = planner_of(robot, distances(robot), around(robot), Limits(robot), CLEARANCE)
    start, goal = next(blocked(planner, robot, 2))
    turns = 2.0 * np.pi * ~np.isfinite(robot.position_upper)
    path, near = planner.path(start + 3.0 * turns, goal + 3.0 * turns, 0), planner.path(start, goal, 0)
    assert path is not None and near is not None
    assert np.allclose(np.array(path) - 3.0 * turns, near, atol=1e-6)
    assert planner.path(start, goal + 3.0 * turns, 0) is None and planner.why


def test_joints_that_need_not_move_stand_still(roboplan):
    """Fingers stay as they are on the way, unless start and goal differ in them."""
    robot = ml.load_robot("panda")
    moving = np.array([robot.moves(name, "panda_hand") for name in robot.joint_names])
    planner = planner_of(robot, distances(robot), around(robot), Limits(robot), CLEARANCE, moving)
    start, goal = next(
        (a, b) for a, b in blocked(planner, robot, 3) if not planner.clear.of_line(a, np.where(moving, b, a))
    )
    goal = np.where(moving, goal, start)
    path = planner.path(start, goal, 0)
    assert path is not None and all(np.array_equal(q[~moving], start[~moving]) for q in path)


def test_what_may_touch_may_touch(roboplan, sawyer: ml.Robot):
    """A hand that holds a handle goes on from inside it, round the box."""
    planner = planner_of(sawyer, distances(sawyer), around(sawyer), Limits(sawyer), CLEARANCE)
    start, goal = next(blocked(planner, sawyer, 4))
    hand = frozenset(
        s for s in sawyer.frame_names if sawyer.frame(s).parent_joint == sawyer.frame("right_gripper_tip").parent_joint
    )
    handle = ml.Scene(
        spheres=[ml.Sphere(0.02, sawyer.pose(start, "right_gripper_tip")[:3, 3], "handle")], handled=("handle",)
    )
    held, not_held = (
        planner_of(sawyer, distances(sawyer), (*around(sawyer), *handle.obstacles(sawyer, links)), *planning)
        for links, planning in ((hand, (Limits(sawyer), CLEARANCE)), (frozenset(), (Limits(sawyer), CLEARANCE)))
    )
    assert held.path(start, goal, 0) is not None
    assert not_held.path(start, goal, 0) is None and "handle" in not_held.why


def test_what_cannot_be_is_said(roboplan):
    """Walls that part the plane of a planar arm, a goal inside one, a base that floats."""
    robot = ml.load_robot("planar3")
    walls = ml.Scene(boxes=[ml.Box((3.0, 0.1, 1.0), (s * 1.8, 0.0, 0.0), f"wall {s}") for s in (-1, 1)])
    planner = planner_of(robot, distances(robot), walls.obstacles(robot), Limits(robot), CLEARANCE)
    up, down, along = np.array([[1.5, 0.3, 0.3], [-1.5, 0.3, 0.3], [0.0, 0.0, 0.0]])
    assert planner.path(up, down, 0) is None and "no path was found" in planner.why
    assert planner.path(up, along, 0) is None and "wall 1" in planner.why and "5 mm" in planner.why
    path = planner.path(up, up + [0.0, 0.3, 0.3], 0)
    assert path is not None and len(path) == 2 and planner.why == ""
    floating = ml.load_robot("planar3", base="floating")
    planner = planner_of(floating, distances(floating), walls.obstacles(floating), Limits(floating), CLEARANCE)
    start, goal = (np.concatenate([[0.0] * 6, q]) for q in (up, down))
    assert planner.path(start, goal, 0) is None and "turn or slide" in planner.why


def test_roboplan_is_asked_where_the_straight_motion_is_not_clear(sawyer: ml.Robot, monkeypatch):
    """Without it, a straight motion that is clear is found, and the sentence says what to install."""
    monkeypatch.setitem(sys.modules, "roboplan.core", None)
    planner = planner_of(sawyer, distances(sawyer), around(sawyer), Limits(sawyer), CLEARANCE)
    start, goal = next(blocked(planner, sawyer, 5))
    assert planner.path(start, start + 1e-3, 0) is not None
    with pytest.raises(MissingExtraError, match=r"pip install 'manip_learn\[plan\]'"):
        planner.path(start, goal, 0)
    nothing = planner_of(sawyer, None, (), Limits(sawyer), CLEARANCE)
    assert nothing.path(start, goal, 0) is not None


@pytest.mark.parametrize("name", ["sawyer", "panda"])
def test_clear_is_what_nothing_is_closer_than(name: str):
    """The quick answer is the same as that of all distances."""
    robot = ml.load_robot(name)
    collision = distances(robot).with_obstacles(around(robot))
    rng = np.random.default_rng(0)
    for q in (robot.random_configuration(rng) for _ in range(300)):
        for far in (0.0, 0.005, 0.1):
            assert collision.is_clear(q, far) == (not collision.closer_than(q, far))
