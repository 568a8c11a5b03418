"""Every fit ends, with an answer or a refusal, whatever was recorded."""

from __future__ import annotations

import numpy as np
import pytest
from mechanism_motions import Path, about, along, demonstrate, wave
from scipy.spatial.transform import Rotation
from task_sets import arm

import manip_learn as ml

MIDDLE = {
    "panda": ("panda_hand_tcp", (0.0, -0.3, 0.0, -1.9, 0.0, 1.7, 0.6)),
    "xarm7": ("link_eef", (0.0, -0.2, 0.0, 1.2, 0.0, 1.4, 0.0)),
}
# of which those seeds are tried that draw planes, cylinders, hinges and screws
SHAPES = ("cylinder", "cylinder", "arc", "line", "plane", "hinge", "screw", "ball")


def side(radius: float, turn: Rotation) -> Path:
    """Path of a hand on a cylinder."""

    def path(pose: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, None]:
        # at most a quarter of a turn each way, and 0.14 m
        way = wave(rng, np.array([min(0.14, radius), 0.14]))
        phi = way[:, 0] / radius
        beside = np.column_stack([radius * np.sin(phi), way[:, 1], radius * np.cos(phi) - radius])
        return pose[:3, 3] + turn.apply(beside), None

    return path


def shape(kind: str, turn: Rotation, radius: float, handle: np.ndarray) -> Path:
    """Path of a hand on one thing, turned."""
    if kind == "cylinder":
        return side(radius, turn)
    if kind == "plane":
        return along(turn.apply([[1.0, 0.0, 0.1], [0.0, 1.0, 0.0]]), 0.2, firm=False)
    point = handle + turn.apply([min(radius, 1.0), 0.0, 0.0])
    pitch = 0.03 if kind == "screw" else 0.0
    axis = turn.apply([0.0, 0.0, 1.0])
    return about(axis, point, min(0.2 / radius, 0.6), pitch=pitch, firm=kind == "hinge")


def on_mechanisms(seed: int) -> tuple[list[ml.FrameJacobian], list[ml.Trajectory]]:
    """Six to twelve recordings of a hand on something; at one place, at two, moved each time, or by an arm that is off.

    Raises:
        RuntimeError: The arm does not get along the path.
    """
    rng = np.random.default_rng([seed, 1])
    name, kind = str(rng.choice(list(MIDDLE))), str(rng.choice(SHAPES))
    radius, where = float(rng.choice([0.1, 0.3, 1.0, 3.0])), str(rng.choice(["one", "two", "moved", "off"]))
    robot, (frame, middle) = arm(name), MIDDLE[name]
    handle = robot.position(np.array(middle), robot.frame(frame))
    first = Rotation.from_rotvec(rng.normal(0.0, 0.3, 3))
    steps = {"one": 0.0, "off": 0.0, "two": np.radians(float(rng.choice([0.5, 1.0, 5.0]))), "moved": 0.08}
    demos, n = [], int(rng.choice([6, 8, 12]))
    for i in range(n):
        angle = steps[where] * (i % 2 if where == "two" else rng.normal())
        path = shape(kind, Rotation.from_rotvec([0.0, 0.6 * angle, 0.8 * angle]) * first, radius, handle)
        noise = float(rng.choice([2e-5, 1e-4, 5e-4]))
        demos += demonstrate(robot, frame, np.array(middle), path, rng, n=1, noise=noise)
    zeros = np.radians(rng.normal(0.0, 1.0, robot.nv)) if where == "off" else 0.0
    demos = [ml.Trajectory(t.time, t.q + zeros, None, t.joint_names, f"demo_{i}") for i, t in enumerate(demos)]
    axes = "pose" if kind == "hinge" else "xyz"
    return [ml.FrameJacobian(robot, frame, axes, reference) for reference in ("world", "local")], demos


# drawn from their numbers: three for which a part was divided by its places, joined and divided again for ever (6, 79,
# 84), and others, whole and cut
SETS = (84, 8, 12, 18, 26, 34)


@pytest.mark.parametrize("number", [*SETS, *(pytest.param(n, marks=pytest.mark.slow) for n in (6, 79))])
def test_a_fit_ends(number: int) -> None:
    """With an answer or a refusal."""
    try:
        maps, demos = on_mechanisms(number)
    except RuntimeError:
        return  # the arm cannot do what was drawn
    try:
        assert ml.ConstraintLearner(maps).fit(demos).reports_
    except ml.ManipLearnError as refusal:
        assert refusal.code
