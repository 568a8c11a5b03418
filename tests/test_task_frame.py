"""The task frame: Lambda in axes that a force controller takes, all of it, on the mechanism, and with its doubt."""

from __future__ import annotations

import dataclasses
import json
from itertools import product

import numpy as np
import pytest
from case import case
from rounding import rounding
from task_sets import generated, learnt

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import (
    CentreOfMass,
    FeatureMap,
    FrameJacobian,
    MechanismRows,
    RelativeFrameJacobian,
)
from manip_learn.constraint.features.mechanism_rows import PlaceRows
from manip_learn.constraint.mechanism import MECHANISM_KINDS
from manip_learn.constraint.task_frame import TaskFrame
from manip_learn.errors import ConstraintError
from manip_learn.linalg import row_basis, row_space_angle
from manip_learn.robot import load_robot

AXIS, POINT = np.array([0.2, -0.1, 1.0]), np.array([0.5, 0.2, 0.1])


@pytest.fixture(scope="module")
def panda():
    return load_robot("panda", locked=("panda_finger_joint1", "panda_finger_joint2"))


def rows_held(frame: TaskFrame) -> np.ndarray:
    """Rows of the hand's twist, rebuilt from the words for the axes alone."""
    return np.eye(6)[frame.along("held")] @ frame.from_hand


def test_all_of_lambda_comes_back(panda):
    """Held rows from the frame span the rows of A to 1e-12 for every mechanism; so do its words, but for a screw."""
    rng = np.random.default_rng(0)
    for kind in MECHANISM_KINDS:
        with case(kind.name):
            features = MechanismRows(
                panda, "panda_hand_tcp", kind.rows, axis=AXIS, point=POINT, pitch=0.01 * (kind.type == "screw")
            )
            constraint = Constraint(np.eye(len(kind.rows)), features)
            for q in [panda.random_configuration(rng) for _ in range(3)]:
                frame, J = constraint.task_frame(q), panda.jacobian(q, "panda_hand_tcp")
                assert row_space_angle(constraint(q), frame.rows @ frame.from_hand @ J) < 1e-12
                R = frame.pose[:3, :3]
                assert (
                    np.allclose(R @ R.T, np.eye(3), rtol=0, atol=rounding(8 * panda.nv, R)) and np.linalg.det(R) > 0.0
                )
                if kind.name != "screw, firm":
                    assert row_space_angle(constraint(q), rows_held(frame) @ J) < 1e-12
                else:  # the z and rz of a screw are mixed by its pitch, and each says so
                    assert frame.axes == ("held",) * 5 + ("free",)
                    mixed = [0.0, 0.0, np.arctan(0.01), 0.0, 0.0, np.arctan(0.01)]
                    np.testing.assert_allclose(frame.uncertainty, mixed, atol=1e-9)


def test_rows_of_a_frame_in_any_axes(panda):
    """Dense rows of any axes, in the base or the hand, or seen from another frame, come back to 1e-12 as well."""
    rng = np.random.default_rng(1)
    tip = "panda_hand_tcp"
    cases: dict[str, FeatureMap] = {"relative": RelativeFrameJacobian(panda, tip, "panda_link2")}
    for axes, reference in product(("xyz", "pose", "x y rz"), ("world", "local")):
        cases[f"{axes}, {reference}"] = FrameJacobian(panda, tip, axes, reference)
    for form in ("point", "point and rotation", "twist"):
        cases[form] = PlaceRows(panda, tip, form, POINT)
    for name, features in cases.items():
        for s in range(1, min(features.n_rows, 5) + 1):
            with case(name, s):
                constraint = Constraint(rng.standard_normal((s, features.n_rows)), features)
                q = panda.random_configuration(rng)
                frame, J = constraint.task_frame(q), panda.jacobian(q, "panda_hand_tcp")
                if name == "relative":
                    p, d = (panda.jacobian(q, "panda_link2"), frame.hand[:3, 3] - panda.position(q, "panda_link2"))
                    J = J - p
                    J[:3] += np.cross(d[:, None], p[3:], axis=0)
                back = frame.rows @ frame.from_hand @ J
                assert row_space_angle(row_basis(constraint(q)), back) < 1e-13 * np.linalg.cond(J)
                assert np.all((frame.uncertainty >= 0.0) & (frame.uncertainty <= np.pi / 2))


def test_axes_in_words():
    """What is held, free and not known of a table, a drawer and a flat arm, z along the mechanism's axis."""
    robot = load_robot("sawyer")
    q = robot.neutral() + 0.3
    table = Constraint([[0.1, 0.2, 0.97]], FrameJacobian(robot, "right_gripper_tip", "xyz")).task_frame(q)
    assert table.axes == ("free", "free", "held", "unknown", "unknown", "unknown")
    assert abs(table.pose[:3, 2] @ [0.1, 0.2, 0.97]) == pytest.approx(np.linalg.norm([0.1, 0.2, 0.97]))
    drawer = Constraint([[-0.6, 0.8, 0], [0, 0, 1]], FrameJacobian(robot, "right_gripper_tip", "xyz")).task_frame(q)
    assert drawer.axes[:3] == ("held", "held", "free")
    assert np.allclose(np.abs(drawer.pose[:3, 2]), [0.8, 0.6, 0.0])
    assert np.array_equal(drawer.pose[:3, 3], drawer.hand[:3, 3]) and drawer.turns == "no"
    cup = np.eye(6)[[3, 4]]
    upright = Constraint(cup, FrameJacobian(robot, "right_gripper_tip", "pose")).task_frame(q)
    assert upright.axes == ("free", "free", "free", "held", "held", "free")
    flat = load_robot("planar3")
    wall = Constraint([[0, 1]], FrameJacobian(flat, "tip", "x y")).task_frame([0.3, 0.8, 0.4])
    assert wall.axes == ("free", "held", "unknown", "unknown", "unknown", "unknown")
    assert np.array_equal(wall.pose[:3, :3], np.eye(3))


def test_on_the_axis_and_with_the_hand(panda):
    """A hinge's frame stands on its axis beside the hand, and x goes on pointing to the hand while the arm moves."""
    rng, a = np.random.default_rng(2), AXIS / np.linalg.norm(AXIS)
    for rows, free in (("radial axial", "y"), ("turn-1 turn-2 slide-1 slide-2 slide", "rz")):
        features = MechanismRows(panda, "panda_hand_tcp", rows, axis=AXIS, point=POINT)
        constraint = Constraint(np.eye(features.n_rows), features)
        for q in [panda.random_configuration(rng) for _ in range(4)]:
            frame = constraint.task_frame(q)
            assert np.linalg.norm(np.cross(frame.pose[:3, 3] - POINT, a)) < 1e-12
            to_hand = (frame.hand[:3, 3] - frame.pose[:3, 3]) @ frame.pose[:3, :3]
            assert to_hand[0] > 0.0 and np.allclose(to_hand[1:], 0.0, atol=1e-12) and frame.turns == "axis"
            names = ("x", "y", "z", "rx", "ry", "rz")
            assert [n for n, state in zip(names, frame.axes, strict=True) if state == "free"] == [free]


def test_states_its_doubt(panda):
    """Of two learnt doors the frame's axis is off by less than three times what it states, and so is its x, which
    points from the axis to the hand; an axis that was not seen may be any, and rows by hand have no doubt.
    """
    for seed in range(9100, 9102):
        with case(seed):
            truth, demos = generated("door", "panda", seed, 6, whole=False)
            constraint = learnt("panda", truth["tip"], demos).constraint_
            frame = constraint.task_frame(demos[0].q[len(demos[0]) // 2])
            axis, point = (np.array(truth["mechanisms"][0][key]) for key in ("axis", "point"))
            out = np.cross(axis, np.cross(frame.hand[:3, 3] - point, axis))
            off = [np.linalg.norm(np.cross(frame.pose[:3, i], x / np.linalg.norm(x))) for i, x in ((0, out), (2, axis))]
            assert np.all(0.0 < frame.uncertainty[:3]) and np.all(frame.uncertainty[:3] < np.radians(2.0))
            assert off[0] < 3.0 * frame.uncertainty[0] and off[1] < 3.0 * frame.uncertainty[2], (off, frame.uncertainty)
            assert np.all(frame.uncertainty[3:] == np.pi / 2)
    by_hand = Constraint([[0, 0, 1]], FrameJacobian(panda, "panda_hand_tcp", "xyz")).task_frame(panda.neutral())
    assert not by_hand.uncertainty[:3].any()


def test_stated_angles_are_in_radians(panda):
    """What the learner states in degrees, of Lambda, or of a fitted axis and its place as seen by the hand."""
    table = Constraint([[0, 0, 1]], FrameJacobian(panda, "panda_hand_tcp"), {"uncertainty_deg": 0.3})
    stated = table.task_frame(panda.neutral()).uncertainty
    np.testing.assert_allclose(stated, [*[np.radians(0.3)] * 3, *[np.pi / 2] * 3], rtol=1e-12)
    features = MechanismRows(panda, "panda_hand_tcp", "radial axial", axis=AXIS, point=POINT)
    fitted = Constraint(np.eye(2), features).mechanism
    fitted = dataclasses.replace(fitted, uncertainty={"axis": 0.5, "point": 2e-3})
    door = Constraint(np.eye(2), features, {"mechanism": fitted.to_dict()}).task_frame(panda.neutral())
    across = np.hypot(np.radians(0.5), np.arctan(2e-3 / np.linalg.norm(door.hand[:3, 3] - door.pose[:3, 3])))
    np.testing.assert_allclose(door.uncertainty[:3], [across, across, np.radians(0.5)], rtol=1e-9)


def test_as_plain_numbers(panda):
    """What is written down is JSON, with the axes by name; features of no frame are refused in a sentence."""
    constraint = Constraint([[0, 0, 1]], FrameJacobian(panda, "panda_hand_tcp", "xyz"))
    described = json.loads(json.dumps(constraint.task_frame(panda.neutral()).to_dict(), allow_nan=False))
    assert described["axes"]["z"] == "held" and described["frame"] == "panda_hand_tcp"
    assert described["mechanism"]["type"] == "plane" and len(described["pose"]) == 4
    with pytest.raises(ConstraintError, match="no rows of one frame's twist"):
        Constraint([[0, 0, 1]], CentreOfMass(panda)).task_frame(panda.neutral())
