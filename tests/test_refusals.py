"""What is refused: mistakes in what is typed or written, each with its code and one sentence that names the fix."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from case import rows_in
from test_motion import LEARNT, learnt

import manip_learn as ml
from manip_learn.cli import main

# what is written in Python, and words of the fix
WRITTEN: dict[str, tuple[Callable[[SimpleNamespace], object], str]] = {
    "features before rows": (lambda h: ml.Constraint(h.features, [[0, 1]]), "Constraint(selection, features)"),
    "posture before constraint": (lambda h: ml.manipulability(h.q, h.constraint), "the constraint comes first"),
    "a gradient likewise": (lambda h: ml.manipulability_gradient(h.q, h.constraint), "the constraint comes first"),
    "robot for constraint": (lambda h: ml.ManipulabilityAscent(h.robot), "ManipulabilityAscent(constraint)"),
    "fit(q, u)": (lambda h: h.learner.fit(np.ones((9, 3)), np.ones((9, 3))), "fit((time, q, u))"),
    "fit(q)": (lambda h: h.learner.fit(np.ones((9, 3))), "give (time, q)"),
    "fit of a file's name": (lambda h: h.learner.fit("demo.csv"), "load_demonstrations('demo.csv', robot)"),
    "the robot in place of features": (lambda h: ml.ConstraintLearner(h.robot), "FrameJacobian(robot, frame="),
    "the answer before it is there": (lambda h: h.learner.constraint_, "call learner.fit(demonstrations) first"),
    "the frame before the robot": (lambda h: ml.FrameJacobian("tip", h.robot), "FrameJacobian(robot, frame)"),
    "the robot before the files": (lambda h: ml.load_demonstrations(h.robot, "demo.csv"), "(paths, robot)"),
    "length before constraint": (lambda h: ml.motion(0.1, h.constraint), "motion(constraint, distance="),
    "a policy of nothing": (lambda h: ml.ResolvedRateController(h.constraint, null_policy=lambda: 0), "lambda q: ..."),
}


@pytest.mark.parametrize("mistake", WRITTEN)
def test_in_python(mistake):
    """Each mistake gives one error of the library, in one line, which names the fix."""
    h = SimpleNamespace(robot=ml.load_robot("planar3"), q=np.array([0.3, 0.8, 0.4]))
    h.features = ml.FrameJacobian(h.robot, "tip", axes="x y")
    h.constraint, h.learner = ml.Constraint([[0, 1]], h.features), ml.ConstraintLearner(h.features)
    written, fix = WRITTEN[mistake]
    with pytest.raises(ml.ManipLearnError) as error:
        written(h)
    assert fix in str(error.value) and "\n" not in str(error.value)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A folder of files that are as they should be, or not; and what was learnt, each beside its robot."""
    folder = tmp_path_factory.mktemp("files")
    sawyer = ml.load_robot("sawyer")
    held = ml.Constraint([[0, 1, 0], [0, 0, 1]], ml.FrameJacobian(sawyer, "right_gripper_tip"))
    held.save(folder / "held.json")
    start = [0, -1, 0, 1.5, 0, 1, 0]
    ml.simulate(sawyer, ml.ResolvedRateController(held), start, duration=0.1).save(folder / "run.npz")
    (folder / "text.urdf").write_text("this is no robot\n", encoding="utf-8")
    (folder / "demo_01.csv").write_text("time,joint1,joint2,joint3\n0,0,0,0\n1,0.1,0.1,0.1\n")
    places = {name: learnt(name)[0].save(folder / f"{name}.json") for name in ("drawer", "door", "table")}
    return folder, {name: f"{LEARNT[name][1]} '{path}'" for name, path in places.items()}


@pytest.mark.parametrize(("typed", "code", "words"), rows_in("typed_mistakes.txt"))
def test_on_the_command_line(typed, code, words, files, monkeypatch, capsys):
    """Exit code 2, one line on standard error without a traceback, and no file; under --json one document too, with the
    code and the sentence; without it nothing on standard output.
    """
    folder, learnt_ = files
    monkeypatch.chdir(folder)
    before = {path: path.is_file() and path.read_bytes() for path in folder.iterdir()}
    line = shlex.split(typed.format(**learnt_))
    assert main([*line, "--json"]) == 2
    out, err = capsys.readouterr()
    error = json.loads(out)["error"]
    assert (error["code"], err) == (code, f"manip-learn: {error['message']}\n"), err
    assert all(part in err for part in words.split(" ...")), err
    assert err.count("\n") == 1 and "internal error" not in err and "Traceback" not in err
    if code == "usage":
        assert main(line) == 2 and capsys.readouterr() == ("", err)
    assert {path: path.is_file() and path.read_bytes() for path in folder.iterdir()} == before
