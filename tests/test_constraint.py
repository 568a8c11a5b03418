"""Constraints: orthonormal rows, files that come back, and files that are refused."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from case import case, rows_in
from generated_motions import arm_features, guided_motions, oblique
from numpy.testing import assert_allclose, assert_array_equal
from rounding import rounding
from test_gradients import feature_maps

import manip_learn as ml
from manip_learn.errors import ConstraintError, ConstraintMismatchError, FeatureError, advice_for_command


@pytest.fixture
def features(robot_of) -> ml.FrameJacobian:
    return ml.FrameJacobian(robot_of("sawyer"), "right_hand", "pose", "local")


def test_rows_are_orthonormal_and_span_the_same(features, rng):
    """Whatever basis is given, the rows are orthonormal and their space is kept; zero rows are dropped."""
    M = rng.standard_normal((3, 6)) * [[1e-6], [1.0], [1e5]]
    S = ml.Constraint(np.insert(M, 1, 0.0, axis=0), features).selection
    assert_allclose(S @ S.T, np.eye(3), rtol=0, atol=rounding(4 * S.size))
    assert_allclose(M - M @ S.T @ S, 0.0, atol=1e-9)
    exact = np.eye(6)[[4, 0]]
    assert_array_equal(ml.Constraint(exact, features).selection, exact)
    for selection in (S, ml.Constraint(exact, features).selection):
        with pytest.raises(ValueError, match="read-only"):
            selection[0, 0] = 1.0


def test_residual_is_a_share_of_speed(rng):
    """A motion at a given angle to what the constraint allows has the sine of that angle; no motion is refused."""
    demos, truth = guided_motions(arm_features(), oblique(2, 3, rng), rng, 2, 10)
    assert truth.residual(demos) < 1e-12
    for angle in (0.01, 1.2, 0.5 * np.pi):
        tilted = []
        for t in demos:
            across = np.array([np.array([0.3, -0.8]) @ truth(q) for q in t.q])
            across *= np.linalg.norm(t.u, axis=1, keepdims=True) / np.linalg.norm(across, axis=1, keepdims=True)
            tilted.append(ml.Trajectory(t.time, t.q, np.cos(angle) * t.u + np.sin(angle) * across, t.joint_names))
        assert truth.residual(tilted) == pytest.approx(np.sin(angle), rel=1e-9)
    for u, words in ((lambda t: 0.0 * t.u, "no motion"), (lambda t: None, "no velocities")):
        with pytest.raises(ConstraintError, match=words):
            truth.residual([ml.Trajectory(t.time, t.q, u(t), t.joint_names) for t in demos])


def test_files_come_back(robot_of, rng, tmp_path):
    """Every kind of features goes through a file: the same A to the last bit, and how it was learnt. The user's own
    functions, and numbers that are none, cannot be saved and leave no file.
    """
    robot = robot_of("wrist")
    for features in feature_maps(robot, "tip", robot.random_configuration(rng)):
        selection, learnt = rng.standard_normal((2, features.n_rows)), {"estimator": "joint", "gap": 9.5}
        constraint = ml.Constraint(selection, features, learnt)
        loaded = ml.Constraint.load(constraint.save(tmp_path / "c.json"), robot)
        q = robot.random_configuration(rng)
        assert_array_equal(loaded(q), constraint(q))
        assert loaded.provenance == constraint.provenance
        content = json.loads((tmp_path / "c.json").read_text())
        assert content["schema"] == 2 and content["robot"]["joint_names"] == list(robot.joint_names)
        assert content["row_units"] == list(features.row_units)
    (tmp_path / "c.json").unlink()
    own = ml.Constraint([[1.0]], ml.CustomFeatures(lambda q: np.ones((1, 2)), ("a",), 2))
    no_number = ml.Constraint([[1.0]], ml.CentreOfMass(robot, "z"), {"gap": np.nan})
    for constraint, error, words in ((own, FeatureError, "cannot be saved"), (no_number, ValueError, "float values")):
        with pytest.raises(error, match=words):
            constraint.save(tmp_path / "c.json")
    assert list(tmp_path.iterdir()) == []


def test_files_of_another_robot(robot_of, features, tmp_path):
    """Another URDF with the same joints is refused, and on demand accepted. A lock that was there
    when the constraint was made is a note; another one is refused, or said on demand.
    """
    path = ml.Constraint(np.eye(6)[:2], features).save(tmp_path / "c.json")
    content = json.loads(path.read_text())
    content["robot"]["fingerprint"] = "0" * 64
    path.write_text(json.dumps(content))
    with pytest.raises(ConstraintMismatchError, match="description has changed"):
        ml.Constraint.load(path, robot_of("sawyer"))
    assert ml.Constraint.load(path, robot_of("sawyer"), same_urdf=False).n_constraints == 2
    made, other = (ml.load_robot("sawyer", locked={"right_j3": x}) for x in (1.2, 0.0))
    path = ml.Constraint([[0.0, 1.0, 0.0]], ml.FrameJacobian(made, "right_hand")).save(tmp_path / "c.json")
    assert ml.Constraint.load(path, made).notes == ("as when the constraint was made: right_j3 = 1.2 locked",)
    for robot, words in (
        (other, r"right_j3' is locked at 1.2, not locked at 0"),
        (robot_of("sawyer"), "its joints are"),
    ):
        with pytest.raises(ConstraintMismatchError, match=words):
            ml.Constraint.load(path, robot)
    note = "when the constraint was made, 'right_j3' is locked at 1.2, not locked at 0"
    assert ml.Constraint.load(path, other, same_urdf=False).notes == (note,)


ROWS = [[0.6, 0.8, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.8, -0.6, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.28, 0.96]]


def test_damaged_and_contradicting_files_are_refused(robot_of, features, tmp_path):
    """A missing or invalid entry, truncated text, other JSON, rows that are not orthonormal, one too few, true or text
    for a number, other names or units than those of the features, postures that are none: each in a sentence that names
    the file.
    """
    robot, path = robot_of("sawyer"), tmp_path / "c.json"

    def refused(content: object, words: str = "c.json") -> None:
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        with case(content), pytest.raises(ConstraintMismatchError, match=words) as caught:
            ml.Constraint.load(path, robot)
        assert str(caught.value).startswith(str(path))

    text = ml.Constraint(ROWS, features, {"postures": [[0.0] * 7]}).save(path).read_text()
    good = json.loads(text)
    for key, written, words in rows_in("contradicting_constraint_files.txt"):
        value = json.loads(written)
        refused(good | {key: good[key] | value if isinstance(value, dict) else value}, words)
    for key in ("format", "schema", "robot", "features", "selection"):
        refused({k: v for k, v in good.items() if k != key})
        for value in ({}, {"kind": "o"}, None, 7, "x", [], [[1e400] * 6]):
            refused(good | {key: value})
    for content in ("", "{", "[]", "null", '"x"', text[: len(text) // 2], "[" * 5000):
        refused(content)
    for nowhere in (tmp_path, tmp_path / "none.json"):
        with pytest.raises(ConstraintMismatchError, match="folder|no such file"):
            ml.Constraint.load(nowhere, robot)
    hinge = ml.Constraint([[1.0, 0.0]], ml.MechanismRows(robot, "right_hand", "radial axial"))
    door = json.loads(hinge.save(path).read_text())
    for change in ({"axis": [True, 0, 0]}, {"rows": ["radial"]}, {"radius": True}, {"point": ["0", "0", "0"]}):
        refused(door | {"features": door["features"] | change})


def test_a_file_changed_by_hand_is_told(robot_of, features, tmp_path):
    """A turned row and other provenance are refused. They are taken once the signature is deleted as the sentence says,
    with a warning, or a note of the command, until they are saved again. A file that another program wrote again, in
    another order and with 1 for 1.0, is the same.
    """
    robot, path = robot_of("sawyer"), tmp_path / "c.json"
    constraint = ml.Constraint([[0, 0, 1.0, 0, 0, 0]], features, {"postures": [[0.1] * 7], "shown": {"extent": 0.3}})
    good = json.loads(constraint.save(path).read_text())
    turned = [[0.0, math.sin(1e-3), math.cos(1e-3), 0.0, 0.0, 0.0]]
    for change in ({"selection": turned}, {"provenance": good["provenance"] | {"shown": {"extent": 0.31}}}):
        path.write_text(json.dumps(good | change))
        with case(change), pytest.raises(ConstraintMismatchError, match='changed after .* delete the entry "sha256"'):
            ml.Constraint.load(path, robot)
        path.write_text(json.dumps({key: value for key, value in (good | change).items() if key != "sha256"}))
        for load in (ml.Constraint.load, ml.Skill.load):
            with pytest.warns(UserWarning, match=r"c\.json states no SHA-256"):
                load(path, robot)
        with advice_for_command([]):
            unsigned = ml.Constraint.load(path, robot)
        assert unsigned.n_constraints == 1 and "states no SHA-256" in unsigned.notes[0]
        assert ml.Constraint.load(unsigned.save(tmp_path / "again.json"), robot).notes == ()
    whole = [[int(x) for x in row] for row in good["selection"]]
    path.write_text(json.dumps(dict(reversed((good | {"selection": whole}).items()))))
    assert_array_equal(ml.Constraint.load(path, robot).selection, constraint.selection)
