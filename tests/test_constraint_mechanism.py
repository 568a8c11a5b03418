"""The mechanism that is read from Lambda: type, axis and pitch of the motions that it leaves free."""

from __future__ import annotations

import numpy as np
import pytest

import manip_learn as ml
from manip_learn.constraint.features import FrameJacobian, MechanismRows, RelativeFrameJacobian
from manip_learn.constraint.mechanism_kinds import MECHANISM_KINDS

TIP = "right_gripper_tip"
AXIS = np.array([0.6, 0.64, 0.48])
ACROSS = np.linalg.svd(AXIS[None])[2][1:]
TURNS = np.hstack([np.zeros((3, 3)), np.eye(3)])


def padded(rows: np.ndarray) -> np.ndarray:
    return np.hstack([rows, np.zeros((len(rows), 3))])


@pytest.mark.parametrize(
    ("axes", "selection", "kind", "axis", "orientation"),
    [
        ("xyz", ACROSS, "line", AXIS, "free"),
        ("xyz", AXIS[None], "plane", AXIS, "free"),
        ("xyz", np.eye(3), None, None, ""),
        ("x y", [[1.0, 0.0]], None, None, ""),
        ("pose", padded(ACROSS), "line", AXIS, "free"),
        ("pose", np.vstack([padded(ACROSS), TURNS]), "line", AXIS, "fixed"),
        ("pose", np.vstack([padded(AXIS[None]), TURNS[:2]]), "plane", AXIS, "about-axis"),
        ("pose", np.hstack([np.zeros((2, 3)), ACROSS]), "held-orientation", AXIS, "about-axis"),
        ("pose", TURNS, "held-orientation", None, "fixed"),
        ("rotation", ACROSS, "held-orientation", AXIS, "about-axis"),
        ("pose", [[0.7, 0.0, 0.0, 0.7, 0.0, 0.0]], None, None, ""),
    ],
)
def test_constant_rows_of_the_base(robot_of, axes, selection, kind, axis, orientation) -> None:
    """Lines, planes and held orientations, in whatever basis the rows come; a row that mixes m and rad is none."""
    features = FrameJacobian(robot_of("sawyer"), TIP, axes)
    turned = np.linalg.qr(np.random.default_rng(0).normal(size=(len(selection),) * 2))[0] @ np.asarray(selection)
    mechanism = ml.Constraint(turned, features).mechanism
    if kind is None:
        assert mechanism is None
        return
    assert mechanism is not None and (mechanism.type, mechanism.orientation) == (kind, orientation)
    if axis is None:
        assert mechanism.axis is None
    else:
        assert abs(mechanism.axis @ axis) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(("pitch", "kind"), [(0.0, "hinge"), (0.0032, "screw"), (-0.01, "screw")])
def test_one_free_twist_of_the_hand(robot_of, pitch, kind) -> None:
    """A hand that is fixed to a hinge or a screw: the twist that is left has their pitch and their distance."""
    v = np.cross([0.2, -0.1, 0.05], AXIS) + pitch * AXIS  # of the hand's origin, for a turn of 1 rad/s
    rows = np.linalg.svd(np.concatenate([v, AXIS])[None])[2][1:]
    mechanism = ml.Constraint(rows, FrameJacobian(robot_of("sawyer"), TIP, "pose", "local")).mechanism
    assert mechanism is not None and mechanism.type == kind and mechanism.grip == "firm"
    far = np.linalg.norm(np.cross(AXIS, np.cross([0.2, -0.1, 0.05], AXIS)))
    assert mechanism.radius == pytest.approx(far, abs=1e-12) and "fixed to the hand" in mechanism.sentence
    assert mechanism.pitch == (None if kind == "hinge" else pytest.approx(pitch, abs=1e-12))
    # the same twist, known to a tenth of a degree only: the smallest of the pitches is not told from none
    learnt = {"uncertainty_deg": 0.1}
    doubted = ml.Constraint(rows, FrameJacobian(robot_of("sawyer"), TIP, "pose", "local"), learnt).mechanism
    assert doubted is not None and doubted.type == ("screw" if abs(pitch) > 0.006 else "hinge")


@pytest.mark.parametrize("kind", MECHANISM_KINDS, ids=lambda kind: kind.name)
def test_rows_about_a_place(robot_of, kind) -> None:
    """Every mechanism that the learner knows is read back from its rows, with its axis, its place and its pitch."""
    features = MechanismRows(robot_of("sawyer"), TIP, kind.rows, axis=AXIS, point=[0.5, 0.1, 0.3], pitch=0.01)
    mechanism = ml.Constraint(np.eye(kind.n_rows), features).mechanism
    assert mechanism is not None and (mechanism.name, mechanism.type) == (kind.name, kind.type)
    if kind.type != "ball":
        np.testing.assert_allclose(mechanism.axis, AXIS, atol=1e-12)
    if kind.type != "held-orientation":
        np.testing.assert_allclose(mechanism.point, [0.5, 0.1, 0.3], atol=1e-12)
    assert mechanism.pitch == (0.01 if kind.type == "screw" else None)


def test_what_the_learner_fitted_belongs_to_its_rows(robot_of, tmp_path) -> None:
    """The fit adds place, radius and uncertainty, also from a file; of other rows, or damaged, it is left aside."""
    robot = robot_of("sawyer")
    fitted = ml.Mechanism("line", AXIS, np.array([0.1, 0.2, 0.3]), uncertainty={"axis": 0.01}, name="line")
    learnt = {"kind": "motion-constrained", "mechanism": fitted.to_dict()}
    constraint = ml.Constraint(ACROSS, FrameJacobian(robot, TIP), learnt)
    assert constraint.mechanism == fitted
    assert ml.Constraint.load(constraint.save(tmp_path / "c.json"), robot).mechanism == fitted
    other = ml.Constraint(np.eye(3)[:2], FrameJacobian(robot, TIP), learnt).mechanism
    assert other is not None and other.point is None and abs(other.axis[2]) == pytest.approx(1.0)
    for damage in ({"type": "line"}, {"axis": 3}, {"type": "line", "axis": ["x"]}, "a line"):
        read = ml.Constraint(ACROSS, FrameJacobian(robot, TIP), {"mechanism": damage}).mechanism
        assert read is not None and read.type == "line"
    assert ml.Constraint(ACROSS, FrameJacobian(robot, TIP), {**learnt, "kind": "self-imposed"}).mechanism is None


def test_rows_of_a_hand_or_of_another_frame(robot_of) -> None:
    """Seen from another frame a line stays a line, without an axis in the base; of a hand that turns it is none."""
    robot = robot_of("sawyer")
    seen = ml.Constraint(ACROSS, RelativeFrameJacobian(robot, TIP, "right_l1", "xyz")).mechanism
    assert seen is not None and seen.type == "line" and seen.axis is None
    assert ml.Constraint(ACROSS, FrameJacobian(robot, TIP, "xyz", "local")).mechanism is None
    assert ml.Constraint([[1.0, 0.0]], ml.CustomFeatures(lambda q: np.eye(2, 7), ("a", "b"), 7)).mechanism is None
