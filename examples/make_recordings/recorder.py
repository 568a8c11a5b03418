"""Let the physics run and keep what the encoders see."""

# pyright: reportAttributeAccessIssue=false
# (the compiled parts of MuJoCo have no complete stubs)
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import mujoco
import numpy as np
from jaxtyping import Float

from manip_learn.robot import Robot

RATE = 100.0  # [Hz]
ENCODER_NOISE = 1e-4  # [rad]

LIMIT_MARGIN = 0.15  # [rad]
SPEED_SHARE = 0.9

Push = Callable[[mujoco.MjModel, mujoco.MjData], None]


@final
@dataclass(frozen=True)
class Recording:
    """What one demonstration left behind.

    Attributes:
        time: shape (T,) [s].
        q: shape (T, 7), what the encoders say [rad].
        exact: shape (T, 7), the simulated angles without noise [rad].
        way: shape (T,), the furniture's own joint [m or rad].
        joint_names: Names of the columns of q.
    """

    time: Float[np.ndarray, " T"]
    q: Float[np.ndarray, "T 7"]
    exact: Float[np.ndarray, "T 7"]
    way: Float[np.ndarray, " T"]
    joint_names: tuple[str, ...]


def record(
    model: mujoco.MjModel, start: Float[np.ndarray, " 7"], duration: float, push: Push, rng: np.random.Generator
) -> Recording:
    """Simulate from rest and sample the first seven joints, the arm's, at 100 Hz.

    Args:
        model: Arm with furniture; the furniture's joint is the last one and starts at 0.
        start: Posture of the arm [rad].
        duration: Length of the recording [s].
        push: Called before each step; adds the operator's forces to `qfrc_applied`.
        rng: Source of the encoder noise.
    """
    data = mujoco.MjData(model)
    data.qpos[: len(start)] = start
    substeps = round(1.0 / (RATE * model.opt.timestep))
    samples = []
    for _ in range(int(duration * RATE) + 1):
        samples.append(data.qpos.copy())
        for _ in range(substeps):
            mujoco.mj_step1(model, data)
            data.qfrc_applied[:] = 0.0
            push(model, data)
            mujoco.mj_step2(model, data)
    rows = np.array(samples)
    exact = rows[:, : len(start)]
    names = tuple(model.joint(i).name for i in range(len(start)))
    noisy = exact + rng.normal(0.0, ENCODER_NOISE, exact.shape)
    return Recording(np.arange(len(rows)) / RATE, noisy, exact, rows[:, -1], names)


def stays_inside(recording: Recording, robot: Robot) -> bool:
    """True if the arm keeps 0.15 rad from its position limits and 10 % from its velocity limits."""
    speed = np.abs(np.diff(recording.exact, axis=0)) * RATE
    return bool(
        np.all(recording.exact > robot.position_lower + LIMIT_MARGIN)
        and np.all(recording.exact < robot.position_upper - LIMIT_MARGIN)
        and np.all(speed < SPEED_SHARE * robot.velocity_limit)
    )
