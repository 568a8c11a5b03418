"""Twenty mistakes of somebody who is new here: each is answered in one sentence that names the fix."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

import manip_learn as ml
from manip_learn.cli import main


class Hands(NamedTuple):
    """What a newcomer has at hand."""

    robot: ml.Robot
    features: ml.FrameJacobian
    constraint: ml.Constraint
    learner: ml.ConstraintLearner
    q: np.ndarray


@pytest.fixture(scope="module")
def hands() -> Hands:
    robot = ml.load_robot("planar3")
    features = ml.FrameJacobian(robot, "tip", axes="x y")
    return Hands(
        robot, features, ml.Constraint([[0, 1]], features), ml.ConstraintLearner(features), np.array([0.3, 0.8, 0.4])
    )


# what is written in Python, and words of the fix
WRITTEN: dict[str, tuple[Callable[[Hands], object], str]] = {
    "features before rows": (lambda h: ml.Constraint(h.features, [[0, 1]]), "Constraint(selection, features)"),
    "posture before constraint": (lambda h: ml.manipulability(h.q, h.constraint), "the constraint comes first"),
    "a gradient likewise": (lambda h: ml.manipulability_gradient(h.q, h.constraint), "the constraint comes first"),
    "the robot in place of the constraint": (
        lambda h: ml.ManipulabilityAscent(h.robot),
        "ManipulabilityAscent(constraint)",
    ),
    "fit(q, u)": (lambda h: h.learner.fit(np.ones((9, 3)), np.ones((9, 3))), "fit((time, q, u))"),
    "fit(q)": (lambda h: h.learner.fit(np.ones((9, 3))), "give (time, q)"),
    "fit of a file's name": (lambda h: h.learner.fit("demo.csv"), "load_demonstrations('demo.csv', robot)"),
    "the robot in place of features": (lambda h: ml.ConstraintLearner(h.robot), "FrameJacobian(robot, frame="),
    "the answer before it is there": (lambda h: h.learner.constraint_, "call learner.fit(demonstrations) first"),
    "the frame before the robot": (lambda h: ml.FrameJacobian("tip", h.robot), "FrameJacobian(robot, frame)"),
    "the robot before the files": (lambda h: ml.load_demonstrations(h.robot, "demo.csv"), "(paths, robot)"),
    "the length before the constraint": (lambda h: ml.motion(0.1, h.constraint), "motion(constraint, distance="),
    "a policy that takes nothing": (
        lambda h: ml.ResolvedRateController(h.constraint, null_policy=lambda: 0),
        "write lambda q: ...",
    ),
}
# what is typed, and words of the fix
TYPED: dict[str, tuple[str, str]] = {
    "a direction in one's own words": ("control planar3 held.json --along 0.1 --direction out", "'shown' or 'back'"),
    "and with nothing else named": ("control planar3 held.json --direction out", "'shown', as the recordings went, or"),
    "a replay of recordings without their robot": ("replay demo_01.csv", "name the robot before it"),
    "a replay of what is not there": ("replay run.npz", "check the path"),
    "a constraint in place of a rollout": ("replay planar3 held.json", "`manip-learn replay`"),
    "the file before the robot": ("control held.json planar3", "name the robot here"),
    "a recording in place of a constraint": ("control planar3 demo_01.csv", "`manip-learn learn ... --out FILE`"),
    "degrees": ("control planar3 held.json --start 17,46,23 --along 0.1", "give positions in rad, not in degrees"),
    "a name with a slip": ("inspect swayer", "did you mean 'sawyer'"),
    "an arm of an extra": ("inspect 'Lite 6'", "pip install 'manip_learn[descriptions]'"),
    "a flange in place of the tip": ("learn planar3 planar3_reach --frame tool0", "likely tips: tip"),
    "an axis too many": ("learn planar3 planar3_reach --axes xyzz", "use 'xyz', 'pose', 'planar', 'rotation'"),
}


@pytest.mark.parametrize("mistake", WRITTEN)
def test_in_python(mistake, hands):
    """One error of the library's own, in one line."""
    written, fix = WRITTEN[mistake]
    with pytest.raises(ml.ManipLearnError) as told:
        written(hands)
    assert fix in str(told.value) and "\n" not in str(told.value)


@pytest.mark.parametrize("mistake", TYPED)
def test_on_the_command_line(mistake, hands, tmp_path, monkeypatch, capsys):
    """Exit code 2, and one line on standard error."""
    monkeypatch.chdir(tmp_path)
    hands.constraint.save("held.json")
    Path("demo_01.csv").write_text("time,joint1,joint2,joint3\n0,0,0,0\n1,0.1,0.1,0.1\n")
    typed, fix = TYPED[mistake]
    assert main(shlex.split(typed)) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and fix in err
