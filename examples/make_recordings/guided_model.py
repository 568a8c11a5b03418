"""Any arm in hand-guiding mode with furniture around it, as a MuJoCo model built from the arm's own kinematics."""

# pyright: reportAttributeAccessIssue=false
# (the compiled parts of MuJoCo have no complete stubs)
from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from make_recordings.arms import Arm
from make_recordings.guided_arm import set_damping
from make_recordings.mechanisms import Axle, Ball, Mechanism, Plane, Slide, across

TIMESTEP = 0.0025  # [s]
STIFF = 2 * TIMESTEP  # the stiffest grip that this step allows: time to settle [s]
STIFF_SOLIMP = (0.9999, 0.99999, 0.001, 0.5, 2.0)

# damping [N m s/rad], dry friction [N m], rotor inertia [kg m^2]; chosen by us, as in guided_arm.py
UPPER, FORE, WRIST = (4.0, 0.5, 0.10), (3.0, 0.3, 0.10), (1.0, 0.1, 0.02)
LEAST_MASS, LEAST_INERTIA = 0.05, 1e-4  # [kg], [kg m^2]: some descriptions have links without
AXES = {"JointModelRX": (1.0, 0.0, 0.0), "JointModelRY": (0.0, 1.0, 0.0), "JointModelRZ": (0.0, 0.0, 1.0)}
TIP = "tip"


def guided_model(
    arm: Arm, mechanisms: list[Mechanism], grips: list[Float[np.ndarray, " 3"]], friction: float
) -> mujoco.MjModel:
    """The arm, then each mechanism with a handle where the hand will take hold [m]; all grips are open.

    Gravity is left out: the drives carry the arm's weight, and the furniture is balanced.

    Args:
        arm: The arm.
        mechanisms: Mechanism i gets the body and the site `handle_<i>` and the equality `grip_<i>`.
        grips: Where each is held when its coordinates are zero.
        friction: Factor on the dry friction of the arm's joints.
    """
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = TIMESTEP, [0.0, 0.0, 0.0]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.tolerance = 1e-12
    _add_arm(spec, arm, friction)
    for number, (mechanism, grip) in enumerate(zip(mechanisms, grips, strict=True)):
        _add_furniture(spec, mechanism, grip, f"handle_{number}", f"grip_{number}")
    return spec.compile()


def _add_arm(spec: mujoco.MjSpec, arm: Arm, friction: float) -> None:
    model = arm.robot.pinocchio_model
    bodies = [spec.worldbody]
    drives = [UPPER, UPPER, *[FORE] * (model.njoints - 6), WRIST, WRIST, WRIST]
    for i in range(1, model.njoints):
        placement, inertia, kind = model.jointPlacements[i], model.inertias[i], model.joints[i]
        body = bodies[model.parents[i]].add_body(name=model.names[i], pos=placement.translation)
        body.quat = Rotation.from_matrix(placement.rotation).as_quat()[[3, 0, 1, 2]]
        body.mass, body.ipos, body.explicitinertial = max(inertia.mass, LEAST_MASS), inertia.lever, True
        moments, axes = np.linalg.eigh(inertia.inertia)
        axes = axes * np.linalg.det(axes)
        body.inertia = np.maximum(moments, LEAST_INERTIA)
        body.iquat = Rotation.from_matrix(axes).as_quat()[[3, 0, 1, 2]]
        axis = AXES.get(kind.shortname()) or kind.extract().axis
        joint = body.add_joint(name=f"joint_{i}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
        damping, dry, joint.armature = drives[i - 1]
        set_damping(joint, damping)
        joint.frictionloss = friction * dry
        bodies.append(body)
    frame = model.frames[arm.tip.index]
    quat = Rotation.from_matrix(frame.placement.rotation).as_quat()[[3, 0, 1, 2]]
    bodies[frame.parentJoint].add_site(name=TIP, pos=frame.placement.act(np.array(arm.offset)), quat=quat)


def _add_furniture(spec: mujoco.MjSpec, mechanism: Mechanism, grip: np.ndarray, handle: str, name: str) -> None:
    joints = joints_of(mechanism)
    if not joints:
        return
    body = spec.worldbody.add_body(name=handle, pos=grip)
    body.mass, body.inertia, body.explicitinertial = 1.0, np.full(3, 0.01), True
    for number, (kind, axis, point) in enumerate(joints):
        joint = body.add_joint(name=f"{handle}_{number}", type=kind, axis=axis, pos=point - grip)
        set_damping(joint, 4.0 if kind == mujoco.mjtJoint.mjJNT_SLIDE else 0.2)
        joint.frictionloss = 0.0 if kind == mujoco.mjtJoint.mjJNT_BALL else 0.2
    body.add_site(name=handle)
    if isinstance(mechanism, Axle) and mechanism.pitch:
        thread = spec.add_equality(name=f"{handle}_thread", type=mujoco.mjtEq.mjEQ_JOINT)
        thread.objtype, thread.name1, thread.name2 = mujoco.mjtObj.mjOBJ_JOINT, f"{handle}_0", f"{handle}_1"
        thread.data[:5] = [0.0, mechanism.pitch, 0.0, 0.0, 0.0]
        thread.solref, thread.solimp = (STIFF, 1.0), STIFF_SOLIMP
    firm = joints_turn_the_hand(mechanism)
    hold = spec.add_equality(name=name, type=mujoco.mjtEq.mjEQ_WELD if firm else mujoco.mjtEq.mjEQ_CONNECT)
    hold.objtype, hold.name1, hold.name2, hold.active = mujoco.mjtObj.mjOBJ_SITE, TIP, handle, False
    hold.solref, hold.solimp = (STIFF, 1.0), STIFF_SOLIMP


def joints_of(mechanism: Mechanism) -> list[tuple[mujoco.mjtJoint, np.ndarray, np.ndarray]]:
    """Type, axis and place of a mechanism's joints in base axes; none if the person alone holds the task."""
    slide, turn = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    match mechanism:
        case Slide():
            return [(slide, mechanism.axis, mechanism.handle)]
        case Plane():
            ways = [(slide, row, mechanism.handle) for row in across(mechanism.normal)]
            return ways + [(turn, mechanism.normal, mechanism.handle)] * mechanism.flat
        case Axle():
            sliding = [(slide, mechanism.axis, mechanism.point)] * bool(mechanism.sleeve or mechanism.pitch)
            return [*sliding, (turn, mechanism.axis, mechanism.point)]
        case Ball():
            return [(mujoco.mjtJoint.mjJNT_BALL, np.array([0.0, 0.0, 1.0]), mechanism.point)]
    return []


def joints_turn_the_hand(mechanism: Mechanism) -> bool:
    """Whether the hand is welded to the handle; else it holds a point of it."""
    return mechanism.truth()["held"] == "firm"
