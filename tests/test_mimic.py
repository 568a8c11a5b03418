"""Mimic joints: resolved into a linear map from the independent joints, wherever their leaders are."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from case import case
from conftest import URDFS
from rounding import rounding

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.manipulability import manipulability_gradient
from manip_learn.robot.collision import SelfCollision
from manip_learn.robot.joints import Mimic
from manip_learn.robot.loading import load_robot, robot_from_text
from manip_learn.robot.robot import Robot

TYPES = {"a": "revolute", "b": "prismatic", "c": "revolute", "d": "revolute"}
AXES = {"a": "0 0 1", "b": "0.6 0.8 0", "c": "0 1 0", "d": "1 0 0"}
WIDE = '<limit lower="-3" upper="3" velocity="2" effort="1"/>'


def urdf(
    mimics: dict[str, tuple[str, float, float]],
    order: str = "abcd",
    types: dict[str, str] | None = None,
    limits: dict[str, str] | None = None,
) -> bytes:
    """A chain of the joints a, b, c, d; `mimics` maps a joint to (leader, multiplier, offset)."""
    types, limits = TYPES | (types or {}), limits or {}
    joints = {}
    for i, name in enumerate("abcd"):
        mimic = ""
        if name in mimics:
            leader, multiplier, offset = mimics[name]
            mimic = f'<mimic joint="{leader}" multiplier="{multiplier}" offset="{offset}"/>'
        joints[name] = (
            f'<joint name="{name}" type="{types[name]}"><parent link="l{i}"/><child link="l{i + 1}"/>'
            f'<origin xyz="0.2 0.1 0.{i}" rpy="0.{i} 0 0.2"/><axis xyz="{AXES[name]}"/>'
            f"{limits.get(name, WIDE)}{mimic}</joint>"
        )
    links = "".join(f'<link name="l{i}"/>' for i in range(5))
    return f'<robot name="chain">{links}{"".join(joints[n] for n in order)}</robot>'.encode()


def load(mimics: dict[str, tuple[str, float, float]], **options) -> Robot:
    """The chain."""
    locked = options.pop("locked", ())
    return robot_from_text(urdf(mimics, **options), Path("chain.urdf"), locked=locked)


def free_pose(positions: dict[str, float], **options) -> np.ndarray:
    """Pose of the last link when all joints are free, at given positions."""
    model = pin.buildModelFromXML(urdf({}, **options).decode())
    data, q = model.createData(), pin.neutral(model)
    for name, x in positions.items():
        joint = model.joints[model.getJointId(name)]
        if joint.nv:
            q[joint.idx_q : joint.idx_q + joint.nq] = (np.cos(x), np.sin(x)) if joint.nq == 2 else x
    pin.framesForwardKinematics(model, data, q)
    return data.oMf[model.getFrameId("l4")].homogeneous


KNOWN = rounding(8 * 4, 2.0 * np.pi)  # four joints that turn by up to a full turn
CHAIN = {"c": ("b", -2.0, 0.1), "b": ("a", 0.5, -0.3)}


def test_mimic_of_mimic_in_any_order(rng):
    """c follows b follows a: one map from (a, d) to all four, wherever in the file the leaders come."""
    for order in ["".join(p) for p in itertools.permutations("abcd")][::3]:
        with case(order):
            robot = load(CHAIN, order=order)
            assert robot.joint_names == ("a", "d")
            b, c = sorted(robot.mimics, key=lambda m: m.joint)
            assert b == Mimic("b", "a", 0.5, -0.3)
            assert (c.joint, c.leader, c.multiplier) == ("c", "a", -1.0) and c.offset == pytest.approx(0.7)
            a, d = rng.uniform(-1, 1, 2)
            b = 0.5 * a - 0.3
            expected = free_pose({"a": a, "b": b, "c": -2 * b + 0.1, "d": d})
            np.testing.assert_allclose(robot.pose([a, d], robot.frame("l4")), expected, atol=KNOWN)


def test_a_fixed_leader_holds_its_followers(rng):
    """What follows a fixed joint rests at its offset, also at second hand."""
    robot = load({"b": ("a", 5.0, 0.4), "c": ("b", 0.5, 0.1)}, types={"a": "fixed"})
    assert robot.joint_names == ("d",) and not robot.mimics
    assert robot.locked == {"b": 0.4, "c": pytest.approx(0.3)}
    assert sum("follows the fixed joint 'a'" in w for w in robot.warnings) == 2
    expected = free_pose({"b": 0.4, "c": 0.3, "d": 0.6}, types={"a": "fixed"})
    np.testing.assert_allclose(robot.pose([0.6], robot.frame("l4")), expected, atol=KNOWN)


def test_a_locked_leader_holds_its_followers():
    """Locking the leader locks the chain, at the positions that follow."""
    robot = load(CHAIN, locked={"a": 0.8})
    assert robot.joint_names == ("d",)
    assert robot.locked == {"a": 0.8, "b": pytest.approx(0.1), "c": pytest.approx(-0.1)}
    expected = free_pose({"a": 0.8, "b": 0.1, "c": -0.1, "d": 0.2})
    np.testing.assert_allclose(robot.pose([0.2], robot.frame("l4")), expected, atol=KNOWN)


def test_full_turns_reach_the_follower():
    """Given as joint positions, a continuous leader's turns count: half the speed is 180 degrees after one turn."""
    robot = load({"b": ("a", 0.5, 0.0)}, types={"a": "continuous", "b": "revolute"})
    assert any("jumps" in w for w in robot.warnings)
    a = 2 * np.pi + 0.4
    expected = free_pose({"a": a, "b": a / 2, "c": 0.0, "d": 0.0}, types={"a": "continuous", "b": "revolute"})
    np.testing.assert_allclose(robot.pose([a, 0, 0], robot.frame("l4")), expected, atol=KNOWN)


def test_limits_of_followers_bind_the_leader():
    """Position limits through the factor and offset, also a negative factor; velocity limits through its size."""
    limits = {"b": '<limit lower="-0.4" upper="1" velocity="0.5" effort="1"/>'}
    robot = load({"b": ("a", -2.0, 0.2)}, limits=limits)
    assert robot.position_lower[0] == pytest.approx(-0.4) and robot.position_upper[0] == pytest.approx(0.3)
    assert robot.velocity_limit[0] == pytest.approx(0.25)
    assert any("limited to -0.4 ... 0.3 by its follower 'b'" in w for w in robot.warnings)
    still = load({"b": ("a", -2.0, 0.2)}, limits={"b": '<limit lower="-4" upper="4" velocity="0" effort="1"/>'})
    assert still.velocity_limit[0] == 2.0  # a velocity limit of 0 is none
    contradicting = load({"b": ("a", 0.1, 9.0)})
    assert (contradicting.position_lower[0], contradicting.position_upper[0]) == (-3.0, 3.0)
    assert any("the limits of 'b' are ignored" in w for w in contradicting.warnings)
    rounded = {"b": '<limit lower="-1.49999" upper="1.49999" velocity="2" effort="1"/>'}
    robot = load({"b": ("a", 0.5, 0.0)}, limits=rounded)  # the leader's up to rounding is no news
    assert robot.warnings == () and robot.position_upper[0] == 3.0
    one_sided = load({"b": ("a", 1.0, 0.0)}, limits={"b": '<limit upper="2.5" velocity="2" effort="1"/>'})
    assert (one_sided.position_lower[0], one_sided.position_upper[0]) == (-3.0, 2.5)


def test_followers_beside_the_chain_change_nothing(rng):
    """A gripper that mimics costs the arm nothing: same batch, same gradient."""
    arm, whole = (load_robot("panda", locked=locked) for locked in (("panda_finger_joint1",), ()))
    assert whole.mimics and not arm.mimics
    built = []
    for robot in (arm, whole):
        features = FrameJacobian(robot, "panda_hand_tcp", "xyz", "world")
        constraint = Constraint([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]], features)
        built.append((constraint, robot.frame_kinematics("panda_hand_tcp")))
    for _ in range(5):
        q = arm.random_configuration(rng)
        both = np.append(q, 0.02)
        (small, table), (large, whole_table) = built
        np.testing.assert_allclose(
            manipulability_gradient(large, both), np.append(manipulability_gradient(small, q), 0.0), atol=1e-12
        )
        np.testing.assert_allclose(whole_table.jacobians(both[None])[0][:, :7], table.jacobians(q[None])[0], atol=1e-13)
        assert not np.any(whole_table.jacobians(both[None])[0][:, 7])


def test_a_follower_in_the_chain_without_its_leader_is_no_free_joint(rng):
    """One that copies its leader exactly, alone in the chain, moves with the leader's column."""
    robot = load({"c": ("d", 1.0, 0.0)})
    frame = robot.frame("l3")  # a, b and the follower c; the leader d is beyond it
    q = robot.random_configuration(rng)
    np.testing.assert_allclose(
        robot.frame_kinematics(frame).jacobians(q[None])[0], robot.jacobian(q, frame), atol=1e-12
    )
    assert np.any(robot.jacobian(q, frame)[:, robot.joint_index("d")])
    offset, free = load({"c": ("d", 1.0, 0.4)}), load({})
    moved = free.configuration([q[0], q[1], q[2] + 0.4, 0.0])  # the follower as a joint of its own
    np.testing.assert_allclose(offset.pose(q, "l3"), free.pose(moved, "l3"), atol=1e-12)
    np.testing.assert_allclose(offset.frame_kinematics("l3").poses(q[None])[0], free.pose(moved, "l3"), atol=1e-12)


def test_a_follower_with_an_offset_alone_in_the_chain_is_where_it_belongs(rng):
    """At an independent joint's motion plus its offset, one by one and in a batch, though its leader is beyond it."""
    types = dict.fromkeys("abd", "fixed") | {"c": "revolute", "d": "revolute"}
    for mimics, kinds in (({"c": ("d", 1.0, 0.4)}, {}), ({"c": ("d", 1.0, 0.4)}, types)):
        with case(mimics, kinds):
            robot = load(mimics, types=kinds)
            q, frame = robot.random_configuration(rng), robot.frame("l3")
            positions = dict(zip(robot.joint_names, q, strict=True))
            positions["c"] = positions["d"] + 0.4
            model = pin.buildModelFromXML(urdf({}, types=kinds).decode())
            data, all_q = model.createData(), pin.neutral(model)
            for name in model.names[1:]:
                all_q[model.joints[model.getJointId(name)].idx_q] = positions[name]
            pin.framesForwardKinematics(model, data, all_q)
            expected = data.oMf[model.getFrameId("l3")].homogeneous
            np.testing.assert_allclose(robot.pose(q, frame), expected, atol=KNOWN)
            np.testing.assert_allclose(robot.frame_kinematics(frame).poses(q[None])[0], expected, atol=KNOWN)


def test_every_derivative_is_exact_with_followers(tmp_path, rng):
    """Jacobians one by one and in a batch, centre of mass, distance of links, effort: along the independent joints.

    Each against central differences or the free robot; a follower below, above and beside its leader.
    """
    masses = (
        '<inertial><origin xyz="0.1 0.2 0"/><mass value="2"/><inertia ixx="1" ixy="0" ixz="0" iyy="2" iyz="0" izz="3"/>'
    )
    ball = '</inertial><collision><origin xyz="0 0.1 0"/><geometry><sphere radius="0.02"/></geometry></collision>'
    for mimics in (CHAIN, {"a": ("d", 0.7, 0.2)}, {"d": ("a", -1.5, 0.1)}):
        free, bound = (urdf(m).replace(b'"/>', b'">' + (masses + ball + "</link>").encode(), 5) for m in ({}, mimics))
        path = tmp_path / "chain.urdf"
        path.write_bytes(bound)
        robot, whole = load_robot(path), robot_from_text(free, Path("free.urdf"))
        q, h = 0.5 * robot.random_configuration(rng), 1e-5

        def slopes(of, q=q, h=h):
            return np.stack([(of(q + step) - of(q - step)) / (2 * h) for step in h * np.eye(len(q))], axis=-1)

        J, H = robot.centre_of_mass_jacobian_and_derivative(q)
        with case(mimics):
            np.testing.assert_allclose(J, slopes(robot.centre_of_mass), atol=1e-9)
            np.testing.assert_allclose(
                H, slopes(lambda x, r=robot: r.centre_of_mass_jacobian_and_derivative(x)[0]), atol=1e-9
            )
            near = SelfCollision(robot)
            found = {p.links: p for p in near.closer_than(q, 10.0)}
            for links, seen in found.items():
                by_steps = slopes(lambda x, n=near, k=links: {p.links: p for p in n.closer_than(x, 10.0)}[k].distance)
                np.testing.assert_allclose(seen.gradient, by_steps, atol=1e-7, err_msg=str(links))
            assert set(found) == {("l0", "l3"), ("l0", "l4"), ("l1", "l4")}
            lift, full = robot.coupling.lift, robot.pinocchio_configuration(q)
            acceleration = rng.normal(size=robot.nv)
            np.testing.assert_allclose(
                robot.inertial_effort(q, acceleration),
                lift.T @ whole.inertial_effort(full, lift @ acceleration),
                atol=1e-12,
            )
            batch = robot.frame_kinematics("l4")
            np.testing.assert_allclose(
                robot.jacobian(q, "l4")[:3], slopes(lambda x, r=robot: r.position(x, "l4")), atol=1e-9
            )
            for reference in ("world", "local"):
                derivative = robot.jacobian_and_derivative(q, "l4", reference)[1]
                by_steps = slopes(lambda x, r=robot, ref=reference: r.jacobian(x, "l4", ref))
                np.testing.assert_allclose(derivative, by_steps, atol=1e-9)
                np.testing.assert_allclose(
                    batch.jacobians_and_derivatives(q[None], reference)[1][0], derivative, atol=1e-12
                )
        assert robot.mass == pytest.approx(8.0)
        assert all(robot.moves(leader, "l4") for leader in robot.joint_names)
    robot = load({"b": ("d", 1.0, 0.0)})
    assert (
        robot.moves("d", "l2") and not robot.moves("c", "l2") and robot.moves("a", "l1") and not robot.moves("d", "l1")
    )


def test_configurations_of_robots_with_followers_are_integrated(rng, tmp_path):
    """Beside continuous joints and a follower a step along the tangent keeps the robot's own size, and leads there."""
    axis = '<axis xyz="0 1 0"/>'
    first, _, last = URDFS["wrist"].rpartition(axis)
    path = tmp_path / "wrist.urdf"
    path.write_text(f'{first}{axis}<mimic joint="joint1" multiplier="-0.5"/>{last}', encoding="utf-8")
    robot = load_robot(path)
    assert (robot.nq, robot.nv) == (5, 3)
    q, step = robot.random_configuration(rng), rng.uniform(-0.5, 0.5, 3)
    there = robot.integrate(q, step)
    assert there.shape == (5,)
    np.testing.assert_allclose(robot.difference(q, there), step, atol=1e-12)
    np.testing.assert_allclose(np.hypot(there[0], there[1]), 1.0, atol=1e-12)
    frame, h = robot.frame("tip"), 1e-6
    moved = [robot.pose(robot.integrate(q, s * h * step), frame)[:3, 3] for s in (1.0, -1.0)]
    np.testing.assert_allclose((moved[0] - moved[1]) / (2 * h), (robot.jacobian(q, frame) @ step)[:3], atol=1e-8)
