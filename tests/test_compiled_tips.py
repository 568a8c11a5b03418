"""Limits on the speed and the place of frames in compiled steps: the commands of the program in Python."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from compiled_cases import RobotOf, agree, both_ways, kernels, needs_numba  # noqa: F401
from conftest import tip_of
from random_arms import random_case, random_posture
from test_batch_rollout import same
from test_mimic import load

import manip_learn as ml
from manip_learn.control import controller as controller_module
from manip_learn.control.command import Method
from manip_learn.control.compiled_controller import why_not

READY = np.array([0.3, -0.6, 0.2, 0.9, 0.1, 0.5, 0.0])


@pytest.fixture
def without_numba(numba: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the kernels are plain Python they are not looked for."""
    if not numba:
        monkeypatch.setattr(controller_module, "find_spec", lambda name: "plain Python instead")


def tight(robot: ml.Robot, frames: tuple[str, ...], q: np.ndarray, rng: np.random.Generator) -> ml.Limits:
    """Limits of frames that bind at a posture: a speed, a box about the first, an oblique wall, or all of them."""
    place, kind = robot.position(q, frames[0]), int(rng.integers(4))
    limits: dict[str, Any] = {"frames": frames}
    if kind in (0, 3):
        limits["tip_speed"] = float(10.0 ** rng.uniform(-2.0, 0.0))
    if kind in (1, 3):
        limits["tip_box"] = [place - 10.0 ** rng.uniform(-4.0, 0.0, 3), place + 10.0 ** rng.uniform(-4.0, 0.0, 3)]
    if kind in (2, 3):  # in front of it, or a little behind
        n = rng.normal(size=3)
        limits["tip_walls"] = [[*n, n @ place + float(rng.choice([-1e-3, 1e-4, 1e-2, 0.1]))]]
    return ml.Limits(robot, acceleration=np.inf if rng.random() < 0.2 else None, **limits)


@both_ways
@pytest.mark.parametrize("name", ["planar3", "sawyer", "kinova", "wrist", "gantry"])
@pytest.mark.usefixtures("kernels")
def test_every_state_is_computed_by_the_kernel(
    name: str, numba: bool, robot_of: RobotOf, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Free, at walls, beyond them, too fast, singular, after a velocity: the numbers and words of the original."""
    robot, told, bound = robot_of(name), set(), 0
    axes = "x y" if name == "planar3" else "xyz"
    links = [frame for frame in robot.frame_names if np.any(robot.jacobian(robot.neutral(), frame)[:3])]
    for seed in range(60 if numba else 12):
        rng = np.random.default_rng(seed)
        features = ml.FrameJacobian(robot, tip_of(name), axes)
        s = int(rng.integers(1, min(features.n_rows, robot.nv) + 1))
        constraint = ml.Constraint(np.linalg.qr(rng.normal(size=(features.n_rows, s)))[0].T, features)
        q = random_posture(rng, robot)
        frames = (tip_of(name),) if seed % 3 else (str(rng.choice(links)), tip_of(name))
        task = ml.PointAttractor(features.coordinates(random_posture(rng, robot)), 3.0)
        policy = ml.ManipulabilityAscent(constraint) if seed % 2 else ml.JointAttractor(rng.normal(size=robot.nv))
        limits = tight(robot, frames, q, rng)
        law = ml.ResolvedRateController(constraint, task, policy, limits=limits)
        compiled = ml.CompiledController(law)
        free = ml.ResolvedRateController(constraint, task, policy, limits=ml.Limits(robot))
        for _ in range(4):
            x = q + rng.normal(size=robot.nv) * rng.choice([0.0, 1e-3, 0.1])
            fastest = np.minimum(robot.velocity_limit, 5.0)
            previous = fastest * rng.uniform(-0.3, 0.3, robot.nv) if rng.random() < 0.5 else None
            arguments = (0.0, float(10.0 ** rng.uniform(-3.0, -1.0)), previous, float(rng.choice([0.0, 0.4, 1.0])))
            expected, beside = law(x, *arguments), law(x * (1.0 + 4e-16) + 1e-16, *arguments)
            with monkeypatch.context() as patch:
                patch.setattr(ml.ResolvedRateController, "__call__", lambda *a: pytest.fail("handed back"))
                got = compiled(x, *arguments)
            agree(got, expected, beside, at_limits=1e-9)
            told.add(str(expected.status))
            bound += bool(np.any(np.abs(free(x, *arguments).velocity - expected.velocity) > 1e-6))
    assert len(told) >= 5 and bound > (100 if numba else 15)


@both_ways
@pytest.mark.usefixtures("kernels", "without_numba")
def test_random_laws_are_bounded_alike(numba: bool, tmp_path: Path) -> None:
    """Behind a law in Python, for random trees, rows, tasks and policies."""
    told, bound = set(), 0
    for seed in range(150 if numba else 40):
        case, rng = random_case(seed, tmp_path), np.random.default_rng(seed)
        free, q = case.law, case.q
        robot = free.robot
        assert robot is not None
        law = free.with_limits(tight(robot, ("tip",), q, rng))
        arguments = (0.0, case.dt, case.previous, float(seed % 3) / 2.0)
        expected, beside = law(q, *arguments), law(q * (1.0 + 4e-16), *arguments)
        agree(law.with_solver("compiled")(q, *arguments), expected, beside, at_limits=1e-9)
        told.add(str(expected.status))
        bound += bool(np.any(np.abs(free(q, *arguments).velocity - expected.velocity) > 1e-6))
    assert len(told) >= 6 and bound > (75 if numba else 20)


@needs_numba
@pytest.mark.parametrize("method", ["euler", "rk4"])
def test_rollouts_are_the_same(method: Method, robot_of: RobotOf) -> None:
    """A whole rollout in compiled code, up to a face of the box at a speed that is limited."""
    robot = robot_of("sawyer")
    tip, dt = tip_of("sawyer"), 0.0023  # [s] whose multiples do not reach a velocity limit exactly
    constraint = ml.Constraint(np.eye(3), ml.FrameJacobian(robot, tip, "xyz"))
    place = robot.position(READY, tip)
    limits = ml.Limits(robot, tip_box=[place - 0.1, place + [0.05, 0.2, 0.2]], tip_speed=0.1, frames=tip)
    law = ml.ResolvedRateController(constraint, ml.PointAttractor(place + [0.2, 0.02, 0.0], gain=5.0), limits=limits)
    compiled = ml.CompiledController(law)
    assert compiled.rolls_out
    expected = ml.simulate(robot, law, READY, 600 * dt, dt, method, compiled=False)
    got = ml.simulate(robot, compiled, READY, 600 * dt, dt, method)
    same((got,), [expected])
    speeds = [np.linalg.norm(constraint(q) @ u) for q, u in zip(got.q, got.u, strict=True)]
    assert 0.099 < max(speeds) <= 0.1 + 1e-9
    assert robot.position(got.q[-1], tip)[0] == pytest.approx(place[0] + 0.05, abs=2e-3)


@needs_numba
def test_a_drawer_is_opened_within_walls(robot_of: RobotOf) -> None:
    """A free direction in a loop, whose velocity is given, and a wall on its way: as with the law in Python."""
    robot, tip = robot_of("sawyer"), tip_of("sawyer")
    wall = [1.0, 0.0, 0.0, robot.position(READY, tip)[0] + 0.05]
    positions = []
    for compiled in (None, False):
        constraint = ml.Constraint(np.eye(3)[1:], ml.FrameJacobian(robot, tip, "xyz"))
        task = ml.FreeDirection(constraint, 0.15, 0.1)
        law = ml.ResolvedRateController(constraint, task, limits=ml.Limits(robot, tip_walls=[wall], frames=tip))
        loop = ml.ServoLoop(law, 0.0023, compiled=compiled)
        q, path = READY, []
        for k in range(700):
            loop.update(q, 0.0023 * k)
            q = loop.position
            assert q is not None
            path.append(q)
        positions.append(np.array(path))
        assert isinstance(loop.controller, ml.CompiledController) == (compiled is None)
    np.testing.assert_allclose(positions[0], positions[1], rtol=0, atol=1e-9)
    assert robot.position(positions[0][-1], tip)[0] == pytest.approx(wall[3], abs=2e-3)


def test_frames_that_followers_move_are_limited_in_python() -> None:
    """A frame behind a joint that mimics another has no compiled chain: said, and solved without."""
    robot = load({"c": ("a", 2.0, 0.1)})
    constraint = ml.Constraint(np.eye(3)[:1], ml.FrameJacobian(robot, "l2", "xyz"))
    for frame, refused in (("l2", False), ("l3", True)):
        limits = ml.Limits(robot, tip_speed=0.1, frames=frame)
        law = ml.ResolvedRateController(constraint, ml.PointAttractor([1.0, 1.0, 1.0]), limits=limits)
        assert ("the speed or the place of a frame" in (why_not(law) or "")) == refused


@needs_numba
def test_a_hand_far_from_every_joint_limit_is_slowed_down(robot_of: RobotOf) -> None:
    """Behind a law in Python the short way past the limits does not pass those of frames by."""
    robot, tip = robot_of("sawyer"), tip_of("sawyer")
    constraint = ml.Constraint(np.eye(3)[:2], ml.CentreOfMass(robot))
    goal = constraint.features.coordinates(READY) + [0.02, 0.05, 0.0]
    limits = ml.Limits(robot, tip_speed=0.02, frames=tip)
    law = ml.ResolvedRateController(constraint, ml.PointAttractor(goal), limits=limits)
    expected, got = law(READY), law.with_solver("compiled")(READY)
    agree(got, expected, at_limits=1e-9)
    assert 0.0199 < np.linalg.norm(robot.jacobian(READY, tip)[:3] @ got.velocity) <= 0.02
