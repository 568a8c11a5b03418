"""Constraints: orthonormal rows, files that come back, and files that are refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
from generated_motions import arm_features, guided_motions, oblique
from test_gradients import case

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CentreOfMass, CustomFeatures, FrameJacobian, Stacked
from manip_learn.errors import ConstraintError, ConstraintMismatchError, FeatureError
from manip_learn.recordings.trajectory import Trajectory


@pytest.fixture
def features(robot_of) -> FrameJacobian:
    return FrameJacobian(robot_of("sawyer"), "right_hand", "pose", "local")


def test_rows_are_orthonormal_and_span_the_same(features, rng):
    """Whatever basis is given, the rows are orthonormal and their space is kept; zero rows are dropped."""
    M = rng.standard_normal((3, 6)) * [[1e-6], [1.0], [1e5]]
    constraint = Constraint(np.insert(M, 1, 0.0, axis=0), features)
    S = constraint.selection
    np.testing.assert_allclose(S @ S.T, np.eye(3), rtol=0, atol=1e-14)
    np.testing.assert_allclose(M - M @ S.T @ S, 0.0, atol=1e-9)
    exact = np.eye(6)[[4, 0]]
    np.testing.assert_array_equal(Constraint(exact, features).selection, exact)
    with pytest.raises(ValueError, match="read-only"):
        S[0, 0] = 1.0


def test_value_and_derivative(features, rng):
    """A = Lambda Phi and its derivative; A has the shape (s, nv)."""
    constraint = Constraint(rng.standard_normal((2, 6)), features)
    q = rng.uniform(-1, 1, 7)
    np.testing.assert_allclose(constraint(q), constraint.selection @ features(q), rtol=0, atol=1e-14)
    np.testing.assert_allclose(
        constraint.derivative(q), np.einsum("sp,pij->sij", constraint.selection, features.derivative(q)), atol=1e-13
    )
    assert (constraint.n_constraints, constraint.nv) == (2, 7)


def test_unusable_selections(features):
    """Zero, dependent, too narrow, NaN, empty, ragged, text and a cube: refused with a reason."""
    bad = (np.zeros((2, 6)), np.ones((2, 6)), np.eye(5), [[np.nan] * 6], [], [[1, 2], [3]], "x", np.ones((2, 2, 6)))
    for selection in bad:
        with case(selection), pytest.raises(ConstraintError, match="selection|rows"):
            Constraint(selection, features)


def test_residual(rng):
    """0 for motions that obey, near 1 for motions along the rows, NaN for none of them."""
    demos, truth = guided_motions(arm_features(), oblique(2, 3, rng), rng, 2, 10)
    assert truth.residual(demos) < 1e-12
    along = [Trajectory(t.time, t.q, [np.ones(2) @ truth(q) for q in t.q], t.joint_names) for t in demos]
    assert truth.residual(along) == pytest.approx(1.0)
    with pytest.raises(ConstraintError, match="nothing moves"):
        truth.residual([Trajectory(t.time, t.q, 0.0 * t.u, t.joint_names) for t in demos])
    with pytest.raises(ConstraintError, match="no velocities"):
        truth.residual([Trajectory(t.time, t.q, None, t.joint_names) for t in demos])


def test_residual_is_a_share_of_speed(rng):
    """A motion at a given angle to what the constraint allows has the sine of that angle, not its square."""
    demos, truth = guided_motions(arm_features(), oblique(2, 3, rng), rng, 2, 10)
    for angle in (0.01, 0.3, 1.2):
        tilted = []
        for t in demos:
            across = np.array([np.array([0.3, -0.8]) @ truth(q) for q in t.q])
            across *= np.linalg.norm(t.u, axis=1, keepdims=True) / np.linalg.norm(across, axis=1, keepdims=True)
            u = np.cos(angle) * t.u + np.sin(angle) * across
            tilted.append(Trajectory(t.time, t.q, u, t.joint_names))
        assert truth.residual(tilted) == pytest.approx(np.sin(angle), rel=1e-9)


def test_files_come_back(robot_of, rng, tmp_path):
    """Every kind of features goes through a file: the same A to the last bit, and how it was learnt."""
    robot = robot_of("wrist")
    frame, mass = FrameJacobian(robot, "tip", "x rz", "local"), CentreOfMass(robot, "z y")
    for features in (frame, mass, Stacked([frame, mass])):
        constraint = Constraint(rng.standard_normal((2, features.n_rows)), features, {"estimator": "joint", "gap": 9.5})
        loaded = Constraint.load(constraint.save(tmp_path / "c.json"), robot)
        q = robot.random_configuration(rng)
        np.testing.assert_array_equal(loaded(q), constraint(q))
        assert loaded.provenance == constraint.provenance
        content = json.loads((tmp_path / "c.json").read_text())
        assert content["schema"] == 1 and content["robot"]["joint_names"] == list(robot.joint_names)
        assert content["row_units"] == list(features.row_units)


def test_files_of_another_robot(robot_of, features, tmp_path):
    """Other joints, or another URDF with the same joints: refused; the latter on demand accepted."""
    path = Constraint(np.eye(6)[:2], features).save(tmp_path / "c.json")
    with pytest.raises(ConstraintMismatchError, match="load that robot"):
        Constraint.load(path, robot_of("planar3"))
    content = json.loads(path.read_text())
    content["robot"]["fingerprint"] = "0" * 64
    path.write_text(json.dumps(content))
    with pytest.raises(ConstraintMismatchError, match="another version"):
        Constraint.load(path, robot_of("sawyer"))
    assert Constraint.load(path, robot_of("sawyer"), same_urdf=False).n_constraints == 2


def test_every_damaged_file_is_refused(robot_of, features, tmp_path):
    """A missing or invalid key, truncated text, other JSON: an error of this library that names the file."""
    path = Constraint(np.eye(6)[:2], features).save(tmp_path / "c.json")
    text, good = path.read_text(), json.loads(path.read_text())
    bad = ["", "{", "[]", "null", '"x"', text[: len(text) // 2], "[" * 5000]
    for key in ("format", "schema", "robot", "features", "selection"):
        bad.append(json.dumps({k: v for k, v in good.items() if k != key}))
        bad += [json.dumps({**good, key: value}) for value in (None, 7, "x", [], {}, [[1e400] * 6], {"kind": "other"})]
    for content in bad:
        path.write_text(content)
        with pytest.raises(ConstraintMismatchError, match="c.json"):
            Constraint.load(path, robot_of("sawyer"))
    for nowhere in (tmp_path, tmp_path / "none.json"):
        with pytest.raises(ConstraintMismatchError, match="folder|not exist"):
            Constraint.load(nowhere, robot_of("sawyer"))


def test_python_functions_cannot_be_saved(tmp_path):
    """A constraint on the user's own functions says so, and leaves no file."""
    constraint = Constraint([[1.0]], CustomFeatures(lambda q: np.ones((1, 2)), ("a",), 2))
    with pytest.raises(FeatureError, match="cannot be saved"):
        constraint.save(tmp_path / "c.json")
    assert list(tmp_path.iterdir()) == []


def test_it_prints_its_rows(features):
    """The rows are printed by name, without zeros."""
    assert repr(Constraint([[0.0, 1.0, 0, 0, 0, 0]], features)).startswith("Constraint(y of FrameJacobian")
