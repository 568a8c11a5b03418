"""Constraints: orthonormal rows, files that come back, and files that are refused."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from case import case
from generated_motions import arm_features, guided_motions, oblique
from rounding import rounding

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import (
    CentreOfMass,
    CurveRows,
    CustomFeatures,
    FrameJacobian,
    MechanismRows,
    RelativeFrameJacobian,
    Stacked,
)
from manip_learn.constraint.features.mechanism_rows import PlaceRows
from manip_learn.constraint.skill import Skill
from manip_learn.errors import ConstraintError, ConstraintMismatchError, FeatureError, advice_for_command
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.loading import load_robot


@pytest.fixture
def features(robot_of) -> FrameJacobian:
    return FrameJacobian(robot_of("sawyer"), "right_hand", "pose", "local")


def test_rows_are_orthonormal_and_span_the_same(features, rng):
    """Whatever basis is given, the rows are orthonormal and their space is kept; zero rows are dropped."""
    M = rng.standard_normal((3, 6)) * [[1e-6], [1.0], [1e5]]
    constraint = Constraint(np.insert(M, 1, 0.0, axis=0), features)
    S = constraint.selection
    np.testing.assert_allclose(S @ S.T, np.eye(3), rtol=0, atol=rounding(4 * S.size))
    np.testing.assert_allclose(M - M @ S.T @ S, 0.0, atol=1e-9)
    exact = np.eye(6)[[4, 0]]
    np.testing.assert_array_equal(Constraint(exact, features).selection, exact)
    with pytest.raises(ValueError, match="read-only"):
        S[0, 0] = 1.0


def test_unusable_selections(features):
    """Zero, dependent, too narrow, NaN, empty, ragged, text and a cube: refused with a reason."""
    bad = (np.zeros((2, 6)), np.ones((2, 6)), np.eye(5), [[np.nan] * 6], [], [[1, 2], [3]], "x", np.ones((2, 2, 6)))
    for selection in bad:
        with case(selection), pytest.raises(ConstraintError, match="selection|rows"):
            Constraint(selection, features)


def test_residual_is_a_share_of_speed(rng):
    """A motion at a given angle to what the constraint allows has the sine of that angle; no motion is refused."""
    demos, truth = guided_motions(arm_features(), oblique(2, 3, rng), rng, 2, 10)
    assert truth.residual(demos) < 1e-12
    for angle in (0.01, 1.2, 0.5 * np.pi):
        tilted = []
        for t in demos:
            across = np.array([np.array([0.3, -0.8]) @ truth(q) for q in t.q])
            across *= np.linalg.norm(t.u, axis=1, keepdims=True) / np.linalg.norm(across, axis=1, keepdims=True)
            u = np.cos(angle) * t.u + np.sin(angle) * across
            tilted.append(Trajectory(t.time, t.q, u, t.joint_names))
        assert truth.residual(tilted) == pytest.approx(np.sin(angle), rel=1e-9)
    for u, words in ((lambda t: 0.0 * t.u, "nothing moves"), (lambda t: None, "no velocities")):
        with pytest.raises(ConstraintError, match=words):
            truth.residual([Trajectory(t.time, t.q, u(t), t.joint_names) for t in demos])


def test_files_come_back(robot_of, rng, tmp_path):
    """Every kind of features goes through a file: the same A to the last bit, and how it was learnt."""
    robot = robot_of("wrist")
    frame, mass = FrameJacobian(robot, "tip", "x rz", "local"), CentreOfMass(robot, "z y")
    seen, place = (
        RelativeFrameJacobian(robot, "tip", "joint0", "y rx"),
        {"axis": (0.3, -0.5, 0.8), "point": (0.4, 0.2, 0)},
    )
    rail = CurveRows(robot, "tip", np.random.default_rng(0).normal(size=(5, 3)), ("across-1", "along", "rz"))
    doors = [MechanismRows(robot, "tip", "radial axial turn", **place, radius=radius) for radius in (None, 0.25)]
    screw = MechanismRows(robot, "tip", "helical slide-1 screw", **place, pitch=0.07)
    places = [PlaceRows(robot, "tip", form, (0.1, 0.2, 0.5)) for form in ("point", "twist", "surface")]
    for features in (frame, mass, Stacked([frame, mass]), seen, rail, *doors, screw, *places):
        constraint = Constraint(rng.standard_normal((2, features.n_rows)), features, {"estimator": "joint", "gap": 9.5})
        loaded = Constraint.load(constraint.save(tmp_path / "c.json"), robot)
        q = robot.random_configuration(rng)
        np.testing.assert_array_equal(loaded(q), constraint(q))
        assert loaded.provenance == constraint.provenance
        content = json.loads((tmp_path / "c.json").read_text())
        assert content["schema"] == 2 and content["robot"]["joint_names"] == list(robot.joint_names)
        assert content["row_units"] == list(features.row_units)


def test_files_of_another_robot(robot_of, features, tmp_path):
    """Other joints, or another URDF with the same joints: refused; the latter on demand accepted."""
    path = Constraint(np.eye(6)[:2], features).save(tmp_path / "c.json")
    with pytest.raises(ConstraintMismatchError, match="made with robot .* its joints are"):
        Constraint.load(path, robot_of("planar3"))
    content = json.loads(path.read_text())
    content["robot"]["fingerprint"] = "0" * 64
    path.write_text(json.dumps(content))
    with pytest.raises(ConstraintMismatchError, match="description has changed"):
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
        with pytest.raises(ConstraintMismatchError, match="folder|no such file"):
            Constraint.load(nowhere, robot_of("sawyer"))


def test_contradicting_files_are_refused(robot_of, features, tmp_path):
    """Rows that are not orthonormal, one too few, true or text for a number, other names or units than those of the
    features, postures that are none: one sentence each, which names the file.
    """
    rows = np.linalg.qr(np.random.default_rng(0).normal(size=(6, 3)))[0].T.tolist()
    kept = {"postures": [[0.0] * 7]}
    path = Constraint(rows, features, kept).save(tmp_path / "c.json")
    good = json.loads(path.read_text())
    described, true = good["features"], [[True, 0, 0, 0, 0, 0], *rows[1:]]
    scaled = [[2.0 * x for x in rows[0]], *rows[1:]]
    for change, words in (
        ({"selection": scaled}, "not orthonormal"),
        ({"selection": [[rows[0][0] + 1e-6, *rows[0][1:]], *rows[1:]]}, "not orthonormal"),
        ({"selection": [rows[0], [0.0] * 6, rows[2]]}, "not orthonormal"),
        ({"selection": rows[:2]}, "states n_constraints 3, its rows and features 2"),
        ({"n_constraints": 2}, "states n_constraints 2, its rows and features 3"),
        ({"selection": [rows[0][:5], *rows[1:]]}, "equal length"),
        ({"selection": true}, "in the place of a number"),
        ({"selection": [["1", "0", "0", "0", "0", "0"]]}, "in the place of a number"),
        ({"features": described | {"units": [True] * 6}}, "changed after it was saved"),
        ({"features": described | {"units": ["m/s"] * 6}}, "changed after it was saved"),
        ({"row_names": ["x", "y", "z", "rx", "rz", "ry"]}, "states row_names .* its rows and features"),
        ({"row_units": ["rad/s"] * 6}, "states row_units .* its rows and features"),
        ({"features": described | {"axes": ["x", "y", "z", "rx", "rz", "ry"]}}, "states row_names"),
        ({"provenance": {"postures": [[0.0] * 6]}}, "postures in which it was shown"),
        ({"provenance": {"postures": [[0.0] * 6 + [True]]}}, "postures|number"),
        ({"provenance": {"postures": "x"}}, "postures|damaged"),
    ):
        path.write_text(json.dumps(good | change))
        with case(change), pytest.raises(ConstraintMismatchError, match=words) as refused:
            Constraint.load(path, robot_of("sawyer"))
        assert str(refused.value).startswith(str(path))
    digits = [[round(x, 11) for x in row] for row in rows]  # written with fewer digits
    unsigned = {key: value for key, value in good.items() if key != "sha256"}
    path.write_text(json.dumps(unsigned | {"selection": digits}))
    with pytest.warns(UserWarning, match="states no SHA-256"):
        np.testing.assert_allclose(Constraint.load(path, robot_of("sawyer")).selection, rows, atol=1e-10)
    door = MechanismRows(robot_of("sawyer"), "right_hand", "radial axial")
    content = json.loads(Constraint([[1.0, 0.0]], door).save(path).read_text())
    for change in ({"axis": [True, 0, 0]}, {"rows": ["radial"]}, {"radius": True}, {"point": ["0", "0", "0"]}):
        path.write_text(json.dumps(content | {"features": content["features"] | change}))
        with case(change), pytest.raises(ConstraintMismatchError, match="c.json"):
            Constraint.load(path, robot_of("sawyer"))


def test_a_file_changed_by_hand_is_told(robot_of, features, tmp_path):
    """A turned row, another place and other postures are refused. They are taken once the signature is deleted as the
    sentence says, with a warning, or a note of the command, until they are saved again. A file that another program
    wrote again, in another order and with 1 for 1.0, is the same.
    """
    robot, path = robot_of("sawyer"), tmp_path / "c.json"
    constraint = Constraint([[0, 0, 1.0, 0, 0, 0]], features, {"postures": [[0.1] * 7], "shown": {"extent": 0.3}})
    good = json.loads(constraint.save(path).read_text())
    turned = [[0.0, math.sin(1e-3), math.cos(1e-3), 0.0, 0.0, 0.0]]
    for change in ({"selection": turned}, {"provenance": good["provenance"] | {"shown": {"extent": 0.31}}}):
        path.write_text(json.dumps(good | change))
        with case(change), pytest.raises(ConstraintMismatchError, match='changed after .* delete the entry "sha256"'):
            Constraint.load(path, robot)
        path.write_text(json.dumps({key: value for key, value in (good | change).items() if key != "sha256"}))
        for load in (Constraint.load, Skill.load):
            with pytest.warns(UserWarning, match=r"c\.json states no SHA-256"):
                load(path, robot)
        with advice_for_command([]):
            unsigned = Constraint.load(path, robot)
        assert unsigned.n_constraints == 1 and "states no SHA-256" in unsigned.notes[0]
        assert Constraint.load(unsigned.save(tmp_path / "again.json"), robot).notes == ()
    whole = [[int(x) for x in row] for row in good["selection"]]
    path.write_text(json.dumps(dict(reversed((good | {"selection": whole}).items()))))
    np.testing.assert_array_equal(Constraint.load(path, robot).selection, constraint.selection)


def test_joints_locked_elsewhere_are_said(tmp_path):
    """A lock that was there when the constraint was made is a note; another one is refused, or said on demand."""
    made, other, free = (load_robot("sawyer", locked=x) for x in ({"right_j3": 1.2}, {"right_j3": 0.0}, ()))
    path = Constraint([[0.0, 1.0, 0.0]], FrameJacobian(made, "right_hand")).save(tmp_path / "c.json")
    assert Constraint.load(path, made).notes == ("as when the constraint was made: right_j3 = 1.2 locked",)
    with pytest.raises(ConstraintMismatchError, match=r"right_j3' is locked at 1.2, not locked at 0"):
        Constraint.load(path, other)
    note = "when the constraint was made, 'right_j3' is locked at 1.2, not locked at 0"
    assert Constraint.load(path, other, same_urdf=False).notes == (note,)
    with pytest.raises(ConstraintMismatchError, match="its joints are"):
        Constraint.load(path, free)
    path = Constraint([[0.0, 1.0, 0.0]], FrameJacobian(free, "right_hand")).save(tmp_path / "free.json")
    assert Constraint.load(path, free).notes == ()
    content = json.loads(path.read_text())
    for wrong in (["right_j3"], {"right_j3": True}, "right_j3"):
        content["robot"]["locked"] = wrong
        path.write_text(json.dumps(content))
        with case(wrong), pytest.raises(ConstraintMismatchError, match="damaged: .*locked"):
            Constraint.load(path, free)


def test_python_functions_cannot_be_saved(robot_of, tmp_path):
    """A constraint on the user's own functions says so, and leaves no file."""
    constraint = Constraint([[1.0]], CustomFeatures(lambda q: np.ones((1, 2)), ("a",), 2))
    with pytest.raises(FeatureError, match="cannot be saved"):
        constraint.save(tmp_path / "c.json")
    features = CentreOfMass(robot_of("wrist"), "z")
    with pytest.raises(ValueError, match="float values"):  # NaN is no JSON
        Constraint([[1.0]], features, {"gap": np.nan}).save(tmp_path / "c.json")
    assert list(tmp_path.iterdir()) == []
