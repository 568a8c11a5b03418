"""The kernel must give the commands and rollouts of the law in `controller`, compiled or as the plain Python it is."""

from __future__ import annotations

import pickle
import re
from pathlib import Path

import numpy as np
import pytest
from compiled_cases import (  # noqa: F401
    RobotOf,
    agree,
    both_ways,
    compared,
    kernels,
    mechanisms,
    needs_numba,
    robot_named,
    state_of,
    tight,
)  # fmt: skip
from conftest import tip_of
from random_arms import random_posture
from test_batch_rollout import same
from test_mimic import load

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features import CentreOfMass, FrameJacobian, MechanismRows
from manip_learn.constraint.manipulability_batch import row_inverses
from manip_learn.constraint.small_matrices import row_inverse
from manip_learn.control import compiled_controller
from manip_learn.control.command import Method
from manip_learn.control.compiled import constrained_rows, control_step
from manip_learn.control.compiled import limits as compiled_limits
from manip_learn.control.compiled_controller import CompiledController, why_not
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.limits import Limits
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent, NullSpacePolicy, ZeroPolicy
from manip_learn.control.rollout import Rollout
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks import Hold, PointAttractor, Track
from manip_learn.errors import ConfigurationError, ConstraintError, MissingExtraError, TargetError
from manip_learn.robot.robot import Reference, Robot
from manip_learn.robot.rotations import left_jacobian_inverse, rotation_matrix, rotation_vector

TARGETS: tuple[tuple[str, Reference], ...] = (
    ("pose", "world"), ("pose", "local"), ("rotation", "world"), ("rotation", "local"), ("xyz", "local"),
    ("x z rx ry rz", "world"), ("z ry", "local"), ("xyz", "world"),
)  # fmt: skip


def controllers(robot: Robot, frame: str, rng: np.random.Generator) -> list[ResolvedRateController]:
    out = []
    rest = robot.positions(robot.random_configuration(rng))
    for axes, reference in (("xyz", "world"), ("z x", "world"), ("pose", "local")):
        features = FrameJacobian(robot, frame, axes, reference)
        for s in range(1, min(features.n_rows, robot.nv - 1, 4) + 1):
            constraint = Constraint(np.linalg.qr(rng.normal(size=(features.n_rows, s)))[0].T, features)
            target = FrameJacobian(robot, frame, "xyz").coordinates(robot.random_configuration(rng))
            target = target[["xyz".index(n) for n in features.row_names]] if axes != "pose" else None
            policies: list[NullSpacePolicy] = [
                ManipulabilityAscent(constraint, 0.5),
                ManipulabilityAscent(constraint, 3.0, logarithmic=False),
                JointAttractor(rest, 2.0, robot),
                JointAttractor(rest, 0.5),
                ZeroPolicy(robot.nv),
            ]
            for i, policy in enumerate(policies):
                task = Hold() if target is None else PointAttractor(target, 2.0, max_speed=0.2 if i % 2 else None)
                inverse = ("damped", "exact", "truncated")[(i + s) % 3]
                out.append(ResolvedRateController(constraint, task, policy, inverse, limits=bool((i + s) % 4)))
    return out


@both_ways
@pytest.mark.usefixtures("kernels")
def test_commands_are_the_same(numba: bool, robot_of: RobotOf, rng: np.random.Generator) -> None:
    """Every part of the command, its numbers to 1e-12 and its status, at random, extreme and singular postures."""
    for name in ("planar3", "sawyer", "panda", "kinova", "gantry", "wrist", "tree"):
        robot, statuses = robot_of(name), set()
        for controller in controllers(robot, tip_of(name), rng):
            compiled = CompiledController(controller)
            q = robot.positions(robot.random_configuration(rng))
            postures = [q, 1.1 * q, np.zeros(robot.nv), 1e-4 * q]
            if not (isinstance(controller.null_policy, JointAttractor) and controller.null_policy.robot is None):
                postures.append(robot.random_configuration(rng))
            for x in postures:
                if np.linalg.cond(controller.constraint(x)) > 1e6 and controller.inverse != "damped":
                    continue  # A^+ b is rounding there
                command = controller(x)
                agree(compiled(x), command)
                statuses.add(command.status)
                agree(compiled(x, 0.0, 0.1), controller(x, 0.0, 0.1))
        assert len(statuses) >= 3, name


@both_ways
@pytest.mark.usefixtures("kernels")
def test_every_state_is_computed_by_the_kernel(numba: bool, robot_of: RobotOf, tmp_path: Path) -> None:
    """At limits, outside, singular and beside it, out of reach, with a velocity before: the numbers of the original."""
    for name in ("tree", "planar3", "sawyer", "panda"):
        told = set()
        for seed in range(40 if numba else 12):
            rng = np.random.default_rng(seed)
            robot, tip = robot_named(name, robot_of, rng, tmp_path)
            features = FrameJacobian(robot, tip, "x y" if name == "planar3" else "xyz")  # whose z is always 0
            s = int(rng.integers(1, min(features.n_rows, robot.nv) + 1))
            constraint = Constraint(np.linalg.qr(rng.normal(size=(features.n_rows, s)))[0].T, features)
            task = PointAttractor(features.coordinates(random_posture(rng, robot)) * rng.choice([1.0, 3.0]), 3.0)
            policies = (ManipulabilityAscent(constraint), JointAttractor(rng.normal(size=robot.nv)), None)
            limits = Limits(robot, acceleration=np.inf) if rng.random() < 0.2 else True
            threshold = 0.05 if seed % 4 else 0.002  # ill-conditioned, and not damped
            law = ResolvedRateController(constraint, task, policies[seed % 3], limits=limits, threshold=threshold)
            compiled = CompiledController(law)
            for _ in range(6):
                q = random_posture(rng, robot)
                told.add(compared(law, compiled, q, *state_of(rng, robot), at_limits=1e-10))
        assert len(told) >= 5, name


@both_ways
@pytest.mark.usefixtures("kernels")
def test_mechanisms_are_computed_by_the_kernel(numba: bool, robot_of: RobotOf, tmp_path: Path) -> None:
    """Doors, balls, screws, cylinders, held orientations, loose and firm: as for constant rows."""
    for name in ("tree", "planar3", "gantry", "sawyer", "panda", "kinova"):
        told = set()
        for seed in range(4 if numba else 1):
            rng = np.random.default_rng(seed)
            robot, tip = robot_named(name, robot_of, rng, tmp_path)
            for i, constraint in enumerate(mechanisms(robot, tip, rng)):
                policies = (ManipulabilityAscent(constraint), JointAttractor(rng.normal(size=robot.nv)))
                threshold = 0.05 if i % 4 else 0.002
                law = ResolvedRateController(constraint, Hold(), policies[i % 3 // 2], threshold=threshold)
                if why_not(law) == "it has more rows than joints":
                    continue
                compiled = CompiledController(law)
                for k in range(4):
                    q = random_posture(rng, robot) if k else np.zeros(robot.nv)  # stretched, folded: singular
                    previous = robot.velocity_limit.clip(0.0, 5.0) * rng.uniform(-1.0, 1.0, robot.nv) if k > 1 else None
                    dt = float(10.0 ** rng.uniform(-3.0, -1.0))
                    told.add(compared(law, compiled, q, 0.0, dt, previous, at_limits=1e-10))
        assert len(told) >= 3, name


@both_ways
@pytest.mark.usefixtures("kernels")
def test_targets_of_every_shape(numba: bool, robot_of: RobotOf, tmp_path: Path) -> None:
    """Far from the target, at it and beside it, singular and at limits: the numbers and the words of the original."""
    for name in ("tree", "planar3", "sawyer", "panda"):
        told, shapes = set(), set()
        for seed in range(64 if numba else 16):
            rng = np.random.default_rng([seed, 5])
            robot, tip = robot_named(name, robot_of, rng, tmp_path)
            axes, reference = TARGETS[seed % len(TARGETS)]
            features = FrameJacobian(robot, tip, axes, reference)
            s = int(rng.integers(1, min(features.n_rows, robot.nv) + 1))
            constraint = Constraint(np.linalg.qr(rng.normal(size=(features.n_rows, s)))[0].T, features)
            at = random_posture(rng, robot)
            whole = features.n_rows in (3, 5, 6) and not (axes == "xyz" and seed % 16 >= 8)
            target = features.coordinates(at) if whole and seed % 3 else features.pose(at)
            policy = (ManipulabilityAscent(constraint), JointAttractor(rng.normal(size=robot.nv)), None)[seed % 3]
            task = PointAttractor(target, 3.0, max_speed=0.2 if seed % 2 else None)
            inverse = ("damped", "damped", "truncated")[seed % 3]
            law = ResolvedRateController(constraint, task, policy, inverse, limits=bool(seed % 5))
            if why_not(law) == "it has more rows than joints":
                continue
            compiled = CompiledController(law)
            for q in (random_posture(rng, robot), at, at + 1e-5 * rng.normal(size=robot.nv), np.zeros(robot.nv)):
                if not 0.0 < np.abs(q - at).max() < 1e-6:  # where the direction of the task is known to few digits
                    told.add(compared(law, compiled, q, *state_of(rng, robot, 0.2)))
            shapes.add(target.shape)
        assert len(told) >= 5 and len(shapes) >= 3, name


@both_ways
@pytest.mark.usefixtures("kernels")
def test_numbers_along_the_constraint(numba: bool, robot_of: RobotOf, rng: np.random.Generator) -> None:
    """A target of one number per constrained row, along the rows of Lambda."""
    robot = robot_of("sawyer")
    features = FrameJacobian(robot, tip_of("sawyer"), "xyz")
    constraint = Constraint(np.linalg.qr(rng.normal(size=(3, 2)))[0].T, features)
    goal = constraint.selection @ features.coordinates(random_posture(rng, robot))
    law = ResolvedRateController(constraint, PointAttractor(goal), ManipulabilityAscent(constraint))
    for _ in range(10):
        q = random_posture(rng, robot)
        agree(CompiledController(law)(q), law(q))


@both_ways
@pytest.mark.usefixtures("kernels")
def test_limits_of_frames_in_every_state(numba: bool, robot_of: RobotOf) -> None:
    """Free, at walls, beyond them, too fast, singular, after a velocity: the numbers and words of the original."""
    for name in ("planar3", "sawyer", "kinova", "wrist", "gantry"):
        robot, told, bound = robot_of(name), set(), 0
        links = [frame for frame in robot.frame_names if np.any(robot.jacobian(robot.neutral(), frame)[:3])]
        for seed in range(24 if numba else 12):
            rng = np.random.default_rng(seed)
            features = FrameJacobian(robot, tip_of(name), "x y" if name == "planar3" else "xyz")
            s = int(rng.integers(1, min(features.n_rows, robot.nv) + 1))
            constraint = Constraint(np.linalg.qr(rng.normal(size=(features.n_rows, s)))[0].T, features)
            q = random_posture(rng, robot)
            frames = (tip_of(name),) if seed % 3 else (str(rng.choice(links)), tip_of(name))
            task = PointAttractor(features.coordinates(random_posture(rng, robot)), 3.0)
            policy = ManipulabilityAscent(constraint) if seed % 2 else JointAttractor(rng.normal(size=robot.nv))
            law = ResolvedRateController(constraint, task, policy, limits=tight(robot, frames, q, rng))
            compiled, free = CompiledController(law), law.with_limits(Limits(robot))
            for _ in range(4):
                x = q + rng.normal(size=robot.nv) * rng.choice([0.0, 1e-3, 0.1])
                arguments = state_of(rng, robot, 0.3)
                told.add(compared(law, compiled, x, *arguments))
                bound += bool(np.any(np.abs(free(x, *arguments).velocity - law(x, *arguments).velocity) > 1e-6))
        assert len(told) >= 5 and bound > (30 if numba else 15), (name, told, bound)


def same_rollout(law: ResolvedRateController, start: np.ndarray, steps: int, dt: float, method: Method) -> Rollout:
    """The law's rollout, which the kernel's must follow to 1e-9."""
    expected = simulate(law.robot, law, start, steps * dt, dt, method)
    got = CompiledController(law).rollout(start, steps, dt, method)
    np.testing.assert_allclose(got.q, expected.q, rtol=0, atol=1e-9)
    np.testing.assert_allclose(got.u, expected.u, rtol=0, atol=1e-8)
    np.testing.assert_allclose(got.mu, expected.manipulability, rtol=0, atol=1e-9)
    np.testing.assert_allclose(got.error, expected.task_error, rtol=0, atol=1e-9)
    assert got.status == expected.status
    return expected


@both_ways
@pytest.mark.usefixtures("kernels")
def test_doors_are_simulated_alike(numba: bool, robot_of: RobotOf) -> None:
    """A rollout of the kernel follows that of the law to 1e-9 and stays on the mechanism as well as the law's does."""
    robot, place = robot_of("panda"), {"axis": (0.1, 0.2, 1), "point": (0.3, 0.4, 0.3)}
    start = robot.positions(robot.configuration([0.1, -0.3, -0.1, -2.0, 0.1, 1.8, 0.7]))
    for rows in ("radial axial", "spherical", "radial helical", "turn-1 turn-2 slide-1 slide-2 slide"):
        for radius in (None, 0.4):
            features = MechanismRows(robot, tip_of("panda"), rows, radius=radius, **place)
            constraint = Constraint(np.eye(features.n_rows), features)
            law = ResolvedRateController(constraint, Hold(), ManipulabilityAscent(constraint))
            for method in ("euler", "rk4"):
                assert np.ptp(same_rollout(law, start, 20, 0.023, method).q, axis=0).max() > 0.1


@both_ways
@pytest.mark.usefixtures("kernels")
def test_rollouts_are_the_same(numba: bool, robot_of: RobotOf, rng: np.random.Generator) -> None:
    """Through singular starts and damped stretches; and up to a face of a box, at a speed of the hand that is limited.

    dt is such that its multiples do not reach a velocity limit by the acceleration limit exactly.
    """
    for name in ("planar3", "sawyer", "kinova"):
        robot = robot_of(name)
        features = FrameJacobian(robot, tip_of(name), "x y")
        constraint = Constraint(np.eye(2), features)
        target = features.coordinates(robot.random_configuration(rng))
        law = ResolvedRateController(constraint, PointAttractor(target), ManipulabilityAscent(constraint, 0.2))
        for start in (robot.positions(robot.random_configuration(rng)), np.full(robot.nv, 1e-3)):
            for method in ("euler", "rk4"):
                same_rollout(law, start, 50, 0.023, method)
    robot, tip = robot_of("sawyer"), tip_of("sawyer")
    ready, constraint = np.array([0.3, -0.6, 0.2, 0.9, 0.1, 0.5, 0.0]), Constraint(np.eye(3), FrameJacobian(robot, tip))
    place = robot.position(ready, tip)
    limits = Limits(robot, tip_box=[place - 0.1, place + [0.05, 0.2, 0.2]], tip_speed=0.1, frames=tip)
    law = ResolvedRateController(constraint, PointAttractor(place + [0.2, 0.02, 0.0], gain=5.0), limits=limits)
    for method in ("euler", "rk4") if numba else ():
        rollout = same_rollout(law, ready, 600, 0.0023, method)
        assert 0.099 < max(rollout.violation(constraint)) <= 0.1 + 1e-9
        assert robot.position(rollout.q[-1], tip)[0] == pytest.approx(place[0] + 0.05, abs=2e-3)


@needs_numba
def test_a_pose_is_reached(robot_of: RobotOf, rng: np.random.Generator) -> None:
    """A compiled run ends at the pose, and follows the run of the original."""
    robot = robot_of("panda")
    middle = 0.5 * (robot.position_lower + robot.position_upper)
    for reference in ("world", "local"):
        features = FrameJacobian(robot, tip_of("panda"), "pose", reference)
        constraint = Constraint(np.eye(6), features)
        goal = features.pose(middle + 0.2 * rng.uniform(-1.0, 1.0, robot.nv))
        law = ResolvedRateController(constraint, PointAttractor(goal, 2.0), ManipulabilityAscent(constraint, 0.2))
        rollout = same_rollout(law, middle, 600, 0.01, "euler")
        assert rollout.task_error[-1] < 1e-4
        np.testing.assert_allclose(features.pose(rollout.q[-1]), goal, rtol=0, atol=1e-4)


@pytest.mark.parametrize("numba", [False])
@pytest.mark.usefixtures("kernels")
def test_rotations_are_those_of_the_library(numba: bool, rng: np.random.Generator) -> None:
    """Rotation vectors and the rates of their rows, from no turn to half a turn."""
    for angle in (0.0, 1e-12, 1e-6, 0.05, 0.0999, 0.1001, 1.0, 3.0, np.pi - 1e-9, np.pi):
        axis = rng.normal(size=3)
        turn = angle * axis / np.linalg.norm(axis)
        R, row = rotation_matrix(turn), rng.normal(size=3)
        got = control_step.rotation_vector(R.reshape(-1))
        np.testing.assert_allclose(got, rotation_vector(R), rtol=0, atol=1e-15)
        expected = row @ left_jacobian_inverse(turn)
        np.testing.assert_allclose(control_step.turned_row(*row, *turn), expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("numba", [False])
@pytest.mark.usefixtures("kernels")
def test_row_inverses_are_the_same(numba: bool, rng: np.random.Generator) -> None:
    """The law's row inverse, the kernel's and that for many postures agree to 1e-12 where the law's does not refuse."""
    for _ in range(100):
        s = int(rng.integers(1, 5))
        A = rng.normal(size=(s, int(rng.integers(s + 1, 9))))
        expected = row_inverse(A)
        X, G, L = np.zeros(A.shape), np.zeros((s, s)), np.zeros((s, s))
        volume, smallest = constrained_rows.row_inverse(A, X, G, L)
        assert (expected is None) == (volume == 0.0)
        if expected is None:
            continue
        many, mu, ill = row_inverses(A[:, :, None])
        assert not ill[0]
        for got in (X, many[..., 0]):
            np.testing.assert_allclose(got, expected[0], rtol=0, atol=1e-12 / expected[2])
        np.testing.assert_allclose([volume, mu[0]], expected[1], rtol=1e-12)
        np.testing.assert_allclose(smallest, expected[2], rtol=1e-11)


@needs_numba
def test_compiled_controllers_are_simulated(robot_of: RobotOf, rng: np.random.Generator) -> None:
    """`simulate` takes a compiled controller, from one start or many, as postures or configurations."""
    robot = robot_of("wrist")
    features = FrameJacobian(robot, tip_of("wrist"), "x y")
    constraint = Constraint([[0.6, 0.8]], features)
    controller = ResolvedRateController(constraint, PointAttractor([0.4, 0.5]), ManipulabilityAscent(constraint, 0.2))
    positions = np.stack([0.8 * robot.positions(robot.random_configuration(rng)) for _ in range(3)])
    for starts in (positions, np.stack([robot.configuration(x) for x in positions])):
        expected = [simulate(robot, controller, start, 0.4, 0.02) for start in starts]
        same(simulate(robot, CompiledController(controller), starts, 0.4, 0.02), expected)
        same((simulate(robot, CompiledController(controller), starts[0], 0.4, 0.02),), expected[:1])


def test_unsupported_controllers_are_refused(robot_of: RobotOf, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each unsupported part is named; without numba the extra is."""

    class Own(PointAttractor):  # type: ignore[misc]
        def __repr__(self) -> str:
            return "Own()"

    robot, arm = robot_of("humanoid"), robot_of("sawyer")
    features = FrameJacobian(arm, "right_hand")
    constraint = Constraint(np.eye(3), features)
    other = Constraint(np.eye(3)[:2], features)
    local, turning = FrameJacobian(arm, "right_hand", "x z", "local"), FrameJacobian(arm, "right_hand", "pose")
    refused = {
        "CentreOfMass": ResolvedRateController(Constraint(np.eye(3), CentreOfMass(arm))),
        "revolute": ResolvedRateController(Constraint(np.eye(3), FrameJacobian(robot, "tip"))),
        "another robot": ResolvedRateController(constraint, robot=robot_of("planar3")),
        "Own": ResolvedRateController(constraint, Own([0.5, 0.1, 0.2])),
        "Track": ResolvedRateController(Constraint(np.eye(6), turning), Track(lambda t: np.eye(4))),
        "x z (local)": ResolvedRateController(Constraint(np.eye(2), local), PointAttractor([0.5, 0.1])),
        "another constraint": ResolvedRateController(constraint, null_policy=ManipulabilityAscent(other)),
        "rest posture": ResolvedRateController(constraint, null_policy=JointAttractor(np.zeros(3))),
        "more rows": ResolvedRateController(Constraint(np.eye(6), FrameJacobian(robot_of("planar3"), "tip", "pose"))),
    }
    for words, controller in refused.items():
        assert words in (why_not(controller) or ""), words
        with pytest.raises(ConstraintError, match=re.escape(words)):
            CompiledController(controller)
    monkeypatch.setattr(compiled_controller, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match="fast"):
        CompiledController(ResolvedRateController(constraint))


@needs_numba
def test_targets_that_are_open_or_wrong(robot_of: RobotOf) -> None:
    """Numbers that leave a part of the rotation to the frame are the original's; a matrix that is none is refused."""
    some = Constraint(np.eye(2), FrameJacobian(robot_of("sawyer"), tip_of("sawyer"), "x rz"))
    assert "rz" in (why_not(ResolvedRateController(some, PointAttractor([0.4, 0.1]))) or "")
    assert why_not(ResolvedRateController(some, PointAttractor(np.eye(4)))) is None
    wrong = ResolvedRateController(some, PointAttractor(np.diag([2.0, 1.0, 1.0, 1.0])))
    for call in (lambda: wrong(np.zeros(7)), lambda: CompiledController(wrong)):
        with pytest.raises(TargetError, match="not a rotation matrix"):
            call()


def test_frames_that_followers_move_are_limited_in_python() -> None:
    """A frame behind a joint that mimics another has no compiled chain: said, and solved without."""
    robot = load({"c": ("a", 2.0, 0.1)})
    constraint = Constraint(np.eye(3)[:1], FrameJacobian(robot, "l2", "xyz"))
    for frame, refused in (("l2", False), ("l3", True)):
        limits = Limits(robot, tip_speed=0.1, frames=frame)
        law = ResolvedRateController(constraint, PointAttractor([1.0, 1.0, 1.0]), limits=limits)
        assert ("the speed or the place of a frame" in (why_not(law) or "")) == refused


@needs_numba
def test_bad_postures_are_refused(robot_of: RobotOf) -> None:
    """NaN, infinity and wrong sizes raise what the original raises."""
    features = FrameJacobian(robot_of("sawyer"), "right_hand")
    controller = ResolvedRateController(Constraint(np.eye(3), features))
    compiled = CompiledController(controller)
    for wrong in (np.full(7, np.nan), [np.inf] * 7, np.zeros(6), "text"):
        with pytest.raises(ConfigurationError):
            compiled(wrong)
    q = np.linspace(-0.5, 0.7, 7)
    for equal in (list(q), q.astype(">f8"), np.repeat(q, 2)[::2]):
        np.testing.assert_array_equal(compiled(equal).velocity, compiled(q).velocity)


@needs_numba
def test_commands_are_ones_own(robot_of: RobotOf) -> None:
    """A later call leaves a command alone, as does a copy in another process; whole numbers are times, too."""
    constraint = Constraint(np.eye(3)[:2], FrameJacobian(robot_of("sawyer"), "right_hand"))
    compiled = CompiledController(ResolvedRateController(constraint, PointAttractor([0.6, 0.1, 0.3])))
    q = np.linspace(-0.5, 0.7, 7)
    command = compiled(q)
    kept = command.velocity.copy()
    copy = pickle.loads(pickle.dumps(compiled))
    np.testing.assert_array_equal(copy(q).velocity, kept)
    assert not np.shares_memory(command.velocity, compiled(1.1 * q, 0, 1, np.zeros(7), 1).velocity)
    np.testing.assert_array_equal(command.velocity, kept)
    expected = compiled.controller(1.1 * q, 0, 1, np.zeros(7), 1)
    agree(compiled(1.1 * q, 0, 1, np.zeros(7), 1), expected)


@pytest.mark.parametrize("numba", [False])
@pytest.mark.usefixtures("kernels")
def test_velocities_near_limits_are_admitted_alike(numba: bool, robot_of: RobotOf, rng: np.random.Generator) -> None:
    """Each sense of motion has the braking distance to its own limit, as in `Limits.bounds`, at every place."""
    robot = robot_of("sawyer")
    constraint = Constraint(np.eye(3), FrameJacobian(robot, "right_hand", "xyz"))
    controller = ResolvedRateController(constraint, null_policy=ZeroPolicy(robot.nv))
    limits, table = controller.limits, compiled_controller.packed(controller)
    assert limits is not None
    dt, told = 0.01, set()
    middle = 0.5 * (robot.position_lower + robot.position_upper)
    for j in range(robot.nv):
        for edge, outward in ((robot.position_upper[j], 1.0), (robot.position_lower[j], -1.0)):
            for distance in (-1e-6, 1e-4, 0.01, 0.1):
                for speed in (-1.5, -0.5, -0.05, 0.05, 0.5, 1.5):
                    q, u = middle.copy(), np.zeros(robot.nv)
                    q[j], u[j] = edge - outward * distance, outward * speed
                    for before in (u, u + 1.01 * limits.acceleration * dt):
                        bounds = limits.bounds(q, dt, before)
                        expected = bounds.outside == 0.0 and bounds.admit(u)
                        assert compiled_limits.admitted(table, q, dt, u, before) == expected
                        told.add((expected, speed > 0.0))
    assert len(told) == 4
