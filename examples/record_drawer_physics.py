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

import argparse
from pathlib import Path

import mujoco
import numpy as np
from make_recordings.csv_file import write_csv
from make_recordings.grip import grip_posture
from make_recordings.guided_arm import GRIP_FRAME, STIFF_SOLIMP, STIFF_SOLREF, guided_arm, set_damping
from make_recordings.operator import out_and_in, slow_noise
from make_recordings.recorder import Recording, record, stays_inside
from scipy.spatial.transform import Rotation

from manip_learn.robot import Robot, load_robot

SEED = 20240
DEMONSTRATIONS = 50
HEADING = np.deg2rad(25.0)
AXIS = np.array([np.cos(HEADING), np.sin(HEADING), 0.0])  # into the chest, base frame
ASIDE = np.array([-AXIS[1], AXIS[0], 0.0])
FRONT = 0.80 * AXIS + np.array([0.0, 0.0, 0.20])  # lowest handle, drawer shut [m]
LEVELS = (0.0, 0.15, 0.30)  # heights of the three handles above the lowest [m]
SPRING, DASHPOT = 400.0, 25.0  # operator's hand [N/m], [N s/m]
DISTURBANCE = np.array([3.0, 3.0, 2.5, 2.5, 0.4, 0.4, 0.4])  # pushes on the joints, standard deviation [N m]


def drawer_model(handle: np.ndarray) -> mujoco.MjModel:
    """The guided arm with its gripper on the handle of a drawer; the handle is given in the base frame [m]."""
    spec = guided_arm()
    drawer = spec.worldbody.add_body(name="drawer", pos=handle)
    drawer.mass, drawer.inertia, drawer.explicitinertial = 3.0, np.array([0.05, 0.05, 0.05]), True
    drawer.gravcomp = 1.0
    rail = drawer.add_joint(name="rail", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=-AXIS)
    set_damping(rail, 4.0)
    rail.frictionloss = 3.0
    drawer.add_site(name="handle")
    spec.body(GRIP_FRAME).add_site(name="grip")
    ball = spec.add_equality(name="ball_grip", type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_SITE)
    ball.name1, ball.name2, ball.solref, ball.solimp = "grip", "handle", STIFF_SOLREF, STIFF_SOLIMP
    return spec.compile()


def record_one(number: int, robot: Robot) -> Recording:
    """Demonstration `number`, counted from 1; it depends on the seed and its number only.

    An attempt in which the arm comes close to a limit, the drawer shuts or the handle is out of reach is repeated, as a
    person would do.

    Raises:
        RuntimeError: None of 50 attempts was usable.
    """
    for attempt in range(50):
        rng = np.random.default_rng([SEED, number, attempt])
        opened = rng.uniform(0.02, 0.10)
        recording = _try(LEVELS[number % 3], opened, robot, rng)
        if recording and stays_inside(recording, robot) and recording.way.min() > -opened:
            return recording
    raise RuntimeError(f"demonstration {number}: 50 tries and none was good; make the disturbance smaller")


def _try(level: float, opened: float, robot: Robot, rng: np.random.Generator) -> Recording | None:
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

    def push(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        along, aside, up = wander(data.time)
        way, speed = data.qpos[-1], data.qvel[-1]
        wanted = handle - (motion(data.time) + along) * AXIS + aside * ASIDE + np.array([0.0, 0.0, up])
        force = SPRING * (wanted - (handle - way * AXIS)) + DASHPOT * speed * AXIS
        data.qfrc_applied[:7] += disturbance(data.time)
        where = data.site("handle").xpos
        mujoco.mj_applyFT(model, data, force, np.zeros(3), where, model.body("drawer").id, data.qfrc_applied)

    return record(drawer_model(handle), start, motion.duration + 0.2, push, rng)


def main(arguments: list[str] | None = None) -> None:
    """Write all demonstrations, or one."""
    parser = argparse.ArgumentParser(description="Record the drawer demonstrations with MuJoCo.")
    parser.add_argument("folder", type=Path, help="folder for demo_01.csv ...")
    parser.add_argument("--only", type=int, help="number of the one demonstration to record")
    options = parser.parse_args(arguments)
    robot = load_robot("sawyer")
    for number in [options.only] if options.only else range(1, DEMONSTRATIONS + 1):
        recording = record_one(number, robot)
        columns = dict(zip(recording.joint_names, recording.q.T, strict=True))
        write_csv(options.folder / f"demo_{number:02d}.csv", recording.time, columns)


if __name__ == "__main__":
    main()
