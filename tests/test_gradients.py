"""Every derivative of the library against central differences: feature maps x references x robots x postures; what
manipulability is at singularities, and the derivatives of pose errors.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from itertools import product

import numpy as np
import pytest
from case import case, rows_in
from conftest import TIPS, URDFS, tip_of
from numpy.testing import assert_allclose, assert_array_equal
from rounding import rounding

import manip_learn as ml
from manip_learn.constraint.features.mechanism_rows import PlaceRows
from manip_learn.constraint.manipulability import gradient_from, smallest_gradient
from manip_learn.constraint.place import ROW_UNITS
from manip_learn.errors import ConfigurationError
from manip_learn.linalg import EPS, manipulability_of
from manip_learn.robot.rotations import rotation_matrix

H = 1e-5
LOST = 1e3  # of the digits of a gradient, three are lost where the rows are nearly dependent: LEAST_LENGTH_RATIO
ROBOTS = [*URDFS, *TIPS]
ABOUT = {"axis": (0.3, -0.5, 0.8), "point": (0.4, 0.2, 0.3), "pitch": 0.07}
RobotOf = Callable[[str], ml.Robot]
MU_GRADIENTS = (ml.manipulability_gradient, ml.log_manipulability_gradient)


def central_difference(f: Callable[[np.ndarray], np.ndarray | float], robot: ml.Robot, q: np.ndarray) -> np.ndarray:
    """d f / d q along every tangent coordinate, last axis."""
    steps = H * np.eye(robot.nv)
    ends = [[np.asarray(f(robot.integrate(q, sign * step))) for sign in (1.0, -1.0)] for step in steps]
    return np.stack([(after - before) / (2 * H) for after, before in ends], axis=-1)


def postures(robot: ml.Robot, rng: np.random.Generator) -> np.ndarray:
    """One at random, and two where arms are singular: stretched (all joints zero) and one elbow only bent."""
    zero, bent = np.zeros(robot.nv), np.zeros(robot.nv)
    bent[robot.nv // 2] = 0.9
    return np.stack([robot.random_configuration(rng), robot.configuration(zero), robot.configuration(bent)])


def other_frame(robot: ml.Robot) -> str:
    """A frame that moves otherwise than the tip: on another branch where there is one, else halfway up the arm."""
    return "arm_b" if robot.name == "tree" else robot.frame_names[len(robot.frame_names) // 2]


def bent_rail(robot: ml.Robot, frame: str, q: np.ndarray, rows: str = "across-1 across-2 along") -> ml.CurveRows:
    """Rows along a curve that passes the hand at a centimetre."""
    t = np.linspace(-1.0, 1.0, 12)
    shape = np.column_stack([0.2 * t, 0.1 * np.sin(2.0 * t) + 0.01, 0.1 * t**2])
    return ml.CurveRows(robot, frame, robot.position(q, frame) + shape, rows)


def feature_maps(robot: ml.Robot, tip: str, q: np.ndarray) -> Iterator[ml.FeatureMap]:
    """Each kind of features that has derivatives of its own; a curve's rows beside a posture."""
    other = other_frame(robot)
    yield from (ml.FrameJacobian(robot, tip, *x) for x in product(("xyz", "pose", "ry x"), ("world", "local")))
    yield ml.FrameJacobian(robot, other, "planar")
    yield from (ml.CentreOfMass(robot, axes) for axes in ("xyz", "z y"))
    yield from (ml.RelativeFrameJacobian(robot, tip, other, axes) for axes in ("pose", "y rz"))
    yield from (ml.MechanismRows(robot, tip, tuple(ROW_UNITS), **ABOUT, radius=radius) for radius in (None, 0.3))
    yield ml.MechanismRows(robot, tip, "radial screw turn-1", **ABOUT, relative_to=other)
    yield PlaceRows(robot, tip, "point", (0.1, 0.2, 0.5), relative_to=other)
    yield from (PlaceRows(robot, tip, form, (0.1, 0.2, 0.5)) for form in ("point and rotation", "twist", "surface"))
    stacked = ml.FrameJacobian(robot, tip, "x rz", "local"), ml.CentreOfMass(robot, "z")
    yield ml.Stacked([*stacked, ml.FrameJacobian(robot, tip, "y")])
    yield bent_rail(robot, tip, q, "rx across-2 along across-1")


@pytest.mark.parametrize("name", ROBOTS)
def test_every_feature_map(robot_of: RobotOf, rng: np.random.Generator, name: str):
    """dPhi/dq is right at random and at singular postures, and every other way to the same numbers gives them."""
    robot = robot_of(name)
    every = postures(robot, rng)
    for features in feature_maps(robot, tip_of(name), every[0]):
        with case(features):
            q = every[:1] if isinstance(features, ml.CurveRows) else every  # elsewhere the nearest place is not one
            Phi, dPhi = (np.stack([f(x) for x in q]) for f in (features, features.derivative))
            expected = np.stack([central_difference(features, robot, x) for x in q])
            scale = max(1.0, float(np.max(np.abs(expected))))
            assert dPhi.shape == (len(q), features.n_rows, robot.nv, robot.nv)
            assert_allclose(dPhi, expected, rtol=0, atol=1e-8 * scale)
            both = [features.value_and_derivative(x) for x in q]
            assert_allclose([value for value, _ in both], Phi, rtol=0, atol=1e-13 * scale)
            assert_array_equal([slope for _, slope in both], dPhi)
            many, slopes = features.batch_with_derivative(q)
            positions = np.stack([robot.positions(x) for x in q])
            for values in (many, features.batch(q), features.batch(positions)):
                assert_allclose(values, Phi, rtol=0, atol=1e-12 * scale)
            assert_allclose(slopes, dPhi, rtol=0, atol=1e-11 * scale)
            constraint = ml.Constraint(rng.normal(size=(min(4, features.n_rows), features.n_rows)), features)
            for i, x in enumerate(q):
                A, vjp = constraint.value_and_vjp(x)
                for value in (A, constraint(x)):
                    assert_allclose(value, constraint.selection @ Phi[i], rtol=0, atol=1e-13 * scale)
                dA = np.einsum("sp,pij->sij", constraint.selection, dPhi[i])
                assert_allclose(constraint.derivative(x), dA, rtol=0, atol=1e-11 * scale)
                assert_allclose(vjp(A), np.einsum("ij,ijk->k", A, dA), rtol=0, atol=1e-11 * scale**2)


@pytest.mark.parametrize("name", ROBOTS)
def test_rows_are_rates(robot_of: RobotOf, rng: np.random.Generator, name: str):
    """Rows are the rate of the frame's origin and orientation in the base, in itself, and as another frame sees it;
    those of the centre of mass that of its place, those of a curve that of the distances and the length along it.
    """
    robot = robot_of(name)
    frame, other = robot.frame(tip_of(name)), robot.frame(other_frame(robot))
    mass, relative = ml.CentreOfMass(robot), ml.RelativeFrameJacobian(robot, frame.name, other.name)

    def twist(pose: Callable[[np.ndarray], np.ndarray], q: np.ndarray) -> np.ndarray:
        rate = central_difference(pose, robot, q)
        spin = np.einsum("ijk,lj->ilk", rate[:3, :3], pose(q)[:3, :3])  # skew matrix of the angular velocity
        return np.concatenate([rate[:3, 3], [spin[2, 1], spin[0, 2], spin[1, 0]]])

    for q in postures(robot, rng):
        with case(q.tolist()):
            R = robot.pose(q, frame)[:3, :3]
            world, local = robot.jacobian(q, frame, "world"), robot.jacobian(q, frame, "local")
            seen = twist(lambda x: np.linalg.inv(robot.pose(x, other)) @ robot.pose(x, frame), q)
            rail = bent_rail(robot, frame.name, q)
            for got, wanted, atol in (
                (world, twist(lambda x: robot.pose(x, frame), q), 1e-8),
                (local, np.concatenate([R.T @ world[:3], R.T @ world[3:]]), 1e-12),
                (relative(q), seen, 1e-8),
                (mass(q), central_difference(mass.coordinates, robot, q), 1e-8),
                (rail(q), central_difference(rail.coordinates, robot, q), 2e-6),
            ):
                assert_allclose(got, wanted, rtol=0, atol=atol)


@pytest.mark.parametrize("name", ["one", "gantry", "wrist", "humanoid", "tree", "mimic", "planar3", "ur5", "panda"])
def test_manipulability_gradients(robot_of: RobotOf, rng: np.random.Generator, name: str):
    """The gradients of mu, log mu and the smallest singular value of dense random rows of every feature map are right
    to 1e-6; mu and its gradient are the same in bulk and in every orthonormal basis of the rows.
    """
    robot, compared = robot_of(name), 0
    middle = np.stack([robot.configuration(0.5 * robot.positions(robot.random_configuration(rng))) for _ in range(2)])
    for features in feature_maps(robot, tip_of(name), middle[0]):
        for s in {1, min(features.n_rows, robot.nv, 3)}:
            constraint = ml.Constraint(rng.normal(size=(s, features.n_rows)), features)
            turned = ml.Constraint(np.linalg.qr(rng.normal(size=(s, s)))[0] @ constraint.selection, features)
            q = middle[:1] if isinstance(features, ml.CurveRows) else middle
            batch = ml.manipulability_batch(constraint, q)
            for i, x in enumerate(q):
                with case(constraint, i):
                    mu, (gradient, log) = ml.manipulability(constraint, x), (f(constraint, x) for f in MU_GRADIENTS)
                    sigma = np.linalg.svd(constraint(x), compute_uv=False)
                    # both come from a factorisation, as products of s or s - 1 numbers that are sigma[0] at most; rows
                    # add up levers and unit axes, their slopes levers crossed with axes
                    largest = max(1.0, float(np.linalg.norm(features(x))))
                    slopes = largest + np.linalg.norm(features.derivative(x))
                    known = rounding(4 * s * robot.nv, largest**s)
                    slack = LOST * rounding(4 * s * robot.nv, largest ** (s - 1), slopes)
                    assert batch.mu[i] == pytest.approx(mu, rel=0, abs=known)
                    assert_allclose(batch.gradient[i], gradient, rtol=0, atol=slack)
                    scale = max(float(np.max(np.abs(gradient))), mu)
                    if sigma[-1] <= max(1e-2 * sigma[0], 1e-4):  # differences lose digits near the tip of the cone
                        continue
                    assert mu == pytest.approx(float(np.prod(sigma)), rel=0, abs=known)
                    assert ml.manipulability(turned, x) == pytest.approx(mu, rel=0, abs=known)
                    assert_allclose(ml.manipulability_gradient(turned, x), gradient, rtol=0, atol=slack)
                    assert_allclose(batch.log_gradient[i], log, rtol=0, atol=slack / mu)
                    expected = central_difference(lambda y, c=constraint: ml.manipulability(c, y), robot, x)
                    assert_allclose(gradient, expected, rtol=0, atol=1e-6 * scale)
                    assert_allclose(log, gradient / mu, rtol=1e-12, atol=slack / mu)
                    compared += 1
                    A, vjp = constraint.value_and_vjp(x)
                    if sigma[-1] < 0.05 or (s > 1 and sigma[-2] - sigma[-1] < 0.05):
                        continue
                    slope = central_difference(lambda y, c=constraint: np.linalg.norm(c(y), -2), robot, x)
                    assert_allclose(smallest_gradient(np.linalg.svd(A), vjp), slope, atol=1e-6 * scale)
    assert compared > 15


def test_singular_is_zero_never_nan(robot_of: RobotOf, rng: np.random.Generator):
    """Stretched arms, A = 0, and more rows than joints, of one posture and of many: mu is 0 to rounding, its gradients
    are finite, and 0 where there are more rows than joints or the rank is short by two.
    """
    stretched = ml.Constraint(np.eye(2), ml.FrameJacobian(robot_of("planar3"), "tip", "x y"))
    crowded = ml.Constraint(np.eye(4), ml.CustomFeatures(lambda q: np.arange(8.0).reshape(4, 2) + q[0], "abcd", 2))
    nothing = ml.Constraint([[1.0]], ml.CustomFeatures(lambda q: np.zeros((1, 2)), "a", 2))
    cases = [(stretched, np.zeros(3)), (crowded, np.ones(2)), (nothing, np.ones(2))]
    for name in ("one", "planar3", "gantry", "wrist", "mimic"):
        features = ml.FrameJacobian(robot_of(name), tip_of(name), "pose")
        cases.append((ml.Constraint(np.eye(6), features), features.robot.random_configuration(rng)))
    for number, (constraint, q) in enumerate(cases):
        with case(constraint, number):
            A, mu = constraint(q), ml.manipulability(constraint, q)
            assert 0.0 <= mu <= rounding(4 * A.size, *[A] * len(A))
            assert mu == constraint.manipulability(q) == manipulability_of(A)
            assert all(np.all(np.isfinite(gradient(constraint, q))) for gradient in MU_GRADIENTS)
            if len(A) > A.shape[1]:
                assert mu == 0.0 and not any(gradient(constraint, q).any() for gradient in MU_GRADIENTS)
                batch = ml.manipulability_batch(constraint, np.stack([q, q]))
                assert not batch.mu.any() and not batch.gradient.any() and batch.gradient.shape == (2, A.shape[1])
    A, dA = np.zeros((2, 3)), np.ones((2, 3, 3))
    mu, gradient, _ = gradient_from(A.shape, np.linalg.svd(A), lambda weights: np.tensordot(weights, dA, 2))
    assert mu == 0.0 and not gradient.any()


@pytest.mark.parametrize(("which", "name", "axes", "selection", "positions"), rows_in("singular_postures.txt"))
def test_singularities(robot_of: RobotOf, rng: np.random.Generator, which, name, axes, selection, positions):
    """At an exact singularity grad mu has the direction and the rate of the cone's steepest ascent: mu rises along it
    at the rate claimed, either way, and faster than along 200 directions at random, its largest entry being positive.
    At distances of 1e-2 down to 1e-13 the gradients stay finite, the gradient in bulk (of the planar arm) is that of
    the single posture, and a step along it raises mu (one of 1e-9 where the distance itself drowns in rounding).
    """
    robot, selection = robot_of(name), json.loads(selection)
    features, q = ml.FrameJacobian(robot, tip_of(name), axes), robot.configuration(json.loads(positions))
    if selection is None:
        selection = np.eye(features.n_rows)
    elif selection == "blocked":
        still = np.linalg.svd(features(q))[0][:, -1]
        selection = np.stack([still, np.random.default_rng(3).normal(size=features.n_rows)])
    constraint = ml.Constraint(selection, features)
    gradient = ml.manipulability_gradient(constraint, q)
    rate = float(np.linalg.norm(gradient))
    assert np.all(np.isfinite(gradient)) and rate > 1e-3
    assert np.max(gradient) == np.max(np.abs(gradient))

    def rise(direction: np.ndarray, h: float = 1e-6) -> float:
        return ml.manipulability(constraint, robot.integrate(q, h * direction / np.linalg.norm(direction))) / h

    A = constraint(q)
    others = np.prod(np.linalg.svd(A, compute_uv=False)[:-1])
    assert ml.manipulability(constraint, q) <= rounding(4 * A.size, A, others)
    assert rise(gradient) == pytest.approx(rate, rel=1e-4) and rise(-gradient) == pytest.approx(rate, rel=1e-4)
    directions = rng.normal(size=(200, robot.nv))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # nor does any small turn of the direction itself help
    assert max(map(rise, [*directions, *(gradient / rate + 0.05 * directions[:50])])) <= rate * (1 + 1e-4)
    away = rng.normal(size=robot.nv)
    for distance in 10.0 ** -np.arange(2.0, 14.0):
        with case(distance):
            near = robot.integrate(q, distance * away)
            gradient, log = (f(constraint, near) for f in MU_GRADIENTS)
            length = float(np.linalg.norm(gradient))
            assert np.all(np.isfinite([gradient, log])) and length <= 1.5 * rate + 0.1
            if name == "planar3" and distance > 1e-12:
                bulk = ml.manipulability_batch(constraint, near[None]).gradient[0]
                assert_allclose(bulk, gradient, rtol=0, atol=1e-9 * length)
            step = robot.integrate(near, (1e-2 * distance if distance > 1e-11 else 1e-9) * gradient / length)
            assert ml.manipulability(constraint, step) >= ml.manipulability(constraint, near)


def test_singular_postures_in_bulk(robot_of: RobotOf):
    """A singular posture among good ones has a gradient, that of its cone; a bad posture is refused by its row."""
    constraint = ml.Constraint(np.eye(2), ml.FrameJacobian(robot_of("planar3"), "tip", "x y"))
    q = np.array([[0.3, 0.7, -0.4], [0.5, 0.0, 0.0], [1.0, -0.3, 0.9], [0.2, 0.0, np.pi]])
    batch = ml.manipulability_batch(constraint, q)
    sigma = np.linalg.svd(constraint(q[1]), compute_uv=False)
    assert_allclose(batch.floor, [0.0, 64.0 * EPS * sigma[0] ** 2, 0.0, batch.floor[3]], rtol=1e-9)
    assert batch.mu[1] <= rounding(4 * 2 * 3, sigma, sigma) and np.linalg.norm(batch.gradient[1]) > 0.1
    assert ml.manipulability_batch(constraint, np.zeros((0, 3))).gradient.shape == (0, 3)
    many = np.zeros((9000, 3))
    many[7000, 1] = np.nan
    for evaluate in (lambda: ml.manipulability_batch(constraint, many), lambda: constraint.features.batch(many)):
        with pytest.raises(ConfigurationError, match="row 7000"):
            evaluate()


ANGLES = [0.0, 1e-9, 1e-4, 0.5, 2.6, 3.1]
AXES = ["pose", "xyz", "rotation", "x y rz", "rx ry", "rz", "z rx"]


def features_of(robot: ml.Robot, axes: str, view: str) -> ml.FeatureMap:
    """Rows of the hand in the base, in itself, or as a link sees it."""
    if view == "relative":
        return ml.RelativeFrameJacobian(robot, TIPS["panda"], "panda_link3", axes)
    return ml.FrameJacobian(robot, TIPS["panda"], axes, view)


def check_rate(features: ml.FeatureMap, target: np.ndarray, q: np.ndarray) -> None:
    """-E is the derivative of the error, and comes with it."""
    slope = central_difference(lambda x: features.error_to(target, x), features.robot, q)
    E = features.error_jacobian(target, q)
    E = features(q) if E is None else E
    assert_allclose(-E, slope, rtol=0, atol=1e-6)
    value, together = features.error_and_jacobian(target, q)
    assert_array_equal(value, features.error_to(target, q))
    assert_array_equal(features(q) if together is None else together, E)


@pytest.mark.parametrize("view", ["world", "local", "relative"])
def test_error_jacobian(robot_of: RobotOf, rng: np.random.Generator, view: str) -> None:
    """The derivative of the error is -E to 1e-6 for every mix of axes, at every angle between frame and target; at the
    target E is A(q). The same for targets that are numbers, where coordinates that are not rows go with the frame. For
    positions along the base E is A(q) everywhere (None).
    """
    robot = robot_of("panda")
    for axes in AXES:
        features, compared = features_of(robot, axes, view), 0
        for angle in ANGLES:
            with case(axes, angle):
                q = rng.uniform(-1.0, 1.0, 7)
                axis, away = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
                target = features.pose(q) if view == "relative" else robot.pose(q, features.frame)
                if axes != "xyz":
                    E = features.error_jacobian(target, q)
                    assert_allclose(E, features(q), rtol=0, atol=rounding(8 * robot.nv, E))
                target[:3, :3] = rotation_matrix(angle * axis) @ target[:3, :3]
                target[:3, 3] += 0.2 * away
                check_rate(features, target, q)
        if view == "local" and axes not in ("pose", "xyz", "rotation"):
            continue  # numbers do not determine such a target
        for _ in range(6):
            q, goal = rng.uniform(-1.0, 1.0, (2, 7))
            target = features.coordinates(goal)
            if np.linalg.norm(features.error_to(target, q)[-3:]) > 3.0:
                continue  # next to half a turn the error changes its sign
            with case(axes, target):
                check_rate(features, target, q)
                C = features.coordinates_jacobian(q)
                C = features(q) if C is None else C
                if view != "local":
                    assert_allclose(C, central_difference(features.coordinates, robot, q), rtol=0, atol=1e-6)
            compared += 1
        assert compared > 2, axes
    for features in (features_of(robot, "x z", "world"), ml.CentreOfMass(robot)):
        target, q = np.zeros(features.n_rows), rng.uniform(-1.0, 1.0, 7)
        assert features.error_jacobian(target, q) is None and features.coordinates_jacobian(q) is None
        task = ml.PointAttractor(target)
        assert task.error_jacobian(ml.Constraint(np.eye(len(target)), features), q, 0.0) is None
