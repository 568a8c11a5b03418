"""The short cuts of one control step must not show in its numbers."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from conftest import tip_of

from manip_learn.constraint import small_matrices
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import FrameJacobian
from manip_learn.constraint.small_matrices import svd
from manip_learn.control.command import Command
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies import ManipulabilityAscent
from manip_learn.control.tasks import PointAttractor, Task
from manip_learn.errors import TargetError
from manip_learn.robot.robot import Robot

RobotOf = Callable[[str], Robot]


def close(a: Command, b: Command) -> None:
    # A is known to 1e-16: where it is small as a whole, so is what A^+ can be known to
    scale = max(1.0, float(np.max(np.abs(a.velocity)))) * max(1.0, 0.01 / max(a.smallest_singular_value, 1e-300))
    for name in ("velocity", "task_velocity", "task_part", "null_part"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=0, atol=1e-12 * scale)
    for name in ("manipulability", "smallest_singular_value"):
        assert getattr(a, name) == pytest.approx(getattr(b, name), rel=1e-11, abs=1e-12)
    for name in ("task_scale", "null_scale"):  # of no meaning where there is nothing to scale: the parts are compared
        assert getattr(a, name) == pytest.approx(getattr(b, name), rel=1e-11, abs=1e-7)
    assert a.status == b.status


def rounded_otherwise(rng: np.random.Generator) -> Callable[[np.ndarray], tuple[np.ndarray, ...]]:
    """The decomposition with other last bits, as another processor's kernels give it: zeros become 1e-17, too."""

    def decompose(A: np.ndarray) -> tuple[np.ndarray, ...]:
        U, sigma, Vt = svd(A)
        last = [(1.0 + 2e-16 * rng.integers(-1, 2, x.shape), 1e-17 * rng.normal(size=x.shape)) for x in (U, sigma, Vt)]
        U, sigma, Vt = (x * factor + more for x, (factor, more) in zip((U, sigma, Vt), last, strict=True))
        return U, np.abs(sigma), Vt

    return decompose


def test_cholesky_and_svd_give_the_same_command(robot_of: RobotOf, monkeypatch: pytest.MonkeyPatch) -> None:
    """The factorisation of the common case and the decomposition of all cases agree to 1e-12, status included.

    So they do whatever the last bits of the decomposition are: processors differ in them.
    """
    law, commands = "manip_learn.control.law", list[list[Command]]()
    for kind in ("factorised", "decomposed", *range(8)):
        if kind != "factorised":
            monkeypatch.setattr(f"{law}.row_inverse", lambda A: None)
        if isinstance(kind, int):
            monkeypatch.setattr(f"{law}.svd", rounded_otherwise(np.random.default_rng(kind)))
        rng, here = np.random.default_rng(5), []
        for name, axes in product(("planar3", "sawyer", "panda", "kinova", "gantry", "tree"), ("x y", "xyz", "pose")):
            robot = robot_of(name)
            features = FrameJacobian(robot, tip_of(name), axes)
            for s in range(1, min(features.n_rows, robot.nv - 1, 4) + 1):
                constraint = Constraint(np.linalg.qr(rng.normal(size=(features.n_rows, s)))[0].T, features)
                for inverse in ("damped", "exact"):
                    q = robot.random_configuration(rng)
                    target = features.coordinates(robot.random_configuration(rng))
                    policy = ManipulabilityAscent(constraint, 0.3, logarithmic=bool(s % 2))
                    if np.linalg.cond(constraint(q)) < 1e6:  # beyond it A^+ b itself is rounding
                        here.append(ResolvedRateController(constraint, PointAttractor(target), policy, inverse)(q))
        commands.append(here)
    assert len(commands[0]) > 80
    for others in commands[1:]:
        for a, b in zip(commands[0], others, strict=True):
            close(a, b)


def test_svd_survives_a_failing_lapack(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    """If LAPACK reports that it did not converge, NumPy's own call has the last word."""
    A = rng.normal(size=(2, 5))
    expected = np.linalg.svd(A)
    monkeypatch.setattr(small_matrices, "dgesdd", lambda A: (np.nan, np.nan, np.nan, 1))
    for got, factor in zip(svd(A), expected, strict=True):
        np.testing.assert_array_equal(got, factor)


@pytest.mark.parametrize("limits", [True, False])
def test_a_task_that_is_not_finite_is_named(limits: bool, robot_of: RobotOf) -> None:
    """NaN or infinity from a task is the task's fault, not the posture's; so is a wrong size."""

    class Broken(Task):
        b: object = None

        def velocity(self, constraint: Constraint, q: np.ndarray, t: float) -> np.ndarray:
            return self.b  # type: ignore[return-value]

        def error(self, constraint: Constraint, q: np.ndarray, t: float) -> float:
            return 0.0

    constraint = Constraint(np.eye(3), FrameJacobian(robot_of("sawyer"), "right_hand"))
    task = Broken()
    for policy in (None, ManipulabilityAscent(constraint)):
        controller = ResolvedRateController(constraint, task, policy, limits=limits)
        for b in (np.array([0.1, np.nan, 0.0]), [np.inf, 0.0, 0.0], np.zeros(2), np.full(3, -np.inf)):
            task.b = b
            for q in (np.linspace(-0.5, 0.7, 7), np.zeros(7)):
                with pytest.raises(TargetError, match="task's velocity"):
                    controller(q)
        task.b = np.array([1, 0, 0])
        assert controller(np.linspace(-0.5, 0.7, 7)).task_velocity.dtype == np.float64
