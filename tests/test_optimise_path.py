"""Optimised paths: derivatives of the problem, never below the greedy law, limits, errors."""

from __future__ import annotations

import sys

import numpy as np
import pytest

import manip_learn as ml
from manip_learn.control.optimise_path import JointBounds, PathPolicy, PathProblem, solve
from manip_learn.errors import ConfigurationError, FeatureError, MissingExtraError

TIPS = {"planar3": "tip", "sawyer": "right_hand", "gantry": "tip", "wrist": "tip"}


def reaching(robot, tip, rows, seed):
    """A constraint of oblique rows, a task within reach, and a start."""
    rng = np.random.default_rng(seed)
    axes = "x y" if robot.name == "planar3" else "xyz"
    features = ml.FrameJacobian(robot, tip, axes)
    constraint = ml.Constraint(np.linalg.qr(rng.normal(size=(features.n_rows, rows)))[0].T, features)
    start, end = (robot.positions(robot.random_configuration(rng)) for _ in range(2))
    return constraint, ml.PointAttractor(features.coordinates(end)), start


def greedy(constraint, task, start, duration, dt=0.01):
    law = ml.ResolvedRateController(constraint, task, ml.ManipulabilityAscent(constraint, 3.0), dt=dt)
    return ml.simulate(constraint.robot, law, start, duration, dt)


def mean_log(rollout):
    return float(np.mean(np.log(np.maximum(rollout.manipulability, 1e-9))))


@pytest.mark.parametrize("acceleration", [np.inf, 5.0])
@pytest.mark.parametrize("name", ["planar3", "sawyer", "gantry"])
def test_derivatives_of_the_problem(robot_of, name, acceleration):
    """Gradient and Jacobian are those of objective and constraints, by central differences."""
    robot, rng = robot_of(name), np.random.default_rng(0)
    constraint, task, start = reaching(robot, TIPS[name], 1, 1)
    n = robot.nv
    bounds = JointBounds(robot.position_lower, robot.position_upper, robot.velocity_limit, np.full(n, acceleration))
    problem = PathProblem(constraint, task, start, 0.1, 4, bounds, 1e-3)
    x = problem.packed(start + 0.1 * rng.normal(size=(4, n)))
    x[-4:] = 0.7
    steps = 1e-5 * np.eye(problem.size)
    gradient = np.array([problem.objective(x + e) - problem.objective(x - e) for e in steps]) / 2e-5
    columns = np.array([problem.constraints(x + e) - problem.constraints(x - e) for e in steps]) / 2e-5
    assert np.allclose(problem.gradient(x), gradient, atol=1e-6)
    assert np.allclose(problem.jacobian(x), columns.T, atol=1e-6)
    assert not np.any(columns.T[~problem.patterns()[0]])


def test_objective_and_constraints_in_numbers(robot_of):
    """Mean of log mu bounded by the floor, the standstill of the task, the changes of velocity.

    A (q_k - q_k-1) less the way that the task asks for in a step, the steps and their changes, within their bounds.
    """
    robot, rng = robot_of("sawyer"), np.random.default_rng(4)
    constraint, task, start = reaching(robot, "right_hand", 2, 1)
    bounds = JointBounds(robot.position_lower, robot.position_upper, robot.velocity_limit, np.full(7, 5.0))
    problem = PathProblem(constraint, task, start, 0.1, 4, bounds, 0.2)
    q, sigma = start + np.cumsum(0.02 * rng.normal(size=(4, 7)), axis=0), np.array([1.0, 0.5, 0.7, 0.0])
    x, all_q = np.concatenate([q.reshape(-1), sigma]), np.vstack([start, q])
    mu, change = np.array([ml.manipulability(constraint, p) for p in q]), np.diff(all_q, 2, axis=0)
    wanted = np.mean(-0.5 * np.log(mu**2 + 0.04)) + np.mean(1.0 - sigma) + 0.5e-3 / (4 * 0.01) * np.sum(change**2)
    assert problem.objective(x) == pytest.approx(wanted, rel=1e-12)
    middle, step = 0.5 * (all_q[1:] + all_q[:-1]), np.diff(all_q, axis=0)
    b = [task.velocity(constraint, m, 0.0) for m in middle]
    rows = [constraint(m) @ u - 0.1 * s * r for m, u, s, r in zip(middle, step, sigma, b, strict=True)]
    parts = (np.ravel(rows), step.ravel(), change.ravel())
    np.testing.assert_allclose(problem.constraints(x), np.concatenate(parts), rtol=0, atol=1e-12)
    most = np.concatenate([np.zeros(8), np.tile(0.1 * robot.velocity_limit, 4), np.full(21, 0.01 * 5.0)])
    np.testing.assert_allclose(problem.constraint_bounds(), [-most, most])
    low, high = problem.variable_bounds()
    np.testing.assert_array_equal(low, [*np.tile(np.minimum(robot.position_lower, start), 4), *np.zeros(4)])
    np.testing.assert_array_equal(high, [*np.tile(np.maximum(robot.position_upper, start), 4), *np.ones(4)])


def test_hessian_of_the_objective(robot_of):
    """The Hessian without multipliers is that of the objective, smoothness included."""
    robot, rng = robot_of("sawyer"), np.random.default_rng(0)
    constraint, task, start = reaching(robot, "right_hand", 2, 1)
    infinite = np.full(7, np.inf)
    for knots in (3, 5):
        problem = PathProblem(constraint, task, start, 0.1, knots, JointBounds(-infinite, *[infinite] * 3), 1e-3)
        x = problem.packed(start + 0.1 * rng.normal(size=(knots, 7)))
        differences = np.array([problem.gradient(x + e) - problem.gradient(x - e) for e in 1e-5 * np.eye(x.size)])
        upper = problem.hessian(x, 1.0, np.zeros(problem.constraint_bounds()[0].size))
        H = upper + np.triu(upper, 1).T
        assert np.allclose(np.tril(upper, -1), 0.0)
        assert np.allclose(H, differences / 2e-5, atol=1e-4)
        assert not np.any(upper[~problem.patterns()[1]])


def test_policy_follows_its_knots():
    """On a system without a task in the way, the posture passes the knots, and rests behind the last one."""
    time, knots = np.array([0.0, 0.5, 1.0, 1.5]), np.array([[0.0, 1.0], [0.2, 0.9], [0.5, 0.5], [0.4, 0.6]])
    policy = PathPolicy(time, knots, 10.0)
    q, dt = knots[0].copy(), 0.001
    for i in range(3000):
        if i == 1000:
            assert np.allclose(q, knots[2], atol=5e-3)
        q = q + dt * policy(q, i * dt)
    assert np.allclose(q, knots[-1], atol=1e-3)
    assert "4 knots" in repr(policy)


def test_missing_extra(robot_of, monkeypatch):
    """Without CasADi the error names the extra."""
    monkeypatch.setitem(sys.modules, "casadi", None)
    constraint, task, start = reaching(robot_of("planar3"), "tip", 1, 0)
    with pytest.raises(MissingExtraError, match=r"manip_learn\[path\]"):
        ml.optimise_path(constraint, task, start)


class TestWithCasadi:
    """What needs the solver."""

    @pytest.fixture(autouse=True)
    def solver(self):
        pytest.importorskip("casadi", reason="optimised paths need the extra 'path' (CasADi)")

    @pytest.mark.parametrize(("name", "rows", "seed"), [("planar3", 2, 0), ("planar3", 1, 1), ("sawyer", 2, 5)])
    def test_never_below_the_greedy_law(self, robot_of, name, rows, seed):
        """Mean log mu is not below that of the greedy law, the task is served as well, and the limits are kept."""
        robot = robot_of(name)
        constraint, task, start = reaching(robot, TIPS[name], rows, seed)
        base = greedy(constraint, task, start, 2.0)
        path = ml.optimise_path(constraint, task, start, 2.0, knots=12, guesses=1)
        assert type(path) is ml.Rollout and len(path) == len(base)
        assert mean_log(path) >= mean_log(base)
        assert path.task_error[-1] <= 1.01 * base.task_error[-1] + 1e-6
        assert np.all(path.q <= robot.position_upper + 1e-6) and np.all(path.q >= robot.position_lower - 1e-6)
        assert np.all(np.abs(path.u) <= robot.velocity_limit + 1e-6)

    def test_better_where_the_greedy_law_is_trapped(self, robot_of):
        """From a posture whose gradient leads the wrong way, the whole path gains a lot."""
        robot = robot_of("planar3")
        constraint, task, start = reaching(robot, "tip", 2, 5)
        base = greedy(constraint, task, start, 4.0)
        path = ml.optimise_path(constraint, task, start, 4.0, knots=20)
        assert np.mean(path.manipulability) > 1.15 * np.mean(base.manipulability)

    def test_same_seed_same_path(self, robot_of):
        """The random guesses are those of the generator that is given."""
        constraint, task, start = reaching(robot_of("planar3"), "tip", 1, 3)
        first, second = (
            ml.optimise_path(constraint, task, start, 1.0, 0.02, knots=6, rng=np.random.default_rng(5))
            for _ in range(2)
        )
        assert np.array_equal(first.q, second.q)

    def test_acceleration_between_knots(self, robot_of):
        """The solver's knots keep the acceleration limit, and obey the task between them."""
        robot = robot_of("planar3")
        constraint, task, start = reaching(robot, "tip", 1, 1)
        bounds = JointBounds(robot.position_lower, robot.position_upper, robot.velocity_limit, np.full(3, 2.0))
        problem = PathProblem(constraint, task, start, 0.1, 15, bounds, 1e-3)
        x, converged = solve(problem, problem.packed(np.tile(start, (15, 1))), 100, 1e-6)
        q = problem.postures(x)
        assert converged
        assert np.max(np.abs(np.diff(q, 2, axis=0))) <= 0.1**2 * 2.0 + 1e-6
        assert np.max(np.abs(problem.constraints(x)[:15])) < 1e-6

    def test_continuous_joints_and_configurations(self, robot_of):
        """A start given as a configuration (nq > nv) gives a rollout of configurations."""
        robot = robot_of("wrist")
        constraint, task, start = reaching(robot, "tip", 2, 2)
        path = ml.optimise_path(constraint, task, robot.configuration(start), 1.0, 0.02, knots=6, guesses=1)
        assert path.q.shape == (51, robot.nq)
        assert robot.nq > robot.nv

    def test_features_of_other_kinds(self, robot_of):
        """Rows without coordinates and a task of the user's own work as well."""
        robot = robot_of("sawyer")
        constraint = ml.Constraint(np.eye(3)[:2], ml.CentreOfMass(robot, "xyz"))
        start = robot.positions(robot.random_configuration(np.random.default_rng(1)))
        path = ml.optimise_path(constraint, ml.Hold(), start, 1.0, 0.02, knots=6, guesses=0)
        assert mean_log(path) >= mean_log(greedy(constraint, ml.Hold(), start, 1.0, 0.02))
        assert np.max(path.violation(constraint)) < 1e-9

    def test_errors_say_what_to_do(self, robot_of):
        """Bases that move, too few knots, and limits that allow nothing are refused in one sentence."""
        constraint, task, start = reaching(robot_of("planar3"), "tip", 1, 0)
        with pytest.raises(ConfigurationError, match="knots must be between 3 and the 10 steps"):
            ml.optimise_path(constraint, task, start, 0.1, 0.01, knots=11)
        with pytest.raises(ConfigurationError, match="acceleration limits must be positive"):
            ml.optimise_path(constraint, task, start, 0.1, 0.01, knots=4, acceleration_limit=0.0)
        robot = robot_of("rover")
        moving = ml.Constraint([[1.0, 0.0, 0.0]], ml.FrameJacobian(robot, "tip", "xyz"))
        with pytest.raises(FeatureError, match="load the robot with a fixed base"):
            ml.optimise_path(moving, ml.Hold(), np.zeros(robot.nv), 1.0)
