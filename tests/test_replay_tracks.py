"""Tracks, marks, mechanisms, evidence, obstacles and warnings of a replay: the page's numbers are the library's own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from case import DATA
from task_sets import DATA as SHIPPED
from test_playback import data_in, unpacked, waving

import manip_learn as ml
from manip_learn.commands import tables
from manip_learn.commands.output import Answer
from manip_learn.constraint.features.frame_jacobian import RelativeFrameJacobian
from manip_learn.constraint.features.mechanism_rows import MechanismRows
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
    """A drawer, rows along the hand's own axes, a plane robot, a hinge, rows that turn as they move, and relative
    motion.
    """
    robot, planar = robot_of("sawyer"), robot_of("planar3")
    hand, seen_from = robot.frame("right_hand"), robot.frame("right_l2")
    here = robot.position(START, hand)[None]
    xyz, local, pose = (ml.FrameJacobian(robot, hand, *axes) for axes in (("xyz",), ("xyz", "local"), ("pose",)))
    hinge, turn = (
        MechanismRows(robot, "right_hand", rows, axis=[1.0, 0.0, 0.0], point=here[0] - [0.0, 0.0, 0.3])
        for rows in ("radial axial", "turn")
    )
    x, y, z = (np.diag(axis) for axis in np.eye(3))
    for rows, features, expected, axes, exact in (
        ([[0, 1, 0], [0, 0, 1]], xyz, [2, 1, 0, 0], None, {"free": x}),
        ([[0, 0, 1]], local, [1, 2, 0, 0], hand, {}),
        (np.eye(6)[[2, 3, 4]], pose, [1, 2, 2, 1], None, {"free_turns": z}),
        # a learnt row leaks by its uncertainty; with more, motion along x alone breaks it only without its rotation
        ([[1, 0, 0, 0, 0.09, 0]], pose, [1, 2, 0, 3], None, {}),
        ([[1, 0, 0, 0, 0.11, 0]], pose, [0, 3, 0, 3], None, {}),
        (np.eye(2), hinge, [2, 1, 0, 0], None, {"free": y, "held": x + z}),
        ([[1.0]], turn, [0, 3, 1, 2], None, {"held_turns": x}),
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
            np.testing.assert_allclose(projectors[name], matrix, atol=1e-9)


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
    """A rollout that grasps earlier waits at its start: nothing slows it there, and its following error is shown."""
    way = {"name": "way", "wanted": 0.1, "done": 0.1, "unit": "m", "stopped_by": None}
    limited, error = ("velocity-limited",) * len(rollout), np.full(len(rollout), 1e-3)
    early = replace(rollout, ways=({**way, "begins": 0.2},), status=limited, following_error=error)
    late = replace(rollout, ways=({**way, "begins": 0.5},))
    data = page_of(robot_of("sawyer"), {"early": early, "late": late}, tmp_path, align="grasp")
    waiting = data["rollouts"][0]
    assert data["zero"] == pytest.approx(0.5)
    assert waiting["status"] == [[0.0, "ok", "ok"], [pytest.approx(0.3), "velocity-limited", "slowed"]]
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


SCREW = {"type": "screw", "axis": (2.0 * AXIS).tolist(), "point": POINT.tolist(), "radius": RADIUS}
ANGLE = np.linspace(0.0, 2.0 * np.pi, 401)[:, None]
CIRCLE = np.array([np.cos(ANGLE) * [0.8, 0.0, -0.6], np.sin(ANGLE) * [0.0, 1.0, 0.0]])  # its parts across the axis


@pytest.mark.parametrize("pitch", [0.05, -0.08])
def test_a_screw_is_an_axis_and_a_helix_through_the_hand(pitch: float) -> None:
    """The axis is longer than the motion by a quarter or 0.06 m at each end, and 0.3 radii. The helix has at most 12
    turns.
    """
    held = POINT + RADIUS * CIRCLE.sum(axis=0) + pitch * ANGLE * AXIS
    axis, helix = mechanism_drawing(SCREW | {"pitch": pitch}, held).lines
    low, high = np.sort(pitch * ANGLE[[0, -1], 0])
    reach = max(0.25 * (high - low), 0.06) + 0.3 * RADIUS
    np.testing.assert_allclose(axis, [POINT + (low - reach) * AXIS, POINT + (high + reach) * AXIS], atol=1e-12)
    along = (helix - POINT) @ AXIS
    np.testing.assert_allclose(np.linalg.norm(helix - POINT - np.outer(along, AXIS), axis=1), RADIUS, atol=1e-12)
    np.testing.assert_allclose([along.min(), along.max()], [low, high], atol=1e-12)
    nearest = np.linalg.norm(held[:, None] - helix[None], axis=2).min(axis=1)
    assert nearest.max() < 0.02  # half the distance of two points of the helix
    assert len(mechanism_drawing(SCREW | {"pitch": 1e-4}, held).lines[1]) == 96 * 12 + 1


def test_planes_and_balls_are_drawn_around_the_motion() -> None:
    """A plane is a rectangle along the widest spread of the motion, and a quarter of it longer at each end; a ball has
    three great circles. Without a centre or an axis there is only the sentence.
    """
    oval = POINT + 0.4 * CIRCLE[0] + 0.1 * CIRCLE[1]
    drawn = mechanism_drawing(SCREW | {"type": "plane"}, oval)
    (patch,), (edge,) = drawn.patches, drawn.lines
    np.testing.assert_array_equal(edge, [*patch, patch[0]])
    np.testing.assert_allclose((patch - POINT) @ AXIS, 0.0, atol=1e-12)
    sides = np.sort(np.linalg.norm(np.diff(edge, axis=0), axis=1))
    np.testing.assert_allclose(sides, [0.2 + 0.4, 0.2 + 0.4, 1.2, 1.2], atol=1e-9)
    np.testing.assert_allclose(patch.mean(axis=0), POINT, atol=1e-9)
    for normal, ring in zip(np.eye(3), mechanism_drawing(SCREW | {"type": "ball"}, POINT[None]).lines, strict=True):
        np.testing.assert_allclose(np.linalg.norm(ring - POINT, axis=1), RADIUS, atol=1e-12)
        np.testing.assert_allclose((ring - POINT) @ normal, 0.0, atol=1e-12)
    for lacking in ({"type": "ball", "radius": 0.1}, {"type": "hinge", "axis": [0, 0, 1]}, {"type": "orientation"}):
        drawn = mechanism_drawing({**lacking, "sentence": "in words"}, POINT[None])
        assert not drawn.lines and not drawn.patches and drawn.sentence == "in words"


def test_bad_numbers_of_a_mechanism_are_named() -> None:
    """The error names the number that cannot be drawn."""
    for key, value in (("axis", [0, 1]), ("point", [0, 0, np.nan]), ("radius", "wide"), ("pitch", 2e9)):
        with pytest.raises(RecordingError, match=f"the mechanism's {key} must be") as caught:
            mechanism_drawing(SCREW | {key: value}, POINT[None])
        assert caught.value.code == "mechanism"


# ---- obstacles and warnings ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scene() -> ml.Scene:
    """One obstacle of each kind near an arm, and a floor well below it."""
    return ml.Scene.load(DATA / "one_of_each.json")


def test_an_assumed_floor_is_neither_drawn_nor_framed(robot_of, tmp_path: Path):
    """A floor that a plan assumes changes no picture, but a sentence names it; a stated floor is drawn."""
    robot, pose = robot_of("sawyer"), np.eye(4)
    pose[2, 3] = -3.0
    floor = {"name": "floor", "kind": "face", "pose": pose.tolist(), "assumed": True, "nearest": 0.12, "link": "a"}
    pages = []
    for around in ((), (floor,), ({**floor, "assumed": False},)):
        motion = replace(waving(robot), around=around)
        pages.append(data_in(ml.replay(robot, motion, tmp_path / "a.html").html))
    plain, assumed, stated = pages
    assert assumed["rollouts"][0]["around"] == []
    assert assumed["rollouts"][0]["clear"] == "floor (0.12 m from a) assumed: state what is there as a scene"
    assert all(assumed[key] == plain[key] for key in ("bounds", "outline", "floor"))
    assert stated["floor"] < plain["floor"]


def test_a_page_has_every_warning_of_the_terminal(run, monkeypatch: pytest.MonkeyPatch):
    """In the same words: of learning, of a task done again, of a rollout, and of a replay of files."""
    answers, show = list[Answer](), tables.show
    monkeypatch.setattr(
        tables, "show", lambda console, answer, *more: (answers.append(answer), show(console, answer, *more))
    )
    for words in (
        ["learn", "panda", SHIPPED / "panda_drawer_whole", "--out", "task.json"],
        ["learn", "panda", SHIPPED / "panda_drawer_mixed", "--out", "mixed.json"],
        ["repeat", "panda", "task.json", "--out", "run.npz"],
        ["control", "panda", "task.json", "--along", "0.1", "--plan", "--out", "short.npz"],
        ["control", "panda", "task.json", "--duration", "0.3"],
        ["replay", "run.npz", "short.npz"],
    ):
        code, out, _ = run(*words, "--html", "a.html")
        assert code == 0, words
        printed, notes = (" ".join(t.split()) for t in (out, " ".join(data_in(Path("a.html"))["notes"])))
        warnings = [text.removeprefix("warning: ") for text in (*answers[-1].warnings, *answers[-1].notes)]
        assert warnings, words
        for warning in (" ".join(text.split()) for text in warnings):
            assert warning in printed and warning in notes, words
    assert answers[1].warnings and answers[-2].warnings


# ---- what a plan keeps clear of --------------------------------------------------------------------------------------

READY = [0.0, -0.5, 0.0, 1.4, 0.0, 0.6, 0.0]


def test_a_rollout_keeps_the_obstacles(scene: ml.Scene, robot_of, tmp_path: Path):
    """Names, kinds, sizes and poses are in both file formats and on the page; damaged ones are refused."""
    sawyer = robot_of("sawyer")
    drawer = ml.Constraint([[0, 1, 0], [0, 0, 1]], ml.FrameJacobian(sawyer, "right_gripper_tip"))
    plan = ml.plan(drawer, ml.motion(drawer, along=-0.1), READY, candidates=48, scene=scene)
    around = {body["name"]: body for body in plan.rollout.around}
    kinds = {"floor": "face", "box": "box", "ball": "sphere", "post": "cylinder", "wedge": "mesh"}
    assert {name: body["kind"] for name, body in around.items()} == kinds
    assert np.array(around["floor"]["pose"])[2, 3] == pytest.approx(-0.9)
    assert len(around["wedge"]["faces"]) == 4 and not any(body["assumed"] for body in around.values())
    for name in ("a.npz", "a.csv"):
        assert ml.Rollout.load(plan.save(tmp_path / name), sawyer).around == plan.rollout.around
    page = data_in(ml.replay(sawyer, {"plan": plan.rollout}, tmp_path / "a.html", open_browser=False).html)
    drawn = {body["name"]: body for body in page["rollouts"][0]["around"]}
    assert drawn["box"]["size"] == [0.3, 0.2, 0.1] and drawn["post"]["size"] == [0.05, 0.4]
    places = {name: np.reshape(body["pose"], (4, 4))[:3, 3].tolist() for name, body in drawn.items()}
    assert places["box"] == [0.3, 0.9, 0.2] and places["ball"] == [0.3, -0.9, 0.2]
    assert [name for name, body in drawn.items() if body["mesh"]] == ["wedge"]
    file = tmp_path / "a.csv"
    file.write_text(file.read_text().replace('"kind": "sphere"', '"kind": "cloud"'))
    with pytest.raises(RecordingError):
        ml.Rollout.load(file, sawyer)
