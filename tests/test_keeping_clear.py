"""Links keep clear of each other and of what stands around while the arm moves: in rollouts and in loops."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from servo_cases import Constantly
from test_gradients import RobotOf

import manip_learn as ml
from manip_learn.errors import ConfigurationError
from manip_learn.robot.collision import Proximity

CLEARANCE, SLACK = 0.005, 1e-4  # [m]
TIPS = {"panda": "panda_hand", "ur5": "tool0", "planar3": "tip"}
STARTS = {
    "panda": [0.0, -0.4, 0.0, -2.0, 0.0, 1.7, 0.8],
    "ur5": [0.0, -1.2, 1.4, -0.4, 0.3, 0.2],
    "planar3": [0.3, 0.8, 0.4],
}


def arm_of(name: str, robot_of: RobotOf) -> ml.Robot:
    """An arm without fingers that move."""
    return ml.load_robot("panda", locked=("panda_finger_joint1",)) if name == "panda" else robot_of(name)


def pairs_of(robot: ml.Robot, scene: ml.Scene) -> ml.SelfCollision:
    """All pairs, by the shapes that the robot has."""
    shapes = "visual" if robot.name.startswith("planar3") else "collision"
    return ml.SelfCollision(robot, shapes=shapes, obstacles=scene.obstacles(robot))


def nearest(pairs: ml.SelfCollision, q: Any) -> Proximity:
    """The two shapes that are nearest to each other."""
    found = pairs.nearest(q)
    assert found is not None
    return found


def distance(pairs: ml.SelfCollision, q: Any) -> float:
    """Of the two that are nearest to each other [m]."""
    return nearest(pairs, q).distance


def to_a_point(robot: ml.Robot, tip: str, goal: Any, limits: ml.Limits | bool) -> ml.ResolvedRateController:
    """The tip goes to a point, x and y only for an arm in a plane."""
    axes = "x y" if robot.nv == 3 else "xyz"
    rows = ml.Constraint(np.eye(len(goal)), ml.FrameJacobian(robot, tip, axes))
    return ml.ResolvedRateController(rows, ml.PointAttractor(goal, max_speed=0.5), limits=limits)


def standing(kind: str, place: np.ndarray, size: float = 0.08) -> ml.Scene:
    """A box or a ball."""
    if kind == "ball":
        return ml.Scene(spheres=[ml.Sphere(size, place, "ball")])
    return ml.Scene(boxes=[ml.Box((2 * size, 2 * size, 2 * size), place, "box")])


def crossing(robot: ml.Robot, name: str, kind: str) -> tuple[np.ndarray, np.ndarray, ml.Scene]:
    """A start, a goal, and a thing in the middle of the way between them."""
    q, tip = np.array(STARTS[name]), TIPS[name]
    way = np.array([0.1, 0.5, 0.0])
    place = robot.position(q, tip)
    if name == "planar3":
        way = np.array([-0.6, 0.6, 0.0])
    goal = place + way
    return q, goal[:2] if robot.nv == 3 else goal, standing(kind, place + 0.5 * way)


@pytest.mark.parametrize(
    ("name", "kind", "dt", "acceleration"),
    [("panda", "box", 0.01, None), ("ur5", "ball", 0.004, None), ("ur5", "box", 0.01, math.inf),
     ("planar3", "ball", 0.01, None), ("planar3", "box", 0.01, math.inf)],
)  # fmt: skip
def test_nothing_comes_nearer_than_the_clearance(name, kind, dt, acceleration, robot_of):
    """A task that leads through a thing: no pair is nearer than the clearance, at any step, and the arm moved."""
    robot = arm_of(name, robot_of)
    q, goal, scene = crossing(robot, name, kind)
    pairs = pairs_of(robot, scene)
    assert distance(pairs, q) > CLEARANCE
    limits = ml.Limits(robot, acceleration=acceleration, clear_of=pairs, clearance=CLEARANCE)
    free, kept = (
        ml.simulate(robot, to_a_point(robot, TIPS[name], goal, one), q, 1.2, dt)
        for one in (ml.Limits(robot, acceleration=acceleration), limits)
    )
    assert min(distance(pairs, x) for x in free.q) < 0.0
    assert min(distance(pairs, x) for x in kept.q) > CLEARANCE - SLACK
    assert np.abs(kept.q - q).max() > 0.1
    for before, after in zip(kept.u, kept.u[1:], strict=False):
        assert np.all(np.abs(after - before) <= dt * limits.acceleration * (1.0 + 1e-9))


def test_the_loop_says_what_is_in_the_way(robot_of):
    """A target within a thing: the arm stands at the clearance, and the words name link and thing."""
    robot = arm_of("ur5", robot_of)
    q = np.array(STARTS["ur5"])
    place = robot.position(q, "tool0") + np.array([0.0, 0.3, 0.0])
    scene = standing("box", place)
    loop = ml.ServoLoop(to_a_point(robot, "tool0", place, ml.Limits(robot, clear_of=scene)), 0.005)
    words = set()
    for k in range(600):
        command = loop.update(q if k == 0 else loop.position, 0.005 * k)
        words.add(command.status)
    pair = nearest(ml.SelfCollision(robot, obstacles=scene.obstacles(robot)), loop.position)
    assert pair.distance == pytest.approx(CLEARANCE, abs=1e-3)
    assert words & {ml.Status.POSITION_LIMITED, ml.Status.STALLED}
    assert loop.stopped_by == f"{pair.links[0]} 5 mm from the box"


def test_a_start_within_the_clearance_may_leave(robot_of):
    """It comes no nearer, and goes where the way leads away."""
    robot = arm_of("ur5", robot_of)
    q = np.array(STARTS["ur5"])
    tip, along = robot.position(q, "tool0"), np.array([0.0, 1.0, 0.0])
    own, size = ml.SelfCollision(robot), 0.05
    apart = 0.3  # the box is moved to where it is 3 mm away
    for _ in range(30):
        pairs = own.with_obstacles(standing("box", tip + apart * along, size).obstacles(robot))
        apart -= distance(pairs, q) - 0.003
    near = distance(pairs, q)
    assert 0.0 < near < CLEARANCE
    limits = ml.Limits(robot, clear_of=pairs)
    for way, arrives in ((-0.1, True), (0.1, False)):
        run = ml.simulate(robot, to_a_point(robot, "tool0", tip + way * along, limits), q, 2.5, 0.01)
        assert min(distance(pairs, x) for x in run.q) > near - SLACK
        assert (run.task_error[-1] < 1e-2) == arrives


def test_a_controller_of_the_users_own_is_stopped(robot_of):
    """The loop brakes what would touch, within its acceleration limits."""
    robot = arm_of("planar3", robot_of)
    q, _, _ = crossing(robot, "planar3", "ball")
    scene = standing("ball", robot.position(robot.integrate(q, np.array([0.6, 0.0, 0.0])), "tip"))
    pairs, own = pairs_of(robot, scene), Constantly(robot, np.array([0.5, 0.0, 0.0]))
    loop = ml.ServoLoop(own, 0.005, limits=ml.Limits(robot, clear_of=pairs))
    least = math.inf
    for k in range(500):
        command = loop.update(q if k == 0 else loop.position, 0.005 * k)
        least = min(least, distance(pairs, loop.position))
    assert CLEARANCE - SLACK < least < 0.05
    assert command.status is ml.Status.POSITION_LIMITED and np.abs(command.velocity).max() < 0.05


def test_impossible_settings(robot_of):
    """One sentence says what is wrong; an arm without shapes has capsules, for which a scene is enough."""
    arm, other = arm_of("ur5", robot_of), ml.SelfCollision(robot_of("panda"))
    for clearance in (-0.1, math.nan):
        with pytest.raises(ConfigurationError, match=f"clearance is {clearance}"):
            ml.Limits(arm, clear_of=ml.Scene(floor=-1.0), clearance=clearance)
    with pytest.raises(ConfigurationError, match="of another"):
        ml.Limits(arm, clear_of=other)
    with pytest.raises(ml.ManipLearnError):
        ml.SelfCollision(robot_of("gantry"))
    assert ml.Limits(robot_of("gantry"), clear_of=ml.Scene(floor=-3.0)).barriers.clear is not None
