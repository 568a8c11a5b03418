"""Promises of the controller on random trees, at any posture: what a user relies on whatever his arm is."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from random_arms import Asks, Case, random_case, random_posture, random_tree
from scipy.optimize import linprog

import manip_learn as ml
from manip_learn.control.command import Command
from manip_learn.errors import ConfigurationError
from manip_learn.linalg import null_basis

seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Where random robots are written."""
    return tmp_path_factory.mktemp("trees")


def commanded(case: Case) -> Command | None:
    """The command; None where the exact inverse overflows, which it says."""
    law, _, q, previous, dt = case
    try:
        return law(q, 0.0, dt, previous)
    except ConfigurationError as error:
        if law.inverse == "damped" or re.search("overflows at this posture", str(error)) is None:
            raise
        return None


@given(seeds)
@pytest.mark.fuzz
def test_every_command_keeps_the_promises(folder, seed):
    """Finite, within the limits, A null_part = 0, N^2 = N = N^T; the progress stated is that of the rows along b."""
    case = random_case(seed, folder)
    command = commanded(case)
    if command is None:
        return
    law, b, q, previous, dt = case
    A, u = law.constraint(q), command.velocity
    assert law.limits is not None
    assert np.all(np.isfinite(u))
    bounds = law.limits.bounds(q, dt, previous)
    assert np.all(u >= np.array(bounds.low) - 1e-12) and np.all(u <= np.array(bounds.high) + 1e-12)
    Z = null_basis(A)
    N = Z @ Z.T
    np.testing.assert_array_equal(N, N.T)
    np.testing.assert_allclose(N @ N, N, rtol=0, atol=1e-12)
    scale = max(1.0, float(np.linalg.norm(A)) * float(np.linalg.norm(command.null_part)))
    np.testing.assert_allclose(A @ command.null_part, 0.0, rtol=0, atol=1e-12 * scale)
    escape = 0.0 if command.escape_part is None else command.escape_part
    parts = command.task_part + command.null_part + escape
    np.testing.assert_allclose(parts, u, rtol=0, atol=1e-11 * max(1.0, float(np.linalg.norm(u))))
    progress = float(b @ mean_velocity(case, command) / (b @ b))
    assert command.progress == pytest.approx(progress, rel=2e-3, abs=2e-3)
    if command.status is ml.Status.OK:
        assert command.outside == 0.0 and progress > 0.99
        assert np.all(q <= law.limits.upper + 1e-9) and np.all(q >= law.limits.lower - 1e-9)


@given(seeds)
@pytest.mark.fuzz
def test_the_direction_of_the_task_is_kept(folder, seed):
    """Rows move forward, beside b by 1e-3 of it at most, wherever the bounds allow any motion along b (by a LP)."""
    case = random_case(seed, folder)
    law, b, q, previous, dt = case
    command = commanded(case)
    if command is None or command.escape_part is not None or b.size > q.size:
        return
    if command.smallest_singular_value < (law.threshold if law.inverse == "damped" else 1e-6):
        return
    A, along = law.constraint(q), b / np.linalg.norm(b)
    assert law.limits is not None
    bounds = law.limits.bounds(q, dt, previous)
    if law.inverse == "damped" and presses(law, command, q, dt):
        return
    columns = np.column_stack((A, -along))
    ranges = [*zip(bounds.low, bounds.high, strict=True), (0.0, None)]
    best = linprog([0.0] * q.size + [-1.0], A_eq=columns, b_eq=np.zeros(b.size), bounds=ranges, method="highs")
    if best.status != 0 or best.x[-1] < 1e-6:
        return
    moved = mean_velocity(case, command)
    forward, speed = float(along @ moved), float(np.linalg.norm(moved))
    assert forward >= -1e-12
    if speed > 1e-9:
        assert np.linalg.norm(moved - forward * along) < 1.2e-3 * np.linalg.norm(b) + 1e-9
    elif np.linalg.norm(b) > 0.01:  # a smaller velocity may wait while the null space brakes
        assert previous is not None or best.x[-1] < 1e-3


def mean_velocity(case: Case, command: Command) -> np.ndarray:
    """A u over the step, as its rows turn by the motion before: that is what the law promises (see `Law`)."""
    A, v = case.law.constraint(case.q), case.previous
    if v is None or not v.any():
        return A @ command.velocity
    c = (case.law.constraint(case.law.robot.integrate(case.q, 0.5 * case.dt * v)) - A) @ v
    most = 0.25 * command.smallest_singular_value * float(np.linalg.norm(v))
    return A @ command.velocity + c * min(1.0, most / max(float(np.linalg.norm(c)), 1e-300))


def presses(law: ml.ResolvedRateController, command: Command, q: np.ndarray, dt: float) -> bool:
    """Whether the approach to a singularity is what bounds the command."""
    free = ml.ResolvedRateController(law.constraint, law.task, law.null_policy, "exact", dt=dt)
    return not np.allclose(free(q, 0.0, dt).velocity, law(q, 0.0, dt).velocity, rtol=0, atol=1e-9)


@given(seeds)
@pytest.mark.fuzz
def test_the_base_may_be_anywhere(folder, seed):
    """An arm on a turned and moved base, with rows turned likewise, has the same joint velocities."""
    rng = np.random.default_rng(seed)
    robot = random_tree(np.random.default_rng(seed), folder)
    moved = random_tree(np.random.default_rng(seed), folder, "0.7 -1.1 0.4", "0.3 -0.8 1.9")
    q = random_posture(rng, robot)
    R = moved.pose(q, "tip")[:3, :3] @ robot.pose(q, "tip")[:3, :3].T
    rows = np.linalg.qr(rng.normal(size=(3, 3)))[0][: int(rng.integers(1, 4))]
    b = rng.normal(size=len(rows))
    commands = []
    for arm, selection in ((robot, rows), (moved, rows @ R.T)):
        constraint = ml.Constraint(selection, ml.FrameJacobian(arm, "tip", "xyz"))
        # a constraint keeps the space of its rows, not each of them
        law = ml.ResolvedRateController(constraint, Asks(constraint.selection @ selection.T @ b))
        law = ml.ResolvedRateController(constraint, law.task, ml.ManipulabilityAscent(constraint))
        commands.append((law(q, 0.0, 0.01, np.zeros(arm.nv)), law.constraint(q)))
    (command, A), (turned, _) = commands
    sigma = np.linalg.svd(A, compute_uv=False)
    if 1e-12 < sigma[-1] / max(sigma[0], 1e-300) < 1e-4:  # rounding is all that says which way leads out
        return
    np.testing.assert_allclose(turned.manipulability, command.manipulability, rtol=0, atol=1e-9)
    if sigma[-1] > 1e-4:
        np.testing.assert_allclose(turned.velocity, command.velocity, rtol=0, atol=1e-6)


@given(seeds)
@pytest.mark.fuzz
def test_a_loop_keeps_every_limit(folder, seed):
    """In a closed loop from inside: positions, velocities and accelerations within their limits in every period."""
    law, _, q, _, dt = random_case(seed, folder, inverse="damped")
    assert law.limits is not None
    robot, q = law.limits.robot, np.clip(q, law.limits.lower, law.limits.upper)
    loop, before = ml.ServoLoop(law, dt, stale_after=1.0), np.zeros(robot.nv)
    for k in range(60):
        command = loop.update(q, k * dt)
        assert command.status is not ml.Status.INVALID_INPUT
        assert np.all(np.abs(command.velocity - before) <= loop.acceleration_limit * dt * (1.0 + 1e-9))
        assert np.all(np.abs(command.velocity) <= law.limits.velocity * (1.0 + 1e-9))
        q, before = robot.integrate(q, dt * command.velocity), command.velocity
        assert np.all(q <= law.limits.upper + 1e-9) and np.all(q >= law.limits.lower - 1e-9)
