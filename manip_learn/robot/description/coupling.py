"""How all joints of a robot follow from the independent ones: the linear map that mimic joints define."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float


@final
@dataclass(frozen=True)
class Mimic:
    """One mimic joint: position = multiplier * position of `leader` + offset."""

    joint: str
    leader: str
    multiplier: float
    offset: float


@final
@dataclass(frozen=True)
class Coupling:
    """Positions and velocities of all joints as an affine map of the independent ones.

    positions_all = lift @ positions + offset;  velocities_all = lift @ velocities.

    Attributes:
        lift: shape (nv_all, nv).
        offset: shape (nv_all,) [rad or m].
    """

    lift: Float[np.ndarray, "n_all nv"]
    offset: Float[np.ndarray, " n_all"]

    def __post_init__(self) -> None:
        self.lift.setflags(write=False)
        self.offset.setflags(write=False)
