"""The mechanism that is read from Lambda: type, axis and pitch of the motions that it leaves free."""

from __future__ import annotations

import pickle
from itertools import product

import numpy as np
import pytest
from case import case

import manip_learn as ml
from manip_learn.constraint.features import FrameJacobian, MechanismRows, RelativeFrameJacobian
from manip_learn.constraint.features.mechanism_rows import PlaceForm, PlaceRows
from manip_learn.constraint.mechanism import MECHANISM_KINDS
from manip_learn.constraint.place import AT_A_DISTANCE, Place, PlaceWeights, mechanism_weights

TIP = "right_gripper_tip"
AXIS = np.array([0.6, 0.64, 0.48])
ACROSS = np.linalg.svd(AXIS[None])[2][1:]
TURNS = np.hstack([np.zeros((3, 3)), np.eye(3)])


def padded(rows: np.ndarray) -> np.ndarray:
    return np.hstack([rows, np.zeros((len(rows), 3))])


CONSTANT_ROWS = [
    ("xyz", ACROSS, "line", AXIS, "free"),
    ("xyz", AXIS[None], "plane", AXIS, "free"),
    ("xyz", np.eye(3), None, None, ""),
    ("x y", [[1.0, 0.0]], None, None, ""),
    ("pose", padded(ACROSS), "line", AXIS, "free"),
    ("pose", np.vstack([padded(ACROSS), TURNS]), "line", AXIS, "fixed"),
    ("pose", np.vstack([padded(AXIS[None]), TURNS[:2]]), "plane", AXIS, "about-axis"),
    ("pose", np.hstack([np.zeros((2, 3)), ACROSS]), "held-orientation", AXIS, "about-axis"),
    ("pose", TURNS, "held-orientation", None, "fixed"),
    ("rotation", ACROSS, "held-orientation", AXIS, "about-axis"),
    ("pose", [[0.7, 0.0, 0.0, 0.7, 0.0, 0.0]], None, None, ""),
]


def test_constant_rows_of_the_base(robot_of) -> None:
    """Lines, planes and held orientations, in whatever basis the rows come; a row that mixes m and rad is none."""
    for axes, selection, kind, axis, orientation in CONSTANT_ROWS:
        with case(axes, selection):
            features = FrameJacobian(robot_of("sawyer"), TIP, axes)
            mixed = np.linalg.qr(np.random.default_rng(0).normal(size=(len(selection),) * 2))[0]
            mechanism = ml.Constraint(mixed @ np.asarray(selection), features).mechanism
            if kind is None:
                assert mechanism is None
                continue
            assert mechanism is not None and (mechanism.type, mechanism.orientation) == (kind, orientation)
            assert (mechanism.point, mechanism.radius, mechanism.pitch) == (None, None, None)
            if axis is None:
                assert mechanism.axis is None
            else:
                np.testing.assert_allclose(mechanism.axis, axis, rtol=0, atol=1e-12)


def test_one_free_twist_of_the_hand(robot_of) -> None:
    """A hand that is fixed to a hinge or a screw: the twist that is left has their pitch and their distance."""
    features = FrameJacobian(robot_of("sawyer"), TIP, "pose", "local")
    for pitch, kind in ((0.0, "hinge"), (0.0032, "screw"), (-0.01, "screw")):
        with case(pitch):
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


def test_rows_about_a_place(robot_of) -> None:
    """Every mechanism that the learner knows is read back from its rows, with its axis, place, radius and pitch."""
    point = [0.5, 0.1, 0.3]
    for kind, radius in product(MECHANISM_KINDS, (None, 0.25)):
        with case(kind.name, radius):
            robot = robot_of("sawyer")
            features = MechanismRows(robot, TIP, kind.rows, axis=AXIS, point=point, pitch=0.01, radius=radius)
            mechanism = ml.Constraint(np.eye(len(kind.rows)), features).mechanism
            assert mechanism is not None and (mechanism.name, mechanism.type) == (kind.name, kind.type)
            assert (mechanism.axis is None) == ("axis" not in kind.unknowns) and mechanism.radius == radius
            if mechanism.axis is not None:
                np.testing.assert_allclose(mechanism.axis, AXIS, atol=1e-12)
            assert (mechanism.point is None) == (kind.type == "held-orientation")
            if mechanism.point is not None:
                np.testing.assert_allclose(mechanism.point, point, atol=1e-12)
            assert mechanism.pitch == (0.01 if kind.type == "screw" else None)
            assert ml.Mechanism.from_dict(mechanism.to_dict()) == mechanism == pickle.loads(pickle.dumps(mechanism))


def test_what_the_learner_fitted_belongs_to_its_rows(robot_of, tmp_path) -> None:
    """The fit adds place, radius and uncertainty, also from a file; of other rows, or damaged, it is left aside."""
    robot = robot_of("sawyer")
    fitted = ml.Mechanism("line", AXIS, np.array([0.1, 0.2, 0.3]), uncertainty={"axis": 0.01}, name="line")
    learnt = {"kind": "motion-constrained", "mechanism": fitted.to_dict()}
    constraint = ml.Constraint(ACROSS, FrameJacobian(robot, TIP), learnt)
    assert constraint.mechanism == fitted
    assert ml.Constraint.load(constraint.save(tmp_path / "c.json"), robot).mechanism == fitted
    other = ml.Constraint(np.eye(3)[:2], FrameJacobian(robot, TIP), learnt).mechanism
    assert other is not None and other.point is None and abs(other.axis[2]) == pytest.approx(1.0)
    for damage in ({"type": "line"}, {"axis": 3}, {"type": "line", "axis": ["x"]}, "a line"):
        read = ml.Constraint(ACROSS, FrameJacobian(robot, TIP), {"mechanism": damage}).mechanism
        assert read is not None and read.type == "line"
    assert ml.Constraint(ACROSS, FrameJacobian(robot, TIP), {**learnt, "kind": "self-imposed"}).mechanism is None


def test_rows_of_a_hand_or_of_another_frame(robot_of) -> None:
    """Seen from another frame a line stays a line, along an axis of that frame; of a hand that turns it is none."""
    robot = robot_of("sawyer")
    seen = ml.Constraint(ACROSS, RelativeFrameJacobian(robot, TIP, "right_l1", "xyz")).mechanism
    assert seen is not None and (seen.type, seen.relative_to) == ("line", "right_l1")
    assert seen.axis is not None and np.max(np.abs(ACROSS @ seen.axis)) < 1e-12
    assert ml.Constraint(ACROSS, FrameJacobian(robot, TIP, "xyz", "local")).mechanism is None
    assert ml.Constraint([[1.0, 0.0]], ml.CustomFeatures(lambda q: np.eye(2, 7), ("a", "b"), 7)).mechanism is None


PLACE = Place(AXIS, np.array([0.5, 0.1, 0.3]), 0.4)
FORM_OF: dict[str, PlaceForm] = {
    "free": "point",
    "about-axis": "point and rotation",
    "fixed": "point and rotation",
    "carried": "twist",
}


def one_form(robot, kind, place: Place, radius: float, middle) -> tuple[PlaceRows, np.ndarray]:
    """A mechanism as a constant Lambda over `PlaceRows`, by what the weights of its rows are where its centre is level
    with the hand.
    """
    form: PlaceForm = "surface" if kind.name in ("cylinder", "screw") else FORM_OF[kind.orientation]
    features = PlaceRows(robot, TIP, form, middle)
    W = mechanism_weights(kind.rows, place, radius)
    if kind.kind in ("line", "plane", "space"):  # the hand's own origin is held
        constant = W.at(place.point[None])[0][0]
        W = PlaceWeights(constant, np.zeros((*constant.shape, 3)))
    if kind.type == "hinge" and kind.orientation != "carried":  # beside the axial row |p - c|^2 says what rho^2 does
        ball = mechanism_weights(("spherical",), place, radius)
        W = PlaceWeights(
            np.concatenate([ball.constant, W.constant[1:]]), np.concatenate([ball.by_place, W.by_place[1:]])
        )
    T = features.place_weights
    flat = [np.concatenate([w.constant, w.by_place.reshape(-1, 18)], axis=1) for w in (T, W)]
    selection = np.linalg.lstsq(flat[0].T, flat[1].T, rcond=1e-12)[0].T
    np.testing.assert_allclose(selection @ flat[0], flat[1], atol=1e-12)
    return features, selection


def test_every_mechanism_is_a_constant_lambda(robot_of, rng, tmp_path) -> None:
    """Over rows that are known in advance; its type, axis, point, radius and pitch are read from it, from a file too.

    What the hand may do beside the mechanism is held by the same rows wherever the middle of the features is, and a
    way along it is a task as for rows that are named after it.
    """
    robot = robot_of("sawyer")
    for kind, pitch in product(MECHANISM_KINDS, (0.4, -0.2)):
        with case(kind.name, pitch):
            q, place = robot.random_configuration(rng), Place(AXIS, PLACE.point, pitch)
            p = robot.position(q, robot.frame(TIP))
            level = p - place.point - AXIS * (AXIS @ (p - place.point))
            radius = float(np.linalg.norm(p - place.point if kind.type == "ball" else level))
            features, selection = one_form(robot, kind, place, radius, p + 0.1 * rng.normal(size=3))
            turned = np.linalg.qr(rng.normal(size=2 * (len(kind.rows),)))[0] @ selection
            constraint = ml.Constraint(turned, features, {"postures": [q.tolist()]})
            read, grip = constraint.mechanism, "loose" if kind.orientation == "free" else "firm"
            assert read is not None
            assert (read.type, read.orientation, read.grip) == (kind.type, kind.orientation, grip)
            if "axis" in kind.unknowns:
                assert abs(read.axis @ AXIS) == pytest.approx(1.0, abs=1e-9)
            if "point" in kind.unknowns:
                np.testing.assert_allclose(read.point, place.point, atol=1e-9)
            elif "point-across" in kind.unknowns:
                np.testing.assert_allclose(np.cross(read.point - place.point, AXIS), 0.0, atol=1e-9)
            assert read.pitch == (pytest.approx(pitch, rel=1e-8) if kind.type == "screw" else None)
            assert read.radius == (pytest.approx(radius, abs=1e-9) if set(kind.rows) & set(AT_A_DISTANCE) else None)
            back = ml.Constraint.load(constraint.save(tmp_path / "c.json"), robot)
            np.testing.assert_array_equal(back(q), constraint(q))
            assert back.mechanism == read
            named = constraint.about_its_mechanism()
            sigma = np.linalg.svd(np.concatenate([constraint(q), named(q)]), compute_uv=False)
            assert np.count_nonzero(sigma > 1e-7) == np.linalg.matrix_rank(constraint(q), 1e-7)  # the same rows there


@pytest.mark.parametrize("keep", [False, True])
def test_a_door_in_place_rows_is_driven(robot_of, keep) -> None:
    """A way about the axis that is read from Lambda; distance and, if asked, the orientation of the hand stay."""
    robot = robot_of("panda")
    tip, axis, centre = "panda_hand_tcp", np.array([0.0, 0.0, 1.0]), np.array([0.3, 0.4, 0.3])
    q = robot.configuration([0.1, -0.3, -0.1, -2.0, 0.1, 1.8, 0.7])
    middle = robot.position(q, tip)
    rows = PlaceRows(robot, tip, "point", middle)
    door = ml.Constraint([[*axis, 0.0], [*(middle - centre), 1.0]], rows, {"postures": [list(q)]})
    assert door.mechanism is not None and door.mechanism.name == "hinge"
    task = ml.FreeDirection(door, 0.2, 0.2, keep_orientation=keep)
    rollout = ml.simulate(robot, ml.ResolvedRateController(task.constraint, task), q, 2.5, 0.01)
    d = np.array([robot.position(x, tip) for x in rollout.q]) - centre
    around, rho = np.unwrap(np.arctan2(d[:, 1], d[:, 0])), np.hypot(d[:, 0], d[:, 1])
    assert around[-1] - around[0] == pytest.approx(0.2 * np.sign(door.mechanism.axis[2]), abs=1e-3)
    assert np.ptp(rho) < 1e-3 and np.ptp(d[:, 2]) < 1e-3
    turned = np.linalg.norm(robot.pose(rollout.q[-1], tip)[:3, :3] - robot.pose(q, tip)[:3, :3])
    assert (turned < 1e-3) == keep


def test_a_flat_surface_is_no_cylinder() -> None:
    """A plane in the rows of second order has no axis of a cylinder, and so no name."""
    flat = PlaceRows(ml.load_robot("sawyer"), TIP, "surface", (0.5, 0.1, 0.3))
    assert ml.Constraint(np.eye(1, flat.n_rows), flat).mechanism is None


def test_rows_between_those_of_a_mechanism_are_none() -> None:
    """Radial and axial rows hold a hinge; a direction between two rows holds no mechanism that has a name."""
    robot = ml.load_robot("sawyer")
    rows = ml.MechanismRows(robot, "right_hand", ("radial", "axial"), axis=(0, 0, 1), point=(0.5, 0.1, 0.3))
    known = ml.Constraint(np.eye(2), rows).mechanism
    assert known is not None and known.type == "hinge"
    for share in (0.2, 0.45, 0.8):
        between = ml.Constraint([[np.sqrt(share), np.sqrt(1.0 - share)]], rows)
        assert between.mechanism is None, share
