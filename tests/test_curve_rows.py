"""Rows across a curve: exact derivatives, what holds the hand to it, and the motion along it."""

from __future__ import annotations

import numpy as np
import pytest

import manip_learn as ml
from manip_learn.errors import ConstraintError, FeatureError, TargetError

FRAMES = {"sawyer": "right_gripper_tip", "ur5": "tool0", "planar3": "tip"}


def bent_rail(robot: ml.Robot, frame: str, seed: int) -> tuple[ml.CurveRows, np.ndarray]:
    """A rail near the hand, and a posture at it."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1.0, 1.0, robot.nv)
    place, t = robot.position(q, robot.frame(frame)), np.linspace(-1.0, 1.0, 12)
    shape = np.column_stack([0.2 * t, 0.1 * np.sin(2.0 * t), 0.1 * t**2])
    return ml.CurveRows(robot, frame, place + shape + [0.0, 0.01, 0.0]), q


@pytest.mark.parametrize("name", sorted(FRAMES))
@pytest.mark.parametrize("seed", range(3))
def test_rows_are_the_rates_of_the_coordinates_and_have_exact_derivatives(name: str, seed: int) -> None:
    """Central differences of coordinates and rows; in bulk the same."""
    robot = ml.load_robot(name)
    rows, q = bent_rail(robot, FRAMES[name], seed)
    h = 1e-6 * np.eye(robot.nv)
    rates = np.array([(rows.coordinates(q + e) - rows.coordinates(q - e)) / 2e-6 for e in h]).T
    np.testing.assert_allclose(rows(q), rates, atol=2e-6)
    slopes = np.array([(rows(q + e) - rows(q - e)) / 2e-6 for e in h]).transpose(1, 2, 0)
    np.testing.assert_allclose(rows.derivative(q), slopes, atol=2e-6)
    np.testing.assert_allclose(rows.batch(q[None])[0], rows(q), atol=1e-12)
    constraint = ml.Constraint(np.eye(2, 3), rows)
    numeric = [(ml.manipulability(constraint, q + e) - ml.manipulability(constraint, q - e)) / 2e-6 for e in h]
    np.testing.assert_allclose(ml.manipulability_gradient(constraint, q), numeric, atol=1e-5)


def test_a_hand_is_led_along_the_curve_and_back_wherever_it_stands(tmp_path) -> None:
    """The way is as long as asked for, and the hand stays as near to the curve; saved and moved ones, too."""
    robot = ml.load_robot("sawyer")
    rows, q = bent_rail(robot, "right_gripper_tip", 1)
    ml.Constraint(np.eye(2), rows.with_rows(("across-1", "across-2"))).save(tmp_path / "rail.json")
    constraint = ml.Constraint.load(tmp_path / "rail.json", robot)
    assert constraint.mechanism is not None and constraint.mechanism.name == "curve"
    shift = np.eye(4)
    shift[:3, 3] = 0.01, 0.0, 0.02
    for held in (constraint, constraint.moved(shift)):
        for way in (0.1, -0.1):
            task = ml.motion(held, along=way)
            rollout = ml.simulate(robot, ml.ResolvedRateController(held, task), q, duration=task.duration + 1.0)
            assert task.progress(rollout.q[-1]) == pytest.approx(way, abs=1e-4)
            off = np.array([held.features.coordinates(row) for row in rollout.q])
            assert np.abs(off - off[0]).max() < 5e-4
    assert constraint.moved(shift).features.coordinates(q) != pytest.approx(
        constraint.features.coordinates(q), abs=1e-3
    )


def test_what_is_no_curve_and_no_way_along_one_is_refused() -> None:
    """Each with what was given."""
    robot = ml.load_robot("sawyer")
    for points in (np.zeros((3, 3)), np.zeros((5, 3)), np.full((5, 3), np.nan)):
        with pytest.raises(FeatureError, match="curve"):
            ml.CurveRows(robot, "right_gripper_tip", points)
    rows, _ = bent_rail(robot, "right_gripper_tip", 2)
    with pytest.raises(FeatureError, match="unknown row 'up'"):
        rows.with_rows(("up",))
    constraint = ml.Constraint(np.eye(2, 3), rows)
    with pytest.raises(ConstraintError, match="does not turn"):
        ml.motion(constraint, turn=0.2)
    with pytest.raises(TargetError, match="forth"):
        ml.motion(constraint, along=0.1, direction=(1.0, 0.0, 0.0))
