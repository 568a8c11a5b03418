"""`Robot`: names, sizes, limits, what it refuses, threads, tables of postures, and joints that follow others.

Derivatives are compared with central differences in test_gradients.py.
"""

from __future__ import annotations

import pickle
import sys
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from case import rows_in
from conftest import TIPS, URDFS, tip_of
from rounding import rounding
from test_gradients import central_difference
from urdf_corpus import edited

import manip_learn as ml
from manip_learn.errors import ConfigurationError, UnknownNameError
from manip_learn.robot import frame_kinematics
from manip_learn.robot.loading import load_robot, robot_from_text

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
    for q in (robot.neutral(), *(robot.random_configuration(rng) for _ in range(20))):
        positions = robot.positions(q)
        assert np.all(positions >= robot.position_lower - 1e-12) and np.all(positions <= robot.position_upper + 1e-12)
        assert pin.isNormalized(robot.pinocchio_model, robot.pinocchio_configuration(q), 1e-12)
    copy = pickle.loads(pickle.dumps(robot))
    assert (copy.fingerprint, copy.joint_names) == (robot.fingerprint, robot.joint_names)
    for frame_name in robot.frame_names:
        frame = robot.frame(frame_name)
        assert frame.name == frame_name and np.all(np.isfinite(robot.pose(q, frame)))
        assert robot.jacobian(q, frame).shape == (6, robot.nv)
        np.testing.assert_array_equal(copy.jacobian(q, copy.frame(frame_name)), robot.jacobian(q, frame))
    assert [robot.joint_index(joint) for joint in robot.joint_names] == list(range(robot.nv))


@pytest.mark.parametrize("wrong", ["", "tipp", "universe", "TIP", None, 3, "tip\x00", "a" * 10000])
def test_unknown_names_never_reach_pinocchio(robot_of, wrong):
    """Any other name, or none, is an error of this library (Pinocchio would read out of bounds)."""
    robot, tip = robot_of("gantry"), tip_of("gantry")
    references = [lambda r, f=f: f(robot.neutral(), tip, r) for f in (robot.jacobian, robot.jacobian_and_derivative)]
    for ask in (robot.frame, robot.joint_index, *references):
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
    ways += [(lambda q, f=f: f(np.zeros(n), q),) for f in (robot.integrate, robot.difference, robot.inertial_effort)]
    for q, (ask, *more) in product(bad, ways):
        with pytest.raises(ConfigurationError):
            ask(q, *more)


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
    robot, interval = robot_of("panda"), sys.getswitchinterval()

    def derivatives(q, times=100):
        return [robot.jacobian_and_derivative(q, "panda_hand_tcp")[1] for _ in range(times)]

    postures = [robot.random_configuration(rng) for _ in range(8)]
    expected = [derivatives(q, 1) * 100 for q in postures]
    sys.setswitchinterval(1e-6)  # threads alternate between any two calls of Pinocchio
    try:
        with ThreadPoolExecutor(8) as threads:
            np.testing.assert_array_equal(list(threads.map(derivatives, postures)), expected)
    finally:
        sys.setswitchinterval(interval)


@pytest.mark.parametrize("name", [name for name in ROBOTS if name != "mimic"])  # that of the independent joints
def test_closed_form_hessian(robot_of, rng, name):
    """The stand-in for Pinocchio's Hessian, should its memory order change, gives the same derivatives."""
    robot, model = robot_of(name), robot_of(name).pinocchio_model
    assert frame_kinematics.pinocchio_order_is_known(model)
    joints = frame_kinematics.columns_to_joints(model)
    for reference in ["world", "local"] * 3:
        J, H = robot.jacobian_and_derivative(robot.random_configuration(rng), tip_of(name), reference)
        np.testing.assert_allclose(frame_kinematics.closed_form(J, joints, reference), H, rtol=0, atol=1e-13)


def gantry_within(folder, *limits):
    """The gantry with other limits of its first joints."""
    text = URDFS["gantry"]
    for limit in limits:
        text = text.replace('lower="-2" upper="2"', limit, 1)
    (folder / "gantry.urdf").write_text(text, encoding="utf-8")
    return load_robot(folder / "gantry.urdf")


def test_neutral_is_zero_where_zero_is_allowed(tmp_path):
    """Joints whose range excludes zero stand in its middle, or at their limit if they have one only."""
    ranges = ('lower="0" upper="2"', 'lower="-2" upper="0"', 'lower="0.5" upper="1"', 'lower="-3" upper="-2"')
    np.testing.assert_allclose(gantry_within(tmp_path, *ranges).neutral(), [0.0, 0.0, 0.75, -2.5, 0.0])
    robot = gantry_within(tmp_path, 'lower="0.5"', 'upper="-0.5"', 'lower="-1"')
    np.testing.assert_array_equal(robot.neutral(), [0.5, -0.5, 0.0, 0.0, 0.0])


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


# ---- kinematics of one posture and of many at once ----

TOLERANCE, CHUNK = 1e-12, frame_kinematics.DERIVATIVE_CHUNK


@pytest.mark.parametrize("n", [0, 1, CHUNK - 1, CHUNK, CHUNK + 1, 2 * CHUNK + 3])
def test_chunks_leave_no_seam(n, robot_of, rng):
    """Any number of postures, including zero: each row is the result of its own posture."""
    robot = robot_of("sawyer")
    q, features = rng.uniform(-2.0, 2.0, (n, robot.nv)), ml.FrameJacobian(robot, "right_hand", "x rz")
    Phi, dPhi = features.batch_with_derivative(q)
    assert features.batch(q).shape == (n, 2, 7) and Phi.shape == (n, 2, 7) and dPhi.shape == (n, 2, 7, 7)
    assert robot.frame_kinematics(features.frame).poses(q).shape == (n, 4, 4)
    for i in {0, n // 2, n - 1} if n else ():
        np.testing.assert_allclose(features.batch(q)[i], features(q[i]), rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(dPhi[i], features.derivative(q[i]), rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_not_finite_names_row_and_joint(value, robot_of):
    """NaN or infinity is refused with the first bad row and the joint's name, before any work."""
    robot, q = robot_of("sawyer"), np.zeros((2000, 7))
    q[1234, 5], q[1500, 0] = value, np.nan
    features = ml.FrameJacobian(robot, "right_hand")
    for call in (features.batch, features.batch_with_derivative, robot.frame_kinematics("right_hand").poses):
        with pytest.raises(ConfigurationError, match=rf"row 1234, joint '{robot.joint_names[5]}'"):
            call(q)


def test_wrong_tables_are_refused(robot_of):
    """One posture, a wrong number of columns, text, a (cos, sin) of length zero: each error says what is expected."""
    robot = robot_of("wrist")
    features = ml.FrameJacobian(robot, "tip")
    for wrong in (np.zeros(4), np.zeros((3, 5)), np.zeros((2, 2, 4)), [["a"] * 4], [[1.0], [1.0, 2.0]]):
        with pytest.raises(ConfigurationError, match="table"):
            features.batch(wrong)
    q = np.stack([robot.configuration(np.zeros(4))] * 3)
    q[2, robot.blocks[2].q] = 0.0
    with pytest.raises(ConfigurationError, match="row 2, joint 'joint2'"):
        features.batch(q)


# ---- the shipped robots/sawyer.urdf against the numbers of its source ----


def test_the_shipped_sawyer_has_the_numbers_of_its_source(robot_of):
    """Limits of positions [rad] and velocities [rad/s], and the places of wrist and tip with all joints at zero [m]."""
    robot, zero = robot_of("sawyer"), np.zeros(7)
    upper, speeds = [3.0503, 2.2736, 3.0426, 3.0439, 2.9761, 2.9761, 4.7124], [1.74, 1.328, 1.957, 1.957]
    np.testing.assert_array_equal(robot.position_upper, upper)
    np.testing.assert_array_equal(robot.position_lower, [-3.0503, -3.8095, *np.negative(upper[2:])])
    np.testing.assert_array_equal(robot.velocity_limit, [*speeds, 3.485, 3.485, 4.545])
    wrist, hand, tip = (robot.position(zero, name) for name in ("right_l6", "right_hand", "right_gripper_tip"))
    np.testing.assert_allclose(wrist, (0.991, 0.1603, 0.317), atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(hand - wrist), 0.0245, atol=1e-12)
    np.testing.assert_allclose(tip - hand, (hand - wrist) * 0.1 / 0.0245, atol=1e-12)


# ---- joints that follow others, wherever their leaders are ----

TYPES = {"a": "revolute", "b": "prismatic", "c": "revolute", "d": "revolute"}
AXES = {"a": "0 0 1", "b": "0.6 0.8 0", "c": "0 1 0", "d": "1 0 0"}
WIDE = '<limit lower="-3" upper="3" velocity="2" effort="1"/>'


def urdf(mimics: dict[str, tuple[str, float, float]], types=None, limits=None) -> bytes:
    """A chain of the joints a, b, c, d; `mimics` maps a joint to (leader, multiplier, offset)."""
    types, limits, joints = TYPES | (types or {}), limits or {}, ""
    for i, name in enumerate("abcd"):
        mimic = ""
        if name in mimics:
            leader, multiplier, offset = mimics[name]
            mimic = f'<mimic joint="{leader}" multiplier="{multiplier}" offset="{offset}"/>'
        joints += (
            f'<joint name="{name}" type="{types[name]}"><parent link="l{i}"/><child link="l{i + 1}"/>'
            f'<origin xyz="0.2 0.1 0.{i}" rpy="0.{i} 0 0.2"/><axis xyz="{AXES[name]}"/>'
            f"{limits.get(name, WIDE)}{mimic}</joint>"
        )
    links = "".join(f'<link name="l{i}"/>' for i in range(5))
    return f'<robot name="chain">{links}{joints}</robot>'.encode()


def load(mimics: dict[str, tuple[str, float, float]], **options) -> ml.Robot:
    """The chain."""
    locked = options.pop("locked", ())
    return robot_from_text(urdf(mimics, **options), Path("chain.urdf"), locked=locked)


KNOWN = rounding(8 * 4, 2.0 * np.pi)  # four joints that turn by up to a full turn
CHAIN = {"c": ("b", -2.0, 0.1), "b": ("a", 0.5, -0.3)}


def assert_same_place(robot, q, positions, **options):
    """The last link is where the joints bring it when all of them are independent."""
    np.testing.assert_allclose(robot.pose(q, "l4"), load({}, **options).pose(positions, "l4"), atol=KNOWN)


def test_a_fixed_leader_holds_its_followers(rng):
    """What follows a fixed joint rests at its offset, also at second hand."""
    robot = load({"b": ("a", 5.0, 0.4), "c": ("b", 0.5, 0.1)}, types={"a": "fixed"})
    assert robot.joint_names == ("d",) and not robot.mimics
    assert robot.locked == {"b": 0.4, "c": pytest.approx(0.3)}
    assert sum("follows the fixed joint 'a'" in w for w in robot.warnings) == 2
    assert_same_place(robot, [0.6], [0.4, 0.3, 0.6], types={"a": "fixed"})


def test_a_locked_leader_holds_its_followers():
    """Locking the leader locks the chain, at the positions that follow."""
    robot = load(CHAIN, locked={"a": 0.8})
    assert robot.joint_names == ("d",)
    assert robot.locked == {"a": 0.8, "b": pytest.approx(0.1), "c": pytest.approx(-0.1)}
    assert_same_place(robot, [0.2], [0.8, 0.1, -0.1, 0.2])


def test_full_turns_reach_the_follower():
    """Given as joint positions, a continuous leader's turns count: half the speed is 180 degrees after one turn."""
    types, a = {"a": "continuous", "b": "revolute"}, 2 * np.pi + 0.4
    robot = load({"b": ("a", 0.5, 0.0)}, types=types)
    assert any("jumps" in w for w in robot.warnings)
    assert_same_place(robot, [a, 0, 0], [a, a / 2, 0, 0], types=types)


@pytest.mark.parametrize(("follows", "limit", "leader", "told"), rows_in("limits_of_followers.txt"))
def test_limits_of_followers_bind_the_leader(follows, limit, leader, told):
    """Position limits through the factor and offset, also a negative factor; velocity limits through its size."""
    factor, offset = map(float, follows.split())
    robot = load({"b": ("a", factor, offset)}, limits={"b": f'<limit {limit} effort="1"/>'})
    seen = [robot.position_lower[0], robot.position_upper[0], robot.velocity_limit[0]]
    assert seen == pytest.approx([*map(float, leader.split())])
    assert any(told in w for w in robot.warnings) == bool(told)


MASS = '<inertial><origin xyz="0.1 0.2 0"/><mass value="2"/><inertia ixx="1" ixy="0" ixz="0" iyy="2" iyz="0" izz="3"/>'
BALL = '</inertial><collision><origin xyz="0 0.1 0"/><geometry><sphere radius="0.02"/></geometry></collision></link>'


@pytest.mark.parametrize("mimics", [CHAIN, {"a": ("d", 0.7, 0.2)}, {"d": ("a", -1.5, 0.1)}])
def test_every_derivative_is_exact_with_followers(mimics, tmp_path, rng):
    """Jacobians one by one and in a batch, centre of mass, distance of links, effort: along the independent joints.

    Each against central differences or the free robot; a follower below, above and beside its leader.
    """
    free, bound = (urdf(m).replace(b'"/>', f'">{MASS}{BALL}'.encode(), 5) for m in ({}, mimics))
    (tmp_path / "chain.urdf").write_bytes(bound)
    robot, whole = load_robot(tmp_path / "chain.urdf"), robot_from_text(free, Path("free.urdf"))
    q, near = 0.5 * robot.random_configuration(rng), ml.SelfCollision(robot)
    views = [ml.FrameJacobian(robot, "l4", "pose", view) for view in ("world", "local")]
    for features in (*views, ml.CentreOfMass(robot)):
        derivative = features.derivative(q)
        np.testing.assert_allclose(derivative, central_difference(features, robot, q), atol=1e-9)
        np.testing.assert_allclose(features.batch_with_derivative(q[None])[1][0], derivative, atol=1e-12)
    for J, place in (
        (robot.jacobian(q, "l4")[:3], lambda x: robot.position(x, "l4")),
        (robot.centre_of_mass_jacobian_and_derivative(q)[0], robot.centre_of_mass),
    ):
        np.testing.assert_allclose(J, central_difference(place, robot, q), atol=1e-9)
    pairs = near.closer_than(q, 10.0)
    assert {p.links for p in pairs} == {("l0", "l3"), ("l0", "l4"), ("l1", "l4")}
    for pair in pairs:
        expected = central_difference(
            lambda x, k=pair.links: {p.links: p for p in near.closer_than(x, 10.0)}[k].distance, robot, q
        )
        np.testing.assert_allclose(pair.gradient, expected, atol=1e-7, err_msg=str(pair.links))
    lift, acceleration = robot.coupling.lift, rng.normal(size=robot.nv)
    expected = lift.T @ whole.inertial_effort(robot.pinocchio_configuration(q), lift @ acceleration)
    np.testing.assert_allclose(robot.inertial_effort(q, acceleration), expected, atol=1e-12)
    assert robot.mass == pytest.approx(8.0)
    assert all(robot.moves(leader, "l4") for leader in robot.joint_names)


def test_which_joints_move_a_link():
    """A follower's leader, wherever it is; not those beyond."""
    robot = load({"b": ("d", 1.0, 0.0)})
    moved = [robot.moves(joint, link) for joint, link in (("d", "l2"), ("c", "l2"), ("a", "l1"), ("d", "l1"))]
    assert moved == [True, False, True, False]
