"""Learnt tasks in other people's solvers: the same velocity as ours."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import manip_learn as ml
from manip_learn.errors import ConfigurationError, ConstraintError, MissingExtraError, TargetError, UnknownNameError

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

    def test_soft_rows_approach_the_hard_ones(self, robot_of):
        """Weighed among the tasks, the rows hold the better the more they cost."""
        robot = robot_of("sawyer")
        constraint, task, policy, q = oblique(robot, np.random.default_rng(1))
        b, climb = task.velocity(constraint, q, 0.0), self.pink_tasks.PinkPolicyTask(policy, robot, DT)
        residuals = []
        for cost in (1.0, 100.0):
            rows = self.pink_tasks.PinkConstraintTask(constraint, task, DT, cost=cost)
            residuals.append(np.linalg.norm(constraint(q) @ self.velocity(robot.pinocchio_model, q, [rows, climb]) - b))
        assert residuals[1] < 1e-2 * residuals[0]

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


class TestPlaco:
    """PlaCo's solver: in an environment of its own, because it pins a Pinocchio that manip_learn does not run with."""

    def test_same_velocity_as_ours(self, robot_of, tmp_path):
        """From A, b and pi as plain numbers PlaCo finds u = A^+ b + N pi to 1e-9."""
        python = os.environ.get("MANIP_LEARN_PLACO_PYTHON")
        if not python:
            pytest.skip("PlaCo needs an environment of its own: name its interpreter in MANIP_LEARN_PLACO_PYTHON")
        robot, rng = robot_of("sawyer"), np.random.default_rng(0)
        steps = [oblique(robot, rng) for _ in range(20)]
        np.savez(
            tmp_path / "rows.npz",
            names=robot.joint_names,
            q=[q for *_, q in steps],
            A=[constraint(q) for constraint, *_, q in steps],
            b=[task.velocity(constraint, q, 0.0) for constraint, task, _, q in steps],
            pi=[policy(q) for *_, policy, q in steps],
        )
        done = subprocess.run(
            [
                python,
                str(ROOT / "tests" / "placo_child.py"),
                str(tmp_path / "rows.npz"),
                str(ROOT / "robots/sawyer.urdf"),
            ],
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            timeout=100,
        )
        assert done.returncode == 0, done.stderr
        answer = json.loads(done.stdout.strip().splitlines()[-1])
        ours = [unlimited(constraint, task, policy)(q).velocity for constraint, task, policy, q in steps]
        assert np.allclose(answer["velocities"], ours, rtol=0.0, atol=1e-9)
        assert "one number per row" in answer["refused"]

    def test_rows_inside_the_half_spaces(self):
        """The half-spaces leave exactly the displacements with A dq = dt b, in the columns of the named joints."""
        from manip_learn.control.interop.placo_task import PlacoTask

        solver = RecordingSolver()
        task = PlacoTask(solver, ["a", "b"])
        task.update([[1.0, 2.0]], [3.0], [0.5, -0.5])
        lhs, bound = solver.half_spaces
        dq = np.array([0.0, 0.01 * 3.0 / 2.0])
        q = np.array([9.0, 9.0, 0.1, 0.2])
        assert np.allclose(lhs @ (q + [0.0, 0.0, *dq]), bound)
        assert solver.targets == pytest.approx({"a": 0.105, "b": 0.195})
        task.update([[1.0, 2.0]], [0.0])
        assert solver.removed == 1
        assert task.velocity([0.0, 0.02, 0.03]).tolist() == pytest.approx([2.0, 3.0])

    def test_errors(self):
        """A solver without dt, unknown priorities, and sizes that do not fit are refused."""
        from manip_learn.control.interop.placo_task import PlacoTask

        with pytest.raises(TargetError, match="solver.dt"):
            PlacoTask(RecordingSolver(dt=0.0), ["a"])
        with pytest.raises(TargetError, match="priority"):
            PlacoTask(RecordingSolver(), ["a"], "scaled")
        with pytest.raises(TargetError, match="A must have 1 columns"):
            PlacoTask(RecordingSolver(), ["a"]).update([[1.0, 2.0]], [1.0])
        with pytest.raises(TargetError, match="finite"):
            PlacoTask(RecordingSolver(), ["a"]).update([[np.nan]], [1.0])


class RecordingSolver:
    """Stands in for `placo.KinematicsSolver`, its robot and its joints task; keeps what it was given."""

    def __init__(self, dt=0.01):
        self.dt, self.robot, self.state, self.removed = dt, self, self, 0
        self.q = np.array([9.0, 9.0, 0.1, 0.2])

    def get_joint_offset(self, name):
        return {"a": 2, "b": 3}[name]

    def get_joint_v_offset(self, name):
        return {"a": 1, "b": 2}[name]

    def get_joint(self, name):
        return float(self.q[self.get_joint_offset(name)])

    def add_joints_task(self):
        return self

    def add_joint_space_half_spaces_constraint(self, A, b):
        self.half_spaces = A, b
        return self

    def remove_constraint(self, _):
        self.removed += 1

    def configure(self, *_):
        """Nothing to keep."""

    def set_joints(self, targets):
        self.targets = targets
