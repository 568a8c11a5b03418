"""Feature maps: rows, coordinates, targets, and what they refuse. Their derivatives are in test_gradients.py."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from case import case
from conftest import tip_of
from scipy.spatial.transform import Rotation

from manip_learn.constraint.features import CentreOfMass, CustomFeatures, FrameJacobian, Stacked
from manip_learn.constraint.features.frame_jacobian import AXES, parse_axes
from manip_learn.errors import FeatureError, TargetError, UnknownNameError


def test_axes():
    """Named sets, words in any order, commas and sequences all mean the rows that they say; others are refused, and the
    valid ones are listed.
    """
    known = {
        "xyz": ("x", "y", "z"),
        "pose": AXES,
        "planar": ("x", "y", "rz"),
        "rotation": ("rx", "ry", "rz"),
        "x": ("x",),
        " x  rz ": ("x", "rz"),
        "ry,z": ("ry", "z"),
        ("rz", "x"): ("rz", "x"),
    }
    assert {axes: parse_axes(axes) for axes in known} == known
    assert parse_axes(["x"]) == ("x",)
    for axes in ("", "  ", "xy", "x w", "x x", "XYZ", [], ["x", ""], "0 1"):
        with case(repr(axes)), pytest.raises(FeatureError, match="x y z rx ry rz"):
            parse_axes(axes)


def test_rows_are_those_of_the_full_jacobian(robot_of, rng):
    """Each row is the row of that name of the six-row Jacobian, in the order asked for."""
    robot = robot_of("panda")
    q = robot.random_configuration(rng)
    for axes, reference in product(("xyz", "planar", "rz x", "z"), ("world", "local")):
        with case(axes, reference):
            full = FrameJacobian(robot, "panda_hand_tcp", "pose", reference)
            some = FrameJacobian(robot, "panda_hand_tcp", axes, reference)
            rows = [AXES.index(n) for n in some.row_names]
            assert some(q).shape == (len(rows), robot.nv)
            np.testing.assert_array_equal(some(q), full(q)[rows])
            np.testing.assert_array_equal(some.derivative(q), full.derivative(q)[rows])
            assert some.row_units == tuple("rad/s" if n.startswith("r") else "m/s" for n in some.row_names)


def test_unknown_frame_and_reference(robot_of):
    """A misspelt frame lists near ones; a misspelt reference lists both."""
    robot = robot_of("panda")
    with pytest.raises(UnknownNameError, match="'panda_hand_tcp'"):
        FrameJacobian(robot, "panda_hand_tpc")
    with pytest.raises(FeatureError, match="'world' or 'local'"):
        FrameJacobian(robot, "panda_hand_tcp", reference="base")  # type: ignore[arg-type]
    with pytest.raises(FeatureError, match="x y z only"):
        CentreOfMass(robot, "planar")


def test_error_to_a_pose(robot_of, rng):
    """The displacement vanishes at the target, and following it (r' = error) leads there from half a radian away."""
    robot = robot_of("ur5")
    goal = robot.configuration([0.3, -1.0, 1.2, -0.4, 1.0, 0.2])
    for axes, reference in product(("xyz", "pose", "rotation"), ("world", "local")):
        with case(axes, reference):
            features = FrameJacobian(robot, tip_of("ur5"), axes, reference)
            pose = robot.pose(goal, features.frame)
            np.testing.assert_allclose(features.error_to(pose, goal), 0.0, rtol=0, atol=1e-12)
            q = robot.integrate(goal, 0.2 * rng.normal(size=robot.nv))
            for _ in range(30):
                q = robot.integrate(q, 0.5 * np.linalg.pinv(features(q)) @ features.error_to(pose, q))
            assert np.linalg.norm(features.error_to(pose, q)) < 1e-6


def test_error_to_numbers_agrees_with_error_to_a_pose(robot_of, rng):
    """Position and rotation vector as six numbers mean the same as the 4 x 4 pose."""
    robot = robot_of("panda")
    q, goal = robot.random_configuration(rng), robot.random_configuration(rng)
    for reference in ("world", "local"):
        features = FrameJacobian(robot, "panda_hand_tcp", "pose", reference)
        pose = robot.pose(goal, features.frame)
        numbers = np.concatenate([pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_rotvec()])
        np.testing.assert_allclose(features.coordinates(goal), numbers, rtol=0, atol=1e-12)
        np.testing.assert_allclose(features.error_to(numbers, q), features.error_to(pose, q), rtol=0, atol=1e-10)


def test_error_to_turns_the_short_way(robot_of):
    """A planar target at 3 rad is reached from -3 rad through pi: 0.28 rad, not 6."""
    robot = robot_of("planar3")
    features = FrameJacobian(robot, "tip", "planar")
    q = np.array([-1.0, -1.0, -1.0])
    target = [*robot.pose(q, features.frame)[:2, 3], 3.0]
    np.testing.assert_allclose(features.error_to(target, q), [0, 0, 6.0 - 2.0 * np.pi], rtol=0, atol=1e-12)


def test_wrong_targets(robot_of):
    """A target of another size, or one that is not finite, is refused, and the rows are listed; in the frame's own axes
    some of x y z do not determine a displacement: refused with the ways out.
    """
    robot = robot_of("panda")
    bad = ([1.0], [1.0, 2.0, 3.0, 4.0], [1.0, np.nan, 2.0], 1.0, [[1.0, 2.0, 3.0]], np.zeros((6, 6)))
    for features, target in product((FrameJacobian(robot, "panda_hand_tcp"), CentreOfMass(robot)), bad):
        with case(features, target), pytest.raises(TargetError, match="x, y, z"):
            features.error_to(target, np.zeros(7))
    with pytest.raises(TargetError, match="4 x 4 pose"):
        FrameJacobian(robot, "panda_hand_tcp", "x z", "local").error_to([0.1, 0.2], np.zeros(7))


def test_stacked(robot_of, rng):
    """Rows come in the parts' order with names that tell them apart; targets are cut up the same way."""
    robot = robot_of("panda")
    parts = [FrameJacobian(robot, "panda_hand_tcp", "x y"), CentreOfMass(robot, "z")]
    stacked = Stacked(parts)
    q = robot.random_configuration(rng)
    assert stacked.row_names == ("0.x", "0.y", "1.z")
    assert stacked.n_rows == 3
    np.testing.assert_array_equal(stacked(q), np.vstack([p(q) for p in parts]))
    expected = np.concatenate([parts[0].error_to([0.1, 0.2], q), parts[1].error_to([0.3], q)])
    np.testing.assert_array_equal(stacked.error_to([0.1, 0.2, 0.3], q), expected)
    with pytest.raises(TargetError):
        stacked.error_to([0.1, 0.2], q)


def test_stacked_refuses(robot_of):
    """Nothing to stack, or parts of two robots, are refused."""
    with pytest.raises(FeatureError):
        Stacked([])
    with pytest.raises(FeatureError, match="one robot"):
        Stacked([FrameJacobian(robot_of("planar3"), "tip"), FrameJacobian(robot_of("panda"), "panda_hand_tcp")])
    with pytest.raises(FeatureError, match="share one robot"):
        Stacked([FrameJacobian(robot_of("sawyer"), "right_hand"), FrameJacobian(robot_of("panda"), "panda_hand_tcp")])


def test_custom_features_without_a_robot():
    """A plain system: values, central differences, the user's own derivative, and coordinates."""

    def function(q: np.ndarray) -> np.ndarray:
        return np.array([[np.sin(q[0]), q[1] ** 2]])

    features = CustomFeatures(function, ("f",), nv=2, coordinates=lambda q: [q @ q])
    exact = np.array([[[np.cos(0.3), 0.0], [0.0, 1.4]]])
    np.testing.assert_allclose(features.derivative([0.3, 0.7]), exact, rtol=0, atol=1e-9)
    given = CustomFeatures(function, ("f",), nv=2, derivative=lambda q: exact)
    np.testing.assert_array_equal(given.derivative([0.3, 0.7]), exact)
    np.testing.assert_allclose(features.coordinates([3.0, 4.0]), [25.0])
    np.testing.assert_allclose(features.error_to([26.0], [3.0, 4.0]), [1.0])
    with pytest.raises(FeatureError, match="no task coordinates"):
        given.coordinates([0.0, 0.0])
    with pytest.raises(FeatureError, match="cannot be saved"):
        features.describe()


def test_custom_features_are_checked():
    """A function with the wrong shape, or with NaN, is caught where it enters; so are maps without a size or names."""
    for wrong, words in (
        (np.zeros((2, 2)), "must have shape"),
        (np.zeros(2), "must have shape"),
        ([[np.nan, 0]], "not fin"),
    ):
        with pytest.raises(FeatureError, match=words):
            CustomFeatures(lambda q, value=wrong: value, ("f",), nv=2)([0.0, 0.0])
    with pytest.raises(FeatureError, match="nv="):
        CustomFeatures(lambda q: q, ("f",))
    with pytest.raises(FeatureError, match="row name"):
        CustomFeatures(lambda q: q, (), nv=2)
