"""What is refused: mistakes in what is typed or written, each with its code and one sentence that names the fix."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from test_motion import LEARNT, learnt

import manip_learn as ml
from manip_learn.cli import main

FRAME = "--frame right_gripper_tip"
LEARN, WATCH = f"learn sawyer sawyer_drawer {FRAME}", "control sawyer held.json"
# what is typed, the code, and words of the sentence
TYPED = [
    ("warm-up", "usage", "warm-up has been removed ...leave the command out"),
    ("lern", "usage", ""),
    ("inspect sawyr", "unknown-name", "did you mean 'sawyer'"),
    ("inspect .", "unknown-name", ""),
    ("inspect text.urdf", "not-xml", ""),
    (f"learn sawyer {FRAME}", "usage", ""),
    (f"learn sawyer nothing.csv {FRAME}", "missing-file", "nothing.csv: there is no such file; check the path"),
    ("learn sawyer sawyer_drawr", "missing-file", "no such file; check the path, or did you mean 'sawyer_drawer', "),
    ("replay sawyer sawyer_drawr", "missing-file", "did you mean 'sawyer_drawer', "),
    ("export sawyer sawyer_drawer --out a.xyz", "output", "ending says the format"),
    ("export sawyer sawyer_drawer --out a.mcap --to csv", "output", "ending says the format"),
    ("export sawyer sawyer_drawer --out a --to hdf5", "output", "--to must be one of"),
    ("export sawyer sawyer_drawer --out a.csv", "output", "name a folder"),
    ("learn sawyer sawyer_drawer --frame right_griper_tip", "unknown-name", "right_gripper_tip"),
    ("learn baxter sawyer_drawer", "frame", "--frame left_gripper; likely tips: left_gripper (0.271 m from its last"),
    (f"{LEARN} --axes 'x w'", "features", ""),
    ("learn planar3 planar3_reach --axes xyzz", "features", "use 'xyz', 'pose', 'planar', 'rotation'"),
    ("learn planar3 planar3_reach --frame tool0", "unknown-name", "likely tips: tip"),
    (f"{LEARN} --constraints 4", "number-of-constraints", "--constraints must be between 1 and 3 ...got 4"),
    (f"{LEARN} --estimator best", "features", "--estimator must be ...best"),
    (f"{LEARN} --out .", "output", ""),
    (f"{LEARN} --out a.json --html ./a.json", "output", "another option writes"),
    ("learn nobody x.csv --out gone/x", "output", "make the folder first, mkdir -p '"),
    ("demo --robot nobody --out gone/x", "output", "make the folder first, mkdir -p '"),
    ("control sawyer text.urdf", "constraint-file", ""),
    ("control planar3 held.json", "constraint-file", ""),
    ("control planar3 demo_01.csv", "constraint-file", "`manip-learn learn ... --out FILE`"),
    ("control held.json planar3", "not-xml", "name the robot here"),
    (f"{WATCH} --target 0.1,0.2,0.3,0.4", "target", ""),
    (f"{WATCH} --start 0,0", "posture", ""),
    (f"{WATCH} --start 90,0,0,0,0,0,0", "target", "give positions in rad, not in degrees"),
    (f"{WATCH} --policy up", "input", ""),
    (f"{WATCH} --duration -1", "posture", ""),
    (f"{WATCH} --along 0.1 --direction out", "target", "'shown' or 'back'"),
    (f"{WATCH} --direction out", "target", "'shown', as the recordings went, or"),
    ("control {drawer} --turn 40", "constraint", "slides and does not turn (a line along ...use --along METRES"),
    ("control {door} --along 0.1", "constraint", "use --turn DEGREES"),
    ("control {table} --along 0.1", "constraint", "2 directions free ...--direction "),
    ("control {drawer} --along 0.1 --target 0.1,0.2,0.3", "target", "give one of them"),
    ("replay sawyer drawer.json", "not-a-recording", "task file of `manip-learn learn`"),
    ("control {drawer} --target 0.1,0.2", "target", "3 numbers (x, y, z), got shape (2,) ...--rows held"),
    ("control {drawer} --target 0.1,0.2,0.3 --rows some", "target", "--rows must be all or held, not 'some'"),
    ("control {drawer} --along 0", "target", "0"),
    ("control {drawer} --along 3", "target", "3 m is longer than the demonstrations (0.2 ...--beyond-shown"),
    ("control {drawer} --along 3 --beyond-shown --check --out run.npz", "not-reached", " of 3.000 m: stopped by "),
    ("control {drawer} --along 0.1 --plan --policy zero", "target", "leave --policy"),
    ("control {drawer} --along 0.1 --seed 2", "target", "go with --plan"),
    ("control {door} --target 0.4,0.1", "target", "three finite numbers"),
    ("replay nothing.npz", "missing", "check the path"),
    ("replay sawyer", "recording", "at least one rollout"),
    ("replay sawyer text.urdf", "no-time", ""),
    ("replay demo_01.csv", "recording", "name the robot before it"),
    ("replay planar3 held.json", "not-a-recording", "`manip-learn replay`"),
    ("replay run.npz --constraint run.npz", "constraint-file", "`manip-learn learn ... --out FILE`"),
    ("demo --robot panda --no-browser", "unknown-name", ""),
    ("demo --out text.urdf/here --no-browser", "output", ""),
]  # fmt: skip


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


@pytest.mark.parametrize(("typed", "code", "words"), TYPED, ids=[row[0] for row in TYPED])
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
