"""Limits: bounds on the next velocity that can always be kept in the step that follows, of joints, frames and links."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from servo_cases import Arm, Constantly

import manip_learn as ml
from manip_learn.control.barriers import approach_bound
from manip_learn.control.limits import farthest_positions
from manip_learn.errors import ConfigurationError, ManipLearnError

TIP, SPEED, DT = "right_gripper_tip", 0.25, 0.002
CLEARANCE, SLACK = 0.005, 1e-4  # [m]
BENT = np.array([0.3, -0.6, 0.2, 0.9, 0.1, 0.5, 0.0])


# ---- joints ----


def braking(d: float, v: float, a: float, dt: float) -> float:
    """brake(d) of `Limits`' docstring: half of the deceleration, 20 per second, a quarter of the speed outside."""
    a, kappa = 0.5 * a, min(20.0, 0.5 / dt)
    d1 = (a / kappa - 0.5 * a * dt) / kappa
    d0 = d1 - ((a / kappa) ** 2 - (0.5 * a * dt) ** 2) / (2.0 * a)
    if d <= d1:
        return max(kappa * d, -0.25 * v)
    return min(v, np.sqrt(2.0 * a * (d - d0) + (0.5 * a * dt) ** 2) - 0.5 * a * dt)


DISTANCES = (-0.3, -1e-3, 0.0, 1e-3, 0.03, 0.2, 9.0)  # from the upper limit [rad]


@pytest.mark.parametrize(("dt", "mirrored"), list(product((0.001, 0.02, 0.1), (False, True))))
def test_bounds_are_those_of_the_docstring(dt, mirrored, sawyer, rng):
    """Velocity, braking distance and change of velocity, on both sides, and which of them each bound comes from."""
    speed, acceleration = rng.uniform(0.5, 2.0, 7), rng.uniform(1.0, 8.0, 7)
    limits = ml.Limits(sawyer, velocity=speed, acceleration=acceleration, margin=0.01)
    low, high = sawyer.position_lower + 0.01, sawyer.position_upper - 0.01
    for distance, previous in product(DISTANCES, (None, 0.3)):
        q = np.maximum(high - distance, 0.5 * (low + high))
        u = None if previous is None else previous * speed
        x, before = (low + high - q, u if u is None else -u) if mirrored else (q, u)
        together = 0.0 if u is None else float(np.max(np.abs(u) / acceleration))  # [s] in which all joints stop
        bounds = limits.bounds(x, dt, before)
        far, near = (bounds.high, bounds.low) if mirrored else (bounds.low, bounds.high)
        causes, sign = (bounds.low_cause, -1.0) if mirrored else (bounds.high_cause, 1.0)
        for j in range(7):
            v, a = float(speed[j]), float(acceleration[j])
            top, bottom = (
                min(braking(d, v, a, dt), d / together if together > 0.0 and d > 0.0 else np.inf)
                for d in (high[j] - q[j], q[j] - low[j])
            )
            bottom, cause = -bottom, 0 if top < v else 1
            if u is not None:
                cause = 2 if u[j] + a * dt < top else cause
                top, bottom = min(top, u[j] + a * dt), max(bottom, u[j] - a * dt)
                if bottom > top:  # the acceleration limit has precedence
                    top = bottom = u[j] - a * dt if top < u[j] - a * dt else u[j] + a * dt
            assert sign * near[j] == pytest.approx(top, rel=1e-12, abs=1e-14)
            assert sign * far[j] == pytest.approx(bottom, rel=1e-12, abs=1e-14)
            assert causes[j] == cause
        assert bounds.outside == pytest.approx(max(0.0, -distance), abs=1e-12)


def test_defaults_and_settings(sawyer):
    """The default acceleration is documented; every limit can be given, as one number or one per joint."""
    np.testing.assert_array_equal(ml.Limits(sawyer).acceleration, 5.0 * sawyer.velocity_limit)
    unbounded = ml.Limits(sawyer, velocity=np.where(np.arange(7) == 2, np.inf, 1.0)).acceleration
    np.testing.assert_array_equal(unbounded, np.where(np.arange(7) == 2, 10.0, 5.0))
    other = ml.Limits(sawyer, jerk=100.0).with_rates(2.0, None)
    np.testing.assert_array_equal([other.acceleration, other.jerk], [np.full(7, 2.0), np.full(7, 100.0)])
    assert other.bounds(np.zeros(7), 0.01, np.zeros(7)).high[0] == pytest.approx(0.02)
    free = ml.Limits(sawyer, position=False)
    assert np.all(np.isinf(free.upper)) and free.bounds(sawyer.position_upper + 1.0, 0.01, None).outside == 0.0


def test_a_singularity_is_approached_so_slowly_that_the_arm_can_stop():
    """Half of the joints' deceleration brakes sigma to the crossing speed within the distance that is left."""
    slope, acceleration = np.array([3.0, 0.0, 4.0]), np.array([6.0, 1e-3, 2.0])
    # a joint that does not move sigma has no say; the others brake it with 0.5 * 5 * min(6 / 0.6, 2 / 0.8)
    deceleration = 0.5 * 5.0 * 2.5
    for sigma in (1e-4, 1e-3, 0.02, 0.3):
        expected = 5.0 * 5e-4 + min(20.0 * sigma, np.sqrt(2.0 * deceleration * sigma))
        assert approach_bound(sigma, slope, acceleration, 1e-3) == pytest.approx(expected, rel=1e-12)
    # a long step leaves less: half of the distance in each
    assert approach_bound(1e-3, slope, acceleration, 0.1) == pytest.approx(5.0 * 5e-4 + 5.0 * 1e-3)
    assert approach_bound(0.1, np.zeros(3), acceleration, 1e-3) == np.inf


def test_when_a_bound_is_looked_at_and_where_there_is_room(sawyer, robot_of):
    """Motions that may be too fast for a singularity; the sense with 0.1 rad of room; what no encoder can say."""
    limits = ml.Limits(sawyer, acceleration=5.0)
    for sigma, dt, least in ((0.002, 1e-3, (20.0 * 0.002) ** 2), (0.002, 0.1, (5.0 * 0.002) ** 2), (1.0, 1e-3, 5.0)):
        assert [limits.may_approach(x * least, 1.0, sigma, dt) for x in (0.999, 1.001)] == [False, True]
    for side, end in ((1.0, sawyer.position_upper[1]), (-1.0, sawyer.position_lower[1])):
        way = 2.0 * side * np.eye(7)[1]
        for room, kept in ((0.101, 1.0), (0.099, -1.0)):
            np.testing.assert_array_equal(limits.freer_sense((end - side * room) * np.eye(7)[1], way), kept * way)
    np.testing.assert_allclose(
        farthest_positions(sawyer) - 2.0 * np.pi, np.abs([sawyer.position_lower, sawyer.position_upper]).max(axis=0)
    )
    assert farthest_positions(robot_of("kinova")) == 1e6


# ---- frames ----


@pytest.mark.parametrize(("axes", "frames"), [("xyz", (TIP,)), ("pose", (TIP, "right_l4"))])
def test_no_frame_is_faster(axes, frames, sawyer, rng):
    """Far targets with a large gain: the tip moves at its limit and never beyond it; without a limit far beyond it."""
    features = ml.FrameJacobian(sawyer, TIP, axes)
    rows = ml.Constraint(np.eye(features.n_rows)[: 2 if axes == "xyz" else 6], features)
    for _ in range(2):
        q = rng.uniform(-0.8, 0.8, 7)
        aim = q + rng.uniform(-0.6, 0.6, 7)
        task = ml.PointAttractor(sawyer.position(aim, TIP) if axes == "xyz" else sawyer.pose(aim, TIP), gain=5.0)
        most = []
        for limits in (ml.Limits(sawyer, tip_speed=SPEED, frames=frames), True):
            law = ml.ResolvedRateController(rows, task, ml.ManipulabilityAscent(rows), limits=limits)
            arm = Arm(ml.ServoLoop(law, DT), q)
            speeds = [
                [np.linalg.norm(sawyer.jacobian(at, frame)[:3] @ arm.last) for frame in frames]
                for at, _ in ((arm.q, arm.call()) for _ in range(600))
            ]
            most.append(np.max(speeds))
        assert 0.99 * SPEED <= most[0] <= SPEED + 1e-9 and most[1] > 1.5 * SPEED


@pytest.mark.parametrize(("gain", "ways"), [(1.0, np.diag([1.0, -1.0, 1.0])), (10.0, np.diag([-1.0, 1.0, -1.0]))])
def test_the_tip_stays_in_its_box(gain, ways, sawyer, rng):
    """Targets beyond each face, and beyond two: the tip comes to rest at the nearest point of the box, at most 0.1 mm
    beyond a face, within all other limits.
    """
    rows, start = ml.Constraint(np.eye(3), ml.FrameJacobian(sawyer, TIP, "xyz")), sawyer.position(BENT, TIP)
    box = np.array([start - 0.06, start + 0.08])
    for way in (*ways, rng.uniform(-1.0, 1.0, 3)):
        task, climb = ml.PointAttractor(start + 0.2 * way, gain=gain), ml.ManipulabilityAscent(rows)
        law = ml.ResolvedRateController(rows, task, climb, limits=ml.Limits(sawyer, tip_box=box))
        arm, beyond, words = Arm(ml.ServoLoop(law, 0.001), BENT), -np.inf, set()
        for _ in range(4000):
            words.add(arm.call().status)
            place = sawyer.position(arm.q, TIP)
            beyond = max(beyond, float(np.max(np.maximum(place - box[1], box[0] - place))))
        assert -2e-3 < beyond < 1e-4
        assert np.linalg.norm(place - np.clip(task.target, *box)) < 5e-3
        assert np.linalg.norm(sawyer.jacobian(arm.q, TIP)[:3] @ arm.last) < 5e-3
        assert ml.Status.POSITION_LIMITED in words


def test_an_oblique_wall_and_a_start_beyond_it(sawyer):
    """Half-spaces are boxes' faces in any direction; a tip that starts behind one comes back."""
    rows, n = ml.Constraint(np.eye(3)[:2], ml.FrameJacobian(sawyer, TIP, "xyz")), np.array([1.0, 2.0, -1.0])
    wall = [*n, n @ sawyer.position(BENT, TIP) - 0.02 * np.linalg.norm(n)]  # 20 mm behind it
    limits = ml.Limits(sawyer, tip_walls=[wall], tip_speed=1.0)
    law = ml.ResolvedRateController(rows, null_policy=ml.ManipulabilityAscent(rows), limits=limits)
    rollout = ml.simulate(sawyer, law, BENT, 1.5, DT)
    behind = [(n @ sawyer.position(x, TIP) - wall[3]) / np.linalg.norm(n) for x in rollout.q]
    assert behind[0] == pytest.approx(0.02) and abs(behind[-1]) < 1e-3


# ---- links, and what stands around ----

STARTS = {  # tip, start, and a way through a thing that stands in its middle
    "panda": ("panda_hand", [0.0, -0.4, 0.0, -2.0, 0.0, 1.7, 0.8], [0.1, 0.5, 0.0]),
    "ur5": ("tool0", [0.0, -1.2, 1.4, -0.4, 0.3, 0.2], [0.1, 0.5, 0.0]),
    "planar3": ("tip", [0.3, 0.8, 0.4], [-0.6, 0.6, 0.0]),
}


def to_a_point(robot, tip, goal, limits):
    """The tip goes to a point, x and y only for an arm in a plane."""
    axes, n = ("x y", 2) if robot.nv == 3 else ("xyz", 3)
    rows = ml.Constraint(np.eye(n), ml.FrameJacobian(robot, tip, axes))
    return ml.ResolvedRateController(rows, ml.PointAttractor(goal[:n], max_speed=0.5), limits=limits)


def standing(kind, place, size=0.08):
    """A box or a ball."""
    if kind == "ball":
        return ml.Scene(spheres=[ml.Sphere(size, place, "ball")])
    return ml.Scene(boxes=[ml.Box((2 * size, 2 * size, 2 * size), place, "box")])


def distance(pairs, q) -> float:
    """Of the two that are nearest to each other [m]."""
    return pairs.nearest(q).distance


@pytest.mark.parametrize(
    ("name", "kind", "dt", "acceleration"),
    [("panda", "box", 0.01, None), ("ur5", "ball", 0.004, None), ("ur5", "box", 0.01, math.inf),
     ("planar3", "ball", 0.01, None), ("planar3", "box", 0.01, math.inf)],
)  # fmt: skip
def test_nothing_comes_nearer_than_the_clearance(name, kind, dt, acceleration, robot_of):
    """A task that leads through a thing: no pair is nearer than the clearance, at any step, and the arm moved."""
    robot, (tip, q, way) = robot_of(name), STARTS[name]
    place = robot.position(q, tip)
    obstacles = standing(kind, place + 0.5 * np.array(way)).obstacles(robot)
    shapes = "visual" if name == "planar3" else "collision"
    pairs = ml.SelfCollision(robot, shapes=shapes, obstacles=obstacles)
    assert distance(pairs, q) > CLEARANCE
    limits = ml.Limits(robot, acceleration=acceleration, clear_of=pairs, clearance=CLEARANCE)
    free, kept = (
        ml.simulate(robot, to_a_point(robot, tip, place + way, one), q, 1.2, dt)
        for one in (ml.Limits(robot, acceleration=acceleration), limits)
    )
    assert min(distance(pairs, x) for x in free.q) < 0.0
    assert min(distance(pairs, x) for x in kept.q) > CLEARANCE - SLACK
    assert np.abs(kept.q - q).max() > 0.1
    assert np.all(np.abs(np.diff(kept.u, axis=0)) <= dt * limits.acceleration * (1.0 + 1e-9))


def test_the_loop_says_what_is_in_the_way(robot_of):
    """A target within a thing: the arm stands at the clearance, and the words name link and thing."""
    robot, (tip, q, _) = robot_of("ur5"), STARTS["ur5"]
    place = robot.position(q, tip) + np.array([0.0, 0.3, 0.0])
    scene = standing("box", place)
    arm = Arm(ml.ServoLoop(to_a_point(robot, tip, place, ml.Limits(robot, clear_of=scene)), 0.005), np.array(q))
    words = {command.status for command in arm.calls(600)}
    pair = ml.SelfCollision(robot, obstacles=scene.obstacles(robot)).nearest(arm.q)
    assert pair.distance == pytest.approx(CLEARANCE, abs=1e-3)
    assert words & {ml.Status.POSITION_LIMITED, ml.Status.STALLED}
    assert arm.loop.stopped_by == f"{pair.links[0]} 5 mm from the box"


def test_a_start_within_the_clearance_may_leave(robot_of):
    """It comes no nearer, and goes where the way leads away."""
    robot, (frame, q, _) = robot_of("ur5"), STARTS["ur5"]
    tip, along, own, apart = robot.position(q, frame), np.array([0.0, 1.0, 0.0]), ml.SelfCollision(robot), 0.3
    for _ in range(30):  # the box is moved to where it is 3 mm away
        pairs = own.with_obstacles(standing("box", tip + apart * along, 0.05).obstacles(robot))
        apart -= distance(pairs, q) - 0.003
    near, limits = distance(pairs, q), ml.Limits(robot, clear_of=pairs)
    assert 0.0 < near < CLEARANCE
    for way, arrives in ((-0.1, True), (0.1, False)):
        run = ml.simulate(robot, to_a_point(robot, frame, tip + way * along, limits), q, 2.5, 0.01)
        assert min(distance(pairs, x) for x in run.q) > near - SLACK
        assert (run.task_error[-1] < 1e-2) == arrives


def test_a_controller_of_the_users_own_keeps_the_limits_too(sawyer):
    """Its velocity is scaled as a whole where a frame is too fast."""
    arm = Arm(ml.ServoLoop(Constantly(sawyer, np.full(7, 0.5)), DT, limits=ml.Limits(sawyer, tip_speed=0.1)), BENT)
    for _ in range(300):
        at = arm.q
        assert np.linalg.norm(sawyer.jacobian(at, TIP)[:3] @ arm.call().velocity) <= 0.101
    assert np.linalg.norm(arm.last) > 0.05


def test_what_can_be_kept_clear(robot_of):
    """Pairs are those of the same arm; an arm without shapes has capsules, for which a scene is enough."""
    with pytest.raises(ConfigurationError, match="built for"):
        ml.Limits(robot_of("ur5"), clear_of=ml.SelfCollision(robot_of("panda")))
    with pytest.raises(ManipLearnError):
        ml.SelfCollision(robot_of("gantry"))
    assert ml.Limits(robot_of("gantry"), clear_of=ml.Scene(floor=-3.0)).barriers.clear is not None
