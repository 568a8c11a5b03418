"""Record the demonstrations of examples/data/sawyer_door: an operator opens and closes a cabinet with a guided Sawyer.

    python examples/record_door_physics.py examples/data/sawyer_door

The gripper holds the door's handle firmly, in the same way each time, so that hand and door move as one body: what the
hand can do is constant in the hand's own frame. In the base frame it is not: the handle moves on an arc, the cabinet
stands elsewhere each time, and has doors that are hinged at the side and flaps that are hinged above. All motion comes
from MuJoCo's rigid-body dynamics.
"""

# pyright: reportAttributeAccessIssue=false
# (the compiled parts of MuJoCo have no complete stubs)
from __future__ import annotations

import mujoco
import numpy as np
from make_recordings.grip import grip_posture
from make_recordings.guided_arm import GRIP_FRAME, STIFF_SOLIMP, STIFF_SOLREF, guided_arm, set_damping
from make_recordings.operator import out_and_in, slow_noise
from make_recordings.recorder import Recording, as_recorded, record, usable, write_demonstrations
from scipy.spatial.transform import Rotation

from manip_learn.robot import Robot

SEED = 20241
DEMONSTRATIONS = 8
RADIUS = 0.35  # from hinge to handle [m]
SPRING, DASHPOT = 400.0, 25.0  # operator's hand [N/m], [N s/m]
DISTURBANCE = np.array([6.0, 6.0, 5.0, 5.0, 0.8, 0.8, 0.8])  # pushes on the joints, standard deviation [N m]


GRASP = Rotation.from_euler("xyz", [10.0, -15.0, 40.0], degrees=True)  # of the tool on the door, always the same


def door_frame(number: int, rng: np.random.Generator) -> tuple[np.ndarray, Rotation]:
    """Place of the handle at the start, 3 degrees ajar [m], and axes of the door there.

    x points to the hinge, y along the hinge, z into the cabinet.

    Odd numbers are doors with an upright hinge, even ones flaps with a level hinge above the handle.
    """
    heading = Rotation.from_euler("z", rng.uniform(-10.0, 30.0), degrees=True)
    upright = Rotation.from_matrix(np.column_stack([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
    roll = Rotation.from_euler("z", 0.0 if number % 2 else -90.0, degrees=True)
    height = rng.uniform(0.35, 0.50) if number % 2 else rng.uniform(0.25, 0.35)
    return heading.apply([rng.uniform(0.70, 0.78), 0.0, height]), heading * upright * roll


def door_model(handle: np.ndarray, axes: Rotation) -> mujoco.MjModel:
    """The guided arm with its gripper firmly on the handle of a door."""
    spec = guided_arm()
    hinge_place = handle + RADIUS * axes.as_matrix()[:, 0]
    door = spec.worldbody.add_body(name="door", pos=hinge_place, quat=axes.as_quat()[[3, 0, 1, 2]])
    door.mass, door.ipos, door.explicitinertial = 4.0, [-RADIUS / 2, 0.0, 0.0], True
    door.inertia = np.array([0.06, 0.11, 0.05])
    door.gravcomp = 1.0  # flaps have gas springs
    hinge = door.add_joint(name="hinge", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0.0, -1.0, 0.0])
    set_damping(hinge, 0.4)
    hinge.frictionloss = 0.3
    door.add_site(name="handle", pos=[-RADIUS, 0.0, 0.0], quat=GRASP.as_quat()[[3, 0, 1, 2]])
    spec.body(GRIP_FRAME).add_site(name="grip")
    firm = spec.add_equality(name="firm_grip", type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_SITE)
    firm.name1, firm.name2, firm.solref, firm.solimp = "grip", "handle", STIFF_SOLREF, STIFF_SOLIMP
    return spec.compile()


def record_one(number: int, robot: Robot) -> Recording:
    """Demonstration `number`, counted from 1; it depends on the seed and its number only.

    Raises:
        RuntimeError: None of 200 attempts was usable.
    """

    def attempt(rng: np.random.Generator) -> tuple[Recording | None, float]:
        handle, axes = door_frame(number, rng)
        return _try(handle, axes, robot, rng), 0.05

    return usable(attempt, number, robot, SEED, 200)


def _try(handle: np.ndarray, axes: Rotation, robot: Robot, rng: np.random.Generator) -> Recording | None:
    to_hinge, _, into = axes.as_matrix().T
    start = grip_posture(robot, GRIP_FRAME, handle, axes * GRASP, rng)
    if start is None:
        return None
    motion = out_and_in((0.6, 0.9), rng)
    wander = slow_noise(np.array([0.010, 0.010, 0.010]), 0.3, 1.2, rng)
    disturbance = slow_noise(DISTURBANCE, 0.15, 0.7, rng)

    def push(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        angle = motion(data.time)
        arc = RADIUS * ((1.0 - np.cos(angle)) * to_hinge - np.sin(angle) * into)
        place, door = data.site("handle").xpos, model.body("door").id
        velocity = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, model.site("handle").id, velocity, 0)
        force = SPRING * (handle + arc + wander(data.time) - place) - DASHPOT * velocity[3:]
        data.qfrc_applied[:7] += disturbance(data.time)
        mujoco.mj_applyFT(model, data, force, np.zeros(3), place, door, data.qfrc_applied)

    return record(door_model(handle, axes), start, motion.duration + 0.2, push, rng)


def main(arguments: list[str] | None = None) -> None:
    """Write all demonstrations, or one."""
    write_demonstrations("door", DEMONSTRATIONS, lambda n, robot: as_recorded(record_one(n, robot)), arguments)


if __name__ == "__main__":
    main()
