"""Learnt tasks in other people's solvers: the same velocity as ours."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import manip_learn as ml
from manip_learn.errors import ConfigurationError, ConstraintError, MissingExtraError, UnknownNameError

DT = 0.01
ROOT = Path(__file__).resolve().parents[1]


def oblique(robot, rng, tip="right_hand"):
    """Two oblique rows, a target nearby, a policy, and a posture."""
    constraint = ml.Constraint(np.linalg.qr(rng.normal(size=(3, 2)))[0].T, ml.FrameJacobian(robot, tip))
    q = 0.8 * robot.positions(robot.random_configuration(rng))
    task = ml.PointAttractor(robot.position(q, tip) + 0.1 * rng.normal(size=3))
    return constraint, task, ml.ManipulabilityAscent(constraint, 0.5), q


def unlimited(constraint, task, policy):
    return ml.ResolvedRateController(constraint, task, policy, "exact", limits=False)


def test_missing_pink(monkeypatch):
    """Without Pink the error names the extra."""
    monkeypatch.setitem(sys.modules, "pink", None)
    monkeypatch.setitem(sys.modules, "pink.tasks", None)
    monkeypatch.delitem(sys.modules, "manip_learn.control.interop.pink_tasks", raising=False)
    with pytest.raises(MissingExtraError, match=r"manip_learn\[pink\]"):
        import manip_learn.control.interop.pink_tasks  # noqa: F401


class TestPink:
    """Pink's tasks, in our environment."""

    @pytest.fixture(autouse=True)
    def interop(self):
        pytest.importorskip("pink", reason="Pink tasks need the extra 'pink'")
        from manip_learn.control.interop import pink_tasks

        self.pink_tasks = pink_tasks

    def velocity(self, model, q, tasks, constraints=None):
        import pink

        configuration = pink.Configuration(model, model.createData(), q)
        return pink.solve_ik(configuration, tasks, DT, solver="daqp", damping=0.0, limits=[], constraints=constraints)

    def test_same_velocity_as_ours(self, robot_of):
        """A hard constraint and a policy give u = A^+ b + N pi to 1e-9."""
        robot, rng = robot_of("sawyer"), np.random.default_rng(0)
        for _ in range(20):
            constraint, task, policy, q = oblique(robot, rng)
            rows = self.pink_tasks.PinkConstraintTask(constraint, task, DT)
            climb = self.pink_tasks.PinkPolicyTask(policy, robot, DT)
            theirs = self.velocity(robot.pinocchio_model, q, [climb], [rows])
            assert np.allclose(theirs, unlimited(constraint, task, policy)(q).velocity, rtol=0.0, atol=1e-9)

    def test_joints_are_found_by_name(self, robot_of):
        """Pink's model may have more joints than ours, which has some locked: the others get nothing from the task."""
        full, rng = robot_of("sawyer"), np.random.default_rng(2)
        locked = ml.load_robot("sawyer", locked={"right_j2": 0.3})
        constraint, task, policy, q = oblique(locked, rng)
        rows = self.pink_tasks.PinkConstraintTask(constraint, task, DT)
        climb = self.pink_tasks.PinkPolicyTask(policy, locked, DT)
        import pink

        everything = np.insert(q, 2, 0.3)
        configuration = pink.Configuration(full.pinocchio_model, full.pinocchio_model.createData(), everything)
        J = rows.compute_jacobian(configuration)
        assert np.allclose(np.delete(J, 2, axis=1), constraint(q)) and not np.any(J[:, 2])
        assert np.allclose(rows.compute_error(configuration), -DT * task.velocity(constraint, q, 0.0))
        assert climb.compute_jacobian(configuration).shape == (6, 7)

    def test_time_of_moving_targets(self, robot_of):
        """The task is asked at the time that the user sets."""
        robot = robot_of("sawyer")
        constraint, _, _, q = oblique(robot, np.random.default_rng(3))
        here = robot.position(q, "right_hand")
        rows = self.pink_tasks.PinkConstraintTask(constraint, ml.Track(lambda t: here + [t, 0.0, 0.0]), DT)
        import pink

        configuration = pink.Configuration(robot.pinocchio_model, robot.pinocchio_model.createData(), q)
        assert np.allclose(rows.compute_error(configuration), 0.0)
        rows.time = 1.0
        assert np.allclose(rows.compute_error(configuration), -DT * constraint.selection[:, 0])

    def test_errors(self, robot_of):
        """Mimic joints, unknown joints, and steps that are not positive are refused."""
        robot, mimic = robot_of("sawyer"), robot_of("mimic")
        constraint, task, _, q = oblique(robot, np.random.default_rng(4))
        with pytest.raises(ConstraintError, match="mimic joints"):
            self.pink_tasks.PinkPolicyTask(ml.ZeroPolicy(mimic.nv), mimic, DT)
        with pytest.raises(ConfigurationError, match="dt must be a positive"):
            self.pink_tasks.PinkConstraintTask(constraint, task, 0.0)
        planar = robot_of("planar3").pinocchio_model
        with pytest.raises(UnknownNameError, match="Pink's model"):
            self.velocity(planar, np.zeros(3), [self.pink_tasks.PinkConstraintTask(constraint, task, DT)])
