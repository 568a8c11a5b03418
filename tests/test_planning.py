"""Plans: the posture in which to take hold, the approach round things, the way, what is said where there is none."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from itertools import pairwise, product

import numpy as np
import pytest
from case import DATA
from conftest import chain_with
from random_arms import random_tree

import manip_learn as ml
from manip_learn.commands.demo import SCENES
from manip_learn.control.barriers import CLEARANCE
from manip_learn.errors import MissingExtraError
from manip_learn.planning.clearance import FLOOR, Clearance, Surroundings, links_of
from manip_learn.planning.joint_path import joint_path
from manip_learn.planning.stations import Stations, path_margins
from manip_learn.planning.ways import soft_margin
from manip_learn.robot.collision import Obstacle, SelfCollision

# ---- Plans: the posture in which to take hold, the approach, the way, and what is said where there is none ----

PANDA_TIP = "panda_hand_tcp"
READY = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.7, 0.8])
FEW = {"candidates": 96}  # where the promise does not depend on how many are compared
HARD = np.array(SCENES["sawyer"].start)  # a degree from a singularity of the drawer's rows


def line(robot: ml.Robot, tip: str, along: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> ml.Constraint:
    across = np.linalg.svd(np.array([along]))[2][1:]
    return ml.Constraint(across, ml.FrameJacobian(robot, tip))


@pytest.fixture(scope="module")
def drawer(sawyer):
    return line(sawyer, "right_gripper_tip", (0.91, 0.42, 0.0))


def opening(constraint: ml.Constraint, **more) -> ml.FreeDirection:
    towards = more.pop("direction", (-1.0, -0.5, 0.0))
    return ml.motion(constraint, along=more.pop("along", 0.3), direction=towards, **more)


@pytest.fixture(scope="module")
def opened(drawer):
    return ml.plan(drawer, opening(drawer, keep_orientation=True, pause=0.5), HARD)


# ---- a plan -----------------------------------------------------------------------------------------------------


def test_a_plan_does_the_whole_way_from_a_start_beside_a_singularity(sawyer, drawer, opened):
    """Approach and way are joined and within limits; the hand takes hold where it was, in the orientation in which it
    was; mu stays above that of the greedy way, which comes within a hundredth of a singularity.
    """
    assert opened.outcome.is_done and opened.outcome.deviation < 1e-3
    assert np.allclose(opened.approach.q[0], HARD, atol=1e-12)
    assert np.max(np.abs(opened.approach.q[-1] - opened.q_grasp)) < 1e-3
    assert np.max(np.abs(opened.way.q[0] - opened.approach.q[-1])) < 1e-12
    there, here = (sawyer.pose(q, "right_gripper_tip") for q in (opened.approach.q[-1], HARD))
    assert np.max(np.abs(there - here)) < 2e-3
    for rollout in (opened.approach, opened.way):
        assert np.all(rollout.q >= sawyer.position_lower) and np.all(rollout.q <= sawyer.position_upper)
        assert np.all(np.abs(rollout.u) <= sawyer.velocity_limit)
    assert 0.2 < np.max(np.abs(opened.approach.u) / sawyer.velocity_limit) < 0.26  # beside people, as ISO 10218-1
    law = ml.ResolvedRateController(drawer, opening(drawer, keep_orientation=True, pause=0.5))
    greedy = ml.simulate(sawyer, law, HARD, 4.5)
    assert np.min(opened.way.manipulability) > 4.0 * np.min(greedy.manipulability)


def test_simulate_and_a_servo_loop_run_a_plan(sawyer, opened):
    """Both end where the plan does; a loop that is reset begins with the approach again."""
    again = ml.simulate(sawyer, opened.controller, HARD, float(opened.rollout.time[-1]))
    n = min(len(again), len(opened.rollout))
    assert np.max(np.abs(again.q[:n] - opened.rollout.q[:n])) < 0.01  # all the way, to a sample's step
    assert np.max(np.abs(again.q[-1] - opened.rollout.q[-1])) < 1e-3
    loop = ml.ServoLoop(opened.controller, dt=0.002)
    loop.reset(HARD)
    q, statuses = HARD.copy(), set()
    for k in range(round((opened.rollout.time[-1] + 0.5) / 0.002)):
        statuses.add(loop.update(q, 0.002 * k).status)
        q = loop.position
    assert np.max(np.abs(q - opened.rollout.q[-1])) < 2e-3
    assert statuses <= {"ok", "null-scaled", "rerouted", "acceleration-limited"}
    loop.reset(HARD)  # and a second time from the start
    loop.update(HARD, 100.0)
    assert loop.controller.number == 0


def test_a_way_too_fast_for_the_joints_takes_longer(panda):
    """It is given the time that the slowest joint needs, and the plan says so."""
    rail = line(panda, PANDA_TIP, (0.0, 1.0, 0.0))
    motion = ml.motion(rail, along=0.5, speed=0.5, keep_orientation=True)
    plan = ml.plan(rail, motion, READY, limits=ml.Limits(panda, velocity=0.4), **FEW)
    assert plan.outcome.is_done and plan.outcome.seconds > 3.0 * 1.5
    assert "too slow" in " ".join(plan.notes)


# ---- where there is none ----------------------------------------------------------------------------------------


def test_a_way_beyond_the_reach_says_how_much_of_it_can_be_done(panda):
    """That much can be done when asked for, and a little more lies beyond the arm's reach."""
    rail = line(panda, PANDA_TIP)
    with pytest.raises(ml.NoPlanError, match=r"no plan for 1\.2 m: 0\.\d+ m at most, stopped by") as refused:
        ml.plan(rail, ml.motion(rail, along=1.2), READY)
    largest = refused.value.largest
    assert 0.3 < largest < 0.6 and "singularity" in refused.value.stopped_by
    law = ml.plan(rail, ml.motion(rail, along=0.95 * largest), READY)  # what it says can be done
    assert law.outcome.is_done
    beyond = panda.position(READY, PANDA_TIP)[0] + 1.1 * largest
    assert beyond > 0.85  # a Panda's hand reaches 0.855 m from its shoulder


def test_a_hand_that_may_turn_is_named_where_it_would_help(panda):
    """Held as it is, the hand does not come so far to the side."""
    rail = line(panda, PANDA_TIP, (0.0, 1.0, 0.0))
    with pytest.raises(ml.NoPlanError) as refused:
        ml.plan(rail, ml.motion(rail, along=0.75, keep_orientation=True), READY, **FEW)
    assert refused.value.helps == ("a hand that is free to rotate could complete it",)


def test_nothing_touches_between_the_stations_of_a_way(tmp_path):
    """A bead that thin links meet between two stations of a long way, and at none of them, is kept clear of."""
    joints = [("revolute", "0 0 1", place, "0 0 0") for place in ("0 0 0", "1 0 0", "1 0 0")]
    rod = '<origin xyz="0.5 0 0" rpy="0 1.570796 0"/><geometry><cylinder radius="0.002" length="1"/></geometry>'
    rods = {f"link{i}": f"<collision>{rod}</collision>" for i in range(3)}
    robot, start = chain_with(tmp_path, joints, rods, 3), np.array([0.9, -1.2, -0.6])
    held = ml.Constraint([[0, 1]], ml.FrameJacobian(robot, "tip", "x y"))
    motion = ml.motion(held, along=-1.6)
    way = ml.plan(held, motion, start, scene=None, **FEW).way
    stations = Stations.of(motion, start, ml.Limits(robot))
    times = way.time[-1] - stations.time[-1] + stations.time
    middle = way.q[np.searchsorted(way.time, 0.5 * (times[40] + times[41]))]
    bead = ml.Sphere(0.001, (robot.pose(middle, "link2") @ [0.9, 0.0, 0.0, 1.0])[:3], "bead")
    scene = ml.Scene(spheres=[bead])
    touching = SelfCollision(robot, obstacles=scene.obstacles(robot))
    at_stations = way.q[np.minimum(np.searchsorted(way.time, times), len(way) - 1)]
    assert all(touching.closer_than(q, 0.0) for q in [middle])
    assert not any(touching.closer_than(q, 0.005) for q in at_stations)
    try:
        found = ml.plan(held, motion, start, scene=scene, **FEW)
    except ml.NoPlanError as refused:
        assert "bead" in refused.stopped_by
    else:
        assert not any(touching.closer_than(q, 0.0) for q in (*found.approach.q, *found.way.q))


def test_bad_starts_and_ways_are_refused_in_a_sentence(panda):
    """Outside limits, in collision, no way, another constraint, no velocity limit."""
    rail, rng, links = line(panda, PANDA_TIP), np.random.default_rng(3), links_of(panda)[0]
    motion = ml.motion(rail, along=0.2)
    touching = next(q for q in (panda.random_configuration(rng) for _ in range(9999)) if links.closer_than(q, 0.0))
    endless = ml.Limits(panda, velocity=np.where(np.arange(7) == 3, np.inf, 2.0))
    for words, *plan in (
        ("outside its limits", rail, motion, READY + [9, 0, 0, 0, 0, 0, 0]),
        ("touch", rail, motion, touching),
        ("motion", rail, ml.PointAttractor([0.5, 0.0, 0.5]), READY),
        ("another constraint", line(panda, PANDA_TIP), motion, READY),
        ("panda_joint4.*no velocity limit", rail, motion, READY, endless),
    ):
        with pytest.raises(ml.ManipLearnError, match=words):
            ml.plan(*plan[:3], **({"limits": plan[3]} if plan[3:] else {}))


# ---- parts ------------------------------------------------------------------------------------------------------


def test_the_slope_of_the_soft_margin_is_that_of_central_differences(panda):
    """Beside a singularity of the wrist, too."""
    rail, rng = line(panda, PANDA_TIP), np.random.default_rng(2)
    stations = Stations.of(ml.motion(rail, along=0.2, keep_orientation=True), READY, ml.Limits(panda))
    q = READY * [1, 1, 1, 1, 1, 1e-3, 1] + np.cumsum(rng.normal(0.0, 0.02, (len(stations), 7)), axis=0)
    value, slope, _ = soft_margin(stations, q)
    steps = 1e-6
    numeric = np.zeros_like(q)
    for i, j in product(range(0, len(q), 3), range(7)):
        ahead, behind = q.copy(), q.copy()
        ahead[i, j] += steps
        behind[i, j] -= steps
        numeric[i, j] = (soft_margin(stations, ahead)[0] - soft_margin(stations, behind)[0]) / (2.0 * steps)
    rows = list(range(0, len(q), 3))
    assert np.max(np.abs(numeric[rows] - slope[rows])) < 1e-5 * max(1.0, np.max(np.abs(slope)))
    assert value <= path_margins(stations, q).margin + 1e-9


def test_the_sense_in_which_joints_have_more_room(rng):
    """A direction is turned round where it would meet a limit within 0.1, and sooner than the other way."""
    robot, turned = ml.load_robot("sawyer"), 0
    limits = ml.Limits(robot)
    for k in range(200):
        q = rng.uniform(robot.position_lower, robot.position_upper)
        j = rng.integers(7)
        q[j] = (robot.position_lower, robot.position_upper, q, robot.position_upper - 1e-3)[k % 4][j]
        direction = rng.normal(size=7) * rng.choice([0.0, 1e-4, 1.0], 7)
        fastest = np.max(np.abs(direction))
        moved = np.abs(direction) > 1e-3 * fastest
        ends = (np.where(sense * direction > 0.0, robot.position_upper, robot.position_lower) for sense in (1, -1))
        # times until the first joint is at its limit
        ahead, behind = (np.min(np.abs((end - q)[moved] / direction[moved]), initial=np.inf) for end in ends)
        back = fastest > 0.0 and ahead < min(behind, 0.1 / fastest)
        np.testing.assert_array_equal(limits.freer_sense(q, direction), -direction if back else direction)
        turned += back
    assert 30 < turned < 170


@pytest.mark.parametrize("first", [0, 1])
def test_of_a_link_with_several_shapes_the_nearest_counts(tmp_path, first):
    """4 and 8 mm away, in either order: it may come half as near as the nearer one is, so that the start is clear."""
    ball = '<collision><origin xyz="{} 0 0"/><geometry><sphere radius="0.05"/></geometry></collision>'
    shapes = "".join([ball.format(0.5), ball.format(0.7)][:: 1 - 2 * first])
    robot = chain_with(tmp_path, [("revolute", "0 0 1", "0 0 0.3", "0 0 0")], {"link0": shapes})
    for at in (0.598, 0.602):  # between both, 4 mm from one
        around = ml.Scene(spheres=[ml.Sphere(0.044, (at, 0.0, 0.3), "ball")]).obstacles(robot)
        clear = Clearance(robot, True, Surroundings(around), np.zeros(1))
        assert clear.allowed(("link0", "ball")) == pytest.approx(2e-3, abs=1e-6) and clear(np.zeros(1))
        assert clear.allowed(("link0", "another")) == 5e-3


def test_what_a_recording_shows_is_possible(panda):
    """Links that touch in a posture that was shown count as clear to that depth, and are named; a posture in which they
    are deeper into each other is not clear.
    """
    rng, links = np.random.default_rng(4), links_of(panda)[0]
    pairs = ((x, links.closer_than(x, 0.0)) for x in (panda.random_configuration(rng) for _ in range(9999)))
    q, found = next((x, found) for x, found in pairs if len(found) == 1 and found[0].distance < -2e-3)
    plain, told = Clearance(panda, True, Surroundings(), READY), Clearance(panda, True, Surroundings(), READY, [q])
    assert not plain(q) and told(q) and not plain.notes
    assert any("{!r} and {!r} touch in the recordings".format(*found[0].links) in note for note in told.notes)


# ---- Joint paths round what is in the way: clear by our own distances, repeatable, for robots from any file ----

STATIONS = 100  # at which a straight motion is checked
NO_ROBOPLAN = "NO ROBOPLAN: PATHS ROUND WHAT IS IN THE WAY ARE NOT TESTED (the extra 'plan')"


def around(robot: ml.Robot) -> tuple[Obstacle, ...]:
    """A box before the arm, a ball and a tube beside it."""
    return ml.Scene.load(DATA / "around_an_arm.json").obstacles(robot)


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
        if not clear.is_line_clear(start, goal):
            yield start, goal, clear


@pytest.mark.parametrize("name", ["sawyer", "panda", pytest.param("kinova", marks=pytest.mark.slow), 2, 5])
def test_paths_are_clear_and_repeated(name, tmp_path):
    """Shapes of every kind, mimic, continuous and sliding joints, trees, and robots whose links are capsules."""
    pytest.importorskip("roboplan.rrt", reason=NO_ROBOPLAN)
    robot = random_tree(np.random.default_rng(name), tmp_path) if isinstance(name, int) else ml.load_robot(name)
    limits, obstacles, found = ml.Limits(robot), around(robot), 0
    known = links_of(robot)[0].with_obstacles(obstacles)
    for number, (start, goal, clear) in zip(range(3), blocked(robot, 1, obstacles), strict=False):
        path = joint_path(robot, start, goal, limits, clear, number)
        if path is None:
            continue
        found += 1
        assert len(path) > 2 and np.array_equal(path[0], start) and np.array_equal(path[-1], goal)
        assert all(np.all(robot.position_lower - 1e-6 <= q) and np.all(q <= robot.position_upper + 1e-6) for q in path)
        for (a, b), s in product(pairwise(path), np.linspace(0.0, 1.0, STATIONS)):  # also between what was looked at
            assert not known.closer_than(a + s * (b - a), 0.9 * clear.least)
        other = Clearance(robot, links_of(robot)[0], Surroundings(obstacles), start)
        same = joint_path(robot, start, goal, limits, other, number)
        assert same is not None and np.array_equal(path, same)
    assert found >= 1


def test_what_cannot_be_is_said(caplog):
    """Walls that part the plane of a planar arm, a goal inside one, a base that floats."""
    pytest.importorskip("roboplan.rrt", reason=NO_ROBOPLAN)
    caplog.set_level(logging.INFO)
    robot = ml.load_robot("planar3")
    walls = ml.Scene(boxes=[ml.Box((3.0, 0.1, 1.0), (s * 1.8, 0.0, 0.0), f"wall {s}") for s in (-1, 1)])
    up, down, along = np.array([[1.5, 0.3, 0.3], [-1.5, 0.3, 0.3], [0.0, 0.0, 0.0]])
    clear = Clearance(robot, True, Surroundings(walls.obstacles(robot)), up)
    assert joint_path(robot, up, down, ml.Limits(robot), clear, 0) is None and "no path" in caplog.text
    assert joint_path(robot, up, along, ml.Limits(robot), clear, 0) is None
    assert joint_path(robot, up, up + [0.0, 0.3, 0.3], ml.Limits(robot), clear, 0) is not None
    floating = ml.load_robot("planar3", base="floating")
    start, goal = (np.concatenate([[0.0] * 6, q]) for q in (up, down))
    clear = Clearance(floating, True, Surroundings(walls.obstacles(floating)), start)
    assert joint_path(floating, start, goal, ml.Limits(floating), clear, 0) is None and "turn or slide" in caplog.text


def test_roboplan_is_asked_where_the_straight_motion_is_not_clear(sawyer, monkeypatch):
    """Without it, a straight motion that is clear is found, and the sentence says what to install."""
    monkeypatch.setitem(sys.modules, "roboplan.core", None)
    start, goal, clear = next(blocked(sawyer, 5, around(sawyer)))
    assert joint_path(sawyer, start, start + 1e-3, ml.Limits(sawyer), clear, 0) is not None
    with pytest.raises(MissingExtraError, match=r"pip install 'manip_learn\[plan\]'"):
        joint_path(sawyer, start, goal, ml.Limits(sawyer), clear, 0)


# ---- what a plan takes to stand around where nobody says: a floor, which gives way to the arm ----

BENT = np.array([0.0, -0.6, 0.0, -2.2, 0.0, 1.8, 0.7])


def test_an_assumed_floor_gives_way_and_a_given_one_does_not(panda: ml.Robot):
    """It lies below what the arm is in at the start, and below all that was shown: one note says which and how deep."""
    middle, above = panda.pose(BENT, "panda_link4")[:3, 3], np.zeros(7)
    floor = next(o for o in ml.Scene(floor=float(middle[2]) - 0.02).obstacles(panda))
    assumed = Surroundings((floor,), assumed=frozenset({FLOOR}))
    for start, shown, where in ((BENT, (), "at the start"), (above, (above, BENT), "in the recordings")):
        clear = Clearance(panda, True, assumed, start, shown)
        nearest = min(pair.distance for pair in clear.links.closer_than(BENT, 10.0) if pair.links[1] == FLOOR)
        assert clear(BENT) and nearest == pytest.approx(CLEARANCE, abs=1e-4)
        assert len(clear.notes) == 1 and clear.notes[0].startswith(f"{where} 'panda_") and "lower" in clear.notes[0]
    assert not Clearance(panda, True, Surroundings((floor,)), above, (BENT,))(BENT)


def test_nothing_is_invented(panda: ml.Robot):
    """Of what is opened nobody knows its front: without a scene there is a floor, with one what it states."""
    box = ml.Scene(boxes=[ml.Box((0.1, 0.1, 0.1), (1.0, 0.0, 0.0), "box")])
    assert [Surroundings.of(x, panda, panda.frame(PANDA_TIP)).names for x in (None, box)] == [(FLOOR,), ("box",)]


def test_a_hand_goes_no_deeper_than_the_least_deep_that_takes_hold(panda: ml.Robot):
    """Of postures that take hold one is in the thing held and one is beside it: the first is not clear."""
    start, place = BENT + [0.0, -0.4, 0.0, 0.0, 0.0, 0.0, 0.0], panda.position(BENT, PANDA_TIP)
    scene = ml.Scene(None, [ml.Box((0.3, 0.3, 0.3), place - [0.0, 0.0, 0.12], "chest")], handled=("chest",))
    clear = Clearance(panda, True, Surroundings.of(scene, panda, panda.frame(PANDA_TIP)), start)
    beside = BENT + [0.0, -0.1, 0.0, 0.0, 0.0, 0.0, 0.0]
    both, alone = clear.for_grasps([BENT, beside]), clear.for_grasps([BENT])
    assert alone(BENT) and alone(beside)
    assert both(beside) and not both(BENT)
    touching = both.nearest_contact(BENT)
    assert touching is not None and touching.links[1] == "chest"
