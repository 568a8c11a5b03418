"""Limits as compiled control steps read them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from manip_learn.control.compiled import step_table as table
from manip_learn.control.limits import Limits
from manip_learn.linalg import Inverse

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
