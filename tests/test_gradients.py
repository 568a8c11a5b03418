"""Every derivative of the library against central differences: feature maps x references x robots x postures."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from case import case
from conftest import TIPS, URDFS, tip_of
from rounding import rounding

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import (
    CentreOfMass,
    CurveRows,
    CustomFeatures,
    FeatureMap,
    FrameJacobian,
    MechanismRows,
    RelativeFrameJacobian,
    Stacked,
)
from manip_learn.constraint.features.mechanism_rows import PlaceRows
from manip_learn.constraint.manipulability import (
    gradient_from,
    log_manipulability_gradient,
    manipulability,
    manipulability_batch,
    manipulability_gradient,
    smallest_gradient,
)
from manip_learn.constraint.place import ROW_UNITS
from manip_learn.robot.robot import Robot

H = 1e-5
LOST = 1e3  # of the digits of a gradient, three are lost where the rows are nearly dependent: LEAST_LENGTH_RATIO
ROBOTS = [*URDFS, *TIPS]
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


def postures(robot: Robot, rng: np.random.Generator) -> np.ndarray:
    """One at random, and two where arms are singular: stretched (all joints zero) and one elbow only bent."""
    zero, bent = np.zeros(robot.nv), np.zeros(robot.nv)
    bent[robot.nv // 2] = 0.9
    return np.stack([robot.random_configuration(rng), robot.configuration(zero), robot.configuration(bent)])


def other_frame(robot: Robot) -> str:
    """A frame that moves otherwise than the tip: on another branch where there is one, else halfway up the arm."""
    return "arm_b" if robot.name == "tree" else robot.frame_names[len(robot.frame_names) // 2]


def bent_rail(robot: Robot, frame: str, q: np.ndarray, rows: str = "across-1 across-2 along") -> CurveRows:
    """Rows along a curve that passes the hand at a centimetre."""
    t = np.linspace(-1.0, 1.0, 12)
    shape = np.column_stack([0.2 * t, 0.1 * np.sin(2.0 * t) + 0.01, 0.1 * t**2])
    return CurveRows(robot, frame, robot.position(q, frame) + shape, rows)


def feature_maps(robot: Robot, tip: str, q: np.ndarray) -> Iterator[FeatureMap]:
    """Each kind of features that has derivatives of its own; a curve's rows beside a posture."""
    other = other_frame(robot)
    for reference in ("world", "local"):
        yield from (FrameJacobian(robot, tip, axes, reference) for axes in ("xyz", "pose", "ry x"))
    yield FrameJacobian(robot, other, "planar")
    yield from (CentreOfMass(robot, axes) for axes in ("xyz", "z y"))
    yield from (RelativeFrameJacobian(robot, tip, other, axes) for axes in ("pose", "y rz"))
    yield from (MechanismRows(robot, tip, tuple(ROW_UNITS), **ABOUT, radius=radius) for radius in (None, 0.3))
    yield MechanismRows(robot, tip, "radial screw turn-1", **ABOUT, relative_to=other)
    yield PlaceRows(robot, tip, "point", (0.1, 0.2, 0.5), relative_to=other)
    yield from (PlaceRows(robot, tip, form, (0.1, 0.2, 0.5)) for form in ("point and rotation", "twist", "surface"))
    yield Stacked(
        [FrameJacobian(robot, tip, "x rz", "local"), CentreOfMass(robot, "z"), FrameJacobian(robot, tip, "y")]
    )
    yield bent_rail(robot, tip, q, "rx across-2 along across-1")


@pytest.mark.parametrize("name", ROBOTS)
def test_every_feature_map(robot_of: RobotOf, rng: np.random.Generator, name: str):
    """dPhi/dq is right at random and at singular postures, and every other way to the same numbers gives them."""
    robot = robot_of(name)
    every = postures(robot, rng)
    for features in feature_maps(robot, tip_of(name), every[0]):
        with case(features):
            q = every[:1] if isinstance(features, CurveRows) else every  # elsewhere the nearest place is not one
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
            constraint = Constraint(rng.normal(size=(min(4, features.n_rows), features.n_rows)), features)
            for i, x in enumerate(q):
                A, vjp = constraint.value_and_vjp(x)
                for value in (A, constraint(x)):
                    np.testing.assert_allclose(value, constraint.selection @ Phi[i], rtol=0, atol=1e-13 * scale)
                dA = np.einsum("sp,pij->sij", constraint.selection, dPhi[i])
                np.testing.assert_allclose(constraint.derivative(x), dA, rtol=0, atol=1e-11 * scale)
                np.testing.assert_allclose(vjp(A), np.einsum("ij,ijk->k", A, dA), rtol=0, atol=1e-11 * scale**2)


@pytest.mark.parametrize("name", ROBOTS)
def test_rows_are_rates(robot_of: RobotOf, rng: np.random.Generator, name: str):
    """Rows are the rate of the frame's origin and orientation in the base, in itself, and as another frame sees it;
    those of the centre of mass that of its place, those of a curve that of the distances and the length along it.
    Without a derivative of the user's own, differences come within 1e-8.
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
            rail = bent_rail(robot, frame.name, q)
            np.testing.assert_allclose(rail(q), central_difference(rail.coordinates, robot, q), rtol=0, atol=2e-6)
            exact = FrameJacobian(robot, frame.name, "x y").derivative(q)
            np.testing.assert_allclose(custom.derivative(q), exact, rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", ["one", "gantry", "wrist", "humanoid", "tree", "mimic", "planar3", "ur5", "panda"])
def test_manipulability_gradients(robot_of: RobotOf, rng: np.random.Generator, name: str):
    """grad mu, grad log mu and grad mu_w of dense random rows of every feature map are right to 1e-6; mu and its
    gradient are the same in bulk and in every orthonormal basis of the rows.
    """
    robot, compared = robot_of(name), 0
    middle = np.stack([robot.configuration(0.5 * robot.positions(robot.random_configuration(rng))) for _ in range(2)])
    for features in feature_maps(robot, tip_of(name), middle[0]):
        for s in {1, min(features.n_rows, robot.nv, 3)}:
            constraint = Constraint(rng.normal(size=(s, features.n_rows)), features)
            turned = Constraint(np.linalg.qr(rng.normal(size=(s, s)))[0] @ constraint.selection, features)
            q = middle[:1] if isinstance(features, CurveRows) else middle
            batch = manipulability_batch(constraint, q)
            for i, x in enumerate(q):
                with case(constraint, i):
                    mu, gradient = manipulability(constraint, x), manipulability_gradient(constraint, x)
                    log = log_manipulability_gradient(constraint, x)
                    sigma = np.linalg.svd(constraint(x), compute_uv=False)
                    # both come from a factorisation, as products of s or s - 1 numbers that are sigma[0] at most; rows
                    # add up levers and unit axes, their slopes levers crossed with axes
                    largest = max(1.0, float(np.linalg.norm(features(x))))
                    slopes = largest + np.linalg.norm(features.derivative(x))
                    known = rounding(4 * s * robot.nv, largest**s)
                    slack = LOST * rounding(4 * s * robot.nv, largest ** (s - 1), slopes)
                    assert batch.mu[i] == pytest.approx(mu, rel=0, abs=known)
                    np.testing.assert_allclose(batch.gradient[i], gradient, rtol=0, atol=slack)
                    scale = max(float(np.max(np.abs(gradient))), mu)
                    if sigma[-1] <= max(
                        1e-2 * sigma[0], 1e-4
                    ):  # differences lose their digits near the tip of the cone
                        continue
                    assert mu == pytest.approx(float(np.prod(sigma)), rel=0, abs=known)
                    assert manipulability(turned, x) == pytest.approx(mu, rel=0, abs=known)
                    np.testing.assert_allclose(manipulability_gradient(turned, x), gradient, rtol=0, atol=slack)
                    np.testing.assert_allclose(batch.log_gradient[i], log, rtol=0, atol=slack / mu)
                    expected = central_difference(lambda y, c=constraint: manipulability(c, y), robot, x)
                    np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-6 * scale)
                    np.testing.assert_allclose(log, gradient / mu, rtol=1e-12, atol=slack / mu)
                    compared += 1
    assert compared > 15


def test_more_rows_than_joints(robot_of: RobotOf, rng: np.random.Generator):
    """With more rows than joints mu is 0 everywhere, and so is its gradient, of one posture and of many."""
    for name in ("one", "planar3", "gantry", "wrist", "mimic"):
        with case(name):
            robot = robot_of(name)
            constraint = Constraint(np.eye(6), FrameJacobian(robot, tip_of(name), "pose"))
            q, none = robot.random_configuration(rng), np.zeros(robot.nv)
            assert manipulability(constraint, q) == 0.0
            np.testing.assert_array_equal(manipulability_gradient(constraint, q), none)
            np.testing.assert_array_equal(log_manipulability_gradient(constraint, q), none)
            batch = manipulability_batch(constraint, np.stack([q, q]))
            assert not batch.mu.any() and not batch.gradient.any() and batch.gradient.shape == (2, robot.nv)


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

    A = constraint(q)
    others = np.prod(np.linalg.svd(A, compute_uv=False)[:-1])
    assert manipulability(constraint, q) <= rounding(4 * A.size, A, others)
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
    mu, gradient, _ = gradient_from(A.shape, np.linalg.svd(A), lambda weights: np.tensordot(weights, dA, 2))
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
