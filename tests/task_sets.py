"""Recordings of tasks: those that are shipped, and those that the scripts beside the examples generate."""

from __future__ import annotations

import importlib
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import manip_learn as ml

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
DATA = EXAMPLES / "data"
LOCKED = {"panda": ("panda_finger_joint1", "panda_finger_joint2")}
Truth = dict[str, Any]


def arm(name: str) -> ml.Robot:
    """A robot by its name, its fingers locked."""
    return ml.load_robot(name, locked=LOCKED.get(name, ()))


@cache
def generated(
    kind: str, robot: str, seed: int, n: int, whole: bool = True, *, noise: float = 1e-4, tilt: float = 0.0
) -> tuple[Truth, list[ml.Trajectory]]:
    """Truth and recordings, positions only, without joint names; made once in a run of the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        make_set = importlib.import_module("make_recordings.kinematic_sets").make_set
        motions, truth = make_set(kind, robot, seed, n, noise=noise, whole=whole, tilt=tilt)
    return truth, [ml.Trajectory(t, q, name=f"demo_{i}") for i, (t, q) in enumerate(motions)]


@cache
def moving(
    kind: str, robot: str, seed: int, n: int, whole: bool = True, tilt: float = 0.0
) -> tuple[ml.FrameJacobian, list[ml.Trajectory], Truth]:
    """Rows of the tip's position, generated recordings with velocities, and their truth."""
    truth, made = generated(kind, robot, seed, n, whole, tilt=tilt)
    features = ml.FrameJacobian(arm(robot), truth["tip"], "xyz")
    built = features.robot
    named = [ml.Trajectory(t.time, t.q, None, built.joint_names, t.name) for t in made]
    return features, [ml.derive_velocities(t, built) for t in named], truth


def true_rows(truth: Truth, mechanism: int = 0) -> np.ndarray:
    """Rows of the position that a mechanism holds, in the world's axes."""
    rows = np.array(truth["mechanisms"][mechanism]["rows"])[:, :3]
    return rows[np.linalg.norm(rows, axis=1) > 0.5]


def learnt(robot: str, tip: str, demos: list[ml.Trajectory], axes: str = "xyz") -> ml.ConstraintLearner:
    """With rows in the world's and in the tool's axes, as the command line does."""
    built = arm(robot)
    return ml.ConstraintLearner([ml.FrameJacobian(built, tip, axes, frame) for frame in ("world", "local")]).fit(demos)


@cache
def shipped(folder: str) -> tuple[Truth, ml.Demonstrations]:
    """Truth and recordings of a folder that is shipped."""
    truth = json.loads((DATA / folder / "truth.json").read_text(encoding="utf-8"))
    return truth, ml.load_demonstrations(sorted((DATA / folder).glob("*.csv")), arm(truth["robot"]))


@cache
def learnt_from(folder: str) -> ml.ConstraintLearner:
    """What is learnt from a shipped folder, once in a run of the tests."""
    truth, demos = shipped(folder)
    return learnt(truth["robot"], truth["tip"], list(demos))


@cache
def sawyer_drawer() -> tuple[ml.Robot, ml.Demonstrations, ml.ConstraintLearner]:
    """The Sawyer, six of the shipped recordings of its drawer, and what is learnt from them, once in a run."""
    robot = ml.load_robot("sawyer")
    demos = ml.load_demonstrations(sorted((DATA / "sawyer_drawer").glob("*.csv"))[:6], robot)
    return robot, demos, ml.ConstraintLearner(ml.FrameJacobian(robot, "right_gripper_tip")).fit(demos)
