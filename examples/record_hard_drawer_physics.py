"""Record examples/data/sawyer_drawer_hard: the drawers of `record_drawer_physics.py`, with the faults of real ones.

    python examples/record_hard_drawer_physics.py examples/data/sawyer_drawer_hard

The same chest, operator and arm, but: the gripper has 2 mm of play around the handle in every direction; drawer and
arm stick and slip (friction falls from 3 times its value at rest within 1 cm/s, or 0.05 rad/s); encoders have noise of
1e-3 rad; and every 50 ms a sample is written, with a velocity that the arm's controller filtered and that is 60 ms old.
"""

# pyright: reportAttributeAccessIssue=false
# (the compiled parts of MuJoCo have no complete stubs)
from __future__ import annotations

import mujoco
import numpy as np
from make_recordings.recorder import RATE, Columns, Push, write_demonstrations
from record_drawer_physics import DEMONSTRATIONS, drawer, record_one

from manip_learn.robot import Robot

SEED = 20260
PLAY = 0.002  # between grip and handle [m]
STICTION = 3.0  # friction at rest over sliding friction
CREEP, ARM_CREEP = 0.01, 0.05  # speed at which the drawer slides [m/s], at which a joint turns [rad/s]
NOISE = 1e-3  # of the encoders [rad]
EVERY = 5  # one sample of five is written: 20 Hz
DELAY, FILTER = 0.06, 0.03  # of the recorded velocity: age, time constant [s]


def hold_loosely(handle: np.ndarray) -> tuple[mujoco.MjModel, str, Push]:
    """The drawer, the site that the operator pulls, and friction that is higher at rest: it sticks and slips."""
    spec = drawer(handle)
    play = spec.add_tendon(name="play", limited=True, range=[0.0, PLAY])
    play.wrap_site("grip")
    play.wrap_site("handle")
    play.solref_limit, play.solimp_limit = (0.002, 1.0), (0.99, 0.999, 0.0005, 0.5, 2.0)
    model = spec.compile()
    sliding, creep = model.dof_frictionloss.copy(), np.append(np.full(model.nv - 1, ARM_CREEP), CREEP)

    def stick(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        model.dof_frictionloss[:] = sliding * (1.0 + (STICTION - 1.0) * np.exp(-((data.qvel / creep) ** 2)))

    return model, "grip", stick


def written(number: int, robot: Robot) -> Columns:
    """Time [s] and columns at 20 Hz: noisy positions [rad], and filtered velocities that are 60 ms old [rad/s]."""
    recording, rng = record_one(number, robot, SEED, hold_loosely), np.random.default_rng([SEED, number])
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
    write_demonstrations("hard drawer", DEMONSTRATIONS, written, arguments)


if __name__ == "__main__":
    main()
