"""Orientations in which a hand may take hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from manip_learn.errors import TargetError
from manip_learn.linalg import finite
from manip_learn.robot.rotations import rotation_matrix

SPINS = 24  # of a hand that may turn about its axis by any angle: every 15 degrees
_ROUNDING = 1e-6  # of a cosine: a hand whose axis stands still counts as inside a cone of no width
TILTS = 48  # of a hand whose axis may tilt


@final
@dataclass(frozen=True, eq=False)
class GraspCone:
    """The hand may take hold with an axis of its own inside a cone.

    A parallel gripper that is the same after half a turn: `GraspCone(turns=2)`. A round knob: `GraspCone(turns=None)`.
    A hand that comes from above, within 30 degrees: `GraspCone(angle=0.52, turns=None, direction=(0, 0, -1))`.

    Args:
        axis: shape (3,), of the hand: the way its fingers point, in its frame.
        angle: Largest angle between that axis and the direction [rad].
        turns: In how many orientations about the axis, evenly apart, the hand takes hold alike; None for all of them.
        direction: shape (3,), where the axis should point when the hand takes hold, in the base frame; None for where
            it points at the start.

    Raises:
        TargetError: Axes that are not three finite numbers, a negative angle, no orientation at all.
    """

    axis: ArrayLike = (0.0, 0.0, 1.0)
    angle: float = 0.0
    turns: int | None = 1
    direction: ArrayLike | None = None

    def __post_init__(self) -> None:
        for name in ("axis", "direction"):
            given = getattr(self, name)
            if given is None:
                continue
            vector = finite(given, 3)
            if vector is None or not vector.any():
                raise TargetError(f"the {name} of a grasp must be three finite numbers not all zero, got {given!r}")
            object.__setattr__(self, name, vector / np.linalg.norm(vector))
        if not 0.0 <= self.angle <= np.pi:
            raise TargetError(f"the angle of a grasp cone must be from 0 to pi [rad], got {self.angle!r}")
        if self.turns is not None and self.turns < 1:
            raise TargetError(f"a hand takes hold in one orientation at least, got turns={self.turns!r}")

    def toward(self, shown: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 3"]:
        """Where the axis should point, in the base frame.

        Args:
            shown: Orientation of the hand at the start.
        """
        return shown @ np.asarray(self.axis) if self.direction is None else np.asarray(self.direction)

    def orientations(self, shown: Float[np.ndarray, "3 3"], rng: np.random.Generator) -> Float[np.ndarray, "g 3 3"]:
        """Orientations of the hand inside the cone, that next to the one shown first.

        Args:
            shown: Orientation of the hand at the start.
            rng: Random numbers of the tilts.
        """
        wanted, axis = self.toward(shown), np.asarray(self.axis)
        upright = _least_turn(shown @ axis, wanted) @ shown
        spins = np.arange(self.turns or SPINS) * 2.0 * np.pi / (self.turns or SPINS)
        spun = upright @ Rotation.from_rotvec(spins[:, None] * axis).as_matrix()
        if self.angle == 0.0:
            return spun
        across = np.linalg.svd(wanted[None])[2][1:]
        # even over the cap of the sphere that the cone cuts out
        tilt = np.arccos(1.0 - rng.uniform(0.0, 1.0, TILTS) * (1.0 - np.cos(self.angle)))
        turn = rng.uniform(0.0, 2.0 * np.pi, TILTS)
        about = np.cos(turn)[:, None] * across[0] + np.sin(turn)[:, None] * across[1]
        tilted = Rotation.from_rotvec(tilt[:, None] * about).as_matrix()
        chosen = spun[rng.integers(len(spun), size=TILTS)]
        if self.turns is None:
            chosen = upright @ Rotation.from_rotvec(rng.uniform(0.0, 2.0 * np.pi, (TILTS, 1)) * axis).as_matrix()
        return np.concatenate([upright[None], tilted @ chosen])

    def holds(
        self, orientations: Float[np.ndarray, "n 3 3"], toward: Float[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """Which hands have their axis in the cone about a direction each."""
        cosine = np.sum((orientations @ np.asarray(self.axis)) * toward, axis=1)
        return cosine >= np.cos(self.angle) - _ROUNDING


def _least_turn(a: Float[np.ndarray, " 3"], b: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation by the least angle from one unit vector to another; one of them where they are opposite."""
    axis, cosine = np.cross(a, b), float(a @ b)
    sine = float(np.linalg.norm(axis))
    if sine < _ROUNDING:
        axis, sine = np.linalg.svd(a[None])[2][1], 1.0
        return rotation_matrix((0.0 if cosine > 0.0 else np.pi) * axis)
    return rotation_matrix(np.arctan2(sine, cosine) / sine * axis)
