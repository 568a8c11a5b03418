"""Mimic joints: resolved into a linear map from the independent joints, wherever their leaders are."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
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


@pytest.mark.parametrize("order", ["".join(p) for p in itertools.permutations("abcd")][::3])
def test_mimic_of_mimic_in_any_order(order, rng):
    """c follows b follows a: one map from (a, d) to all four, wherever in the file the leaders come."""
    robot = load(CHAIN, order=order)
    assert robot.joint_names == ("a", "d")
    b, c = sorted(robot.mimics, key=lambda m: m.joint)
    assert b == Mimic("b", "a", 0.5, -0.3)
    assert (c.joint, c.leader, c.multiplier) == ("c", "a", -1.0) and c.offset == pytest.approx(0.7)
    a, d = rng.uniform(-1, 1, 2)
    b = 0.5 * a - 0.3
    same_place(robot, [a, d], {"a": a, "b": b, "c": -2 * b + 0.1, "d": d})


def same_place(robot, q, positions, **options):
    """The last link is where the free joints bring it."""
    np.testing.assert_allclose(robot.pose(q, robot.frame("l4")), free_pose(positions, **options), atol=KNOWN)


def test_a_fixed_leader_holds_its_followers(rng):
    """What follows a fixed joint rests at its offset, also at second hand."""
    robot = load({"b": ("a", 5.0, 0.4), "c": ("b", 0.5, 0.1)}, types={"a": "fixed"})
    assert robot.joint_names == ("d",) and not robot.mimics
    assert robot.locked == {"b": 0.4, "c": pytest.approx(0.3)}
    assert sum("follows the fixed joint 'a'" in w for w in robot.warnings) == 2
    same_place(robot, [0.6], {"b": 0.4, "c": 0.3, "d": 0.6}, types={"a": "fixed"})


def test_a_locked_leader_holds_its_followers():
    """Locking the leader locks the chain, at the positions that follow."""
    robot = load(CHAIN, locked={"a": 0.8})
    assert robot.joint_names == ("d",)
    assert robot.locked == {"a": 0.8, "b": pytest.approx(0.1), "c": pytest.approx(-0.1)}
    same_place(robot, [0.2], {"a": 0.8, "b": 0.1, "c": -0.1, "d": 0.2})


def test_full_turns_reach_the_follower():
    """Given as joint positions, a continuous leader's turns count: half the speed is 180 degrees after one turn."""
    types, a = {"a": "continuous", "b": "revolute"}, 2 * np.pi + 0.4
    robot = load({"b": ("a", 0.5, 0.0)}, types=types)
    assert any("jumps" in w for w in robot.warnings)
    same_place(robot, [a, 0, 0], {"a": a, "b": a / 2, "c": 0.0, "d": 0.0}, types=types)


@pytest.mark.parametrize(
    ("follows", "limit", "leader", "told"),
    [
        ((-2.0, 0.2), 'lower="-0.4" upper="1" velocity="0.5"', (-0.4, 0.3, 0.25), "-0.4 ... 0.3 by its follower 'b'"),
        ((-2.0, 0.2), 'lower="-4" upper="4" velocity="0"', (-1.9, 2.1, 2.0), "limit"),  # a velocity limit of 0 is none
        ((0.1, 9.0), 'lower="-3" upper="3" velocity="2"', (-3.0, 3.0, 2.0), "the limits of 'b' are ignored"),
        ((0.5, 0.0), 'lower="-1.49999" upper="1.49999" velocity="2"', (-3.0, 3.0, 2.0), ""),  # up to rounding
        ((1.0, 0.0), 'upper="2.5" velocity="2"', (-3.0, 2.5, 2.0), "limited to"),
    ],
)
def test_limits_of_followers_bind_the_leader(follows, limit, leader, told):
    """Position limits through the factor and offset, also a negative factor; velocity limits through its size."""
    robot = load({"b": ("a", *follows)}, limits={"b": f'<limit {limit} effort="1"/>'})
    seen = (robot.position_lower[0], robot.position_upper[0], robot.velocity_limit[0])
    assert seen == pytest.approx(leader) and any(told in w for w in robot.warnings) == bool(told)


def test_followers_beside_the_chain_change_nothing(rng):
    """A gripper that mimics costs the arm nothing: same batch, same gradient."""
    arm, whole = (load_robot("panda", locked=locked) for locked in (("panda_finger_joint1",), ()))
    assert whole.mimics and not arm.mimics
    small, large = (
        Constraint([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]], FrameJacobian(robot, "panda_hand_tcp")) for robot in (arm, whole)
    )
    for _ in range(5):
        q = arm.random_configuration(rng)
        both = np.append(q, 0.02)
        gradients = manipulability_gradient(large, both), np.append(manipulability_gradient(small, q), 0.0)
        np.testing.assert_allclose(*gradients, atol=1e-12)
        J = whole.frame_kinematics("panda_hand_tcp").jacobians(both[None])[0]
        np.testing.assert_allclose(J[:, :7], arm.frame_kinematics("panda_hand_tcp").jacobians(q[None])[0], atol=1e-13)
        assert not np.any(J[:, 7])


@pytest.mark.parametrize("kinds", [{}, {"a": "fixed", "b": "fixed"}])
@pytest.mark.parametrize("offset", [0.0, 0.4])
def test_a_follower_alone_in_the_chain_is_where_it_belongs(kinds, offset, rng):
    """At an independent joint's motion plus its offset, one by one and in a batch, though its leader is beyond it."""
    robot, free = load({"c": ("d", 1.0, offset)}, types=kinds), load({}, types=kinds)
    q, frame = robot.random_configuration(rng), robot.frame("l3")
    batch, leader = robot.frame_kinematics(frame), robot.joint_index("d")
    moved = np.append(q[:leader], [q[leader] + offset, 0.0])  # the follower as a joint of its own
    np.testing.assert_allclose(robot.pose(q, frame), free.pose(moved, "l3"), atol=KNOWN)
    np.testing.assert_allclose(batch.poses(q[None])[0], free.pose(moved, "l3"), atol=KNOWN)
    np.testing.assert_allclose(batch.jacobians(q[None])[0], robot.jacobian(q, frame), atol=1e-12)
    assert np.any(robot.jacobian(q, frame)[:, leader])


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
    q, steps = 0.5 * robot.random_configuration(rng), 1e-5 * np.eye(robot.nv)

    def slopes(of):
        return np.stack([(of(q + step) - of(q - step)) / 2e-5 for step in steps], axis=-1)

    J, H = robot.centre_of_mass_jacobian_and_derivative(q)
    near, batch = SelfCollision(robot), robot.frame_kinematics("l4")
    checked = [
        (J, slopes(robot.centre_of_mass)),
        (H, slopes(lambda x: robot.centre_of_mass_jacobian_and_derivative(x)[0])),
        (robot.jacobian(q, "l4")[:3], slopes(lambda x: robot.position(x, "l4"))),
    ]
    for reference in ("world", "local"):
        derivative = robot.jacobian_and_derivative(q, "l4", reference)[1]
        checked.append((derivative, slopes(lambda x, ref=reference: robot.jacobian(x, "l4", ref))))
        many = batch.jacobians_and_derivatives(q[None], reference)[1][0]
        np.testing.assert_allclose(many, derivative, atol=1e-12)
    for exact, by_steps in checked:
        np.testing.assert_allclose(exact, by_steps, atol=1e-9)
    found = {p.links: p for p in near.closer_than(q, 10.0)}
    assert set(found) == {("l0", "l3"), ("l0", "l4"), ("l1", "l4")}
    for links, seen in found.items():
        by_steps = slopes(lambda x, k=links: {p.links: p for p in near.closer_than(x, 10.0)}[k].distance)
        np.testing.assert_allclose(seen.gradient, by_steps, atol=1e-7, err_msg=str(links))
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
