"""Rows about an axis or a centre: manipulability, files, and zero on the mechanism's own motion.

Their derivatives are in test_gradients.py.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from case import case
from test_gradients import central_difference

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import MechanismRows
from manip_learn.constraint.features.mechanism_rows import FIELDS, PlaceRows
from manip_learn.constraint.manipulability import manipulability, manipulability_gradient
from manip_learn.constraint.manipulability_batch import manipulability_batch
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import Hold, PointAttractor
from manip_learn.errors import ConstraintMismatchError, FeatureError

AXIS, POINT, PITCH = (0.3, -0.5, 0.8), (0.4, 0.2, 0.3), 0.07
TIPS = {"planar3": "tip", "panda": "panda_hand_tcp", "ur5": "tool0"}
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
    return MechanismRows(robot, TIPS[name], rows, **options)


@pytest.mark.parametrize("name", list(TIPS))
def test_manipulability_gradient(robot_of, rng, name):
    """grad mu of constraints on these rows is right to 1e-6, one posture or many."""
    robot = robot_of(name)
    q = np.stack([robot.random_configuration(rng) for _ in range(4)])
    for rows in GROUPS:
        with case(rows):
            features = rows_of(robot, name, rows, radius=0.4 if name == "panda" else None)
            constraint = Constraint(np.eye(features.n_rows), features)
            batch = manipulability_batch(constraint, q)
            for i, x in enumerate(q):
                mu, gradient = manipulability(constraint, x), manipulability_gradient(constraint, x)
                assert batch.mu[i] == pytest.approx(mu, rel=1e-9, abs=1e-12)
                np.testing.assert_allclose(batch.gradient[i], gradient, rtol=1e-7, atol=1e-9)
                if mu > 1e-3:
                    expected = central_difference(lambda y, c=constraint: manipulability(c, y), robot, x)
                    np.testing.assert_allclose(
                        gradient, expected, rtol=0, atol=1e-6 * max(np.linalg.norm(expected), mu)
                    )


def test_rows_are_what_they_are_called(robot_of, rng):
    """Each row is the velocity that its name says, in numbers; with a radius those of that distance."""
    robot, h = robot_of("panda"), PITCH
    q = robot.random_configuration(rng)
    J, p = robot.jacobian(q, robot.frame("panda_hand_tcp")), robot.position(q, robot.frame("panda_hand_tcp"))
    a = np.array(AXIS) / np.linalg.norm(AXIS)
    for radius in (None, 0.3):
        features = rows_of(robot, "panda", tuple(FIELDS), radius=radius)
        first, second = features.geometry.across
        np.testing.assert_allclose(np.linalg.det([first, second, a]), 1.0, rtol=1e-12)  # a right-handed base
        d = p - POINT
        x = d - (a @ d) * a
        rho, far = (np.linalg.norm(x), np.linalg.norm(d)) if radius is None else (radius, radius)
        size = rho * np.hypot(rho, h)
        at_c = J[:3] + np.cross(J[3:].T, POINT - p).T  # of the hand's point that is at c
        wanted = {
            "radial": x / rho @ J[:3],
            "tangential": np.cross(a, x) / rho @ J[:3],
            "axial": a @ J[:3],
            "helical": (rho**2 * a - h * np.cross(a, x)) / size @ J[:3],
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
        for name, row in zip(features.row_names, features(q), strict=True):
            np.testing.assert_allclose(row, wanted[name], rtol=0, atol=1e-8, err_msg=f"{name}, radius {radius}")


def test_rows_of_a_place_in_numbers(robot_of, rng):
    """v, the rate of half the squared distance, w; the velocity of the hand's point at m; products (p - m)_i v_j."""
    robot, m = robot_of("panda"), np.array([0.3, -0.2, 0.6])
    q = robot.random_configuration(rng)
    J, d = robot.jacobian(q, robot.frame("panda_hand_tcp")), robot.position(q, "panda_hand_tcp") - m
    v, w, place, turn = J[:3], J[3:], ("m/s",) * 3, ("rad/s",) * 3
    forms = {
        "point": ([*v, d @ v], "x y z distance", (*place, "m^2/s")),
        "point and rotation": ([*v, d @ v, *w], "x y z distance rx ry rz", (*place, "m^2/s", *turn)),
        "twist": ([*(v + np.cross(d, w.T).T), *w], "x y z rx ry rz", (*place, *turn)),
        "surface": ([*v, *np.kron(d[:, None], v)], "x y z xx xy xz yx yy yz zx zy zz", (*place, *("m^2/s",) * 9)),
    }
    for form, (rows, names, units) in forms.items():
        features = PlaceRows(robot, "panda_hand_tcp", form, m)
        np.testing.assert_allclose(features(q), rows, rtol=0, atol=1e-12, err_msg=form)
        assert (features.row_names, features.row_units) == (tuple(names.split()), units)
    for wrong, words in (
        (("line", m), "form must be"),
        (("point", m[:2]), "middle"),
        (("point", m * np.nan), "middle"),
    ):
        with pytest.raises(FeatureError, match=words):
            PlaceRows(robot, "panda_hand_tcp", *wrong)


def test_finite_on_the_axis(robot_of, rng):
    """On the axis, in the centre and close by everything stays finite, and mu vanishes only there."""
    robot = robot_of("panda")
    q = robot.random_configuration(rng)
    p = robot.position(q, robot.frame("panda_hand_tcp"))
    for rows, distance in product(
        ("radial axial", "helical radial", "spherical", "tangential"), (0, 1e-12, 1e-6, 1e-4)
    ):
        with case(rows, distance):
            features = rows_of(robot, "panda", rows, point=p + distance * np.array([1.0, 0.6, 0.0]), pitch=0.0)
            constraint = Constraint(np.eye(features.n_rows), features)
            assert np.all(np.isfinite(features.derivative(q)))
            assert np.all(np.isfinite(manipulability_gradient(constraint, q)))
            assert np.all(np.isfinite(ResolvedRateController(constraint, task=Hold())(q).velocity))
            assert (manipulability(constraint, q) < 1e-6) == (distance < 1e-9)


def test_files_keep_every_bit(robot_of, rng, tmp_path):
    """A saved constraint comes back with the same rows and the same numbers; a damaged one is refused."""
    robot = robot_of("panda")
    q = robot.random_configuration(rng)
    for rows in GROUPS:
        with case(rows):
            features = rows_of(robot, "panda", rows, radius=0.25 if "radial" in rows else None)
            constraint = Constraint(rng.normal(size=(1, features.n_rows)), features)
            back = Constraint.load(constraint.save(tmp_path / "door.json"), robot)
            np.testing.assert_allclose(back(q), constraint(q), rtol=0, atol=1e-15)
            np.testing.assert_array_equal(back.selection, constraint.selection)
            assert back.features.row_units == features.row_units
            text = (tmp_path / "door.json").read_text().replace('"axis"', '"akis"')
            (tmp_path / "broken.json").write_text(text)
            with pytest.raises(ConstraintMismatchError, match="damaged"):
                Constraint.load(tmp_path / "broken.json", robot)


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
        ({"rows": "radial", "radius": np.inf}, "radius"),
    ]
    for options, message in wrong:
        with pytest.raises(FeatureError, match=message):
            MechanismRows(robot, "panda_hand_tcp", **options)
    with pytest.raises(FeatureError, match="coordinates"):
        rows_of(robot, "panda", "tangential").coordinates(robot.neutral())
