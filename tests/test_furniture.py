"""The drawer, the door and the crank of a replay: they move as the hand does, and stand still without it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import manip_learn as ml
from manip_learn.constraint.shown import Shown
from manip_learn.playback.kinematic_tree import kinematic_tree
from manip_learn.playback.mechanism_drawing import furniture_of
from manip_learn.playback.recorded_motion import recorded_motion

N = 60  # samples of each stage
TILTED = np.array([0.6, 0.0, 0.8])
CENTRE = np.array([0.5, 0.1, 0.4])
MECHANISMS = {
    "line": {"type": "line", "axis": [1.0, 0.0, 0.0], "point": [9.0, 9.0, 9.0]},  # held elsewhere by the recordings
    "hinge": {"type": "hinge", "axis": TILTED.tolist(), "point": CENTRE.tolist(), "radius": 0.3},
    "screw": {"type": "screw", "axis": TILTED.tolist(), "point": CENTRE.tolist(), "radius": 0.1, "pitch": 0.02},
}


def place(kind, way):
    """Where the hand is after ways along a mechanism [m or rad]."""
    if kind == "line":
        return np.array([0.7, 0.2, 0.35]) + np.outer(way, [1.0, 0.0, 0.0])
    mechanism = MECHANISMS[kind]
    right = np.array([0.8, 0.0, -0.6])
    turned = np.outer(np.cos(way), right) + np.outer(np.sin(way), np.cross(TILTED, right))
    return CENTRE + mechanism["radius"] * turned + np.outer(mechanism.get("pitch", 0.0) * way, TILTED)


def stages(kind, *ways):
    """Times and path of a hand that comes from aside, goes these ways, and leaves to another side."""
    smooth = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, N))
    along = np.concatenate([a + (b - a) * smooth for a, b in zip((0.0, *ways[:-1]), ways, strict=True)])
    on = place(kind, along)
    aside = np.outer(np.linspace(0.2, 0.0, N, endpoint=False), [0.3, 0.5, 0.8])
    path = np.concatenate([on[0] + aside, on, on[-1] - aside[::-1] * [1.0, -0.4, -1.0]])
    return 0.01 * np.arange(len(path)), path


def as_shown(kind, way):
    """What recordings show who took hold of it where it is shut, and went this way [m or rad]."""
    begin, end = place(kind, np.array([0.0, way]))
    turns, sense = kind != "line", np.sign(way)
    axes = sense * np.array([MECHANISMS[kind]["axis"]])
    free = ml.Mechanism("hinge" if turns else "line", axes[0], CENTRE)
    numbers = abs(way), 0.0, abs(way), abs(way), abs(way), 0.1, 1.0
    first = ("rad" if turns else "m", *numbers, False, 5, begin, 0.0, np.zeros((2, 1)), np.arange(2.0))
    return Shown(*first, begin, np.eye(3), 0.0, True, free)


WAYS = [("line", 0.3, -1.0), ("hinge", 0.9, 1.0), ("hinge", 0.9, -1.0), ("screw", 7.5, 1.0)]


def test_it_moves_with_the_hand_and_only_with_it():
    """Untouched while the hand comes, its handle in the hand along the way, and left where the hand leaves it."""
    for kind, way, sense in WAYS:
        times, path = stages(kind, sense * way)
        piece = furniture_of(MECHANISMS[kind], times, path)
        assert piece is not None and piece.unit == ("m" if kind == "line" else "rad"), kind
        opening, handle = piece.opening, np.zeros((1, 3))
        # a hand that comes is on the mechanism from 5 mm on, which is its last step or two
        np.testing.assert_allclose(opening[: N - 2], 0.0, atol=1e-12, err_msg=kind)
        np.testing.assert_allclose(opening[2 * N + 2 :], way, rtol=0.02, err_msg=kind)
        for i in range(N, 2 * N, 7):
            np.testing.assert_allclose(piece.moved(handle, opening[i])[0], path[i], atol=2e-3, err_msg=kind)


@pytest.mark.parametrize(("kind", "way", "sense"), WAYS)
def test_it_stands_where_it_was_shown(kind, way, sense):
    """Shut with its handle where recordings took hold, whatever the hand does: it comes and goes the whole way, begins
    in the middle, which has it open by so much from the first, goes back, or never takes hold.
    """
    shown, begin = as_shown(kind, sense * way), place(kind, np.zeros(1))
    out, back = np.linspace(0.0, way, N), np.linspace(0.7 * way, 0.2 * way, N)
    for along, held in ((out, True), (np.linspace(0.4 * way, way, N), True), (back, True), (out, False)):
        on = place(kind, sense * along)
        aside = on[0] + np.outer(np.linspace(0.2, 0.0, N), [0.3, 0.5, 0.8])
        times, path = 0.01 * np.arange(2 * N), np.concatenate([aside, on if held else on + [0.0, 0.2, 0.1]])
        piece = furniture_of(MECHANISMS[kind], times, path, [(times[N], times[-1])], shown)
        assert piece is not None
        handle, shut = np.zeros((1, 3)), way if piece.pushed_from else 0.0
        np.testing.assert_allclose(piece.moved(handle, 0.0), begin, atol=1e-9)
        expected = along if held else np.zeros(N)
        np.testing.assert_allclose(piece.opening[N:], expected, atol=1e-9)
        np.testing.assert_allclose(piece.opening[:N], expected[0], atol=1e-9)
        if held:
            np.testing.assert_allclose(piece.moved(handle, piece.opening[-1])[0], path[-1], atol=1e-9)
        assert piece.pushed_from == pytest.approx(shut)


def test_the_chest_stands_away_from_the_base():
    """A hand that comes towards the base pulls its drawer open; one that goes away pushes an open one shut."""
    for way, open_at_first, open_at_last in ((-0.3, 0.0, 0.3), (0.3, 0.3, 0.0)):
        piece = furniture_of(MECHANISMS["line"], *stages("line", way))
        assert piece is not None
        assert piece.pose[0, 1] == pytest.approx(-1.0)  # it opens towards the base
        shut = piece.pose[0, 3]
        for opening, wanted in ((piece.opening[0], open_at_first), (piece.opening[-1], open_at_last)):
            assert shut - piece.moved(np.zeros((1, 3)), opening)[0, 0] == pytest.approx(wanted, abs=5e-3)
        assert piece.corners()[:, 2].min() == pytest.approx(0.0, abs=1e-9)  # on the floor


def test_nothing_is_made_up():
    """Without a mechanism that opens, without its place or its way, or where the hand hardly moves, there is none."""
    for mechanism, way in (
        *((None, 0.3), ({"type": "plane", "axis": [0, 0, 1], "point": [0, 0, 0]}, 0.3), ({"type": "line"}, 0.3)),
        *(({"type": "hinge", "axis": [0, 0, 1]}, 0.3), (MECHANISMS["line"], 0.015)),
    ):
        assert furniture_of(mechanism, *stages("line", way)) is None, mechanism
    for ways in ([], [(0.0, 0.01 * N)], [(90.0, 95.0)]):
        assert furniture_of(MECHANISMS["line"], *there_and_back("line", -0.3), ways) is None, ways
    assert furniture_of(MECHANISMS["line"], *stages("line", 0.025)) is not None


def there_and_back(kind, way):
    """Times and path of a hand that waits on its mechanism, goes aside and comes back, waits, and goes its way."""
    smooth = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, N))
    begins = place(kind, np.zeros(N))
    aside = np.outer(np.sin(np.pi * np.linspace(0.0, 1.0, N)), [0.3, 0.5, 0.8])
    path = np.concatenate([begins, begins + aside, begins, place(kind, way * smooth)])
    return 0.01 * np.arange(len(path)), path


def test_it_is_shut_until_the_way_begins():
    """A hand that begins at the handle, leaves it and comes back moves it from the beginning of its way on only."""
    for kind, way, sense in WAYS:
        times, path = there_and_back(kind, sense * way)
        piece = furniture_of(MECHANISMS[kind], times, path, [(times[3 * N], times[-1])])
        assert piece is not None and not np.any(piece.opening[: 3 * N + 1]), kind
        assert piece.opening[-1] == pytest.approx(way, rel=1e-9)
        for i in range(3 * N, 4 * N, 7):
            np.testing.assert_allclose(piece.moved(np.zeros((1, 3)), piece.opening[i])[0], path[i], atol=1e-9)


def test_the_phases_of_a_rollout_say_when_it_moves(robot_of):
    """Phases of a plan tell its way, those with other names tell nothing, and a plan without its way opens nothing."""
    robot = robot_of("sawyer")
    kept = {"n_constraints": 2, "mechanism": MECHANISMS["line"]}
    constraint = ml.Constraint([[0, 1, 0], [0, 0, 1]], ml.FrameJacobian(robot, "right_gripper_tip"), kept)
    controller = ml.ResolvedRateController(constraint, task=ml.FreeDirection(constraint, -0.12, 0.2))
    rollout = ml.simulate(robot, controller, [0.3, -0.9, 0.2, 1.6, 0.1, 0.7, 0.4], duration=1.3, dt=0.01)
    tree, tip = kinematic_tree(robot), robot.frame("right_gripper_tip")
    plain = recorded_motion(robot, tree, tip, "a", rollout, mechanism=MECHANISMS["line"])
    way = np.linalg.norm(robot.position(rollout.q[-1], tip) - robot.position(rollout.q[0], tip))
    (track,) = [t for t in plain.measures if t.kind == "opening"]
    assert track.curves[0].values[-1] == pytest.approx(way, abs=1e-4) == pytest.approx(0.12, abs=2e-3)
    recording = rollout.trajectory("a")
    assert recorded_motion(robot, tree, tip, "a", recording, mechanism=MECHANISMS["line"]).furniture == ()
    for names, opens_at in ((("approach", "hold", "way"), 0.6), (("approach", "approach", "hold"), None)):
        spans = list(zip(names, (0.0, 0.4, 0.6), (0.4, 0.6, 1.3), strict=True))
        later = replace(rollout, time=rollout.time + 7.0, phases=tuple((n, 7.0 + a, 7.0 + b) for n, a, b in spans))
        motion = recorded_motion(robot, tree, tip, "a", later, mechanism=MECHANISMS["line"])
        assert [(b.name, pytest.approx(b.start), pytest.approx(b.end)) for b in motion.phases] == spans
        assert (motion.furniture == ()) is (opens_at is None), names
        if opens_at is not None:
            moving = motion.furniture[0].times[motion.furniture[0].opening > 0.0]
            assert opens_at < moving[0] < opens_at + 0.05, names
