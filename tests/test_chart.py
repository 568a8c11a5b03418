"""Free coordinates of a hand on each mechanism that may hold it: poses, twists, held errors and rows agree."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_gradients import RobotOf

import manip_learn as ml
from manip_learn.constraint.features.curve_rows import Curve
from manip_learn.constraint.mechanism import MECHANISM_KINDS
from manip_learn.errors import ConstraintError

AXIS = np.array([0.36, -0.48, 0.8])
POINT = np.array([0.5, 0.1, 0.3])
INTERPOLATED = 2e-5  # of the frame that goes along a curve, between the points at which it is known


def bent() -> Curve:
    t = np.linspace(0.0, 1.0, 9)
    return Curve(np.column_stack([0.3 + 0.4 * t, 0.1 * np.sin(3.0 * t), 0.2 + 0.1 * t**2]))


def mechanisms() -> list[ml.Mechanism]:
    """Each kind with each orientation that a hand may have on it; a curve loosely, held straight, and carried."""
    out = []
    for kind in MECHANISM_KINDS:
        axis, point = AXIS if "axis" in kind.unknowns else None, None if kind.type == "held-orientation" else POINT
        pitch = 0.03 if kind.type == "screw" else None
        out.append(ml.Mechanism(kind.type, axis, point, pitch=pitch, orientation=kind.orientation, name=kind.name))
    orientations = ("free", "fixed", "carried")
    return out + [ml.Mechanism("other", orientation=o, name="curve", curve=bent()) for o in orientations]


def near(rng: np.random.Generator, mechanism: ml.Mechanism) -> np.ndarray:
    """A pose beside the mechanism."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    middle = bent().at(np.array([0.2]))[0] if mechanism.curve is not None else POINT
    pose[:3, 3] = middle + rng.uniform(0.01 if mechanism.curve is not None else 0.1, 0.15, 3) * rng.choice([0.2, 1.0])
    return pose


@pytest.mark.parametrize("mechanism", mechanisms(), ids=lambda m: f"{m.kind}, {m.orientation}")
def test_a_pose_and_its_coordinates(mechanism: ml.Mechanism):
    """Back from a pose come its coordinates, held coordinates are zero on the mechanism and not beside it, and the
    twist is the derivative of the pose.
    """
    rng = np.random.default_rng(5)
    for _ in range(5):
        grasp = near(rng, mechanism)
        chart, k = mechanism.at(grasp), mechanism.n_free
        assert np.allclose(chart.pose(np.zeros(k)), grasp, atol=1e-12)
        np.testing.assert_allclose(chart.coordinates(grasp), np.zeros(k), atol=1e-12)
        s = rng.uniform(-0.15, 0.15, k)
        pose = chart.pose(s)
        np.testing.assert_allclose(chart.coordinates(pose), s, atol=2e-9)
        np.testing.assert_allclose(chart.held_error(pose), np.zeros(6 - k), atol=2e-9)
        slopes, h = [], 1e-5
        for step in np.eye(k) * h:
            after, before = chart.pose(s + step), chart.pose(s - step)
            v, turn = after[:3, 3] - before[:3, 3], Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
            slopes.append(np.concatenate([v, turn]) / (2.0 * h))
        np.testing.assert_allclose(chart.twist(s), np.transpose(slopes), atol=INTERPOLATED if mechanism.curve else 1e-8)
        beside = pose.copy()
        beside[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, 0.02, 3)).as_matrix() @ pose[:3, :3]
        beside[:3, 3] += rng.normal(0.0, 0.005, 3)
        off = chart.held_error(beside)
        assert len(off) == 6 - k and (not len(off) or np.linalg.norm(off) > 1e-4)


@pytest.mark.parametrize("mechanism", mechanisms(), ids=lambda m: f"{m.kind}, {m.orientation}")
def test_rows_are_zero_along_the_mechanism(mechanism: ml.Mechanism, robot_of: RobotOf):
    """Its features leave the twists of all free coordinates alone, and hold as many rows as are held."""
    robot, rng = robot_of("panda"), np.random.default_rng(2)
    features = mechanism.features(robot, "panda_hand_tcp")
    assert mechanism.orientation == "carried" or features.n_rows == 6 - mechanism.n_free
    grasp = near(rng, mechanism)
    weights = features.weights_at(grasp[None])[0]  # type: ignore[attr-defined]
    if mechanism.kind == "curve" and mechanism.orientation == "carried":
        weights = weights[:2]  # of a hand that turns with a curve only the place is held by rows
    assert np.max(np.abs(weights @ mechanism.at(grasp).twist(np.zeros(mechanism.n_free)))) < (
        INTERPOLATED if mechanism.curve else 1e-9
    )


def test_where_the_fixture_stands_elsewhere():
    """A moved mechanism has the same coordinates at moved poses."""
    rng, T = np.random.default_rng(3), np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix(), [0.1, 0.2, -0.1]
    for mechanism in mechanisms():
        if mechanism.kind == "space" and mechanism.axis is None:
            continue  # its coordinates are those of the base
        grasp, s = near(rng, mechanism), rng.uniform(-0.1, 0.1, mechanism.n_free)
        if mechanism.kind in ("line", "hinge", "screw", "curve") and mechanism.orientation in ("fixed", "carried"):
            there = mechanism.moved(T).at(T @ grasp)
            np.testing.assert_allclose(there.pose(s), T @ mechanism.at(grasp).pose(s), atol=1e-6)


def test_what_has_no_coordinates_is_refused():
    """A place that is unknown, a hand on the axis that it turns about, and what is no pose: each by name."""
    hinge = ml.Mechanism("hinge", AXIS, POINT, name="hinge")
    on_axis = np.eye(4)
    on_axis[:3, 3] = POINT + 0.2 * AXIS
    for mechanism, pose, words in (
        (ml.Mechanism("line", name="line"), np.eye(4), "its axis is unknown"),
        (ml.Mechanism("ball", name="ball"), np.eye(4), "its point is unknown"),
        (hinge, on_axis, "has no angle about it"),
        (hinge, np.eye(3), "4 x 4 finite numbers"),
        (hinge, np.full((4, 4), np.nan), "4 x 4 finite numbers"),
    ):
        with pytest.raises(ConstraintError, match=words):
            mechanism.at(pose)
    firm = ml.Mechanism("hinge", AXIS, POINT, radius=0.0, orientation="carried", name="hinge, firm")
    assert firm.at(on_axis).coordinates(on_axis) == pytest.approx([0.0])  # a knob: its rotation is the angle
