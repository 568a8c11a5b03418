"""The Sawyer-like arm in hand-guiding mode, as a MuJoCo model that furniture can be added to."""

# pyright: reportAttributeAccessIssue=false
# (the compiled parts of MuJoCo have no complete stubs)
from __future__ import annotations

from pathlib import Path

import mujoco

ROBOTS = Path(__file__).resolve().parents[2] / "robots"
GRIP_FRAME = "right_gripper_tip"
TIMESTEP = 0.0005  # [s]

# joint: damping [N m s/rad], dry friction [N m], rotor inertia [kg m^2]. The URDF's 5 and 5 are for an arm under
# position control; in hand-guiding mode the drives make up for most of it. Chosen by us, heavier at the shoulder.
GUIDING = {
    "right_j0": (4.0, 0.5, 0.10),
    "right_j1": (4.0, 0.5, 0.10),
    "right_j2": (3.0, 0.3, 0.10),
    "right_j3": (3.0, 0.3, 0.10),
    "right_j4": (1.0, 0.1, 0.02),
    "right_j5": (1.0, 0.1, 0.02),
    "right_j6": (1.0, 0.1, 0.02),
}
# The grip as stiff as the time step allows: 1 ms to settle, next to no give.
STIFF_SOLREF = (2 * TIMESTEP, 1.0)
STIFF_SOLIMP = (0.9999, 0.99999, 0.001, 0.5, 2.0)


def guided_arm() -> mujoco.MjSpec:
    """A model of robots/sawyer.urdf whose drives carry its weight and nothing else."""
    spec = mujoco.MjSpec.from_file(str(ROBOTS / "sawyer.urdf"))
    spec.compiler.fusestatic = False  # keep the hand's frames as bodies, the grip is attached to one
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.tolerance = 1e-12
    for body in spec.bodies:
        body.gravcomp = 1.0
    for joint in spec.joints:
        damping, friction, rotor = GUIDING[joint.name]
        set_damping(joint, damping)
        joint.frictionloss = friction
        joint.armature = rotor
    return spec


def set_damping(joint: mujoco.MjsJoint, damping: float) -> None:
    """Linear damping [N m s/rad or N s/m]; MuJoCo 4 keeps three coefficients a joint, MuJoCo 3 one."""
    if isinstance(joint.damping, float):
        joint.damping = damping
    else:
        joint.damping = [damping] + [0.0] * (len(joint.damping) - 1)
