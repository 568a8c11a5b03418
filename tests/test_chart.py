"""Free coordinates of a hand on each mechanism that may hold it: poses, twists, held errors and rows agree."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from conftest import tip_of
from scipy.spatial.transform import Rotation
from test_gradients import RobotOf, central_difference

import manip_learn as ml
from manip_learn.constraint.place import Curve
from manip_learn.errors import ConstraintError

AXIS = np.array([0.36, -0.48, 0.8])
POINT = np.array([0.5, 0.1, 0.3])
TYPES = {"space": "held-orientation", "cylinder": "other", "curve": "other"}
ARMS = ("wrist", "sawyer", "panda", "ur5", "kinova")
INTERPOLATED = 2e-5  # of the frame that goes along a curve, between the points at which it is known


def bent() -> Curve:
    t = np.linspace(0.0, 1.0, 9)
    return Curve(np.column_stack([0.3 + 0.4 * t, 0.1 * np.sin(3.0 * t), 0.2 + 0.1 * t**2]))


def mechanisms() -> list[ml.Mechanism]:
    """Return each kind with each orientation that a hand may have on it."""
    kinds = ("line", "plane", "space", "hinge", "screw", "cylinder", "ball", "curve")
    out = []
    for kind, orientation in product(kinds, ("free", "about-axis", "fixed", "carried")):
        if (kind, orientation) != ("space", "free") and (kind, orientation) != ("curve", "about-axis"):
            axis, pitch = None if kind == "curve" else AXIS, 0.03 if kind == "screw" else None
            of_curve = {"name": "curve", "curve": bent()} if kind == "curve" else {}
            made = ml.Mechanism(TYPES.get(kind, kind), axis, POINT, pitch=pitch, orientation=orientation, **of_curve)
            out.append(made)
    return out


def near(rng: np.random.Generator, mechanism: ml.Mechanism) -> np.ndarray:
    """Return a pose beside the mechanism, on a line or a plane."""
    pose, d = np.eye(4), rng.uniform(0.1, 0.15, 3) * rng.choice([-1.0, 1.0])
    pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    along = (d @ AXIS) * AXIS
    pose[:3, 3] = POINT + {"line": along, "plane": d - along}.get(mechanism.kind, d)
    if mechanism.curve is not None:
        pose[:3, 3] = mechanism.curve.at(np.array([0.2]))[0] + rng.uniform(0.0, 0.01, 3)
    return pose


@pytest.mark.parametrize("mechanism", mechanisms(), ids=lambda m: f"{m.kind}, {m.orientation}")
def test_a_pose_and_its_coordinates(mechanism: ml.Mechanism):
    """Back from a pose come its coordinates, one by one and along a motion; held coordinates are zero on the mechanism
    and not beside it; and the twist is the derivative of the pose.
    """
    rng, exact = np.random.default_rng(5), 2e-9 if mechanism.curve else 1e-12
    for _ in range(5):
        grasp = near(rng, mechanism)
        chart, k = mechanism.at(grasp), mechanism.n_free
        np.testing.assert_allclose(chart.pose(np.zeros(k)), grasp, atol=1e-12)
        s = rng.uniform(-0.15, 0.15, k)
        pose = chart.pose(s)
        np.testing.assert_allclose(chart.coordinates(pose), s, atol=exact)
        np.testing.assert_allclose(chart.coordinates(np.array([grasp, pose])), [0.0 * s, s], atol=exact)
        np.testing.assert_allclose(chart.held_error(pose), np.zeros(6 - k), atol=exact)
        for step, twist in zip(np.eye(k) * 1e-5, chart.twist(s).T, strict=True):
            after, before = chart.pose(s + step), chart.pose(s - step)
            turn = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
            slope = np.append(after[:3, 3] - before[:3, 3], turn) / 2e-5
            np.testing.assert_allclose(twist, slope, atol=INTERPOLATED if mechanism.curve else 1e-8)
        beside = pose.copy()
        beside[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, 0.02, 3)).as_matrix() @ pose[:3, :3]
        beside[:3, 3] += rng.normal(0.0, 0.005, 3)
        off = chart.held_error(beside)
        assert len(off) == 6 - k and (not len(off) or np.linalg.norm(off) > 1e-4)


@pytest.mark.parametrize("arm", ARMS)
def test_rows_are_the_rates_of_what_is_held(arm: str, robot_of: RobotOf):
    """On the mechanism the rows are the rates of the held errors, and their derivative that of central differences."""
    robot, rng, h = robot_of(arm), np.random.default_rng(2), 1e-6
    tip = tip_of(arm)
    for mechanism in mechanisms():
        q = robot.random_configuration(rng)
        grasp = robot.pose(q, tip)
        T = np.eye(4)
        T[:3, 3] = grasp[:3, 3] - near(rng, mechanism)[:3, 3]
        here = mechanism.moved(T)
        features, chart = here.features(robot, tip), here.at(grasp)
        assert here.orientation == "carried" or features.n_rows == 6 - here.n_free
        rates = np.zeros((features.n_rows, robot.nv))
        for j, step in enumerate(h * np.eye(robot.nv)):
            errors = [chart.held_error(robot.pose(robot.integrate(q, x), tip)) for x in (step, -step)]
            rates[:, j] = (errors[0] - errors[1])[: features.n_rows] / (2.0 * h)
        scale = max(1.0, float(np.abs(rates).max()))
        np.testing.assert_allclose(features(q), rates, rtol=0, atol=(3e-4 if here.curve else 1e-8) * scale)
        dPhi = central_difference(features, robot, q)
        scale = max(1.0, float(np.abs(dPhi).max()))
        np.testing.assert_allclose(features.derivative(q), dPhi, rtol=0, atol=(1e-6 if here.curve else 1e-8) * scale)


def test_where_the_fixture_stands_elsewhere():
    """A moved mechanism has the same poses, moved."""
    rng, T = np.random.default_rng(3), np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix(), [0.1, 0.2, -0.1]
    for mechanism in mechanisms():
        if mechanism.n_free == 1:
            grasp = near(rng, mechanism)
            there = mechanism.moved(T).at(T @ grasp)
            np.testing.assert_allclose(there.pose([0.1]), T @ mechanism.at(grasp).pose([0.1]), atol=1e-6)
            back = mechanism.reversed().at(grasp).pose([-0.1])
            np.testing.assert_allclose(back, mechanism.at(grasp).pose([0.1]), atol=1e-6)


def test_angles_beyond_half_a_turn_are_next_to_what_is_said():
    """A valve turned three times; the same along a motion, without being told."""
    valve = ml.Mechanism("screw", AXIS, POINT, pitch=0.01, orientation="carried", grip="firm")
    chart = valve.at(near(np.random.default_rng(1), valve))
    turned = np.linspace(0.0, 6.0 * np.pi, 40)
    poses = np.array([chart.pose([s]) for s in turned])
    np.testing.assert_allclose(chart.coordinates(poses)[:, 0], turned, atol=1e-9)
    assert chart.coordinates(poses[-1], near=18.0) == pytest.approx([6.0 * np.pi])


def test_a_hand_that_cannot_hold_it_there_is_refused():
    """A place that is unknown, a hand that is off, and what is no pose: with figures."""
    beside = np.eye(4)
    beside[:3, 3] = POINT + [0.0, 0.1, 0.0]
    door = ml.Mechanism("hinge", (0, 0, 1), POINT, radius=0.4)
    for mechanism, pose, words in (
        (ml.Mechanism("line"), np.eye(4), "not known where the mechanism is"),
        (ml.Mechanism("ball"), np.eye(4), "not known where the mechanism is"),
        (ml.Mechanism("plane", (0, 1, 0), POINT), beside, "100 mm off the mechanism .*50 mm are allowed"),
        (door, beside, "300 mm off the mechanism"),
        (door, np.eye(3), "a pose"),
        (door, np.full((4, 4), np.nan), "a pose"),
    ):
        with pytest.raises(ConstraintError, match=words):
            mechanism.at(pose)
    assert door.at(beside, within=0.5).coordinates(beside) == pytest.approx(np.zeros(4))
    knob = ml.Mechanism("hinge", AXIS, POINT, radius=0.0, orientation="carried", grip="firm")
    beside[:3, 3] = POINT + 0.2 * AXIS
    assert knob.at(beside).coordinates(beside) == pytest.approx([0.0])  # its rotation is the angle
