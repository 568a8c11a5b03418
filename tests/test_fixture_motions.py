"""Motions along hand-written mechanisms with a firm grasp: the hand moves and turns with the fixture."""

from __future__ import annotations

import numpy as np
import pytest
from mechanism_motions import about, along, demonstrate
from scipy.spatial.transform import Rotation
from test_mechanism import MIDDLE, TIP

import manip_learn as ml
from manip_learn.constraint.place import across

# arm -> end effector and a well-conditioned posture [rad]
ARMS = {
    "sawyer": ("right_gripper_tip", [0.1, -0.6, 0.1, 1.3, 0.2, 1.0, 1.5]),
    "ur5e": ("tool0", [0.3, -1.7, 2.0, -1.2, -1.3, 0.4]),
}
# fixture -> radius [m], pitch [m/rad] or None for a translation, axis ("hand": the approach axis), travel [rad or m]
FIXTURES = {
    "door": (0.35, 0.0, (0.05, -0.02, 1.0), 0.8),
    "door, closing": (0.25, 0.0, (0.0, 0.1, 1.0), -0.6),
    "valve": (0.09, 0.0, "hand", 1.2),
    "knob on its axis": (0.0, 0.0, "hand", 1.0),
    "knob near its axis": (0.004, 0.0, "hand", -1.0),
    "screw": (0.002, 0.01 / (2 * np.pi), "hand", 2.0),
    "left-handed screw": (0.0, -0.02 / (2 * np.pi), "hand", 1.5),
    "sliding door": (0.0, None, (0.2, 1.0, 0.1), 0.25),
}


def geometry(name: str, hand: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the axis of a fixture and a point on it [m] for a hand pose (4, 4), in the base frame."""
    radius, _, direction, _ = FIXTURES[name]
    axis = hand[:3, 2] if direction == "hand" else np.array(direction)
    axis = axis / np.linalg.norm(axis)
    beside = np.cross(axis, hand[:3, 0])  # towards the middle of the workspace for either arm
    return axis, hand[:3, 3] + radius * beside / max(float(np.linalg.norm(beside)), 0.1)


def constraint_of(name: str, robot: ml.Robot, tip: str, axis: np.ndarray, point: np.ndarray) -> ml.Constraint:
    """Return the constraint of a hand fixed to a fixture: five rows."""
    pitch = FIXTURES[name][1]
    if pitch is None:
        held = np.linalg.svd(np.concatenate([axis, np.zeros(3)])[None])[2][1:]
        return ml.Constraint(held, ml.FrameJacobian(robot, tip, "pose"))
    rows = "turn-1 turn-2 slide-1 slide-2 " + ("screw" if pitch else "slide")
    return ml.Constraint(np.eye(5), ml.MechanismRows(robot, tip, rows, axis=axis, point=point, pitch=pitch))


def displaced(name: str, axis: np.ndarray, point: np.ndarray, s: float, hand: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) of a hand carried by a fixture over a coordinate s [rad or m]."""
    pitch, pose = FIXTURES[name][1], hand.copy()
    turn = Rotation.from_rotvec((pitch is not None) * s * axis).as_matrix()
    pose[:3, :3] = turn @ hand[:3, :3]
    pose[:3, 3] = point + turn @ (hand[:3, 3] - point) + (1.0 if pitch is None else pitch) * s * axis
    return pose


def coordinate(name: str, axis: np.ndarray, hand: np.ndarray, pose: np.ndarray) -> float:
    """Return the travel of a hand along or about the axis since a pose [m or rad]."""
    moved = pose[:3, 3] - hand[:3, 3]
    return float((moved if FIXTURES[name][1] is None else turn_between(hand, pose)) @ axis)


def turn_between(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the rotation vector from one pose to another [rad]."""
    return Rotation.from_matrix(other[:3, :3] @ one[:3, :3].T).as_rotvec()


@pytest.mark.parametrize("name", FIXTURES)
@pytest.mark.parametrize("arm", ARMS)
def test_hand_moves_with_fixture(name: str, arm: str):
    """The hand goes the whole travel within 0.1 %, 0.3 mm and 0.1 degrees from the fixture, and turns with it."""
    (tip, start), robot = ARMS[arm], ml.load_robot(arm)
    hand, travel = robot.pose(start, tip), FIXTURES[name][3]
    axis, point = geometry(name, hand)
    constraint = constraint_of(name, robot, tip, axis, point)
    amount = {"distance": travel} if FIXTURES[name][1] is None else {"angle": travel}
    task = ml.motion(constraint, **amount)
    controller = ml.ResolvedRateController(constraint, task, task.ascent())
    rollout = ml.simulate(robot, controller, start, task.duration + 1.0)

    poses = [robot.pose(q, tip) for q in rollout.q]
    gone = np.array([coordinate(name, axis, hand, pose) for pose in poses])
    assert gone[-1] == pytest.approx(travel, rel=1e-3) and np.max(np.abs(gone)) <= abs(travel) * 1.001
    for pose, s in zip(poses, gone, strict=True):
        carried = displaced(name, axis, point, s, hand)
        assert np.linalg.norm(pose[:3, 3] - carried[:3, 3]) < 3e-4
        assert np.degrees(np.linalg.norm(turn_between(carried, pose))) < 0.1


@pytest.mark.parametrize(("name", "path"), [("panda", "hinge"), ("panda", "line"), ("ur5", "hinge")])
def test_a_firm_grip_that_was_learnt_is_repeated_as_one(robot_of, name: str, path: str):
    """Learnt with default options, of which the rows are those of the hand's place: the hand turns with the fixture."""
    robot, tip = robot_of(name), TIP[name]
    middle, axis = np.array(MIDDLE[name]), np.array([0.1, -0.2, 0.95]) / np.linalg.norm([0.1, -0.2, 0.95])
    point = robot.position(middle, tip) + 0.3 * across(axis)[0]
    ways = {"hinge": about(axis, point, 0.6), "line": along(axis[None], 0.15, True)}
    demos = demonstrate(robot, tip, middle, ways[path], np.random.default_rng(3))
    learner = ml.ConstraintLearner(ml.FrameJacobian(robot, tip), joint_offset_std=0.0).fit(demos)
    constraint = learner.constraint_
    assert constraint.n_constraints == 2 and constraint.mechanism is not None and constraint.mechanism.grip == "firm"
    task, start = ml.motion(constraint), demos[2].q[0]
    law = ml.ResolvedRateController(constraint, task, task.ascent())
    rollout = ml.simulate(robot, law, start, task.duration_from(start) + 1.0)
    begun = int(np.searchsorted(rollout.time, task.way_begins or 0.0))
    hand, end = (robot.pose(q, tip) for q in rollout.q[[begun, -1]])
    assert abs(task.progress(rollout.q[-1])) == pytest.approx(constraint.shown.extent, rel=1e-3)
    wanted = np.zeros(3) if path == "line" else task.progress(rollout.q[-1]) * constraint.mechanism.axis
    assert np.degrees(np.linalg.norm(turn_between(hand, end) - wanted)) < 0.2
