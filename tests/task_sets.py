"""Recordings of tasks: those that are shipped, and those that the scripts beside the examples generate."""

from __future__ import annotations

import importlib
import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
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
GRIP, WANDER = 0.12, 0.06  # [rad] between grips, and of the spare joints on the way
FINDS_AGAIN = 4e-4  # [m] to which a person finds a handle again
SPREAD = 0.06  # of how far people go, relative


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


def out_and_back(
    kinds: Sequence[str], robot: str, seed: int, n: int = 6
) -> tuple[ml.Robot, str, list[ml.Trajectory], list[Any], list[list[float]]]:
    """Whole recordings of people who take hold of a handle, move the thing out and back, or wipe a table, and go away:
    robot, tip, recordings, the things (`make_recordings.mechanisms`), and how far each recording went [m or rad].
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(EXAMPLES))
        names = ("arms", "furniture", "hand_motion", "mechanism_motion", "whole_recording")
        arms, furniture, hand, moved, whole = (importlib.import_module(f"make_recordings.{name}") for name in names)

        def way(thing: Any, tempo: float, rng: np.random.Generator) -> np.ndarray:
            if len(thing.size) > 1:
                return furniture.draw_way(thing, tempo, rng)
            points = np.outer([rng.normal(1.0, SPREAD), 0.0], thing.size)
            return hand.strokes(points, tempo * rng.uniform(1.6, 2.4, 2), np.array([0.3, 0.0]))

        patch.setattr(whole, "draw_way", way)
        built = arms.load_arm(robot)
        for draw in range(200):
            rng = np.random.default_rng([seed, draw])
            places = [furniture.comfortable(built, rng) for _ in kinds]
            pairs = zip(kinds, places, strict=True)
            things = [getattr(furniture, kind)(built.pose(q)[:3, 3], rng) for kind, q in pairs]
            things = [replace(thing, bar=FINDS_AGAIN * np.eye(3)) for thing in things]
            session = whole.Session(built, things, places, GRIP, WANDER, True)
            with suppress(moved.UnreachableError):
                tapes = [session.demonstrate([*range(len(kinds))], False, [seed, draw, i]) for i in range(n)]
                break
    demos, ways = [], [list[float]() for _ in kinds]
    for i, tape in enumerate(tapes):
        q, names = tape.motion, built.robot.joint_names
        demos.append(
            ml.Trajectory(0.01 * np.arange(len(q)), q + rng.normal(0.0, 1e-4, q.shape), None, names, f"demo_{i}")
        )
        for begin, end, number in tape.windows:
            hands = np.array([built.pose(x)[:3, 3] for x in q[round(100 * begin) : round(100 * end) + 1]])
            far = float(np.max(np.linalg.norm(hands - hands[0], axis=1)))
            across = 2.0 * getattr(things[number], "radius", 0.0)
            ways[number].append(2.0 * np.arcsin(far / across) if across else far)
    return built.robot, built.tip.name, demos, things, ways


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
