"""Free directions and moving targets in compiled steps: the commands, loops and rollouts of the law in Python."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from compiled_cases import RobotOf, both_ways, compared, kernels, needs_numba, state_of  # noqa: F401
from conftest import tip_of
from random_arms import random_posture
from test_batch_rollout import same

import manip_learn as ml
from manip_learn.control.command import Method
from manip_learn.control.compiled_controller import why_not
from manip_learn.errors import ConfigurationError, ConstraintError, TargetError

DT = 0.0023  # [s] whose multiples do not reach a velocity limit by the acceleration limit exactly
# after braking for one call both bounds are the same number, and rounding says which is named
SLOWED = {ml.Status.ACCELERATION_LIMITED, ml.Status.VELOCITY_LIMITED}
# what holds the hand, the way along what is left free [m or rad], and which free direction is meant
HELD = {
    "line": ("y z", 0.15, None),
    "plane": ("z", -0.2, (1.0, 2.0, 0.0)),
    "door": ("radial axial", 0.6, None),
    "screw": ("radial helical", -0.4, None),
    "hinge": ("turn-1 turn-2 slide-1 slide-2 slide", 0.5, None),
}


def law_of(robot: ml.Robot, kind: str, name: str, climb: bool = True) -> ml.ResolvedRateController:
    """A controller that drives what a mechanism leaves free, its task at rest."""
    rows, distance, direction = HELD[kind]
    if kind in ("line", "plane"):
        features = ml.FrameJacobian(robot, tip_of(name), "xyz")
        selection = np.eye(3)[["xyz".index(axis) for axis in rows.split()]]
    else:
        features = ml.MechanismRows(robot, tip_of(name), rows, axis=(0.1, 0.2, 1.0), point=(0.2, 0.3, 0.3), pitch=0.05)
        selection = np.eye(features.n_rows)
    task = ml.FreeDirection(ml.Constraint(selection, features), distance, 0.4, direction=direction)
    policy = ml.ManipulabilityAscent(task.constraint) if climb else None
    return ml.ResolvedRateController(task.learnt, task, policy)


def follower_of(robot: ml.Robot, name: str, kind: str, speed: float = 0.5) -> ml.ResolvedRateController:
    """A controller whose target goes round a circle of 0.1 m, at the speed [m/s]."""
    features, middle = ml.FrameJacobian(robot, tip_of(name), "xyz"), np.array([0.5, 0.1, 0.4])

    def target(t: float) -> np.ndarray:
        angle = 10.0 * speed * t
        place = middle + 0.1 * np.array([np.cos(angle), np.sin(angle), 0.0])
        if kind != "pose":
            return place
        return np.block([[np.eye(3), place[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])

    def rate(t: float) -> np.ndarray:
        angle = 10.0 * speed * t
        return speed * np.array([-np.sin(angle), np.cos(angle), 0.0])

    constraint = ml.Constraint(np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0]]), features)
    task = ml.Track(target, rate if kind == "rate" else None, gain=2.0)
    return ml.ResolvedRateController(constraint, task, ml.ManipulabilityAscent(constraint))


@both_ways
@pytest.mark.usefixtures("kernels")
def test_moving_targets_are_followed_alike(numba: bool, robot_of: RobotOf, rng: np.random.Generator) -> None:
    """A place, a pose or a rate: every part of the command near and far, with b of the period asked for."""
    robot = robot_of("sawyer")
    for kind in ("place", "pose", "rate"):
        law, told = follower_of(robot, "sawyer", kind), set()
        compiled = ml.CompiledController(follower_of(robot, "sawyer", kind))
        for _ in range(12):
            q = random_posture(rng, robot)
            t, state = float(rng.uniform(0.0, 3.0)), state_of(rng, robot)[1:]
            told.add(compared(law, compiled, q, t, *state))
            assert compiled.task_error(q, t) == law.task_error(q, t)
        assert len(told) >= 2, kind


@needs_numba
def test_a_moving_target_leads_a_loop(robot_of: RobotOf) -> None:
    """The loop and a rollout of the compiled law stay with those in Python, near the target; a bad target is told."""
    robot = robot_of("sawyer")
    q0 = np.array([0.3, -0.6, 0.2, 0.9, 0.1, 0.5, 0.0])
    loops = [ml.ServoLoop(follower_of(robot, "sawyer", "place", 0.1), DT, compiled=c) for c in (None, False)]
    assert isinstance(loops[0].controller, ml.CompiledController) and not loops[0].controller.rolls_out
    for loop in loops:
        loop.reset(q0)
    q, error = q0, np.inf
    for k in range(2000):
        got, expected = (loop.update(q, k * DT) for loop in loops)
        np.testing.assert_allclose(got.velocity, expected.velocity, rtol=0, atol=1e-9)
        q, error = loops[1].position, loops[1].task_error(q, k * DT)
    assert error < 1e-3
    rollouts = [ml.simulate(robot, loop.controller, q0, 1.0, 0.01) for loop in loops]
    same(rollouts[:1], rollouts[1:])
    constraint = loops[1].controller.constraint
    wrong = ml.CompiledController(ml.ResolvedRateController(constraint, ml.Track(lambda _t: [0.1, 0.2, np.nan])))
    with pytest.raises(TargetError):
        wrong(q0)


@both_ways
@pytest.mark.usefixtures("kernels")
def test_commands_are_the_same(numba: bool, robot_of: RobotOf, rng: np.random.Generator) -> None:
    """On the way, late, at limits, outside, with a velocity before: every part of the command, from the kernel."""
    for name, kind in product(("sawyer", "panda", "kinova"), HELD):
        robot, told = robot_of(name), set()
        law, other = law_of(robot, kind, name), law_of(robot, kind, name)
        compiled = ml.CompiledController(other)
        for case in range(6):
            start = random_posture(rng, robot) if case else robot.positions(robot.random_configuration(rng))
            for controller, begun in ((law, law), (other, compiled)):
                controller.task.reset()
                begun(start, 0.0, DT)
            for t in (0.2, 0.4, 2.0):
                q = start + rng.normal(size=robot.nv) * rng.choice([1e-3, 0.1])
                told.add(compared(law, compiled, q, t, *state_of(rng, robot)[1:]))
        assert len(told) >= 2, (name, kind)


@needs_numba
@pytest.mark.parametrize("kind", ["line", "door"])
def test_loops_keep_time_alike(kind: str, robot_of: RobotOf) -> None:
    """Calls that are late, a stop, a gap and a second run: the clock of the task goes on as with the law in Python."""
    robot = robot_of("sawyer")
    q0 = np.array([0.3, -0.6, 0.2, 0.9, 0.1, 0.5, 0.0])
    loops = [ml.ServoLoop(law_of(robot, kind, "sawyer"), DT, compiled=compiled) for compiled in (None, False)]
    assert isinstance(loops[0].controller, ml.CompiledController)
    told, moved = set(), 0.0
    for run in range(2):
        for loop in loops:
            loop.reset(q0)
        t, q = 5.0 * run, q0
        for k in range(900):
            t += 0.3 if k == 300 else DT * (1.0 + 0.4 * (k % 50 == 49))
            for loop in loops:
                if k in (500, 600):
                    (loop.stop if k == 500 else loop.start)()
            got, expected = (loop.update(q, t) for loop in loops)
            assert got.status == expected.status or {got.status, expected.status} <= SLOWED
            np.testing.assert_allclose(got.velocity, expected.velocity, rtol=0, atol=1e-9)
            np.testing.assert_allclose(loops[0].position, loops[1].position, rtol=0, atol=1e-9)
            told.add(str(got.status))
            q = loops[1].position
            assert q is not None
        moved = max(moved, float(np.max(np.abs(q - q0))))
        np.testing.assert_allclose(loops[0].task_error(q, t), loops[1].task_error(q, t), rtol=0, atol=1e-9)
    assert moved > 0.1 and {"ok", "stale", "stopped"} <= told


@needs_numba
@pytest.mark.parametrize("method", ["euler", "rk4"])
def test_rollouts_are_made_command_by_command(method: Method, robot_of: RobotOf) -> None:
    """b changes with the posture and the time: `simulate` asks for it at every step, from one start and from many."""
    robot = robot_of("sawyer")
    starts = np.array([[0.3, -0.6, 0.2, 0.9, 0.1, 0.5, 0.0], [0.1, -0.4, 0.3, 1.0, 0.2, 0.4, 0.1]])
    law, other = law_of(robot, "line", "sawyer"), law_of(robot, "line", "sawyer")
    compiled = ml.CompiledController(other)
    same(
        ml.simulate(robot, compiled, starts, 3.0, 0.01, method),
        [ml.simulate(robot, law, start, 3.0, 0.01, method) for start in starts],
    )
    (rollout,) = ml.simulate(robot, compiled, starts[:1], 3.0, 0.01, method)
    assert other.task.progress(rollout.q[-1]) == pytest.approx(0.15, abs=1e-3)  # type: ignore[attr-defined]
    assert not compiled.rolls_out
    with pytest.raises(ConstraintError, match="use simulate"):
        compiled.rollout(starts[0], 10, 0.01)


@needs_numba
def test_a_bad_posture_starts_nothing(robot_of: RobotOf) -> None:
    """The motion begins at the first posture that is one."""
    robot = robot_of("sawyer")
    law = law_of(robot, "line", "sawyer")
    compiled = ml.CompiledController(law)
    for bad in (np.full(7, np.nan), np.zeros(6)):
        with pytest.raises(ConfigurationError):
            compiled(bad, 0.0)
    assert law.task.goal() is None
    compiled(np.zeros(7), 0.0)
    assert law.task.goal() is not None


def test_what_turns_the_hand_is_not_compiled(robot_of: RobotOf) -> None:
    """Along poses the rows of the error are others than those held; a hinge's are its own."""
    robot = robot_of("sawyer")
    features = ml.FrameJacobian(robot, tip_of("sawyer"), "pose")
    constraint = ml.Constraint(np.eye(6)[1:], features)
    task = ml.FreeDirection(constraint, 0.1, 0.1)
    assert not task.along_rows and "FreeDirection" in (why_not(ml.ResolvedRateController(constraint, task)) or "")
    for task in (ml.Track(lambda _t: np.eye(4)), ml.Track(lambda _t: np.zeros(6))):
        assert "Track" in (why_not(ml.ResolvedRateController(constraint, task)) or "")
    for kind in HELD:
        assert why_not(law_of(robot, kind, "sawyer")) is None, kind


@needs_numba
def test_a_drawer_is_opened_within_walls(robot_of: RobotOf) -> None:
    """A free direction in a loop, whose velocity is given, and a wall on its way: as with the law in Python."""
    robot, tip = robot_of("sawyer"), tip_of("sawyer")
    ready = np.array([0.3, -0.6, 0.2, 0.9, 0.1, 0.5, 0.0])
    wall = [1.0, 0.0, 0.0, robot.position(ready, tip)[0] + 0.05]
    positions = []
    for compiled in (None, False):
        constraint = ml.Constraint(np.eye(3)[1:], ml.FrameJacobian(robot, tip, "xyz"))
        task = ml.FreeDirection(constraint, 0.15, 0.1)
        law = ml.ResolvedRateController(constraint, task, limits=ml.Limits(robot, tip_walls=[wall], frames=tip))
        loop = ml.ServoLoop(law, 0.0023, compiled=compiled)
        q, path = ready, []
        for k in range(700):
            loop.update(q, 0.0023 * k)
            q = loop.position
            assert q is not None
            path.append(q)
        positions.append(np.array(path))
        assert isinstance(loop.controller, ml.CompiledController) == (compiled is None)
    np.testing.assert_allclose(positions[0], positions[1], rtol=0, atol=1e-9)
    assert robot.position(positions[0][-1], tip)[0] == pytest.approx(wall[3], abs=2e-3)
