"""Parts of the planner, each against what it promises: grips, seeds, shortcuts, the freer sense of a joint."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from case import case

import manip_learn as ml
from manip_learn.control.limits import Limits
from manip_learn.planning.approach import Clearance, GraspCone, clear_path
from manip_learn.planning.plan import PathPolicy
from manip_learn.planning.search import SELF_MOTION, SHARE, seeds_of
from manip_learn.planning.stations import Stations
from manip_learn.robot.robot import Robot
from manip_learn.robot.rotations import rotation_matrix

RobotOf = Callable[[str], Robot]
SHOWN = rotation_matrix(np.array([0.3, -1.1, 0.7]))


def angle_of(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.arccos(np.clip(a @ b, -1.0, 1.0)))


def test_a_grasp_cone_is_filled_evenly(rng: np.random.Generator) -> None:
    """Every axis is inside the cone; of the cap's area each half of the cosines has half; the first is the nearest."""
    for angle, turns, direction in ((0.5, None, (0, 0, -1)), (1.2, 2, None), (np.pi, 3, (1, 2, 0.5))):
        with case(angle):
            cone = GraspCone((0.0, 0.6, 0.8), angle, turns, direction)
            wanted, some = cone.toward(SHOWN), []
            for _ in range(40):
                found = cone.orientations(SHOWN, rng)
                np.testing.assert_allclose(
                    found @ found.transpose(0, 2, 1), np.eye(3)[None].repeat(len(found), 0), atol=1e-9
                )
                assert angle_of(found[0] @ np.asarray(cone.axis), wanted) < 1e-6
                some += [angle_of(R @ np.asarray(cone.axis), wanted) for R in found[1:]]
            assert max(some) <= angle + 1e-6
            share = (1.0 - np.cos(some)) / (1.0 - np.cos(angle))
            assert np.mean(share) == pytest.approx(0.5, abs=0.05) and np.mean(share < 0.25) == pytest.approx(
                0.25, abs=0.05
            )


def test_a_gripper_that_is_alike_after_a_turn(rng: np.random.Generator) -> None:
    """Without a cone: so many orientations, evenly about the axis, the first as shown."""
    for turns in (1, 2, 5):
        cone = GraspCone((0.0, 0.0, 1.0), turns=turns)
        found = cone.orientations(SHOWN, rng)
        assert len(found) == turns
        np.testing.assert_allclose(found[0], SHOWN, atol=1e-12)
        for k, R in enumerate(found):
            about = rotation_matrix(np.array([0.0, 0.0, 2.0 * np.pi * k / turns]))
            np.testing.assert_allclose(R, SHOWN @ about, atol=1e-12)
    every = GraspCone(turns=None).orientations(SHOWN, rng)
    np.testing.assert_allclose(every[:, :, 2], np.repeat(SHOWN[None, :, 2], len(every), 0), atol=1e-12)
    assert len(every) > 4


def test_where_a_search_begins(robot_of: RobotOf, rng: np.random.Generator) -> None:
    """At the start, along its self-motion both ways, and anywhere within the limits at three stations of the way."""
    robot = robot_of("sawyer")
    constraint = ml.Constraint(np.eye(3)[1:], ml.FrameJacobian(robot, "right_hand"))
    start = np.array([0.3, -0.6, 0.2, 1.2, 0.1, 0.9, 0.4])
    stations = Stations.of(ml.motion(constraint, along=0.2), start, Limits(robot))
    n, grips = 96, 2
    q, station, family = seeds_of(stations, start, n, rng, grips)
    walked = round(SHARE * n)
    assert q.shape == (n, 7) and set(station.tolist()) == {0, len(stations) // 2, len(stations) - 1}
    np.testing.assert_array_equal(q[0], start)
    assert not station[:walked].any() and not family[:walked].any() and set(family.tolist()) == {0, 1}
    along = (q[1:walked] - start) / SELF_MOTION
    biggest = np.max(np.abs(along), axis=1)
    assert np.max(np.abs(biggest - np.round(biggest))) < 1e-9
    assert {float(s) for s in np.sign(along[:, np.argmax(np.abs(along[0]))])} >= {-1.0, 1.0}
    A = stations.matrices(start[None], np.zeros(1, dtype=int))[0]
    assert np.max(np.abs(A @ along.T)) < 1e-9
    low, high = stations.span
    assert np.all(q[walked:] >= low) and np.all(q[walked:] <= high)
    assert np.ptp(q[walked:, 0]) > 0.8 * (high[0] - low[0])


def test_an_approach_takes_the_straight_way_where_it_is_clear(robot_of: RobotOf, rng: np.random.Generator) -> None:
    """Nothing in between: start and goal alone; a wall: clear motions around it."""
    robot = robot_of("planar3")
    clear = Clearance(None, robot, [])
    start, goal = np.array([0.0, 0.5, 0.5]), np.array([1.0, -0.5, 0.2])
    straight = clear_path(start, goal, Limits(robot), clear, rng)
    assert straight is not None and len(straight) == 2
    wall = Blocked(None, robot, [])
    around = clear_path(start, goal, Limits(robot), wall, rng)
    assert around is not None and len(around) > 2
    np.testing.assert_array_equal([around[0], around[-1]], [start, goal])
    assert all(wall.of_line(a, b) for a, b in pairwise(around))


class Blocked(Clearance):
    """A wall between the two, with an opening beside them."""

    def __call__(self, q: np.ndarray) -> bool:
        """Whether the first joint is away from the wall, or the second one in the opening."""
        return bool(abs(q[0] - 0.5) > 0.1 or q[1] > 1.0)


def test_the_sense_in_which_joints_have_more_room(robot_of: RobotOf, rng: np.random.Generator) -> None:
    """A direction is turned round where it would meet a limit within 0.1, and sooner than the other way."""
    robot, turned = robot_of("sawyer"), 0
    limits = Limits(robot)
    for k in range(200):
        q = rng.uniform(robot.position_lower, robot.position_upper)
        j = rng.integers(7)
        q[j] = (robot.position_lower, robot.position_upper, q, robot.position_upper - 1e-3)[k % 4][j]
        direction = rng.normal(size=7) * rng.choice([0.0, 1e-4, 1.0], 7)
        fastest = np.max(np.abs(direction))
        moved = np.flatnonzero(np.abs(direction) > 1e-3 * fastest)
        room = {}
        for sense in (1.0, -1.0):  # the time until the first joint is at its limit
            ends = np.where(sense * direction > 0.0, robot.position_upper, robot.position_lower)
            room[sense] = min((abs(ends[i] - q[i]) / abs(direction[i]) for i in moved), default=np.inf)
        back = fastest > 0.0 and room[1.0] < min(room[-1.0], 0.1 / fastest)
        np.testing.assert_array_equal(limits.freer_sense(q, direction), -direction if back else direction)
        turned += back
    assert 30 < turned < 170


def test_a_policy_passes_its_knots() -> None:
    """Without a task in the way, the posture passes the knots in time, and rests behind the last one."""
    time, knots = np.array([0.0, 0.5, 1.0, 1.5]), np.array([[0.0, 1.0, 0], [0.2, 0.9, 0], [0.5, 0.5, 0], [0.4, 0.6, 0]])
    policy = PathPolicy(time, knots, 10.0, ml.load_robot("planar3"))
    q, dt = knots[0].copy(), 0.001
    for i in range(3000):
        if i == 1000:
            assert np.allclose(q, knots[2], atol=5e-3)
        q = q + dt * policy(q, i * dt)
    assert np.allclose(q, knots[-1], atol=1e-3)
