"""What a plan takes to stand around where nobody says: a floor, which gives way to the arm."""

from __future__ import annotations

import numpy as np
import pytest

import manip_learn as ml
from manip_learn.control.barriers import CLEARANCE
from manip_learn.planning.clearance import FLOOR, Clearance, Surroundings

TIP, READY = "panda_hand_tcp", np.array([0.0, -0.6, 0.0, -2.2, 0.0, 1.8, 0.7])
HEIGHT = np.array([0.0, 0.0, 1.0])


def test_an_assumed_floor_gives_way_and_a_given_one_does_not(panda: ml.Robot):
    """It lies below what the arm is in at the start, and below all that was shown: one note says which and how deep."""
    middle, above = panda.pose(READY, "panda_link4")[:3, 3], np.zeros(7)
    floor = next(o for o in ml.Scene(floor=float(middle[2]) - 0.02).obstacles(panda))
    assumed = Surroundings((floor,), assumed=frozenset({FLOOR}))
    for start, shown, where in ((READY, (), "at the start"), (above, (above, READY), "in the recordings")):
        clear = Clearance(panda, True, assumed, start, shown)
        nearest = min(pair.distance for pair in clear.links.closer_than(READY, 10.0) if pair.links[1] == FLOOR)
        assert clear(READY) and nearest == pytest.approx(CLEARANCE, abs=1e-4)
        assert len(clear.notes) == 1 and clear.notes[0].startswith(where) and "lower" in clear.notes[0]
    assert not Clearance(panda, True, Surroundings((floor,)), above, (READY,))(READY)


def test_nothing_is_invented(panda: ml.Robot):
    """Of what is opened nobody knows its front: without a scene there is a floor, with one what it states."""
    box = ml.Scene(boxes=[ml.Box((0.1, 0.1, 0.1), (1.0, 0.0, 0.0), "box")])
    assert [Surroundings.of(x, panda, panda.frame(TIP)).names for x in (None, box)] == [(FLOOR,), ("box",)]


def test_a_hand_goes_no_deeper_than_the_least_deep_that_takes_hold(panda: ml.Robot):
    """Of postures that take hold one is in the thing held and one is beside it: the first is not clear."""
    start, place = READY + [0.0, -0.4, 0.0, 0.0, 0.0, 0.0, 0.0], panda.position(READY, TIP)
    scene = ml.Scene(None, [ml.Box((0.3, 0.3, 0.3), place - [0.0, 0.0, 0.12], "chest")], handled=("chest",))
    clear = Clearance(panda, True, Surroundings.of(scene, panda, panda.frame(TIP)), start)
    beside = READY + [0.0, -0.1, 0.0, 0.0, 0.0, 0.0, 0.0]
    both, alone = clear.for_grasps([READY, beside]), clear.for_grasps([READY])
    assert alone(READY) and alone(beside)
    assert both(beside) and not both(READY)
    touching = both.nearest_contact(READY)
    assert touching is not None and touching.links[1] == "chest"
