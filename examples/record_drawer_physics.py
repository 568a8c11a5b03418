"""Record the demonstrations of examples/data/sawyer_drawer: an operator opens and closes drawers with a guided Sawyer.

    python examples/record_drawer_physics.py examples/data/sawyer_drawer

A chest with three drawers stands in front of the arm, turned by 25 degrees. The arm carries its own weight only. Its
gripper holds a handle like a ball joint, somewhere along the handle's bar. The operator pulls the handle with a spring
towards a point that moves out and in and wanders to the sides, while slow pushes disturb the arm's joints. All motion
comes from MuJoCo's rigid-body dynamics.
"""

# pyright: reportAttributeAccessIssue=false
# (the compiled parts of MuJoCo have no complete stubs)
from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from make_recordings.grip import grip_posture
from make_recordings.guided_arm import GRIP_FRAME, STIFF_SOLIMP, STIFF_SOLREF, guided_arm, set_damping
from make_recordings.operator import out_and_in, slow_noise
from make_recordings.recorder import Push, Recording, as_recorded, record, usable, write_demonstrations
from scipy.spatial.transform import Rotation

from manip_learn.robot import Robot

SEED = 20240
DEMONSTRATIONS = 50
HEADING = np.deg2rad(25.0)
AXIS = np.array([np.cos(HEADING), np.sin(HEADING), 0.0])  # into the chest, base frame
ASIDE = np.array([-AXIS[1], AXIS[0], 0.0])
FRONT = 0.80 * AXIS + np.array([0.0, 0.0, 0.20])  # lowest handle, drawer shut [m]
LEVELS = (0.0, 0.15, 0.30)  # heights of the three handles above the lowest [m]
SPRING, DASHPOT = 400.0, 25.0  # operator's hand [N/m], [N s/m]
DISTURBANCE = np.array([3.0, 3.0, 2.5, 2.5, 0.4, 0.4, 0.4])  # pushes on the joints, standard deviation [N m]


Hold = Callable[[np.ndarray], tuple[mujoco.MjModel, str, Push]]


def drawer(handle: np.ndarray) -> mujoco.MjSpec:
    """The guided arm and a drawer, with sites at grip and handle; the handle is given in the base frame [m]."""
    spec = guided_arm()
    drawer = spec.worldbody.add_body(name="drawer", pos=handle)
    drawer.mass, drawer.inertia, drawer.explicitinertial = 3.0, np.array([0.05, 0.05, 0.05]), True
    drawer.gravcomp = 1.0
    rail = drawer.add_joint(name="rail", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=-AXIS)
    set_damping(rail, 4.0)
    rail.frictionloss = 3.0
    drawer.add_site(name="handle")
    spec.body(GRIP_FRAME).add_site(name="grip")
    return spec


def hold_firmly(handle: np.ndarray) -> tuple[mujoco.MjModel, str, Push]:
    """The grip as a ball joint on the handle, the site that the operator pulls, and what changes in a step: nothing."""
    spec = drawer(handle)
    ball = spec.add_equality(name="ball_grip", type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_SITE)
    ball.name1, ball.name2, ball.solref, ball.solimp = "grip", "handle", STIFF_SOLREF, STIFF_SOLIMP
    return spec.compile(), "handle", lambda model, data: None


def record_one(number: int, robot: Robot, seed: int = SEED, hold: Hold = hold_firmly) -> Recording:
    """Demonstration `number`, counted from 1; it depends on the seed and its number only.

    Args:
        number: Of the demonstration.
        robot: The arm.
        seed: Root of the random numbers.
        hold: Handle [m] -> model, the site that the operator pulls, and what changes before each step.

    Raises:
        RuntimeError: None of 50 attempts was usable.
    """

    def attempt(rng: np.random.Generator) -> tuple[Recording | None, float]:
        opened = rng.uniform(0.02, 0.10)
        return _try(LEVELS[number % 3], opened, robot, hold, rng), opened

    return usable(attempt, number, robot, seed, 50)


def _try(level: float, opened: float, robot: Robot, hold: Hold, rng: np.random.Generator) -> Recording | None:
    handle = FRONT - opened * AXIS + rng.uniform(-0.08, 0.08) * ASIDE + np.array([0.0, 0.0, level])
    # tool axis z into the chest, then tilted and rolled at will
    straight = Rotation.from_matrix(np.column_stack([ASIDE, np.cross(AXIS, ASIDE), AXIS]))
    tilt = Rotation.from_rotvec(np.append(rng.uniform(-0.4, 0.4, 2), rng.uniform(-0.8, 0.8)))
    start = grip_posture(robot, GRIP_FRAME, handle, straight * tilt, rng)
    if start is None:
        return None
    motion = out_and_in((0.18, 0.28), rng)
    wander = slow_noise(np.array([0.006, 0.012, 0.012]), 0.3, 1.2, rng)
    disturbance = slow_noise(DISTURBANCE, 0.15, 0.7, rng)
    model, pulled, before = hold(handle)
    body = model.site(pulled).bodyid[0]

    def push(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        before(model, data)
        along, aside, up = wander(data.time)
        way, speed = data.qpos[-1], data.qvel[-1]
        wanted = handle - (motion(data.time) + along) * AXIS + aside * ASIDE + np.array([0.0, 0.0, up])
        force = SPRING * (wanted - (handle - way * AXIS)) + DASHPOT * speed * AXIS
        data.qfrc_applied[:7] += disturbance(data.time)
        mujoco.mj_applyFT(model, data, force, np.zeros(3), data.site(pulled).xpos, body, data.qfrc_applied)

    return record(model, start, motion.duration + 0.2, push, rng)


def main(arguments: list[str] | None = None) -> None:
    """Write all demonstrations, or one."""
    write_demonstrations("drawer", DEMONSTRATIONS, lambda n, robot: as_recorded(record_one(n, robot)), arguments)


if __name__ == "__main__":
    main()
