"""Limits as compiled control steps read them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from manip_learn.control.compiled import step_table as table
from manip_learn.control.limits import Limits
from manip_learn.linalg import Inverse
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.frame import Frame

LARGEST_ACCELERATION = 1e12  # [rad/s2] stands for none in the kernel, which must stay finite


def packed_limits(
    limits: Limits | None, nv: int, inverse: Inverse, threshold: float
) -> tuple[Float[np.ndarray, "2 12"], Float[np.ndarray, "nv 12"]]:
    """The two rows of settings and those of the degrees of freedom, as far as limits set them."""
    header, dofs = np.zeros((table.CHAIN, table.WIDTH)), np.zeros((nv, table.WIDTH))
    header[0, table.INVERSE], header[0, table.THRESHOLD] = table.INVERSES.index(inverse), threshold
    header[0, table.LIMITS] = limits is not None
    if limits is not None:
        dofs[:, :3] = np.stack((limits.velocity, limits.lower, limits.upper), axis=1)
        dofs[:, table.ACCELERATION] = np.minimum(limits.acceleration, LARGEST_ACCELERATION)
    return header, dofs


def tips_are_compiled(limits: Limits | None) -> bool:
    """Whether compiled code knows the chains of all frames whose speed or place is limited; True where none is."""
    return limits is None or limits.tip is None or all(_chain_of(limits, frame) for frame in limits.tip.frames)


def with_tips(constants: Float[np.ndarray, "rows 12"], limits: Limits | None) -> Float[np.ndarray, "all_rows 12"]:
    """A table of constants, with the limits of frames behind it where there are any."""
    if limits is None or limits.tip is None:
        return constants
    from manip_learn.robot.batch.compiled_kinematics import JOINTS  # and with it numba

    tip, numbers = limits.tip, np.zeros((1 + len(limits.tip.walls), table.WIDTH))
    numbers[0, table.N_FRAMES], numbers[0, table.N_WALLS] = len(tip.frames), len(tip.walls)
    numbers[0, table.TIP_SPEED], numbers[1:, :4] = tip.speed, tip.walls
    chains = [batch_kinematics(limits.robot, frame).chain_table("world") for frame in tip.frames]
    for chain in chains:
        chain[1, table.LENGTH] = len(chain) - JOINTS
    constants[table.CHAIN + 1, table.TIPS] = len(constants)
    return np.concatenate([constants, numbers, *chains])


def _chain_of(limits: Limits, frame: Frame) -> bool:
    kinematics = batch_kinematics(limits.robot, frame)
    return kinematics.fast and kinematics.public_columns is not None
