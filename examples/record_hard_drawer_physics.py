"""Record examples/data/sawyer_drawer_hard: the drawers of `record_drawer_physics.py`, with the faults of real ones.

    python examples/record_hard_drawer_physics.py examples/data/sawyer_drawer_hard

The same chest, operator and arm, but: the gripper has 2 mm of play around the handle in every direction; drawer and
arm stick and slip (friction falls from 3 times its value at rest within 1 cm/s, or 0.05 rad/s); encoders have noise of
1e-3 rad; and every 50 ms a sample is written, with a velocity that the arm's controller filtered and that is 60 ms old.
"""

# pyright: reportAttributeAccessIssue=false
# (the compiled parts of MuJoCo have no complete stubs)
from __future__ import annotations

import argparse
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float
from make_recordings.csv_file import write_csv
from make_recordings.grip import grip_posture
from make_recordings.guided_arm import GRIP_FRAME, guided_arm, set_damping
from make_recordings.operator import out_and_in, slow_noise
from make_recordings.recorder import RATE, Recording, record, stays_inside
from record_drawer_physics import ASIDE, AXIS, DASHPOT, DEMONSTRATIONS, DISTURBANCE, FRONT, LEVELS, SPRING
from scipy.spatial.transform import Rotation

from manip_learn.robot import Robot, load_robot

SEED = 20260
PLAY = 0.002  # between grip and handle [m]
STICTION = 3.0  # friction at rest over sliding friction
SLIDING, CREEP = 3.0, 0.01  # of the drawer [N], speed at which it slides [m/s]
ARM_CREEP = 0.05  # [rad/s]
NOISE = 1e-3  # of the encoders [rad]
EVERY = 5  # one sample of five is written: 20 Hz
DELAY, FILTER = 0.06, 0.03  # of the recorded velocity: age, time constant [s]


def drawer_model(handle: Float[np.ndarray, " 3"]) -> mujoco.MjModel:
    """The guided arm and a drawer whose handle cannot be further than the play from the grip; base frame [m]."""
    spec = guided_arm()
    drawer = spec.worldbody.add_body(name="drawer", pos=handle)
    drawer.mass, drawer.inertia, drawer.explicitinertial = 3.0, np.array([0.05, 0.05, 0.05]), True
    drawer.gravcomp = 1.0
    rail = drawer.add_joint(name="rail", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=-AXIS)
    set_damping(rail, 4.0)
    rail.frictionloss = SLIDING
    drawer.add_site(name="handle")
    spec.body(GRIP_FRAME).add_site(name="grip")
    play = spec.add_tendon(name="play", limited=True, range=[0.0, PLAY])
    play.wrap_site("grip")
    play.wrap_site("handle")
    play.solref_limit, play.solimp_limit = (0.002, 1.0), (0.99, 0.999, 0.0005, 0.5, 2.0)
    return spec.compile()


def record_one(number: int, robot: Robot) -> Recording:
    """Demonstration `number`, counted from 1, at 100 Hz; it depends on the seed and its number only.

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
    straight = Rotation.from_matrix(np.column_stack([ASIDE, np.cross(AXIS, ASIDE), AXIS]))
    tilt = Rotation.from_rotvec(np.append(rng.uniform(-0.4, 0.4, 2), rng.uniform(-0.8, 0.8)))
    start = grip_posture(robot, GRIP_FRAME, handle, straight * tilt, rng)
    if start is None:
        return None
    motion = out_and_in((0.18, 0.28), rng)
    wander = slow_noise(np.array([0.006, 0.012, 0.012]), 0.3, 1.2, rng)
    disturbance = slow_noise(DISTURBANCE, 0.15, 0.7, rng)
    model = drawer_model(handle)
    sliding, creep = model.dof_frictionloss.copy(), np.append(np.full(model.nv - 1, ARM_CREEP), CREEP)

    def push(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        # friction at rest is higher than in motion: what is pulled sticks, then slips
        model.dof_frictionloss[:] = sliding * (1.0 + (STICTION - 1.0) * np.exp(-((data.qvel / creep) ** 2)))
        along, aside, up = wander(data.time)
        way, speed = data.qpos[-1], data.qvel[-1]
        wanted = handle - (motion(data.time) + along) * AXIS + aside * ASIDE + np.array([0.0, 0.0, up])
        force = SPRING * (wanted - (handle - way * AXIS)) + DASHPOT * speed * AXIS
        data.qfrc_applied[:7] += disturbance(data.time)
        hand = model.site("grip").bodyid[0]
        mujoco.mj_applyFT(model, data, force, np.zeros(3), data.site("grip").xpos, hand, data.qfrc_applied)

    return record(model, start, motion.duration + 0.2, push, rng)


def written(recording: Recording, rng: np.random.Generator) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Time [s] and columns at 20 Hz: noisy positions [rad], and filtered velocities that are 60 ms old [rad/s]."""
    speed = np.gradient(recording.exact, 1.0 / RATE, axis=0)
    filtered, share = np.zeros_like(speed), 1.0 / (1.0 + FILTER * RATE)
    for i in range(1, len(speed)):
        filtered[i] = filtered[i - 1] + share * (speed[i] - filtered[i - 1])
    late = round(DELAY * RATE)
    old = np.concatenate([np.zeros_like(filtered[:late]), filtered[:-late]])
    q = recording.exact + rng.normal(0.0, NOISE, recording.exact.shape)
    columns = dict(zip(recording.joint_names, q[::EVERY].T, strict=True))
    columns |= {f"{name}_velocity": v for name, v in zip(recording.joint_names, old[::EVERY].T, strict=True)}
    return recording.time[::EVERY], columns


def main(arguments: list[str] | None = None) -> None:
    """Write all demonstrations, or one."""
    parser = argparse.ArgumentParser(description="Record the hard drawer demonstrations with MuJoCo.")
    parser.add_argument("folder", type=Path, help="folder for demo_01.csv ...")
    parser.add_argument("--only", type=int, help="number of the one demonstration to record")
    options = parser.parse_args(arguments)
    robot = load_robot("sawyer")
    for number in [options.only] if options.only else range(1, DEMONSTRATIONS + 1):
        time, columns = written(record_one(number, robot), np.random.default_rng([SEED, number]))
        write_csv(options.folder / f"demo_{number:02d}.csv", time, columns)


if __name__ == "__main__":
    main()
