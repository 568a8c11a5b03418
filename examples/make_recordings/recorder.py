"""Let the physics run and keep what the encoders see."""

# pyright: reportAttributeAccessIssue=false
# (the compiled parts of MuJoCo have no complete stubs)
from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import final

import mujoco
import numpy as np
from jaxtyping import Float

from make_recordings.csv_file import write_csv
from manip_learn.robot import Robot, load_robot

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


def usable(
    attempt: Callable[[np.random.Generator], tuple[Recording | None, float]],
    number: int,
    robot: Robot,
    seed: int,
    attempts: int,
) -> Recording:
    """Demonstration `number`, counted from 1; it depends on the seed and its number only.

    An attempt in which the arm comes close to a limit, the furniture shuts or the handle is out of reach is repeated,
    as a person would do.

    Args:
        attempt: rng -> what was recorded, None where the handle is out of reach; and how far the furniture was open at
            the start [m or rad].
        number: Of the demonstration.
        robot: The arm.
        seed: Root of the random numbers.
        attempts: So many are made.

    Raises:
        RuntimeError: No attempt was usable.
    """
    for i in range(attempts):
        recording, opened = attempt(np.random.default_rng([seed, number, i]))
        if recording and stays_inside(recording, robot) and recording.way.min() > -opened:
            return recording
    raise RuntimeError(f"demonstration {number}: {attempts} tries and none was good; make the disturbance smaller")


Columns = tuple[Float[np.ndarray, " T"], Mapping[str, Float[np.ndarray, " T"]]]


def as_recorded(recording: Recording) -> Columns:
    """Time [s], and joint -> positions [rad]."""
    return recording.time, dict(zip(recording.joint_names, recording.q.T, strict=True))


def write_demonstrations(
    what: str, count: int, written: Callable[[int, Robot], Columns], arguments: list[str] | None
) -> None:
    """A script's work: write all demonstrations with the Sawyer, or one.

    Args:
        what: Is recorded, for the help.
        count: Number of demonstrations.
        written: (number, robot) -> time and columns of its file.
        arguments: Of the command line; None for those of this process.
    """
    parser = argparse.ArgumentParser(description=f"Record the {what} demonstrations with MuJoCo.")
    parser.add_argument("folder", type=Path, help="folder for demo_01.csv ...")
    parser.add_argument("--only", type=int, help="number of the one demonstration to record")
    options = parser.parse_args(arguments)
    robot = load_robot("sawyer")
    for number in [options.only] if options.only else range(1, count + 1):
        write_csv(options.folder / f"demo_{number:02d}.csv", *written(number, robot))
