"""Rows about an axis or a centre: derivatives, batches, files, and zero on the mechanism's own motion."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest
from test_gradients import central_difference, postures

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FrameJacobian, MechanismRows
from manip_learn.constraint.features.mechanism_rows import FIELDS
from manip_learn.constraint.manipulability import manipulability, manipulability_gradient
from manip_learn.constraint.manipulability_batch import manipulability_batch
from manip_learn.control.compiled_controller import CompiledController
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies import ManipulabilityAscent
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import Hold, PointAttractor
from manip_learn.errors import ConstraintMismatchError, FeatureError

AXIS, POINT, PITCH = (0.3, -0.5, 0.8), (0.4, 0.2, 0.3), 0.07
ROBOTS = ["one", "planar3", "gantry", "ur5", "kinova", "panda", "mimic", "rover"]
TIPS = {"planar3": "tip", "panda": "panda_hand_tcp", "ur5": "tool0", "kinova": "j2s6s200_end_effector"}
GROUPS = [
    "radial axial",
    "helical radial",
    "spherical",
    "turn-1 turn-2 slide-1 slide-2 slide",
    "turn-1 turn-2 slide-1 slide-2 screw",
    "tangential turn",
]


def rows_of(robot, name, rows, **changed):
    options = {"axis": AXIS, "point": POINT, "pitch": PITCH} | changed
    return MechanismRows(robot, TIPS.get(name, "tip"), rows, **options)


@pytest.mark.parametrize("radius", [None, 0.3])
@pytest.mark.parametrize("name", ROBOTS)
def test_derivative_of_every_row(robot_of, rng, name, radius):
    """dPhi/dq is right to 1e-8 at random and at singular postures, whatever the joints, and the cheap forms agree."""
    robot = robot_of(name)
    features = rows_of(robot, name, tuple(FIELDS), radius=radius)
    selection = np.linalg.qr(rng.normal(size=(features.n_rows, 4)))[0].T
    for q in postures(robot, rng):
        exact, expected = features.derivative(q), central_difference(features, robot, q)
        scale = max(1.0, float(np.max(np.abs(expected))))
        np.testing.assert_allclose(exact, expected, rtol=0, atol=1e-8 * scale)
        value, together = features.value_and_derivative(q)
        np.testing.assert_allclose(value, features(q), rtol=0, atol=1e-13 * scale)
        np.testing.assert_array_equal(together, exact)
        A, contract = features.value_and_vjp(q, features.padded(selection))
        np.testing.assert_allclose(A, selection @ value, rtol=0, atol=1e-13 * scale)
        weights = rng.normal(size=A.shape)
        wanted = np.einsum("ij,ip,pjk->k", weights, selection, exact)
        np.testing.assert_allclose(contract(weights), wanted, rtol=0, atol=1e-12 * scale)


@pytest.mark.parametrize("radius", [None, 0.3])
@pytest.mark.parametrize("name", ROBOTS)
def test_batch_equals_single(robot_of, rng, name, radius):
    """Values, derivatives and contractions of a batch are those of its postures one by one."""
    robot = robot_of(name)
    features = rows_of(robot, name, tuple(FIELDS), radius=radius)
    q = np.stack([robot.random_configuration(rng) for _ in range(7)])
    Phi, dPhi = features.batch_with_derivative(q)
    single = [features.value_and_derivative(x) for x in q]
    np.testing.assert_allclose(features.batch(q), [s[0] for s in single], rtol=0, atol=1e-12)
    np.testing.assert_allclose(Phi, [s[0] for s in single], rtol=0, atol=1e-12)
    np.testing.assert_allclose(dPhi, [s[1] for s in single], rtol=0, atol=1e-11)
    weights = rng.normal(size=Phi.shape)
    got = features.batch_vjp(q, lambda _, part: weights[part].transpose(1, 2, 0))
    np.testing.assert_allclose(got, np.einsum("nij,nijk->nk", weights, dPhi), rtol=0, atol=1e-11)


@pytest.mark.parametrize("rows", GROUPS)
@pytest.mark.parametrize("name", ["planar3", "ur5", "panda"])
def test_manipulability_gradient(robot_of, rng, name, rows):
    """grad mu of constraints on these rows is right to 1e-6, one posture or many."""
    robot = robot_of(name)
    features = rows_of(robot, name, rows, radius=0.4 if name == "panda" else None)
    constraint = Constraint(np.eye(features.n_rows), features)
    q = np.stack([robot.random_configuration(rng) for _ in range(4)])
    batch = manipulability_batch(constraint, q)
    if find_spec("numba"):
        kernel = manipulability_batch(constraint, q, compiled=True)
        np.testing.assert_allclose(kernel.mu, batch.mu, rtol=1e-11, atol=1e-14)
        scale = 1.0 + np.abs(batch.gradient).max()
        np.testing.assert_allclose(kernel.gradient, batch.gradient, rtol=0, atol=1e-11 * scale)
    for i, x in enumerate(q):
        mu, gradient = manipulability(constraint, x), manipulability_gradient(constraint, x)
        assert batch.mu[i] == pytest.approx(mu, rel=1e-9, abs=1e-12)
        np.testing.assert_allclose(batch.gradient[i], gradient, rtol=1e-7, atol=1e-9)
        if mu > 1e-3:
            expected = central_difference(lambda y: manipulability(constraint, y), robot, x)
            np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-6 * max(np.linalg.norm(expected), mu))


@pytest.mark.parametrize("rows", ["radial axial", "helical radial", "spherical", "tangential"])
def test_finite_on_the_axis(robot_of, rng, rows):
    """On the axis, in the centre and close by everything stays finite, and mu vanishes only there."""
    robot = robot_of("panda")
    q = robot.random_configuration(rng)
    p = robot.position(q, robot.frame("panda_hand_tcp"))
    for distance in (0.0, 1e-12, 1e-6, 1e-4):
        features = rows_of(robot, "panda", rows, point=p + distance * np.array([1.0, 0.6, 0.0]), pitch=0.0)
        constraint = Constraint(np.eye(features.n_rows), features)
        assert np.all(np.isfinite(features.derivative(q)))
        assert np.all(np.isfinite(manipulability_gradient(constraint, q)))
        assert np.all(np.isfinite(ResolvedRateController(constraint, task=Hold())(q).velocity))
        assert (manipulability(constraint, q) < 1e-6) == (distance < 1e-9)


def test_the_motion_of_a_hinge_is_free(robot_of, rng):
    """A hand that a screw carries along breaks none of the firm rows; its tip breaks none of the loose ones."""
    robot = robot_of("panda")
    q = robot.random_configuration(rng)
    frame = FrameJacobian(robot, "panda_hand_tcp", "pose")
    a, c = np.array(AXIS) / np.linalg.norm(AXIS), np.array(POINT)
    p = robot.position(q, robot.frame("panda_hand_tcp"))
    for pitch, rows in ((0.0, (GROUPS[0], GROUPS[2], GROUPS[3])), (PITCH, (GROUPS[1], GROUPS[4]))):
        u = np.linalg.pinv(frame(q)) @ np.concatenate([np.cross(a, p - c) + pitch * a, a])
        for names in rows:
            features = rows_of(robot, "panda", names, pitch=pitch)
            np.testing.assert_allclose(features(q) @ u, 0.0, atol=1e-9)
        assert abs(rows_of(robot, "panda", "tangential", pitch=pitch)(q) @ u)[0] > 0.05


@pytest.mark.parametrize("rows", GROUPS)
def test_files_keep_every_bit(robot_of, rng, tmp_path, rows):
    """A saved constraint comes back with the same rows and the same numbers."""
    robot = robot_of("panda")
    features = rows_of(robot, "panda", rows, radius=0.25 if "radial" in rows else None)
    constraint = Constraint(rng.normal(size=(1, features.n_rows)), features)
    back = Constraint.load(constraint.save(tmp_path / "door.json"), robot)
    q = robot.random_configuration(rng)
    np.testing.assert_allclose(back(q), constraint(q), rtol=0, atol=1e-15)
    np.testing.assert_array_equal(back.selection, constraint.selection)
    assert back.features.row_units == features.row_units
    text = (tmp_path / "door.json").read_text().replace('"axis"', '"akis"')
    (tmp_path / "broken.json").write_text(text)
    with pytest.raises(ConstraintMismatchError, match="damaged"):
        Constraint.load(tmp_path / "broken.json", robot)


def test_the_controller_keeps_the_door_on_its_circle(robot_of):
    """While it climbs mu in the null space the hand stays on the circle, and mu grows, compiled or not."""
    robot = robot_of("panda")
    q = robot.configuration([0.1, -0.3, -0.1, -2.0, 0.1, 1.8, 0.7])
    features = rows_of(robot, "panda", "radial axial")
    constraint = Constraint(np.eye(2), features)
    controller = ResolvedRateController(constraint, task=Hold(), null_policy=ManipulabilityAscent(constraint))
    laws = [controller, CompiledController(controller)] if find_spec("numba") else [controller]
    for law in laws:
        rollout = simulate(robot, law, q, duration=1.0, dt=0.005)
        r = np.stack([features.coordinates(x) for x in rollout.q])
        assert np.ptp(r, axis=0).max() < 2e-3
        assert rollout.manipulability[-1] > 1.02 * rollout.manipulability[0]


def test_distances_of_a_door_of_known_radius(robot_of, rng):
    """Distances from the axis and along it move as `coordinates_jacobian` says; a target for them is come to."""
    robot = robot_of("panda")
    q = robot.configuration([0.1, -0.3, -0.1, -2.0, 0.1, 1.8, 0.7])
    features = rows_of(robot, "panda", "radial axial", radius=0.3)
    expected = central_difference(features.coordinates, robot, q)
    np.testing.assert_allclose(features.coordinates_jacobian(q), expected, atol=1e-8)
    goal = features.coordinates(q) + [0.05, -0.04]
    task = PointAttractor(goal, 4.0)
    rollout = simulate(robot, ResolvedRateController(Constraint(np.eye(2), features), task), q, 3.0, 0.01)
    np.testing.assert_allclose(features.coordinates(rollout.q[-1]), goal, atol=1e-4)
    assert rollout.task_error[-1] < 1e-4


def test_wrong_arguments_say_what_is_wrong(robot_of):
    """Unknown rows, axes without direction and points that are none are refused with the reason."""
    robot = robot_of("panda")
    wrong = [
        ({"rows": "radia"}, "unknown row"),
        ({"rows": "radial radial"}, "twice"),
        ({"rows": ""}, "no row"),
        ({"rows": "axial", "axis": (0, 0, 0)}, "no direction"),
        ({"rows": "axial", "point": (0, np.nan, 0)}, "finite"),
        ({"rows": "axial", "pitch": np.inf}, "pitch"),
        ({"rows": "radial", "radius": 0.0}, "radius"),
        ({"rows": "radial", "radius": np.nan}, "radius"),
    ]
    for options, message in wrong:
        with pytest.raises(FeatureError, match=message):
            MechanismRows(robot, "panda_hand_tcp", **options)
    with pytest.raises(FeatureError, match="coordinates"):
        rows_of(robot, "panda", "tangential").coordinates(robot.neutral())
