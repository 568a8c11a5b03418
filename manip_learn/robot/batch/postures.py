"""Many postures at once: checked like a single one, and turned into joint positions."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.errors import ConfigurationError
from manip_learn.robot.robot import Robot

SHORTEST_UNIT = 1e-6  # a (cos, sin) below this length has no direction


def checked_postures(robot: Robot, q: ArrayLike) -> Float[np.ndarray, "n width"]:
    """Postures, one per row, each a configuration (nq) or joint positions (nv).

    Raises:
        ConfigurationError: Not a table of nq or nv columns, or NaN or infinity; names the first bad row and joint.
    """
    try:
        table = np.ascontiguousarray(q, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigurationError(f"postures must be a table of numbers, not {type(q).__name__}: {error}") from error
    if table.ndim != 2 or table.shape[1] not in (robot.nq, robot.nv):
        sizes = (
            f"{robot.nv}" if robot.nq == robot.nv else f"{robot.nq} (configurations) or {robot.nv} (joint positions)"
        )
        raise ConfigurationError(
            f"postures of {robot.name!r} must be a table of n rows and {sizes} columns, this one has shape "
            f"{table.shape}; joints in order: {', '.join(robot.joint_names)}"
        )
    finite = np.isfinite(table)
    if not finite.all():
        row, column = (int(k) for k in np.argwhere(~finite)[0])
        where = f"joint {robot.joint_names[column]!r}" if table.shape[1] == robot.nv else f"entry {column}"
        for block in robot.blocks if table.shape[1] != robot.nv else ():
            if block.q.start <= column < block.q.stop:
                where = f"joint {block.name!r} (entry {column})"
        value = table[row, column]
        raise ConfigurationError(
            f"postures of {robot.name!r}: row {row}, {where} is {value}, a finite number is needed"
        )
    for block in robot.blocks if table.shape[1] != robot.nv else ():
        length = np.hypot(*table[:, block.q].T) if block.kind == "continuous" else np.ones(0)
        if length.size and length.min() < SHORTEST_UNIT:
            row = int(np.argmin(length))
            raise ConfigurationError(
                f"postures of {robot.name!r}: row {row}, joint {block.name!r}: its (cos, sin) is "
                f"{table[row, block.q]}, which has no direction; it must have length 1"
            )
    return table


def positions_of(robot: Robot, postures: Float[np.ndarray, "n width"]) -> Float[np.ndarray, "n nv"]:
    """Joint positions (nv) [rad or m] of checked postures; for joints of one degree of freedom, others are left 0."""
    if postures.shape[1] == robot.nv:
        return postures
    out = np.zeros((postures.shape[0], robot.nv))
    for block in robot.blocks:
        if block.kind == "continuous":
            out[:, block.v.start] = np.arctan2(postures[:, block.q.start + 1], postures[:, block.q.start])
        elif block.v.stop - block.v.start == 1:
            out[:, block.v.start] = postures[:, block.q.start]
    return out


def unwound(robot: Robot, postures: Float[np.ndarray, "n width"]) -> Float[np.ndarray, "n nv"]:
    """Joint positions of a motion, without jumps by full turns where a configuration has none.

    Args:
        robot: The robot.
        postures: Configurations or joint positions, in order of time.
    """
    positions = positions_of(robot, postures)
    return positions if postures.shape[1] == robot.nv else np.unwrap(positions, axis=0)
