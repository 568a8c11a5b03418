"""`Robot`: names, sizes, limits, what it refuses, threads and processes. Its derivatives are in test_gradients.py."""

from __future__ import annotations

import pickle
import sys
from concurrent.futures import ThreadPoolExecutor
from itertools import product

import numpy as np
import pinocchio as pin
import pytest
from conftest import TIPS, URDFS, tip_of
from rounding import rounding
from urdf_corpus import edited

from manip_learn.errors import ConfigurationError, UnknownNameError
from manip_learn.robot.frame_kinematics import closed_form, columns_to_joints, pinocchio_order_is_known
from manip_learn.robot.loading import load_robot

ROBOTS = [*URDFS, *TIPS]


@pytest.mark.parametrize("name", ROBOTS)
def test_names_limits_postures_and_copies_fit_together(robot_of, rng, name):
    """One name and one limit a degree of freedom; postures obey the limits; every frame and joint can be asked for.

    A pickled robot has the names, limits, fingerprint and kinematics of the original.
    """
    robot = robot_of(name)
    assert len(robot.joint_names) == len(set(robot.joint_names)) == len(robot.joint_units) == robot.nv <= robot.nq
    for limit in (robot.position_lower, robot.position_upper, robot.velocity_limit):
        assert limit.shape == (robot.nv,) and not limit.flags.writeable
    assert np.all(robot.position_lower < robot.position_upper) and np.all(robot.velocity_limit > 0)
    assert robot.name in repr(robot)
    for q in (robot.neutral(), *(robot.random_configuration(rng) for _ in range(20))):
        positions = robot.positions(q)
        assert np.all(positions >= robot.position_lower - 1e-12) and np.all(positions <= robot.position_upper + 1e-12)
        assert pin.isNormalized(robot.pinocchio_model, robot.pinocchio_configuration(q), 1e-12)
    copy = pickle.loads(pickle.dumps(robot))
    assert (copy.fingerprint, copy.joint_names) == (robot.fingerprint, robot.joint_names)
    np.testing.assert_array_equal(copy.position_upper, robot.position_upper)
    for frame_name in robot.frame_names:
        frame = robot.frame(frame_name)
        assert frame.name == frame_name and np.all(np.isfinite(robot.pose(q, frame)))
        assert robot.jacobian(q, frame).shape == (6, robot.nv)
        np.testing.assert_array_equal(copy.jacobian(q, copy.frame(frame_name)), robot.jacobian(q, frame))
    assert [robot.joint_index(joint) for joint in robot.joint_names] == list(range(robot.nv))


@pytest.mark.parametrize("wrong", ["", "tipp", "universe", "TIP", None, 3, "tip\x00", "a" * 10000])
def test_unknown_names_never_reach_pinocchio(robot_of, wrong):
    """Any other name, or none, is an error of this library (Pinocchio would read out of bounds)."""
    for ask in (robot_of("gantry").frame, robot_of("gantry").joint_index):
        with pytest.raises(UnknownNameError):
            ask(wrong)


@pytest.mark.parametrize("name", ["one", "planar3", "wrist", "humanoid", "mimic"])
def test_wrong_postures_are_refused(robot_of, name):
    """Wrong sizes, NaN, infinity, text and None are rejected wherever a posture or a velocity is an argument."""
    robot, n = robot_of(name), robot_of(name).nv
    frame = robot.frame(tip_of(name))
    bad = [np.zeros(n + 7), [], np.full(n, np.nan), np.full(robot.nq, np.inf), np.zeros((n, 2)), ["x"] * n, None, {}]
    ways = [(f,) for f in (robot.configuration, robot.positions, robot.velocity)]
    ways += [(f, frame) for f in (robot.pose, robot.jacobian, robot.jacobian_and_derivative)]
    ways += [(lambda q, f=f: f(np.zeros(n), q),) for f in (robot.integrate, robot.difference)]
    for q, (ask, *more) in product(bad, ways):
        with pytest.raises(ConfigurationError):
            ask(q, *more)


def test_numbers_that_are_none_are_named(robot_of):
    """By their joint, and what was given."""
    gantry = robot_of("gantry")
    for ask, wrong, said in (
        (gantry.configuration, [0, 0, np.nan, 0, 0], "'joint2' is nan"),
        (gantry.velocity, [0, 0, 0, np.inf, 0], "'joint3' is inf"),
        (gantry.velocity, [1e300, np.nan, 0, 0, 0], "'joint1' is nan"),
    ):
        with pytest.raises(ConfigurationError, match=said):
            ask(wrong)


def test_configurations_without_direction_are_refused(robot_of):
    """(cos, sin) = (0, 0) is no angle and a zero quaternion no orientation; other lengths are made 1."""
    wrist, humanoid = robot_of("wrist"), robot_of("humanoid")
    with pytest.raises(ConfigurationError, match="joint0"):
        wrist.configuration(np.zeros(wrist.nq))
    with pytest.raises(ConfigurationError, match="quaternion"):
        humanoid.configuration(np.zeros(humanoid.nq))
    q = wrist.configuration([0.3, 0.1, -0.4, 0.2])
    longer = q.copy()
    longer[:2] *= 3.0
    np.testing.assert_allclose(wrist.configuration(longer), q, rtol=0, atol=rounding(8, q))


@pytest.mark.parametrize("name", ["planar3", "wrist", "panda"])
def test_any_memory_layout(robot_of, rng, name):
    """Lists, float32, big-endian, strided and read-only vectors give the same kinematics."""
    robot, frame = robot_of(name), robot_of(name).frame(tip_of(name))
    q = robot.random_configuration(rng).astype(np.float32).astype(np.float64)
    strided, frozen, expected = np.stack([q, q], axis=1)[:, 0], q.copy(), robot.jacobian(q, frame)
    frozen.setflags(write=False)
    for same in (q.tolist(), tuple(q), q.astype(">f8"), q.astype(np.float32), strided, frozen):
        np.testing.assert_array_equal(robot.jacobian(same, frame), expected)


def test_inputs_are_left_alone_and_results_belong_to_the_caller(robot_of, rng):
    """No method writes to its arguments, and later calls do not change earlier results (Pinocchio hands out views)."""
    robot, v = robot_of("wrist"), rng.normal(size=4)

    def answers(q):
        frame, centre = robot.frame("tip"), robot.centre_of_mass_jacobian_and_derivative(q)
        kinematics = [robot.pose(q, frame), robot.jacobian(q, frame), *robot.jacobian_and_derivative(q, frame)]
        there = robot.integrate(q, v)
        return [*kinematics, there, robot.difference(q, there), robot.centre_of_mass(q), *centre]

    q = 1.7 * robot.random_configuration(rng)
    q.setflags(write=False)
    v.setflags(write=False)
    first = answers(q)
    copies = [a.copy() for a in first]
    for _ in range(3):
        answers(robot.random_configuration(rng))
    for kept, copy in zip(first, copies, strict=True):
        np.testing.assert_array_equal(kept, copy)


def test_many_threads(robot_of, rng):
    """One robot in eight threads gives in each what it gives alone."""
    robot, frame, interval = robot_of("panda"), robot_of("panda").frame("panda_hand_tcp"), sys.getswitchinterval()
    postures = [robot.random_configuration(rng) for _ in range(8)]
    expected = [robot.jacobian_and_derivative(q, frame)[1] for q in postures]

    def is_right(i):
        return all(
            np.array_equal(robot.jacobian_and_derivative(postures[i], frame)[1], expected[i]) for _ in range(100)
        )

    sys.setswitchinterval(1e-6)  # threads alternate between any two calls of Pinocchio
    try:
        with ThreadPoolExecutor(8) as threads:
            assert all(threads.map(is_right, range(8)))
    finally:
        sys.setswitchinterval(interval)


@pytest.mark.parametrize("name", [name for name in ROBOTS if name != "mimic"])  # that of the independent joints
def test_closed_form_hessian(robot_of, rng, name):
    """The stand-in for Pinocchio's Hessian, should its memory order change, gives the same derivatives."""
    robot, model = robot_of(name), robot_of(name).pinocchio_model
    assert pinocchio_order_is_known(model)
    for reference in ["world", "local"] * 3:
        J, H = robot.jacobian_and_derivative(robot.random_configuration(rng), tip_of(name), reference)
        np.testing.assert_allclose(closed_form(J, columns_to_joints(model), reference), H, rtol=0, atol=1e-13)


def test_joint_order_is_that_of_the_names(robot_of):
    """A branching robot's names are in Pinocchio's order, and each position moves the joint of its own name."""
    robot = robot_of("tree")
    at_rest, q = robot.neutral(), robot.positions(robot.neutral()).copy()
    q[robot.joint_index("z_side")] = 0.25
    moved = robot.position(q, "arm_b") - robot.position(at_rest, "arm_b")
    assert np.linalg.norm(moved) == pytest.approx(0.25)
    np.testing.assert_array_equal(robot.pose(q, "tip"), robot.pose(at_rest, "tip"))


def gantry_within(folder, *limits):
    """The gantry with other limits of its first joints."""
    text = URDFS["gantry"]
    for limit in limits:
        text = text.replace('lower="-2" upper="2"', limit, 1)
    (folder / "gantry.urdf").write_text(text, encoding="utf-8")
    return load_robot(folder / "gantry.urdf")


def test_neutral_is_zero_where_zero_is_allowed(tmp_path):
    """Joints whose range begins or ends at zero stand at zero, those whose range leaves it out in its middle."""
    ranges = ((0, 2), (-2, 0), (0.5, 1), (-3, -2))
    robot = gantry_within(tmp_path, *(f'lower="{low}" upper="{high}"' for low, high in ranges))
    np.testing.assert_allclose(robot.neutral(), [0.0, 0.0, 0.75, -2.5, 0.0])


def test_joints_limited_on_one_side(tmp_path, rng):
    """They stand at their limit if zero is outside, and are drawn within a turn of it."""
    robot, turn = gantry_within(tmp_path, 'lower="0.5"', 'upper="-0.5"', 'lower="-1"'), 2.0 * np.pi
    np.testing.assert_array_equal(robot.neutral(), [0.5, -0.5, 0.0, 0.0, 0.0])
    drawn = np.array([robot.random_configuration(rng) for _ in range(500)])
    low, high = [0.5, -0.5 - turn, -1.0, -2.0, -2.0], [0.5 + turn, -0.5, -1.0 + turn, 2.0, 2.0]
    np.testing.assert_allclose([drawn.min(axis=0), drawn.max(axis=0)], [low, high], atol=0.1)
    assert np.all(drawn >= low) and np.all(drawn <= high)


@pytest.mark.parametrize("name", ["gantry", "wrist", "mimic", "tree"])
def test_inertial_efforts_are_those_of_newton_and_euler(robot_of, rng, name):
    """M a: the difference that an acceleration makes to the efforts of a robot at rest; M is symmetric, positive."""
    robot = robot_of(name)
    q, model = robot.random_configuration(rng), robot.pinocchio_model
    lift = np.eye(robot.nv) if robot.coupling is None else robot.coupling.lift
    at_rest = [model, model.createData(), robot.pinocchio_configuration(q), np.zeros(model.nv)]
    weight = pin.rnea(*at_rest, np.zeros(model.nv))
    M = np.array([robot.inertial_effort(q, a) for a in np.eye(robot.nv)])
    expected = [lift.T @ (pin.rnea(*at_rest, lift @ a) - weight) for a in np.eye(robot.nv)]
    np.testing.assert_allclose(M, expected, atol=1e-11)
    np.testing.assert_allclose(M, M.T, atol=1e-12)
    assert np.linalg.eigvalsh(M)[0] > 0.0


def test_frames_and_joints_of_one_name(tmp_path):
    """Of a link and a joint that share a name, the link is meant; a step and a difference are inverse to each other."""
    path = tmp_path / "arm.urdf"
    path.write_bytes(edited(("elbow", "tip")))
    robot = load_robot(path)
    assert robot.pinocchio_model.frames[robot.frame("tip").index].type == pin.FrameType.BODY
    assert robot.frame(robot.frame("tip")) is robot.frame("tip") and robot.joint_index("tip") == 1
    assert robot.joint_units == ("rad", "rad")
    rover, humanoid = load_robot(path, base="planar"), load_robot(path, base="floating", objects="box")
    assert rover.joint_units == ("m", "m", "rad", "rad", "rad")
    assert humanoid.joint_units == (*(("m",) * 3 + ("rad",) * 3) * 2, "rad", "rad")
    assert [n for n in humanoid.joint_names if "box" in n] == [f"box.{c}" for c in ("x", "y", "z", "rx", "ry", "rz")]
