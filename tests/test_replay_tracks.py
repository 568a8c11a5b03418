"""Tracks, marks, mechanisms and evidence of a replay: the page's numbers are the library's own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from test_playback import data_in, unpacked

import manip_learn as ml
from manip_learn.constraint.features import MechanismRows, RelativeFrameJacobian
from manip_learn.errors import RecordingError, TargetError
from manip_learn.playback.replay_page import evidence_of
from manip_learn.playback.scene_data import held_directions, mechanism_drawing
from manip_learn.recordings.velocities import derive_velocities

START = np.array([0.3, -0.9, 0.2, 1.6, 0.1, 0.7, 0.4])
TARGET = (0.6, 0.27, 0.35)


def curves_of(rollout: dict, kind: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Curve -> times and values of a track in the page."""
    measures = rollout["measures"]
    clocks = [unpacked(clock) for clock in measures["clocks"]]
    track = next(t for t in measures["tracks"] if t["kind"] == kind)
    times = {c["name"]: clocks[c["clock"]] if "clock" in c else unpacked(c["times"], "<f4") for c in track["curves"]}
    return {c["name"]: (times[c["name"]], unpacked(c["values"], "<f4")) for c in track["curves"]}


@pytest.fixture
def shown(tmp_path):
    """The only rollout of a page."""
    return lambda robot, motion, **more: page_of(robot, motion, tmp_path, **more)["rollouts"][0]


def page_of(robot, motion, folder, **more):
    """The data of a page."""
    motions = motion if isinstance(motion, dict) else {"demo": motion}
    return data_in(ml.replay(robot, motions, folder / "a.html", **more).html)


@pytest.fixture(scope="module")
def drawer(robot_of) -> ml.Constraint:
    """Two rows of a drawer, held by hand."""
    robot = robot_of("sawyer")
    rows = np.array([[-0.42, 0.91, 0.0], [0.0, 0.0, 1.0]])
    return ml.Constraint(rows, ml.FrameJacobian(robot, "right_gripper_tip", "xyz"), {"kind": "motion-constrained"})


@pytest.fixture(scope="module")
def rollout(robot_of, drawer) -> ml.Rollout:
    """One second towards a target."""
    controller = ml.ResolvedRateController(drawer, ml.PointAttractor(TARGET), ml.ManipulabilityAscent(drawer))
    return ml.simulate(robot_of("sawyer"), controller, START, 1.0, 0.01)


def test_fit_uses_the_constraint_of_each_phase(drawer, rollout, shown):
    """Within a phase its own constraint counts, outside the first; without one, or if b != 0, there is no fit."""
    robot = drawer.features.robot
    demo = ml.Trajectory(rollout.time, rollout.q, rollout.u, robot.joint_names, "demo")
    other = ml.Constraint([[1.0, 0.0, 0.0]], drawer.features)
    phases = (("demo", 0.0, 0.3, 0), ("demo", 0.4, 0.6, 1), ("demo", 0.7, 0.8, 2))
    ((times, shares),) = curves_of(shown(robot, demo, phases=phases, constraint=(drawer, other)), "fit").values()
    for t, share in zip(times, shares, strict=True):
        i = int(np.argmin(np.abs(rollout.time - t)))
        if 0.7 <= t <= 0.8:
            assert np.isnan(share)
        elif not np.isnan(share):
            A, u = (other if 0.4 <= t <= 0.6 else drawer)(rollout.q[i]), rollout.u[i]
            assert share == pytest.approx(np.linalg.norm(np.linalg.pinv(A) @ A @ u) / np.linalg.norm(u), rel=1e-5)
    imposed = ml.Constraint(drawer.selection, drawer.features, {"kind": "self-imposed"})
    assert "fit" not in [track["kind"] for track in shown(robot, demo, constraint=imposed)["measures"]["tracks"]]


def test_recordings_without_velocities_show_derived_ones(robot_of, rollout, shown):
    """They are those that the learner derives, at their own times; too few samples have none."""
    robot = robot_of("sawyer")
    bare = ml.Trajectory(rollout.time + 3.0, rollout.q, None, robot.joint_names, "demo")  # on a clock of its own
    derived = derive_velocities(bare, robot)
    times, values = curves_of(shown(robot, bare), "velocity")[robot.joint_names[1]]
    np.testing.assert_allclose(times, derived.time - 3.0)
    np.testing.assert_allclose(values, derived.u[:, 1] / robot.velocity_limit[1], rtol=1e-6, atol=1e-7)
    page = shown(robot, bare[3.0:3.025])
    assert [t["kind"] for t in page["measures"]["tracks"]] == ["position"]


def test_directions_held_and_free(robot_of):
    """A drawer, rows along the hand's own axes, a plane robot, rows that turn as they move, and relative motion."""
    robot, planar = robot_of("sawyer"), robot_of("planar3")
    hand, seen_from = robot.frame("right_hand"), robot.frame("right_l2")
    here = robot.position(START, hand)[None]
    xyz, local, pose = (ml.FrameJacobian(robot, hand, *axes) for axes in (("xyz",), ("xyz", "local"), ("pose",)))
    about_x = MechanismRows(robot, "right_hand", "turn", axis=[1.0, 0.0, 0.0], point=[0.0, 0.0, 0.0])
    x, z = np.diag([1.0, 0.0, 0.0]), np.diag([0.0, 0.0, 1.0])
    for rows, features, expected, axes, exact in (
        ([[0, 1, 0], [0, 0, 1]], xyz, [2, 1, 0, 0], None, {"free": x}),
        ([[0, 0, 1]], local, [1, 2, 0, 0], hand, {}),
        (np.eye(6)[[2, 3, 4]], pose, [1, 2, 2, 1], None, {"free_turns": z}),
        # a learnt row leaks by its uncertainty; with more, motion along x alone breaks it only without its rotation
        ([[1, 0, 0, 0, 0.09, 0]], pose, [1, 2, 0, 3], None, {}),
        ([[1, 0, 0, 0, 0.11, 0]], pose, [0, 3, 0, 3], None, {}),
        ([[1.0]], about_x, [0, 3, 1, 2], None, {"held_turns": x}),
        (np.eye(3)[:1], ml.FrameJacobian(planar, "tip", "planar"), [1, 1, 0, 1], None, {}),
        ([[0, 0, 1]], RelativeFrameJacobian(robot, hand, seen_from, "xyz"), [1, 2, 0, 0], seen_from, {}),
    ):
        rows = np.array(rows, dtype=float)
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        directions = held_directions(ml.Constraint(rows, features), here)
        names = "held", "free", "held_turns", "free_turns"
        projectors = {name: np.reshape(getattr(directions, name), (-1, 3, 3))[0] for name in names}
        assert [round(np.trace(P)) for P in projectors.values()] == expected and directions.axes == axes, rows
        for name, matrix in exact.items():
            np.testing.assert_allclose(projectors[name], matrix, atol=1e-12)


@pytest.mark.parametrize("rows", ["radial axial", "turn-1 turn-2 slide-1 slide-2 slide"])
def test_a_hinge_leaves_its_tangent_free_everywhere(robot_of, rows):
    """On each place of the circle, near the axis too, the tangent is free and what is across it is held."""
    robot = robot_of("sawyer")
    axis, point = np.array([0.0, 0.6, 0.8]), np.array([0.4, 0.1, 0.3])
    features = MechanismRows(robot, "right_hand", rows, axis=axis, point=point)
    arm = np.cross(axis, [1.0, 0.0, 0.0])
    places = np.array([point + r * arm + 0.1 * axis for r in (0.02, 0.3, 1.5)])
    directions = held_directions(ml.Constraint(np.eye(features.n_rows), features), places)
    assert directions is not None and directions.free.shape == (3, 3, 3)
    tangent = np.cross(axis, arm)
    for held, free in zip(directions.held, directions.free, strict=True):
        np.testing.assert_allclose(free, np.outer(tangent, tangent), atol=1e-9)
        np.testing.assert_allclose(held, np.eye(3) - free, atol=1e-9)
    if "turn-1" in rows:
        np.testing.assert_allclose(directions.free_turns[0], np.outer(axis, axis), atol=1e-9)


def test_the_target_is_where_the_task_wants_the_tip(drawer, rollout, shown, tmp_path):
    """It comes from the rollout's file or the argument: a place, a pose, values of the rows, or in a moving frame."""
    robot = drawer.features.robot
    saved = ml.Rollout.load(rollout.save(tmp_path / "r.npz"), robot)
    target_of = lambda **given: shown(robot, saved, **given)["marks"][0]["target"]  # noqa: E731
    assert target_of() == {"carrier": None, "point": pytest.approx(TARGET)}
    pose = pin.SE3(np.eye(3), np.array([0.4, 0.5, 0.6])).homogeneous
    for given, point in (([0.1, 0.2, 0.3], [0.1, 0.2, 0.3]), (pose, [0.4, 0.5, 0.6])):
        assert target_of(target=given)["point"] == point
    rows = drawer.selection @ np.array(TARGET)
    point = np.array(target_of(target=rows)["point"])
    np.testing.assert_allclose(drawer.selection @ point, rows, atol=1e-12)
    along, start = np.linalg.svd(drawer.selection)[2][2], robot.position(rollout.q[0], drawer.features.frame)
    assert along @ point == pytest.approx(along @ start)  # the free direction keeps its start
    seen = ml.Constraint(np.eye(3), RelativeFrameJacobian(robot, "right_gripper_tip", "right_l2", "xyz"))
    carried = target_of(constraint=seen, target=[0.1, 0.0, 0.2])
    assert carried["point"] == [0.1, 0.0, 0.2] and carried["carrier"]["joint"] == robot.frame("right_l2").parent_joint
    for wrong in ("here", [np.nan, 0, 0]):
        with pytest.raises(TargetError, match="target to show"):
            target_of(target=wrong)


def test_a_rollout_shows_its_own_constraint_and_mechanism(drawer, tmp_path):
    """The evidence, mechanism and frame that a rollout's constraint keeps are in the page, also from its file."""
    robot = drawer.features.robot
    line = {"type": "line", "axis": [0.91, 0.42, 0.0], "point": [0.6, 0.2, 0.3], "sentence": "a line"}
    learnt = {"kind": "motion-constrained", "sentence": "moves freely", "facts": {"gap": "12"}, "mechanism": line}
    constraint = ml.Constraint(drawer.selection, drawer.features, learnt)
    law = ml.ResolvedRateController(constraint, ml.PointAttractor(TARGET))
    moved = ml.Rollout.load(ml.simulate(robot, law, START, 0.1, 0.01).save(tmp_path / "r.csv"), robot)
    data = page_of(robot, moved, tmp_path)
    assert data["mechanisms"][0]["type"] == "line" and data["robot"]["tip"] == "right_gripper_tip"
    assert data["evidence"]["headline"] == "moves freely" and data["evidence"]["facts"] == [["gap", "12"]]
    bare = page_of(robot, replace(moved, constraint=None), tmp_path)
    assert bare["mechanisms"] == bare["rollouts"][0]["marks"] == [] and bare["evidence"] is None


def test_a_rollout_that_waits_is_ok_and_keeps_its_tracks(robot_of, rollout, tmp_path):
    """One that grasps earlier waits at its start: nothing slows it there, and its following error is still shown."""
    way = {"name": "way", "wanted": 0.1, "done": 0.1, "unit": "m", "stopped_by": None}
    limited, error = ("velocity-limited",) * len(rollout), np.full(len(rollout), 1e-3)
    early = replace(rollout, ways=({**way, "begins": 0.2},), status=limited, following_error=error)
    late = replace(rollout, ways=({**way, "begins": 0.5},))
    named = {"early": early, "late": late, "bare": replace(early, status=())}
    data = page_of(robot_of("sawyer"), named, tmp_path, align="grasp")
    waiting, _, bare = data["rollouts"]
    assert data["zero"] == pytest.approx(0.5)
    assert waiting["status"] == [[0.0, "ok", "ok"], [pytest.approx(0.3), "velocity-limited", "slowed"]]
    assert bare["status"] == []
    times, errors = curves_of(waiting, "following-error")[""]
    np.testing.assert_allclose(times[[0, 1, -1]], [0.0, 0.3, 0.3 + rollout.time[-1]])
    np.testing.assert_allclose(errors, 1e-3)


def test_evidence_in_words():
    """The page has the report's facts, verdicts and warnings; missing or damaged parts are left out, long ones cut."""
    rows = [{"strength": 261.0, "p_value": 0.005, "state": "held"}, {"strength": 2e7, "state": "untried"}]
    evidence = evidence_of({"facts": {"gap": "3,940"}, "row_evidence": rows, "warnings": ["w"]})
    assert evidence["facts"] == [["gap", "3,940"]] and evidence["warnings"] == ["w"] and evidence["kind"] == ""
    assert evidence["rows"] == [
        ["row 1", "held", "261 times", "p = 0.005"],
        ["row 2", "not tried: nothing moved along it", "over a million times", ""],
    ]
    assert "b is not 0" in evidence_of({"kind": "self-imposed"})["kind"]
    damaged = {"facts": [3], "rows": 3, "row_evidence": "x", "warnings": None, "odd_trajectories": [3]}
    assert evidence_of(damaged)["facts"] == [] and evidence_of({})["headline"] == ""
    long = evidence_of({"notes": ["x" * 3000] * 100, "odd_trajectories": [{"trajectory": "a", "reason": "b"}, ("c",)]})
    assert [len(note) for note in long["notes"]] == [2000] * 60 and long["odd"] == [["a", "b"]]


# ---- what is drawn of a mechanism ------------------------------------------------------------------------------------

AXIS, POINT, RADIUS = np.array([0.6, 0.0, 0.8]), np.array([0.3, -0.1, 0.2]), 0.4
FIRST = np.array([0.8, 0.0, -0.6])  # across the axis
SECOND = np.cross(AXIS, FIRST)


def around(angle: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Points at a radius from the axis, shape (n, 3)."""
    turned = np.cos(angle)[:, None] * FIRST + np.sin(angle)[:, None] * SECOND
    return POINT + RADIUS * turned + along[:, None] * AXIS


def described(kind: str, **more: object) -> dict[str, object]:
    """A mechanism's dictionary; its axis is twice as long as it need be."""
    return {"type": kind, "axis": (2.0 * AXIS).tolist(), "point": POINT.tolist(), **more}


def in_the_axes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance from the axis, angle about it, and place along it."""
    arm = points - POINT
    x, y = arm @ FIRST, arm @ SECOND
    return np.hypot(x, y), np.arctan2(y, x), arm @ AXIS


@pytest.mark.parametrize(("kind", "heights"), [("hinge", [0.1]), ("other", [-0.1, 0.3]), ("line", [])])
def test_an_axis_is_longer_than_the_motion_and_circles_lie_on_it(kind: str, heights: list[float]) -> None:
    """The axis is longer than the motion by a quarter at each end, and 0.3 radii. A hinge has a circle in the middle, a
    cylinder has one at each end of the motion, a line has none.
    """
    held = around(np.linspace(0.2, 1.2, 30), np.linspace(-0.1, 0.3, 30))
    axis, *circles = mechanism_drawing(described(kind, radius=RADIUS), held).lines
    reach = 0.25 * 0.4 + 0.3 * RADIUS
    np.testing.assert_allclose(axis, [POINT - (0.1 + reach) * AXIS, POINT + (0.3 + reach) * AXIS], atol=1e-12)
    for height, circle in zip(heights, circles, strict=True):
        radius, angle, along = in_the_axes(circle)
        np.testing.assert_allclose([radius, along], np.outer([RADIUS, height], np.ones(len(circle))), atol=1e-12)
        np.testing.assert_allclose(np.abs(np.diff(np.unwrap(angle))), np.deg2rad(3.75), atol=1e-9)
        np.testing.assert_allclose(circle[0], circle[-1], atol=1e-12)


@pytest.mark.parametrize("pitch", [0.05, -0.08])
def test_a_screw_is_a_helix_through_the_hand(pitch: float) -> None:
    """The helix goes through the hand and ends where the motion does, right- and left-handed, with at most 12 turns."""
    angle = np.linspace(0.5, 4.0, 400)
    held = around(angle, pitch * angle)
    _, helix = mechanism_drawing(described("screw", radius=RADIUS, pitch=pitch), held).lines
    radius, turned, along = in_the_axes(helix)
    np.testing.assert_allclose(radius, RADIUS, atol=1e-12)
    np.testing.assert_allclose([along.min(), along.max()], np.sort(pitch * angle[[0, -1]]), atol=1e-12)
    np.testing.assert_allclose(np.diff(along), pitch * np.diff(np.unwrap(turned)), atol=1e-9)
    nearest = np.linalg.norm(held[:, None] - helix[None], axis=2).min(axis=1)
    assert nearest.max() < 0.02  # half the distance of two points of the helix
    _, turns, _ = in_the_axes(mechanism_drawing(described("screw", radius=RADIUS, pitch=1e-4), held).lines[1])
    assert np.ptp(np.unwrap(turns)) == pytest.approx(2.0 * np.pi * 12.0)


def test_a_table_is_a_patch_around_the_motion() -> None:
    """Its corners lie in the plane, its sides along the widest spread of the motion, and a quarter of it longer."""
    angle = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)[:, None]
    widest = np.cos(0.3) * FIRST + np.sin(0.3) * SECOND
    held = POINT + (0.4 - 0.4 * np.cos(angle)) * widest + 0.1 * np.sin(angle) * np.cross(AXIS, widest)
    drawn = mechanism_drawing(described("plane"), held)
    (patch,), (edge,) = drawn.patches, drawn.lines
    np.testing.assert_array_equal(edge, [*patch, patch[0]])
    np.testing.assert_allclose((patch - POINT) @ AXIS, 0.0, atol=1e-12)
    sides = np.sort(np.linalg.norm(np.diff(edge, axis=0), axis=1))
    np.testing.assert_allclose(sides, [0.2 + 0.4, 0.2 + 0.4, 1.2, 1.2], atol=1e-9)
    np.testing.assert_allclose(patch.mean(axis=0), POINT + 0.4 * widest, atol=1e-9)


def test_a_ball_is_three_circles_and_an_unknown_place_is_not_drawn() -> None:
    """A ball is three great circles. Without a centre or an axis there is only the sentence."""
    circles = mechanism_drawing(described("ball", radius=RADIUS), POINT[None]).lines
    for normal, circle in zip(np.eye(3), circles, strict=True):
        np.testing.assert_allclose(np.linalg.norm(circle - POINT, axis=1), RADIUS, atol=1e-12)
        np.testing.assert_allclose((circle - POINT) @ normal, 0.0, atol=1e-12)
    for lacking in ({"type": "ball", "radius": 0.1}, {"type": "hinge", "axis": [0, 0, 1]}, {"type": "orientation"}):
        drawn = mechanism_drawing({**lacking, "sentence": "in words"}, POINT[None])
        assert not drawn.lines and not drawn.patches and drawn.sentence == "in words"


@pytest.mark.parametrize(
    ("key", "value"),
    [("axis", [0, 1]), ("point", [0, 0, np.nan]), ("radius", "wide"), ("pitch", 2e9), ("point", [1e9, 0, 0])],
)
def test_bad_numbers_are_named(key: str, value: object) -> None:
    """The error names the number that it cannot use."""
    with pytest.raises(RecordingError, match=f"the mechanism's {key} must be") as caught:
        mechanism_drawing({**described("hinge", radius=RADIUS), key: value}, POINT[None])
    assert caught.value.code == "mechanism"
