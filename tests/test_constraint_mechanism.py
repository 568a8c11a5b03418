"""The mechanism that is read from Lambda: type, axis and pitch of the motions that it leaves free; the coordinates of a
hand on it, and the frame that a force controller takes.
"""

from __future__ import annotations

import dataclasses
import json
import pickle
from itertools import product

import numpy as np
import pytest
from case import case, rows_in
from numpy.testing import assert_allclose, assert_array_equal
from rounding import rounding
from scipy.spatial.transform import Rotation
from task_sets import arm

import manip_learn as ml
from manip_learn.constraint.features.mechanism_rows import PlaceForm, PlaceRows
from manip_learn.constraint.mechanism import MECHANISM_KINDS
from manip_learn.constraint.place import DISTANCE_ROWS, Curve, Place, PlaceWeights, mechanism_weights
from manip_learn.errors import ConstraintError
from manip_learn.linalg import row_basis, row_space_angle

TIP, TCP = "right_gripper_tip", "panda_hand_tcp"
AXIS, POINT = np.array([0.36, -0.48, 0.8]), np.array([0.5, 0.1, 0.3])
ACROSS = np.array([[0.8, 0.6, 0.0], [-0.48, 0.64, 0.6]])


@pytest.mark.parametrize(("axes", "selection", "kind", "axis", "orientation"), rows_in("mechanisms_of_rows.txt"))
def test_constant_rows_of_the_base(robot_of, axes, selection, kind, axis, orientation) -> None:
    """Lines, planes and held orientations, in whatever basis the rows come; a row that mixes m and rad is none."""
    rows, axis = np.array(json.loads(selection)), json.loads(axis)
    mixed = np.linalg.qr(np.random.default_rng(0).normal(size=(len(rows),) * 2))[0] @ rows
    mechanism = ml.Constraint(mixed, ml.FrameJacobian(robot_of("sawyer"), TIP, axes)).mechanism
    if kind == "none":
        assert mechanism is None
        return
    assert mechanism is not None and (mechanism.type, mechanism.orientation) == (kind, orientation)
    assert (mechanism.point, mechanism.radius, mechanism.pitch) == (None, None, None)
    assert (mechanism.axis is None) == (axis is None)
    if axis is not None:
        assert_allclose(mechanism.axis, axis, rtol=0, atol=1e-12)


PITCHES = [(0.0, "hinge"), (1.5e-5, "hinge"), (1.7e-5, "screw"), (0.0032, "screw"), (-0.01, "screw")]


@pytest.mark.parametrize(("pitch", "kind"), PITCHES)
def test_one_free_twist_of_the_hand(robot_of, pitch, kind) -> None:
    """A hand that is fixed to a hinge or a screw: the twist that is left has their pitch and their distance; less than
    a tenth of the flattest thread in use is none.
    """
    features = ml.FrameJacobian(robot_of("sawyer"), TIP, "pose", "local")
    v = np.cross([0.2, -0.1, 0.05], AXIS) + pitch * AXIS  # of the hand's origin, for a turn of 1 rad/s
    rows = np.linalg.svd(np.concatenate([v, AXIS])[None])[2][1:]
    mechanism = ml.Constraint(rows, features).mechanism
    assert mechanism is not None and mechanism.type == kind and mechanism.grip == "firm"
    far = np.linalg.norm(np.cross(AXIS, np.cross([0.2, -0.1, 0.05], AXIS)))
    assert mechanism.radius == pytest.approx(far, abs=1e-12) and "fixed to the hand" in mechanism.sentence
    assert mechanism.pitch == (None if kind == "hinge" else pytest.approx(pitch, abs=1e-12))
    # the same twist, known to a tenth of a degree only: the smallest of the pitches is not told from none
    doubted = ml.Constraint(rows, features, {"uncertainty_deg": 0.1}).mechanism
    assert doubted is not None and doubted.type == ("screw" if abs(pitch) > 0.006 else "hinge")


def test_rows_between_those_of_a_mechanism_are_none(robot_of) -> None:
    """Rows between two of a hinge's, or of a plane of second order, are no mechanism that has a name."""
    robot = robot_of("sawyer")
    rows = ml.MechanismRows(robot, "right_hand", ("radial", "axial"), axis=(0, 0, 1), point=POINT)
    for share in (0.2, 0.45, 0.8):
        assert ml.Constraint([[np.sqrt(share), np.sqrt(1.0 - share)]], rows).mechanism is None, share
    flat = PlaceRows(robot, TIP, "surface", POINT)
    assert ml.Constraint(np.eye(1, flat.n_rows), flat).mechanism is None


def test_what_the_learner_fitted_belongs_to_its_rows(robot_of, tmp_path) -> None:
    """The fit adds place, radius and uncertainty, also from a file; of other rows, or damaged, it is left aside. Seen
    from another frame a line stays a line, along an axis of that frame; of a hand that turns it is none.
    """
    robot = robot_of("sawyer")
    base = ml.FrameJacobian(robot, TIP)
    fitted = ml.Mechanism("line", AXIS, POINT, uncertainty={"axis": 0.01}, name="line")
    learnt_so = {"kind": "motion-constrained", "mechanism": fitted.to_dict()}
    constraint = ml.Constraint(ACROSS, base, learnt_so)
    assert constraint.mechanism == fitted
    assert ml.Constraint.load(constraint.save(tmp_path / "c.json"), robot).mechanism == fitted
    other = ml.Constraint(np.eye(3)[:2], base, learnt_so).mechanism
    assert other is not None and other.point is None and abs(other.axis[2]) == pytest.approx(1.0)
    for damage in ({"type": "line"}, {"type": "line", "axis": ["x"]}, "a line"):
        read = ml.Constraint(ACROSS, base, {"mechanism": damage}).mechanism
        assert read is not None and read.type == "line"
    seen = ml.Constraint(ACROSS, ml.RelativeFrameJacobian(robot, TIP, "right_l1", "xyz")).mechanism
    assert seen is not None and (seen.type, seen.relative_to) == ("line", "right_l1")
    assert seen.axis is not None and np.max(np.abs(ACROSS @ seen.axis)) < 1e-12
    own = ml.CustomFeatures(lambda q: np.eye(2, 7), ("a", "b"), 7)
    local = ml.FrameJacobian(robot, TIP, "xyz", "local")
    for rows, features, given in (
        (ACROSS, base, learnt_so | {"kind": "self-imposed"}),
        (ACROSS, local, {}),
        ([[1.0, 0.0]], own, {}),
    ):
        assert ml.Constraint(rows, features, given).mechanism is None


FORM_OF: dict[str, PlaceForm] = {"cylinder": "surface", "screw": "surface", "free": "point", "carried": "twist"}


def one_form(robot, kind, place: Place, radius: float, middle) -> tuple[PlaceRows, np.ndarray]:
    """A mechanism as a constant Lambda over `PlaceRows`, by what the weights of its rows are where its centre is level
    with the hand.
    """
    form = FORM_OF.get(kind.name) or FORM_OF.get(kind.orientation, "point and rotation")
    features = PlaceRows(robot, TIP, form, middle)
    W = mechanism_weights(kind.rows, place, radius)
    if kind.kind in ("line", "plane", "space"):  # the hand's own origin is held
        constant = W.at(place.point[None])[0][0]
        W = PlaceWeights(constant, np.zeros((*constant.shape, 3)))
    if kind.type == "hinge" and kind.orientation != "carried":  # beside the axial row |p - c|^2 says what rho^2 does
        ball = mechanism_weights(("spherical",), place, radius)
        W = PlaceWeights(*(np.concatenate([getattr(ball, x), getattr(W, x)[1:]]) for x in ("constant", "by_place")))
    flat = [np.concatenate([w.constant, w.by_place.reshape(-1, 18)], axis=1) for w in (features.place_weights, W)]
    selection = np.linalg.lstsq(flat[0].T, flat[1].T, rcond=1e-12)[0].T
    assert_allclose(selection @ flat[0], flat[1], atol=1e-12)
    return features, selection


def test_every_mechanism_is_a_constant_lambda(robot_of, rng, tmp_path) -> None:
    """Its type, axis, point, radius and pitch are read from rows that are known in advance, from rows that are named
    after it, and from a file.

    What the hand may do beside the mechanism is held by the same rows wherever the middle of the features is, and a
    way along it is a task as for rows that are named after it.
    """
    robot = robot_of("sawyer")
    for kind, pitch in product(MECHANISM_KINDS, (0.4, -0.2)):
        with case(kind.name, pitch):
            q, place = robot.random_configuration(rng), Place(AXIS, POINT, pitch)
            p = robot.position(q, robot.frame(TIP))
            level = p - place.point - AXIS * (AXIS @ (p - place.point))
            far = float(np.linalg.norm(p - place.point if kind.type == "ball" else level))
            features, selection = one_form(robot, kind, place, far, p + 0.1 * rng.normal(size=3))
            turned = np.linalg.qr(rng.normal(size=2 * (len(kind.rows),)))[0] @ selection
            constraint = ml.Constraint(turned, features, {"postures": [q.tolist()]})
            radius = pytest.approx(far, abs=1e-9) if set(kind.rows) & set(DISTANCE_ROWS) else None
            wanted = [(constraint, radius, 1e-9)]
            for given in (None, 0.25):
                rows = ml.MechanismRows(robot, TIP, kind.rows, axis=AXIS, point=POINT, pitch=pitch, radius=given)
                wanted.append((ml.Constraint(np.eye(len(kind.rows)), rows), given, 1e-12))
            for made, distance, exact in wanted:
                read, grip = made.mechanism, "loose" if kind.orientation == "free" else "firm"
                assert read is not None and (read.type, read.name) == (kind.type, kind.name)
                assert (read.orientation, read.grip, read.radius) == (kind.orientation, grip, distance)
                assert ml.Mechanism.from_dict(read.to_dict()) == read == pickle.loads(pickle.dumps(read))
                assert (read.axis is None) == ("axis" not in kind.unknowns)
                assert (read.point is None) == (kind.type == "held-orientation")
                if "axis" in kind.unknowns:
                    assert abs(read.axis @ AXIS) == pytest.approx(1.0, abs=exact)
                if "point" in kind.unknowns:
                    assert_allclose(read.point, place.point, atol=exact)
                elif "point-across" in kind.unknowns:
                    assert_allclose(np.cross(read.point - place.point, AXIS), 0.0, atol=exact)
                assert read.pitch == (pytest.approx(pitch, rel=1e-8) if kind.type == "screw" else None)
            back = ml.Constraint.load(constraint.save(tmp_path / "c.json"), robot)
            assert_array_equal(back(q), constraint(q))
            assert back.mechanism == constraint.mechanism
            both = np.concatenate([constraint(q), constraint.about_its_mechanism()(q)])  # the same rows there
            assert np.linalg.matrix_rank(both, 1e-7) == np.linalg.matrix_rank(constraint(q), 1e-7)


# ---- coordinates of a hand on a mechanism -------------------------------------------------------------------------

TYPES = {"space": "held-orientation", "cylinder": "other", "curve": "other"}
INTERPOLATED = 2e-5  # of the frame that goes along a curve, between the points at which it is known


def mechanisms() -> list[ml.Mechanism]:
    """Return each kind with each orientation that a hand may have on it."""
    t = np.linspace(0.0, 1.0, 9)
    bent = Curve(np.column_stack([0.3 + 0.4 * t, 0.1 * np.sin(3.0 * t), 0.2 + 0.1 * t**2]))
    kinds = ("line", "plane", "space", "hinge", "screw", "cylinder", "ball", "curve")
    out = []
    for kind, orientation in product(kinds, ("free", "about-axis", "fixed", "carried")):
        if (kind, orientation) not in (("space", "free"), ("curve", "about-axis")):
            own = {"name": "curve", "curve": bent} if kind == "curve" else {"pitch": 0.03 if kind == "screw" else None}
            axis = None if kind == "curve" else AXIS
            out.append(ml.Mechanism(TYPES.get(kind, kind), axis, POINT, orientation=orientation, **own))
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
    and not beside it; the twist is the derivative of the pose; a moved mechanism has the same poses, moved.
    """
    rng, exact, k = np.random.default_rng(5), 2e-9 if mechanism.curve else 1e-12, mechanism.n_free
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix(), [0.1, 0.2, -0.1]
    for _ in range(5):
        grasp = near(rng, mechanism)
        chart = mechanism.at(grasp)
        assert_allclose(chart.pose(np.zeros(k)), grasp, atol=1e-12)
        s = rng.uniform(-0.15, 0.15, k)
        pose = chart.pose(s)
        assert_allclose(chart.coordinates(pose), s, atol=exact)
        assert_allclose(chart.coordinates(np.array([grasp, pose])), [0.0 * s, s], atol=exact)
        assert_allclose(chart.held_error(pose), np.zeros(6 - k), atol=exact)
        for step, twist in zip(np.eye(k) * 1e-5, chart.twist(s).T, strict=True):
            after, before = chart.pose(s + step), chart.pose(s - step)
            turn = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
            slope = np.append(after[:3, 3] - before[:3, 3], turn) / 2e-5
            assert_allclose(twist, slope, atol=INTERPOLATED if mechanism.curve else 1e-8)
        beside = pose.copy()
        beside[:3, :3] = Rotation.from_rotvec(rng.normal(0.0, 0.02, 3)).as_matrix() @ pose[:3, :3]
        beside[:3, 3] += rng.normal(0.0, 0.005, 3)
        off = chart.held_error(beside)
        assert len(off) == 6 - k and (not len(off) or np.linalg.norm(off) > 1e-4)
        if k == 1:
            there, back = mechanism.moved(T).at(T @ grasp), mechanism.reversed().at(grasp)
            assert_allclose(there.pose([0.1]), T @ chart.pose([0.1]), atol=1e-6)
            assert_allclose(back.pose([-0.1]), chart.pose([0.1]), atol=1e-6)


def test_a_hand_that_cannot_hold_it_there_is_refused():
    """A place that is unknown, a hand that is off, and what is no pose: with figures."""
    beside = np.eye(4)
    beside[:3, 3] = POINT + [0.0, 0.1, 0.0]
    door = ml.Mechanism("hinge", (0, 0, 1), POINT, radius=0.4)
    for mechanism, pose, words in (
        (ml.Mechanism("line"), np.eye(4), "the place of the mechanism is not known"),
        (ml.Mechanism("ball"), np.eye(4), "the place of the mechanism is not known"),
        (ml.Mechanism("plane", (0, 1, 0), POINT), beside, "100 mm off the mechanism .*50 mm are allowed"),
        (door, beside, "300 mm off the mechanism"),
        (door, np.eye(3), "a grasp pose"),
        (door, np.full((4, 4), np.nan), "a grasp pose"),
    ):
        with pytest.raises(ConstraintError, match=words):
            mechanism.at(pose)
    assert door.at(beside, within=0.5).coordinates(beside) == pytest.approx(np.zeros(4))
    knob = ml.Mechanism("hinge", AXIS, POINT, radius=0.0, orientation="carried", grip="firm")
    beside[:3, 3] = POINT + 0.2 * AXIS
    assert knob.at(beside).coordinates(beside) == pytest.approx([0.0])  # its rotation is the angle
    rods = [ml.Mechanism("other", AXIS, POINT, radius=x, orientation="carried") for x in (4.9e-3, 5.1e-3)]
    assert [rod.in_fingers for rod in rods] == [True, False]  # nearer than 5 mm it turns about itself


# ---- the task frame -----------------------------------------------------------------------------------------------

STANDS, OFF = np.array([0.2, -0.1, 1.0]), np.array([0.5, 0.2, 0.1])  # of an axis: how it stands, and where


def frame_features() -> dict[str, ml.FeatureMap]:
    """Rows in any axes, of the base, of the hand or as another frame sees it; of each mechanism, and of places."""
    panda = arm("panda")
    maps: dict[str, ml.FeatureMap] = {"relative": ml.RelativeFrameJacobian(panda, TCP, "panda_link2")}
    for axes, reference in product(("xyz", "pose", "x y rz"), ("world", "local")):
        maps[f"{axes}, {reference}"] = ml.FrameJacobian(panda, TCP, axes, reference)
    for form in ("point", "point and rotation", "twist"):
        maps[form] = PlaceRows(panda, TCP, form, OFF)
    for kind in MECHANISM_KINDS:
        pitch = 0.01 * (kind.type == "screw")
        maps[kind.name] = ml.MechanismRows(panda, TCP, kind.rows, axis=STANDS, point=OFF, pitch=pitch)
    return maps


@pytest.mark.parametrize(("name", "features"), frame_features().items(), ids=frame_features())
def test_all_of_lambda_comes_back(name, features):
    """Held rows from the frame span the rows of A to rounding, of a mechanism and of dense rows; so do its words, but
    for a screw, of which z and rz are mixed by its pitch, and each says so.
    """
    panda, rng, mechanism = features.robot, np.random.default_rng(1), isinstance(features, ml.MechanismRows)
    n = features.n_rows
    selections = [np.eye(n)] * 3 if mechanism else [rng.standard_normal((s, n)) for s in range(1, min(n, 5) + 1)]
    for selection in selections:
        constraint, q = ml.Constraint(selection, features), panda.random_configuration(rng)
        frame, J = constraint.task_frame(q), panda.jacobian(q, TCP)
        if name == "relative":
            d = frame.hand[:3, 3] - panda.position(q, "panda_link2")
            J = J - panda.jacobian(q, "panda_link2")
            J[:3] += np.cross(d[:, None], panda.jacobian(q, "panda_link2")[3:], axis=0)
        exact = 1e-12 if mechanism else 1e-13 * np.linalg.cond(J)
        assert row_space_angle(row_basis(constraint(q)), frame.rows @ frame.from_hand @ J) < exact
        assert np.all((frame.uncertainty >= 0.0) & (frame.uncertainty <= np.pi / 2))
        R = frame.pose[:3, :3]
        assert np.allclose(R @ R.T, np.eye(3), rtol=0, atol=rounding(8 * panda.nv, R)) and np.linalg.det(R) > 0.0
        if name == "screw, firm":
            assert frame.axes == ("held",) * 5 + ("free",)
            assert_allclose(frame.uncertainty, [0.0, 0.0, np.arctan(0.01)] * 2, atol=1e-9)
        elif mechanism:
            told = np.eye(6)[frame.along("held")] @ frame.from_hand  # rebuilt from the words for the axes alone
            assert row_space_angle(constraint(q), told @ J) < exact


def test_axes_in_words():
    """What is held, free and not known of a table and a drawer, z along the mechanism's axis. What is
    written down is JSON, with the axes by name; features of no frame are refused in a sentence.
    """
    robot = arm("sawyer")
    q = robot.neutral() + 0.3

    def frame(selection, axes: str) -> ml.TaskFrame:
        return ml.Constraint(selection, ml.FrameJacobian(robot, TIP, axes)).task_frame(q)

    table = frame([[0.1, 0.2, 0.97]], "xyz")
    assert table.axes == ("free", "free", "held", "unknown", "unknown", "unknown")
    assert abs(table.pose[:3, 2] @ [0.1, 0.2, 0.97]) == pytest.approx(np.linalg.norm([0.1, 0.2, 0.97]))
    drawer = frame([[-0.6, 0.8, 0], [0, 0, 1]], "xyz")
    assert drawer.axes[:3] == ("held", "held", "free") and np.allclose(np.abs(drawer.pose[:3, 2]), [0.8, 0.6, 0.0])
    assert np.array_equal(drawer.pose[:3, 3], drawer.hand[:3, 3]) and drawer.turns == "no"
    assert frame(np.eye(6)[[3, 4]], "pose").axes == ("free", "free", "free", "held", "held", "free")
    described = json.loads(json.dumps(frame([[0, 0, 1]], "xyz").to_dict(), allow_nan=False))
    assert described["axes"]["z"] == "held" and described["mechanism"]["type"] == "plane"
    with pytest.raises(ConstraintError, match="not rows of one frame's twist"):
        ml.Constraint([[0, 0, 1]], ml.CentreOfMass(robot)).task_frame(q)


def test_stated_angles_are_in_radians():
    """What the learner states in degrees, of Lambda, or of a fitted axis and its place as seen by the hand; rows by
    hand have no doubt.
    """
    panda = arm("panda")
    q, up = panda.neutral(), ml.FrameJacobian(panda, TCP)
    for given, angle in (({}, 0.0), ({"uncertainty_deg": 0.3}, np.radians(0.3))):
        stated = ml.Constraint([[0, 0, 1]], up, given).task_frame(q).uncertainty
        assert_allclose(stated, [*[angle] * 3, *[np.pi / 2] * 3], rtol=1e-12)
    features = ml.MechanismRows(panda, TCP, "radial axial", axis=STANDS, point=OFF)
    fitted = dataclasses.replace(ml.Constraint(np.eye(2), features).mechanism, uncertainty={"axis": 0.5, "point": 2e-3})
    door = ml.Constraint(np.eye(2), features, {"mechanism": fitted.to_dict()}).task_frame(q)
    across = np.hypot(np.radians(0.5), np.arctan(2e-3 / np.linalg.norm(door.hand[:3, 3] - door.pose[:3, 3])))
    assert_allclose(door.uncertainty[:3], [across, across, np.radians(0.5)], rtol=1e-9)
