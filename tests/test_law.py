"""The law: equation (2) where nothing binds, the nearest velocity within bounds, and what a hand is held by."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from conftest import tip_of
from random_arms import Asks, inside, oblique
from scipy.optimize import lsq_linear, nnls

import manip_learn as ml
from manip_learn.control.law import ACROSS, ALONG, nearest_within
from manip_learn.control.limits import Bounds
from manip_learn.control.policies import SampledPolicy
from manip_learn.control.simulation import simulate_way

DT = 0.01
ARMS = ["planar3", "sawyer", "kinova", "gantry", "tree", "wrist"]
Policies = Callable[[ml.Robot, ml.Constraint], ml.NullSpacePolicy | None]
POLICIES: dict[str, Policies] = {
    "none": lambda robot, rows: None,
    "ascent": lambda robot, rows: ml.ManipulabilityAscent(rows),
    "raw ascent": lambda robot, rows: ml.ManipulabilityAscent(rows, logarithmic=False),
    "rest": lambda robot, rows: ml.JointAttractor(robot.neutral(), robot=robot),
    "middle": lambda robot, rows: ml.JointLimitAvoidance(robot),
    "lambda": lambda robot, rows: lambda q, t: np.full(robot.nv, 0.1),  # type: ignore[return-value]
}


@pytest.fixture(autouse=True, params=["", "python"])
def engine(request, monkeypatch):
    """The compiled law if there is one, and the law in Python."""
    monkeypatch.setenv("MANIP_LEARN_ENGINE", request.param)


def velocity_of(policy: ml.NullSpacePolicy, q: np.ndarray) -> np.ndarray:
    """What the policy asks for, held for DT."""
    return policy(q, 0.0, DT) if isinstance(policy, SampledPolicy) else policy(q, 0.0)


@pytest.mark.parametrize(("name", "kind"), list(zip(ARMS, POLICIES, strict=True)))
def test_equation_2_where_nothing_binds(name, kind, robot_of, rng):
    """u = A^+ b + (1 - A^+ A) w to 1e-12, with every inverse, where the status says that nothing was done to it."""
    robot, compared = robot_of(name), 0
    for axes, inverse, limits in product(("x y", "xyz", "pose"), ("damped", "exact", "truncated"), (True, False)):
        for s in (1, 2, 3):
            features = ml.FrameJacobian(robot, tip_of(name), axes)
            rows, q = oblique(features, min(s, 2 if axes == "x y" else 3), rng), inside(robot, rng, 0.9)
            b = 0.02 * rng.normal(size=rows.n_constraints)
            policy = POLICIES[kind](robot, rows)
            command = ml.ResolvedRateController(rows, Asks(b), policy, inverse, limits=limits, dt=DT)(q)
            A = rows(q)
            sigma = np.linalg.svd(A, compute_uv=False)
            if A.shape[0] > A.shape[1] or sigma[-1] < 0.05 or command.status is not ml.Status.OK:
                continue
            w = np.zeros(robot.nv) if policy is None else velocity_of(policy, q)
            X = np.linalg.pinv(A)
            expected = X @ b + w - X @ (A @ w)
            size = max(1.0, float(np.linalg.norm(w))) / min(1.0, float(sigma[-1]))
            np.testing.assert_allclose(command.velocity, expected, rtol=0, atol=1e-12 * size)
            assert command.task_scale == command.null_scale == 1.0
            assert command.progress == pytest.approx(1.0, rel=0, abs=1e-12)
            compared += 1
    assert compared >= 20


def box_of(n: int, rng: np.random.Generator) -> Bounds:
    """Bounds, some of them equal, some on one side of zero."""
    middle = 0.5 * rng.normal(size=n)
    half = rng.exponential(size=n) * (rng.random(n) < 0.8)
    return Bounds(middle - half, middle + half, np.ones(n, dtype=int), np.ones(n, dtype=int), 0.0)


def weighted_rows(n: int, rng: np.random.Generator) -> np.ndarray:
    """W of the metric 1 + W^T W with the weights of the law, of few or many rows."""
    return rng.normal(size=(int(rng.integers(1, n + 1)), n)) / rng.choice([ACROSS, ALONG, 1.0])


def excess(u: np.ndarray, bounds: Bounds) -> float:
    """By how much a velocity exceeds bounds."""
    return float(np.max(np.maximum(u - np.array(bounds.high), np.array(bounds.low) - u)))


@pytest.mark.parametrize("seed", range(3))
def test_the_nearest_velocity_meets_the_conditions_of_the_optimum(seed):
    """Within the bounds, and M (u - u*) is held by the bounds and rows that are met, each pushing inwards (by NNLS).

    The conditions of Karush, Kuhn and Tucker are sufficient: the program is convex.
    """
    rng = np.random.default_rng([42, seed])
    for _ in range(60):
        n = int(rng.integers(1, 10))
        W, bounds, wish = weighted_rows(n, rng), box_of(n, rng), 2.0 * rng.normal(size=n)
        low, high = np.array(bounds.low), np.array(bounds.high)
        G = rng.normal(size=(int(rng.integers(0, 4)), n))
        least = G @ rng.uniform(low, high) - 0.1 * rng.exponential(size=len(G))  # a point within the bounds meets them
        u = nearest_within(wish, W, bounds, (G, least) if len(G) else None)
        assert excess(u, bounds) <= 0.0
        assert np.all(G @ u >= least - 1e-9)
        met = 1e-9 * (1.0 + np.abs(u))
        pushing = np.vstack((np.eye(n)[u <= low + met], -np.eye(n)[u >= high - met], G[G @ u <= least + 1e-8]))
        M = np.eye(n) + W.T @ W
        slope = M @ (u - wish)
        size = float(np.linalg.norm(M) * np.linalg.norm(u - wish))
        if size > 0.0:
            left = nnls(pushing.T / size, slope / size)[1] if len(pushing) else float(np.linalg.norm(slope)) / size
            assert left <= 1e-9


def test_bounds_have_precedence_over_rows(rng):
    """Rows that no velocity within the bounds meets are left out."""
    for _ in range(100):
        n = int(rng.integers(1, 10))
        W, bounds, wish = weighted_rows(n, rng), box_of(n, rng), 2.0 * rng.normal(size=n)
        g = rng.normal(size=n)
        most = float(np.maximum(g * np.array(bounds.low), g * np.array(bounds.high)).sum())
        u = nearest_within(wish, W, bounds, (g[None], np.array([most + 0.1])))
        np.testing.assert_array_equal(u, nearest_within(wish, W, bounds, None))


def test_the_joint_named_is_furthest_beyond_its_bound(sawyer):
    """Of two joints at their bounds, the one whose desired velocity exceeds its bound by more, in both directions."""
    limits = ml.Limits(sawyer, velocity=[1.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    bounds = limits.bounds(0.5 * (sawyer.position_lower + sawyer.position_upper), 0.01, None)
    for sign in (1.0, -1.0):
        desired = sign * np.array([3.0, 2.5, 0.0, 0.0, 0.0, 0.0, 0.0])
        assert bounds.binding(np.clip(desired, bounds.low, bounds.high), desired)[0] == 0


@pytest.mark.parametrize("name", ["sawyer", "gantry"])
def test_the_command_solves_the_program_of_the_docstring(name, robot_of, rng):
    """Held rows weigh 1 / ACROSS^2, the speed along the way 1 / ALONG^2, the policy 1: SciPy's minimum in the box."""
    robot, compared = robot_of(name), 0
    for _ in range(60):
        rows = oblique(ml.FrameJacobian(robot, tip_of(name), "xyz"), 2, rng)
        q = inside(robot, rng, 0.98)
        A = rows(q)
        if np.linalg.svd(A, compute_uv=False)[-1] < 0.3:  # nearer, the approach to the singularity has its own bound
            continue
        task, policy = Asks(0.05 * rng.normal(size=2)), ml.JointAttractor(robot.neutral(), 2.0, robot=robot)
        law = ml.ResolvedRateController(rows, task, policy, dt=DT)
        previous = 0.1 * np.minimum(robot.velocity_limit, 3.0) * rng.uniform(-1.0, 1.0, robot.nv)
        assert law.limits is not None
        bounds = law.limits.bounds(q, DT, previous)
        command = law(q, 0.0, DT, previous)
        X = np.linalg.pinv(A)
        drive, w = X @ task.b, velocity_of(policy, q)
        wish = drive + w - X @ (A @ w)
        wish -= X @ ((rows(robot.integrate(q, 0.5 * DT * previous)) - A) @ previous)
        if bounds.admit(wish) or np.any(np.abs(drive) > law.limits.velocity):
            continue
        d = task.b / np.linalg.norm(task.b)
        weighed = np.vstack(((A - np.outer(d, d @ A)) / ACROSS, (d @ A)[None] / ALONG, np.eye(robot.nv)))
        low, high = np.array(bounds.low), np.array(bounds.high)
        best = lsq_linear(weighed, weighed @ wish, (low, high + 1e-15), method="bvls", tol=1e-15).x
        cost = [float(np.sum((weighed @ (u - wish)) ** 2)) for u in (command.velocity, best)]
        assert excess(command.velocity, bounds) <= 0.0
        assert cost[0] <= cost[1] * (1.0 + 1e-6) + 1e-9
        np.testing.assert_allclose(command.velocity, best, rtol=0, atol=1e-5)
        compared += 1
    assert compared >= 15


def rail(robot: ml.Robot) -> ml.Constraint:
    """A rail along x: y and z of the hand are held."""
    return ml.Constraint([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], ml.FrameJacobian(robot, "link_eef"))


@pytest.mark.parametrize("climbs", ["held", "driven"])
def test_a_joint_at_its_limit_pulls_no_hand_off_its_rail(climbs):
    """Where a joint stops the way the hand stands on its rail to 0.5 mm, whatever the null-space policy asks for."""
    robot = ml.load_robot("xarm7")
    start, rows = [3.302, -1.7578, 0.2082, 3.0665, 5.0783, 1.7292, 0.1807], rail(robot)
    task = ml.FreeDirection(rows, -0.5, 0.1)
    climb = ml.ManipulabilityAscent(rows if climbs == "held" else task.constraint)
    law = ml.ResolvedRateController(rows, task, climb, dt=DT)
    rollout, way = simulate_way(robot, law, start, DT)
    places = np.array([robot.position(q, "link_eef") for q in rollout.q])
    assert float(np.max(np.linalg.norm(places[:, 1:] - places[0, 1:], axis=1))) <= 5e-4
    assert way.deviation <= 5e-4 and abs(way.done) > 0.2
