"""Joint paths round what is in the way: clear by our own distances, repeatable, for robots from any file."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from random_arms import random_tree

import manip_learn as ml
from manip_learn.control.limits import Limits
from manip_learn.errors import MissingExtraError
from manip_learn.planning.clearance import Clearance, Surroundings, links_of
from manip_learn.planning.joint_path import joint_path
from manip_learn.robot.collision import Obstacle, SelfCollision

STATIONS = 100  # at which a straight motion is checked
NO_ROBOPLAN = "NO ROBOPLAN: PATHS ROUND WHAT IS IN THE WAY ARE NOT TESTED (the extra 'plan')"


def around(robot: ml.Robot, size: float = 1.0) -> tuple[Obstacle, ...]:
    """A box before the arm, a ball and a tube beside it."""
    return ml.Scene(
        boxes=[ml.Box((0.3 * size, 0.5 * size, 0.6 * size), (0.5 * size, 0.0, 0.3 * size), "box")],
        spheres=[ml.Sphere(0.1 * size, (-0.4 * size, 0.4 * size, 0.6 * size), "ball")],
        cylinders=[ml.Cylinder(0.05 * size, 0.8 * size, (-0.3 * size, -0.5 * size, 0.4 * size), "tube")],
    ).obstacles(robot)


def blocked(
    robot: ml.Robot, seed: int, obstacles: tuple[Obstacle, ...]
) -> Iterator[tuple[np.ndarray, np.ndarray, Clearance]]:
    """Clear postures between which the straight motion is not clear."""
    rng = np.random.default_rng(seed)
    links = links_of(robot)[0]
    known = links.with_obstacles(obstacles)
    postures = (robot.positions(robot.random_configuration(rng)) for _ in range(4000))
    free = (q for q in postures if not known.closer_than(q, 0.006))
    for start, goal in zip(free, free, strict=False):
        clear = Clearance(robot, links, Surroundings(obstacles), start)
        if not clear.of_line(start, goal):
            yield start, goal, clear


def is_nearer(collision: SelfCollision, path: list[np.ndarray], distance: float) -> bool:
    """Whether anything comes nearer than a distance [m] on straight motions through postures."""
    stations = np.linspace(0.0, 1.0, STATIONS)
    pairs = zip(path[:-1], path[1:], strict=True)
    return any(collision.closer_than(a + s * (b - a), distance) for a, b in pairs for s in stations)


@pytest.fixture(scope="module")
def roboplan():
    return pytest.importorskip("roboplan.rrt", reason=NO_ROBOPLAN)


@pytest.fixture(scope="module")
def sawyer():
    return ml.load_robot("sawyer")


@pytest.mark.parametrize("name", ["sawyer", "panda", pytest.param("kinova", marks=pytest.mark.slow), 2, 5])
def test_paths_are_clear_and_repeated(roboplan, name, tmp_path):
    """Shapes of every kind, mimic, continuous and sliding joints, trees, and robots whose links are capsules."""
    robot = random_tree(np.random.default_rng(name), tmp_path) if isinstance(name, int) else ml.load_robot(name)
    limits, obstacles, found = Limits(robot), around(robot), 0
    known = links_of(robot)[0].with_obstacles(obstacles)
    for number, (start, goal, clear) in zip(range(3), blocked(robot, 1, obstacles), strict=False):
        path = joint_path(robot, start, goal, limits, clear, number)
        if path is None:
            continue
        found += 1
        assert len(path) > 2 and np.array_equal(path[0], start) and np.array_equal(path[-1], goal)
        assert all(np.all(robot.position_lower - 1e-6 <= q) and np.all(q <= robot.position_upper + 1e-6) for q in path)
        assert not is_nearer(known, path, 0.9 * clear.least)  # between the postures that were looked at
        other = Clearance(robot, links_of(robot)[0], Surroundings(obstacles), start)
        same = joint_path(robot, start, goal, limits, other, number)
        assert same is not None and np.array_equal(path, same)
    assert found >= 1


def test_a_joint_without_end_keeps_its_turns(roboplan):
    """The goal is reached as it is given, not a whole turn beside it."""
    robot = ml.load_robot("kinova")
    start, goal, clear = next(blocked(robot, 2, around(robot)))
    turns = 6.0 * np.pi * ~np.isfinite(robot.position_upper)
    near, path = (joint_path(robot, start + x, goal + x, Limits(robot), clear, 0) for x in (0.0, turns))
    assert path is not None and near is not None
    assert np.allclose(np.array(path) - turns, near, atol=1e-6)


def test_fingers_stand_still(roboplan):
    """They stay as they are on the way where start and goal do not differ in them; the arm does not."""
    robot = ml.load_robot("panda")
    arm = np.array([robot.moves(name, "panda_hand") for name in robot.joint_names])
    assert not np.all(arm)
    for start, goal, clear in blocked(robot, 3, around(robot)):
        goal = np.where(arm, goal, start)
        if clear(goal) and not clear.of_line(start, goal):
            path = joint_path(robot, start, goal, Limits(robot), clear, 0)
            assert path is not None and all(np.array_equal(q[~arm], start[~arm]) for q in path)
            assert not any(np.array_equal(q[arm], start[arm]) for q in path[1:])
            break


def test_what_cannot_be_is_said(roboplan, caplog):
    """Walls that part the plane of a planar arm, a goal inside one, a base that floats."""
    caplog.set_level(logging.INFO)
    robot = ml.load_robot("planar3")
    walls = ml.Scene(boxes=[ml.Box((3.0, 0.1, 1.0), (s * 1.8, 0.0, 0.0), f"wall {s}") for s in (-1, 1)])
    up, down, along = np.array([[1.5, 0.3, 0.3], [-1.5, 0.3, 0.3], [0.0, 0.0, 0.0]])
    clear = Clearance(robot, True, Surroundings(walls.obstacles(robot)), up)
    assert joint_path(robot, up, down, Limits(robot), clear, 0) is None and "no path" in caplog.text
    assert joint_path(robot, up, along, Limits(robot), clear, 0) is None
    assert joint_path(robot, up, up + [0.0, 0.3, 0.3], Limits(robot), clear, 0) is not None
    floating = ml.load_robot("planar3", base="floating")
    start, goal = (np.concatenate([[0.0] * 6, q]) for q in (up, down))
    clear = Clearance(floating, True, Surroundings(walls.obstacles(floating)), start)
    assert joint_path(floating, start, goal, Limits(floating), clear, 0) is None and "turn or slide" in caplog.text


def test_roboplan_is_asked_where_the_straight_motion_is_not_clear(sawyer, monkeypatch):
    """Without it, a straight motion that is clear is found, and the sentence says what to install."""
    monkeypatch.setitem(sys.modules, "roboplan.core", None)
    start, goal, clear = next(blocked(sawyer, 5, around(sawyer)))
    assert joint_path(sawyer, start, start + 1e-3, Limits(sawyer), clear, 0) is not None
    with pytest.raises(MissingExtraError, match=r"pip install 'manip_learn\[plan\]'"):
        joint_path(sawyer, start, goal, Limits(sawyer), clear, 0)
