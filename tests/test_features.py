"""Feature maps: what their rows are called and mean, targets, and what they refuse (derivatives: test_gradients.py)."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from case import case
from conftest import tip_of
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation
from test_gradients import bent_rail, central_difference

import manip_learn as ml
from manip_learn.constraint.place import ROW_UNITS, across
from manip_learn.errors import ConstraintError, FeatureError, TargetError
from manip_learn.linalg import row_space_angle

TCP = "panda_hand_tcp"
PLACE = {"axis": (0.3, -0.5, 0.8), "point": (0.4, 0.2, 0.3), "pitch": 0.07}
NAN, NO_ROTATIONS = np.nan, ([1, 1, -1, 1], [0, 0, 0, 0], [2, 2, 2, 1])


def test_what_is_refused(robot_of, panda):
    """Rows of several robots, functions of the wrong shape, targets of another size: each with what was wrong, and the
    valid ones.
    """
    sawyer, zero = robot_of("sawyer"), np.zeros(7)
    hand, mass, other = ml.FrameJacobian(panda, TCP), ml.CentreOfMass(panda), ml.FrameJacobian(sawyer, "right_hand")
    rail, pose = ml.CurveRows(panda, TCP, np.eye(4, 3)), ml.FrameJacobian(panda, TCP, "pose")
    one = ml.CustomFeatures(lambda q: [[1.0, 0.0]], ("f",), nv=2)
    seen = ml.RelativeFrameJacobian(sawyer, "right_hand", "right_l3", "x")

    def custom(value) -> np.ndarray:
        return ml.CustomFeatures(lambda q: value, ("f",), nv=2)([0.0, 0.0])

    refused = [
        (lambda: ml.Stacked([]), FeatureError, "one robot"),
        (lambda: ml.Stacked([ml.FrameJacobian(robot_of("planar3"), "tip"), hand]), FeatureError, "one robot"),
        (lambda: ml.Stacked([other, hand]), FeatureError, "share one robot"),
        (lambda: ml.MechanismRows(panda, TCP, "tangential").coordinates(zero), FeatureError, "coordinates"),
        (lambda: rail.with_rows(("up",)), FeatureError, "unknown row 'up'"),
        *((lambda v=v: custom(v), FeatureError, "must have shape") for v in (np.zeros((2, 2)), np.zeros(2))),
        (lambda: custom([[NAN, 0]]), FeatureError, "not fin"),
        (lambda: one.coordinates([0.0, 0.0]), FeatureError, "no task coordinates"),
        (lambda: one.describe(), FeatureError, "cannot be saved"),
        (lambda: one.with_rotation(np.eye(1)), ConstraintError, "belong to no frame"),
        (lambda: ml.CustomFeatures(lambda q: q, ("f",)), FeatureError, "nv="),
        (lambda: ml.CustomFeatures(lambda q: q, (), nv=2), FeatureError, "row name"),
        (lambda: seen.error_to([1.0, 2.0], zero), TargetError, "1 finite"),
        (lambda: ml.Stacked([hand, mass]).error_to([0.1, 0.2], zero), TargetError, "6 finite"),
        (lambda: ml.FrameJacobian(panda, TCP, "x z", "local").error_to([0.1, 0.2], zero), TargetError, "4 x 4 pose"),
        *((lambda d=d: pose.error_to(np.diag(d), zero), TargetError, "not a rotation") for d in NO_ROTATIONS),
        (lambda: pose.error_jacobian(np.full((4, 4), NAN), zero), TargetError, "finite"),
    ]
    for number, (call, error, words) in enumerate(refused):
        with case(number, words), pytest.raises(error, match=words) as caught:
            call()
        assert isinstance(caught.value, ml.ManipLearnError)


def test_rows_are_those_of_the_full_jacobian(panda, rng):
    """Each row is the row of that name of the six-row Jacobian, in the order asked for; stacked rows come in the parts'
    order with names that tell them apart, and targets are cut up the same way.
    """
    q = panda.random_configuration(rng)
    full, some = (ml.FrameJacobian(panda, TCP, names, "local") for names in ("pose", "rz x"))
    assert_array_equal(some(q), full(q)[[5, 0]])
    assert some.row_units == ("rad/s", "m/s")
    parts = [ml.FrameJacobian(panda, TCP, "x y"), ml.CentreOfMass(panda, "z")]
    stacked = ml.Stacked(parts)
    assert stacked.row_names == ("0.x", "0.y", "1.z")
    assert_array_equal(stacked(q), np.vstack([p(q) for p in parts]))
    expected = np.concatenate([parts[0].error_to([0.1, 0.2], q), parts[1].error_to([0.3], q)])
    assert_array_equal(stacked.error_to([0.1, 0.2, 0.3], q), expected)


def test_error_to_a_pose(robot_of, rng):
    """The displacement vanishes at the target, and following it (r' = error) leads there from half a radian away; six
    numbers, position and rotation vector, mean the same as the 4 x 4 pose, which may be written with few digits; an
    angle goes the short way, through pi.
    """
    robot = robot_of("ur5")
    goal = robot.configuration([0.3, -1.0, 1.2, -0.4, 1.0, 0.2])
    for axes, reference in (("xyz", "world"), ("pose", "world"), ("pose", "local"), ("rotation", "local")):
        with case(axes, reference):
            features = ml.FrameJacobian(robot, tip_of("ur5"), axes, reference)
            pose = robot.pose(goal, features.frame)
            assert_allclose(features.error_to(pose, goal), 0.0, rtol=0, atol=1e-12)
            assert np.linalg.norm(features.error_to(np.round(pose, 5), goal)) < 1e-4
            q = robot.integrate(goal, 0.2 * rng.normal(size=robot.nv))
            if axes == "pose":
                numbers = np.concatenate([pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_rotvec()])
                assert_allclose(features.coordinates(goal), numbers, rtol=0, atol=1e-12)
                assert_allclose(features.error_to(numbers, q), features.error_to(pose, q), atol=1e-10)
            for _ in range(30):
                q = robot.integrate(q, 0.5 * np.linalg.pinv(features(q)) @ features.error_to(pose, q))
            assert np.linalg.norm(features.error_to(pose, q)) < 1e-6
    features, q = ml.FrameJacobian(robot_of("planar3"), "tip", "planar"), np.array([-1.0, -1.0, -1.0])
    target = [*features.robot.pose(q, features.frame)[:2, 3], 3.0]
    assert_allclose(features.error_to(target, q), [0, 0, 6.0 - 2.0 * np.pi], rtol=0, atol=1e-12)


def test_custom_features_without_a_robot():
    """A plain system: values, central differences, the user's own derivative, and coordinates."""

    def function(q: np.ndarray) -> np.ndarray:
        return np.array([[np.sin(q[0]), q[1] ** 2]])

    features = ml.CustomFeatures(function, ("f",), nv=2, coordinates=lambda q: [q @ q])
    exact = np.array([[[np.cos(0.3), 0.0], [0.0, 1.4]]])
    assert_allclose(features.derivative([0.3, 0.7]), exact, rtol=0, atol=1e-9)
    given = ml.CustomFeatures(function, ("f",), nv=2, derivative=lambda q: exact)
    assert_array_equal(given.derivative([0.3, 0.7]), exact)
    assert_allclose(features.error_to([26.0], [3.0, 4.0]), [1.0])


@pytest.mark.parametrize("radius", [None, 0.3])
def test_rows_of_a_mechanism_in_numbers(panda, rng, radius):
    """Each row is the velocity that its name says, in numbers; with a radius those of that distance."""
    h, q = PLACE["pitch"], panda.random_configuration(rng)
    J, p = panda.jacobian(q, TCP), panda.position(q, TCP)
    a, c = np.array(PLACE["axis"]) / np.linalg.norm(PLACE["axis"]), np.array(PLACE["point"])
    features = ml.MechanismRows(panda, TCP, tuple(ROW_UNITS), **PLACE, radius=radius)
    first, second = across(features.geometry.axis)
    assert_allclose(np.linalg.det([first, second, a]), 1.0, rtol=1e-12)  # a right-handed base
    d = p - c
    x = d - (a @ d) * a
    rho, far = (np.linalg.norm(x), np.linalg.norm(d)) if radius is None else (radius, radius)
    at_c = J[:3] + np.cross(J[3:].T, c - p).T  # of the hand's point that is at c
    wanted = {
        "radial": x / rho @ J[:3],
        "tangential": np.cross(a, x) / rho @ J[:3],
        "axial": a @ J[:3],
        "across-1": first @ J[:3],
        "across-2": second @ J[:3],
        "helical": (rho**2 * a - h * np.cross(a, x)) / (rho * np.hypot(rho, h)) @ J[:3],
        "spherical": d / far @ J[:3],
        "turn-1": first @ J[3:],
        "turn-2": second @ J[3:],
        "turn": a @ J[3:],
        "slide-1": first @ at_c,
        "slide-2": second @ at_c,
        "slide": a @ at_c,
        "screw": a @ at_c - h * a @ J[3:],
    }
    units = ["rad/s" if name.startswith("turn") else "m/s" for name in features.row_names]
    assert set(wanted) == set(features.row_names) and list(features.row_units) == units
    assert_allclose(features(q), [wanted[name] for name in features.row_names], rtol=0, atol=1e-8)


def test_finite_on_the_axis(panda, rng):
    """On the axis, in the centre and close by everything stays finite, and mu vanishes only there."""
    q = panda.random_configuration(rng)
    p = panda.position(q, TCP)
    for rows, off in product(("radial axial", "helical radial", "spherical", "tangential"), (0, 1e-12, 1e-6, 1e-4)):
        with case(rows, off):
            point = p + off * np.array([1.0, 0.6, 0.0])
            features = ml.MechanismRows(panda, TCP, rows, axis=PLACE["axis"], point=point)
            constraint = ml.Constraint(np.eye(features.n_rows), features)
            velocity = ml.ResolvedRateController(constraint, task=ml.Hold())(q).velocity
            for values in (features.derivative(q), ml.manipulability_gradient(constraint, q), velocity):
                assert np.all(np.isfinite(values))
            assert (ml.manipulability(constraint, q) < 1e-6) == (off < 1e-9)


def test_targets_are_come_to(panda):
    """Distances from a door's axis and along it, of known radius."""
    q = panda.configuration([0.1, -0.3, -0.1, -2.0, 0.1, 1.8, 0.7])
    door = ml.MechanismRows(panda, TCP, "radial axial", **PLACE, radius=0.3)
    assert_allclose(door.coordinates_jacobian(q), central_difference(door.coordinates, panda, q), atol=1e-8)
    constraint, goal = ml.Constraint(np.eye(2), door), door.coordinates(q) + [0.05, -0.04]
    law = ml.ResolvedRateController(constraint, ml.PointAttractor(goal, 4.0))
    rollout = ml.simulate(panda, law, q, 3.0, 0.01)
    assert np.max(np.abs(door.error_to(goal, rollout.q[-1]))) < 1e-4


def test_rows_move_with_what_holds_the_hand(panda):
    """At the moved pose the moved rows weigh the moved twist as the rows weigh the twist; rows that go with the hand or
    with another frame are the same ones.
    """
    rng, T = np.random.default_rng(3), np.eye(4)
    T[:3, :3], T[:3, 3] = np.linalg.qr(rng.normal(size=(3, 3)))[0], (0.1, 0.2, -0.3)
    T[:3, :3] *= np.linalg.det(T[:3, :3])
    pose = panda.pose(panda.neutral(), TCP)
    door = ml.MechanismRows(panda, TCP, "radial axial turn screw", **PLACE, radius=0.3)
    path = pose[:3, 3] + np.cumsum(0.05 * rng.normal(size=(6, 3)), axis=0)
    rail = ml.CurveRows(panda, TCP, path, "across-1 across-2")
    for features in (ml.FrameJacobian(panda, TCP, "x y"), ml.FrameJacobian(panda, TCP, "rz y x"), door, rail):
        selection = np.linalg.qr(rng.normal(size=(features.n_rows, 2)))[0].T
        moved, rows = features.moved(T, selection)
        here = selection @ features.weights_at(pose[None])[0]
        there = rows @ moved.weights_at((T @ pose)[None])[0] @ np.kron(np.eye(2), T[:3, :3])
        assert row_space_angle(here, there) < 1e-6, features
    link = "panda_link3"
    seen, own = ml.MechanismRows(panda, TCP, "radial", relative_to=link), ml.FrameJacobian(panda, TCP, "x", "local")
    for features in (seen, own, ml.RelativeFrameJacobian(panda, TCP, link, "x"), ml.CentreOfMass(panda)):
        assert features.moved(T, np.eye(1, features.n_rows))[0] is features


def test_a_hand_is_led_along_a_curve_and_back_wherever_it_stands(robot_of, tmp_path):
    """The way is as long as asked for, and the hand stays as near to the curve; saved and moved ones, too."""
    robot, q = robot_of("sawyer"), np.random.default_rng(1).uniform(-1.0, 1.0, 7)
    rail = ml.Constraint(np.eye(2), bent_rail(robot, "right_gripper_tip", q, "across-1 across-2"))
    constraint, shift = ml.Constraint.load(rail.save(tmp_path / "c.json"), robot), np.eye(4)
    assert constraint.mechanism is not None and constraint.mechanism.name == "curve"
    shift[:3, 3] = 0.01, 0.0, 0.02
    moved = constraint.moved(shift)
    for held, way in ((constraint, 0.05), (moved, -0.05)):
        task = ml.motion(held, along=way)
        law = ml.ResolvedRateController(held, task)
        rollout = ml.simulate(robot, law, q, duration=task.duration + 1.0, dt=0.02)
        assert task.progress(rollout.q[-1]) == pytest.approx(way, abs=1e-4)
        off = np.array([held.features.coordinates(row) for row in rollout.q])
        assert np.abs(off - off[0]).max() < 5e-4
    assert moved.features.coordinates(q) != pytest.approx(constraint.features.coordinates(q), abs=1e-3)
