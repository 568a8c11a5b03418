"""What a plan takes to stand around where nobody says: floor, front and leaf, and what gives way to the arm."""

from __future__ import annotations

import numpy as np
import pytest

import manip_learn as ml
from manip_learn.control.keeping_clear import CLEARANCE
from manip_learn.control.limits import Limits
from manip_learn.planning.clearance import Clearance
from manip_learn.planning.stations import Stations
from manip_learn.planning.surroundings import FLOOR, FRONT, LEAF, Surroundings, half_space, hand_of, surroundings_of

TIP, READY = "panda_hand_tcp", np.array([0.0, -0.6, 0.0, -2.2, 0.0, 1.8, 0.7])
HEIGHT = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def panda() -> ml.Robot:
    return ml.load_robot("panda", locked=("panda_finger_joint1", "panda_finger_joint2"))


def door(robot: ml.Robot, hinge: np.ndarray) -> ml.Constraint:
    rows = ml.MechanismRows(robot, TIP, ("radial", "axial"), axis=HEIGHT, point=hinge)
    return ml.Constraint(np.eye(2), rows)


def around(
    constraint: ml.Constraint, motion: ml.FreeDirection, scene: ml.Scene | None
) -> tuple[Surroundings, Stations]:
    robot = constraint.robot
    assert robot is not None
    stations = Stations.of(motion, READY, Limits(robot))
    return surroundings_of(scene, robot, robot.frame(TIP), stations, constraint.mechanism), stations


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("turn", [-1.0, 1.0])
@pytest.mark.parametrize("is_given", [False, True])
def test_a_leaf_runs_from_its_hinge_behind_its_handle(panda: ml.Robot, side: float, turn: float, is_given: bool):
    """At every station of the way its face passes the hinge's axis and goes by behind the hand; in given scenes too."""
    hinge = panda.position(READY, TIP) + [0.0, side * 0.35, 0.0]
    constraint = door(panda, hinge)
    found, stations = around(constraint, ml.motion(constraint, turn=turn), ml.Scene(floor=0.0) if is_given else None)
    assert LEAF in found.assumed and (FRONT in found.names) is not is_given
    leaf = next(o for o in found.obstacles if o.name == LEAF)
    before = stations.places[1] - stations.places[0]
    for k, place in enumerate(stations.places):
        inside = np.linalg.inv(found.at(k)[LEAF])
        at_hinge, at_handle = (inside[:3, :3] @ point + inside[:3, 3] for point in (hinge, place))
        assert abs(at_hinge[1]) <= leaf.half[1] + 1e-9  # the axis is in the plane of the board
        assert -leaf.half[0] - 0.1 < at_hinge[0] < -leaf.half[0] < at_handle[0] < leaf.half[0]
        assert 0.02 < abs(at_handle[1]) - leaf.half[1] < 0.03  # a flat handle stands out
    face = found.at(0)[LEAF][:3, 1]
    out = np.sign((stations.places[0] - found.at(0)[LEAF][:3, 3]) @ face)
    toward_base = -np.sign(out * face @ (stations.places[0] * [1.0, 1.0, 0.0]))
    assert toward_base > 0.0 and abs(before @ face) > 0.9 * np.linalg.norm(before)


def test_a_knob_has_no_leaf(panda: ml.Robot):
    """A handle 4 cm from its axis is no door's."""
    knob = door(panda, panda.position(READY, TIP) + [0.0, 0.04, 0.0])
    assert LEAF not in around(knob, ml.motion(knob, turn=1.0), None)[0].names


def test_what_was_assumed_gives_way_to_what_is_in_it(panda: ml.Robot):
    """A link that is in the front passes through it, others do not; the floor is lower. What is given does not."""
    middle = panda.pose(READY, "panda_link4")[:3, 3]
    front = half_space(FRONT, middle, -middle / np.linalg.norm(middle), frozenset())
    floor = next(o for o in ml.Scene(floor=float(middle[2]) - 0.02).obstacles(panda))
    here = Clearance(panda, True, Surroundings((front,), assumed=frozenset({FRONT})), READY)
    inside = {
        pair.links[0] for pair in Clearance(panda, True, Surroundings((front,)), READY).links.closer_than(READY, 0.0)
    }
    assert here(READY) and len(here.notes) == 1 and all(link in here.notes[0] for link in inside)
    kept = here.links.closer_than(READY, 10.0)
    assert {pair.links[0] for pair in kept if pair.links[1] == FRONT} and not inside & {
        pair.links[0] for pair in kept if pair.links[1] == FRONT
    }
    below = Clearance(panda, True, Surroundings((floor,), assumed=frozenset({FLOOR})), READY)
    nearest = min(pair.distance for pair in below.links.closer_than(READY, 10.0) if pair.links[1] == FLOOR)
    assert below(READY) and nearest == pytest.approx(CLEARANCE, abs=1e-4) and "lower" in below.notes[0]
    for given in (front, floor):
        assert not Clearance(panda, True, Surroundings((given,)), READY)(READY)


def test_a_hand_goes_no_deeper_than_the_least_deep_that_takes_hold(panda: ml.Robot):
    """Of postures that take hold one is in the thing held and one is beside it: the first is not clear."""
    start, place = READY + [0.0, -0.4, 0.0, 0.0, 0.0, 0.0, 0.0], panda.position(READY, TIP)
    scene = ml.Scene(None, [ml.Box((0.3, 0.3, 0.3), place - [0.0, 0.0, 0.12], "chest")], handled=("chest",))
    hand = hand_of(panda, panda.frame(TIP))
    clear = Clearance(panda, True, Surroundings(scene.obstacles(panda, hand)).for_hand(panda, hand), start)
    beside = READY + [0.0, -0.1, 0.0, 0.0, 0.0, 0.0, 0.0]
    both, alone = clear.holding([READY, beside]), clear.holding([READY])
    assert alone(READY) and alone(beside)
    assert both(beside) and not both(READY)
    touching = both.touching(READY)
    assert touching is not None and touching.links[1] == "chest"
