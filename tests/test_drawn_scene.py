"""What a page draws and says: what was learnt and stated, nothing that an arm goes through, and every warning."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_playback import data_in, waving

import manip_learn as ml
from manip_learn.cli import main
from manip_learn.commands import tables
from manip_learn.commands.output import Answer
from manip_learn.errors import RecordingError

DATA = Path(__file__).resolve().parents[1] / "examples" / "data"


@pytest.fixture(scope="module")
def scene() -> ml.Scene:
    """One obstacle of each kind near an arm, and a floor well below it."""
    vertices, faces = [[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]
    return ml.Scene(
        floor=-0.9,
        boxes=[ml.Box((0.3, 0.2, 0.1), (0.3, 0.9, 0.2), "box")],
        spheres=[ml.Sphere(0.1, (0.3, -0.9, 0.2), "ball")],
        cylinders=[ml.Cylinder(0.05, 0.4, (-0.6, 0.5, 0.2), "post")],
        meshes=[ml.Mesh((vertices, faces), (-0.6, -0.5, 0.2), "wedge")],
    )


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


def test_a_page_has_every_warning_of_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    """In the same words: of learning, of a task done again, of a rollout, and of a replay of files."""
    page, task, run, short = (tmp_path / name for name in ("a.html", "task.json", "run.npz", "short.npz"))
    answers, show = list[Answer](), tables.show
    monkeypatch.setattr(
        tables, "show", lambda console, answer, *more: (answers.append(answer), show(console, answer, *more))
    )
    for words in (
        ["learn", "panda", str(DATA / "panda_drawer_whole"), "--out", str(task)],
        ["learn", "panda", str(DATA / "panda_drawer_mixed"), "--out", str(tmp_path / "mixed.json")],
        ["repeat", "panda", str(task), "--out", str(run)],
        ["control", "panda", str(task), "--along", "0.1", "--plan", "--out", str(short)],
        ["control", "panda", str(task), "--duration", "0.3"],
        ["replay", str(run), str(short)],
    ):
        assert main([*words, "--html", str(page)]) == 0, words
        printed, notes = (" ".join(t.split()) for t in (capsys.readouterr().out, " ".join(data_in(page)["notes"])))
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
