"""Every derivative of the library against central differences: feature maps x references x robots x postures."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product

import numpy as np
import pytest
from case import case
from conftest import LOCKED, TIPS, URDFS, tip_of

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import (
    CentreOfMass,
    CustomFeatures,
    FeatureMap,
    FrameJacobian,
    MechanismRows,
    RelativeFrameJacobian,
    Stacked,
)
from manip_learn.constraint.features.mechanism_rows import FIELDS, PlaceRows
from manip_learn.constraint.manipulability import (
    gradient_of,
    log_manipulability_gradient,
    manipulability,
    manipulability_gradient,
    smallest_gradient,
)
from manip_learn.robot.robot import Robot

H = 1e-5
ROBOTS = [*URDFS, *TIPS]
AXES = ["xyz", "pose", "planar", "x", "x rz", "ry z"]
REFERENCES = ["world", "local"]
ABOUT = {"axis": (0.3, -0.5, 0.8), "point": (0.4, 0.2, 0.3), "pitch": 0.07}
RobotOf = Callable[[str], Robot]


def central_difference(f: Callable[[np.ndarray], np.ndarray | float], robot: Robot, q: np.ndarray) -> np.ndarray:
    """d f / d q along every tangent coordinate, last axis."""
    columns = []
    for k in range(robot.nv):
        step = np.zeros(robot.nv)
        step[k] = H
        columns.append((np.asarray(f(robot.integrate(q, step))) - np.asarray(f(robot.integrate(q, -step)))) / (2 * H))
    return np.stack(columns, axis=-1)


def postures(robot: Robot, rng: np.random.Generator) -> list[np.ndarray]:
    """Two at random, and two where arms are singular: stretched (all joints zero) and one elbow only bent."""
    zero, bent = np.zeros(robot.nv), np.zeros(robot.nv)
    bent[robot.nv // 2] = 0.9
    return [
        robot.random_configuration(rng),
        robot.random_configuration(rng),
        robot.configuration(zero),
        robot.configuration(bent),
    ]


def other_frame(robot: Robot) -> str:
    """A frame that moves otherwise than the tip: on another branch where there is one, else halfway up the arm."""
    return "arm_b" if robot.name == "tree" else robot.frame_names[len(robot.frame_names) // 2]


def feature_maps(robot: Robot, tip: str) -> Iterator[FeatureMap]:
    """Each kind of features that has derivatives of its own."""
    other = other_frame(robot)
    for frame, axes, reference in product((tip, other), AXES, REFERENCES):
        yield FrameJacobian(robot, frame, axes, reference)
    yield from (CentreOfMass(robot, axes) for axes in ("xyz", "x", "z y"))
    yield from (RelativeFrameJacobian(robot, tip, other, axes) for axes in ("pose", "x", "y rz"))
    yield from (MechanismRows(robot, tip, tuple(FIELDS), **ABOUT, radius=radius) for radius in (None, 0.3))
    yield from (PlaceRows(robot, tip, form, (0.1, 0.2, 0.5)) for form in ("point and rotation", "twist", "surface"))
    mixed = FrameJacobian(robot, tip, "x rz", "local"), CentreOfMass(robot, "z"), FrameJacobian(robot, tip, "y")
    yield Stacked(mixed)


@pytest.mark.parametrize("name", ROBOTS)
def test_every_feature_map(robot_of: RobotOf, rng: np.random.Generator, name: str):
    """dPhi/dq is right at random and at singular postures, and every other way to the same numbers gives them."""
    robot = robot_of(name)
    q = np.stack(postures(robot, rng))
    for features in feature_maps(robot, tip_of(name)):
        with case(features):
            Phi, dPhi = (np.stack([f(x) for x in q]) for f in (features, features.derivative))
            expected = np.stack([central_difference(features, robot, x) for x in q])
            scale = max(1.0, float(np.max(np.abs(expected))))
            assert dPhi.shape == (len(q), features.n_rows, robot.nv, robot.nv)
            np.testing.assert_allclose(dPhi, expected, rtol=0, atol=1e-8 * scale)
            both = [features.value_and_derivative(x) for x in q]
            np.testing.assert_allclose([value for value, _ in both], Phi, rtol=0, atol=1e-13 * scale)
            np.testing.assert_array_equal([slope for _, slope in both], dPhi)
            many, slopes = features.batch_with_derivative(q)
            np.testing.assert_allclose(features.batch(q), Phi, rtol=0, atol=1e-12 * scale)
            np.testing.assert_allclose(many, Phi, rtol=0, atol=1e-12 * scale)
            np.testing.assert_allclose(slopes, dPhi, rtol=0, atol=1e-11 * scale)
            positions = np.stack([robot.positions(x) for x in q])
            np.testing.assert_allclose(features.batch(positions), Phi, rtol=0, atol=1e-12 * scale)
            weights, wanted = rng.normal(size=Phi.shape), np.empty((len(q), robot.nv))
            selection = np.linalg.qr(rng.normal(size=(features.n_rows, min(4, features.n_rows))))[0].T
            for i, x in enumerate(q):
                A, vjp = features.value_and_vjp(x, features.padded(selection))
                np.testing.assert_allclose(A, selection @ Phi[i], rtol=0, atol=1e-13 * scale)
                sought = np.einsum("ij,ijk->k", selection.T @ A, dPhi[i])
                np.testing.assert_allclose(vjp(A), sought, rtol=0, atol=1e-11 * scale**2)
                wanted[i] = np.einsum("ij,ijk->k", weights[i], dPhi[i])
            got = features.batch_vjp(q, lambda _, part, w=weights: w[part].transpose(1, 2, 0))
            np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-10 * scale)


@pytest.mark.parametrize("name", ROBOTS)
def test_rows_are_rates(robot_of: RobotOf, rng: np.random.Generator, name: str):
    """Rows are the rate of the frame's origin and orientation in the base, in itself, and as another frame sees it;
    those of the centre of mass that of its place. Without a derivative of the user's own, differences come within 1e-8.
    """
    robot = robot_of(name)
    frame, other = robot.frame(tip_of(name)), robot.frame(other_frame(robot))
    mass, relative = CentreOfMass(robot), RelativeFrameJacobian(robot, frame.name, other.name)
    custom = CustomFeatures(lambda q: robot.jacobian(q, frame)[:2], ("x", "y"), robot=robot)

    def twist(pose: Callable[[np.ndarray], np.ndarray], q: np.ndarray) -> np.ndarray:
        rate = central_difference(pose, robot, q)
        spin = np.einsum("ijk,lj->ilk", rate[:3, :3], pose(q)[:3, :3])  # skew matrix of the angular velocity
        return np.concatenate([rate[:3, 3], [spin[2, 1], spin[0, 2], spin[1, 0]]])

    for q in postures(robot, rng):
        with case(q.tolist()):
            R = robot.pose(q, frame)[:3, :3]
            world, local = robot.jacobian(q, frame, "world"), robot.jacobian(q, frame, "local")
            np.testing.assert_allclose(world, twist(lambda x: robot.pose(x, frame), q), rtol=0, atol=1e-8)
            np.testing.assert_allclose(local, np.concatenate([R.T @ world[:3], R.T @ world[3:]]), rtol=0, atol=1e-12)
            seen = twist(lambda x: np.linalg.inv(robot.pose(x, other)) @ robot.pose(x, frame), q)
            np.testing.assert_allclose(relative(q), seen, rtol=0, atol=1e-8)
            np.testing.assert_allclose(mass(q), central_difference(mass.coordinates, robot, q), rtol=0, atol=1e-8)
            exact = FrameJacobian(robot, frame.name, "x y").derivative(q)
            np.testing.assert_allclose(custom.derivative(q), exact, rtol=0, atol=1e-8)


def relative_error(got: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(got - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize("name", ROBOTS)
def test_manipulability_gradient(robot_of: RobotOf, rng: np.random.Generator, name: str):
    """grad mu and grad log mu of dense random constraints are right to 1e-6, for every number of rows."""
    for axes, reference in product(AXES, REFERENCES):
        checked = check_manipulability_gradient(robot_of(name), rng, name, axes, reference)
        assert checked > 0 or structurally_singular(name, axes), f"{axes} in {reference} axes: nothing was compared"


def check_manipulability_gradient(robot: Robot, rng: np.random.Generator, name: str, axes: str, reference: str) -> int:
    """Number of gradients that were compared with differences."""
    features = FrameJacobian(robot, tip_of(name), axes, reference)
    words, checked = f"{axes} in {reference} axes", 0
    for s in range(1, min(features.n_rows, robot.nv) + 1):
        constraint = Constraint(rng.normal(size=(s, features.n_rows)), features)
        for _ in range(3):
            q = robot.random_configuration(rng)
            sigma = np.linalg.svd(constraint(q), compute_uv=False)
            if sigma[-1] <= 1e-3 * sigma[0]:  # differences lose their digits near the tip of the cone
                continue
            gradient = manipulability_gradient(constraint, q)
            expected = central_difference(lambda x, c=constraint: manipulability(c, x), robot, q)
            if np.linalg.norm(expected) < 1e-6 * np.prod(sigma):  # mu is constant
                np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-9, err_msg=words)
                checked += 1
                continue
            assert relative_error(gradient, expected) <= 1e-6, words
            checked += 1
            if np.linalg.norm(expected) * H > 1e-3 * np.prod(sigma):  # log mu is too curved for differences
                continue
            in_logs = central_difference(lambda x, c=constraint: np.log(manipulability(c, x)), robot, q)
            assert relative_error(log_manipulability_gradient(constraint, q), in_logs) <= 1e-6, words
    return checked


def structurally_singular(name: str, axes: str) -> bool:
    """A planar arm neither moves along z nor turns about x or y: those rows are zero at every posture."""
    return name == "planar3" and axes == "ry z"


def test_more_rows_than_joints(robot_of: RobotOf, rng: np.random.Generator):
    """With more rows than joints mu is 0 everywhere, and so is its gradient."""
    for name in ("one", "planar3", "gantry", "wrist", "mimic"):
        robot = robot_of(name)
        constraint = Constraint(np.eye(6), FrameJacobian(robot, tip_of(name), "pose"))
        q = robot.random_configuration(rng)
        assert manipulability(constraint, q) == 0.0, name
        np.testing.assert_array_equal(manipulability_gradient(constraint, q), np.zeros(robot.nv), err_msg=name)
        np.testing.assert_array_equal(log_manipulability_gradient(constraint, q), np.zeros(robot.nv), err_msg=name)


# Each is exactly singular with its rank short by one: robot, axes, selection (None: all rows; "blocked": one row that
# no joint moves at this posture, and one at random), posture.
CONES = {
    "planar, stretched along x": ("planar3", "x y", None, [0.0, 0.0, 0.0]),
    "planar, stretched askew": ("planar3", "x y", None, [0.4, 0.0, 0.0]),
    "planar, folded": ("planar3", "x y", None, [0.7, np.pi, np.pi]),
    "planar, one row, all zero": ("planar3", "x y", [[1.0, 0.0]], [0.0, 0.0, 0.0]),
    "planar, square": ("planar3", "planar", None, [0.2, 0.0, 0.5]),
    "planar, dense": ("planar3", "planar", [[np.cos(0.4), np.sin(0.4), 0.0], [-0.5, 0.3, 2.0]], [0.4, 0.0, 0.0]),
    "continuous joints": ("wrist", "pose", "blocked", [0.3, 0.9, -0.4, 0.2]),
    "prismatic joints": ("gantry", "pose", "blocked", [0.3, 0.5, -0.4, 0.2, 0.1]),
    "mimic joint": ("mimic", "pose", "blocked", [0.3, 0.5, -0.4]),
    "ur5, pose": ("ur5", "pose", None, [0.3, -1.0, 0.8, 0.4, 0.0, 0.2]),
    "panda, upright": ("panda", "rotation", None, [0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1]),
}


def cone(robot_of: RobotOf, name: str, axes: str, selection: list | str | None, positions: list[float]):
    robot = robot_of(name)
    features = FrameJacobian(robot, tip_of(name), axes)
    q = robot.configuration(positions)
    if selection is None:
        selection = np.eye(features.n_rows)
    elif selection == "blocked":
        still = np.linalg.svd(features(q))[0][:, -1]
        selection = np.stack([still, np.random.default_rng(3).normal(size=features.n_rows)])
    return robot, Constraint(selection, features), q


@pytest.mark.parametrize("which", CONES)
def test_singularities(robot_of: RobotOf, rng: np.random.Generator, which: str):
    """At an exact singularity grad mu has the direction and the rate of the cone's steepest ascent: mu rises along it
    at the rate claimed, either way, and faster than along 200 directions at random, its largest entry being positive.
    From 1e-2 down to 1e-13 beside it the gradients stay finite, and grad mu keeps pointing up the cone: a step along it
    raises mu (one of 1e-9 where the distance itself drowns in rounding).
    """
    robot, constraint, q = cone(robot_of, *CONES[which])
    gradient = manipulability_gradient(constraint, q)
    rate = float(np.linalg.norm(gradient))
    assert np.all(np.isfinite(gradient)) and rate > 1e-3
    assert np.max(gradient) == np.max(np.abs(gradient))

    def rise(direction: np.ndarray, h: float = 1e-6) -> float:
        return manipulability(constraint, robot.integrate(q, h * direction)) / h

    assert manipulability(constraint, q) <= 1e-15
    assert rise(gradient / rate) == pytest.approx(rate, rel=1e-4)
    assert rise(-gradient / rate) == pytest.approx(rate, rel=1e-4)
    directions = rng.normal(size=(200, robot.nv))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert max(rise(d) for d in directions) <= rate * (1 + 1e-4)
    for d in directions[:50]:  # nor does any small turn of the direction itself help
        turned = gradient / rate + 0.05 * d
        assert rise(turned / np.linalg.norm(turned)) <= rate * (1 + 1e-4)
    away = rng.normal(size=robot.nv)
    for distance in 10.0 ** -np.arange(2.0, 14.0):
        with case(distance):
            near = robot.integrate(q, distance * away)
            gradient = manipulability_gradient(constraint, near)
            length = float(np.linalg.norm(gradient))
            assert np.all(np.isfinite(gradient)) and length <= 1.5 * rate + 0.1
            assert np.all(np.isfinite(log_manipulability_gradient(constraint, near)))
            step = robot.integrate(near, (1e-2 * distance if distance > 1e-11 else 1e-9) * gradient / length)
            assert manipulability(constraint, step) >= manipulability(constraint, near)


def test_rank_short_by_two(robot_of: RobotOf):
    """Where the rank is short by two, mu grows faster than linearly in no direction: the gradient is zero, not NaN."""
    robot = robot_of("planar3")
    A, dA = np.zeros((2, robot.nv)), np.ones((2, robot.nv, robot.nv))
    mu, gradient, _ = gradient_of(A, dA)
    assert mu == 0.0
    np.testing.assert_array_equal(gradient, np.zeros(robot.nv))


def test_gradient_keeps_its_digits_near_the_cone(robot_of: RobotOf):
    """1e-7 from a singularity the gradient of the stretched planar arm is still right to 1e-6 (closed form)."""
    robot = robot_of("planar3")
    constraint = Constraint(np.eye(2), FrameJacobian(robot, "tip", "x y"))
    # links of 1 m: mu^2 is the sum of the squared 2 x 2 minors of the planar Jacobian
    q1, q2, q3 = 0.4, 1e-7, 2e-7

    def minors(q2: float, q3: float) -> np.ndarray:
        return np.array([np.sin(q2) + np.sin(q2 + q3), np.sin(q2 + q3) + np.sin(q3), np.sin(q3)])

    m = minors(q2, q3)
    d2 = np.array([np.cos(q2) + np.cos(q2 + q3), np.cos(q2 + q3), 0.0])
    d3 = np.array([np.cos(q2 + q3), np.cos(q2 + q3) + np.cos(q3), np.cos(q3)])
    mu = float(np.linalg.norm(m))
    expected = np.array([0.0, m @ d2, m @ d3]) / mu
    got = manipulability_gradient(constraint, np.array([q1, q2, q3]))
    assert manipulability(constraint, np.array([q1, q2, q3])) == pytest.approx(mu, rel=1e-6)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-6 * np.linalg.norm(expected))


def test_the_robots_cover_what_they_should(robot_of: RobotOf):
    """The matrix above holds nv = 1, 3, 6 and 7, prismatic, continuous and mimic joints, floating and planar bases."""
    robots = {name: robot_of(name) for name in ROBOTS}
    assert {1, 3, 6, 7} <= {r.nv for r in robots.values()}
    kinds = {b.kind for r in robots.values() for b in r.blocks}
    assert {"revolute", "prismatic", "continuous", "floating", "planar"} <= kinds
    assert any(r.mimics for r in robots.values())
    assert any(r.nq != r.nv for r in robots.values())
    assert set(LOCKED) <= set(ROBOTS)


@pytest.mark.parametrize("name", ["planar3", "panda", "gantry"])
def test_gradient_of_the_smallest_singular_value(name: str, robot_of: RobotOf, rng: np.random.Generator) -> None:
    """It is the slope of sigma_min, wherever that is neither 0 nor double."""
    robot = robot_of(name)
    constraint = Constraint(np.eye(2), FrameJacobian(robot, tip_of(name), "x y"))
    for _ in range(5):
        q = robot.random_configuration(rng)
        sigma = np.linalg.svd(constraint(q), compute_uv=False)
        if min(sigma[1], sigma[0] - sigma[1]) < 0.05:
            continue
        slope = central_difference(lambda x: float(np.linalg.svd(constraint(x), compute_uv=False)[-1]), robot, q)
        A, vjp = constraint.value_and_vjp(q)
        np.testing.assert_allclose(smallest_gradient(np.linalg.svd(A), vjp), slope.reshape(-1), atol=1e-6)
