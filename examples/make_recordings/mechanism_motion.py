"""Move an arm whose tip is held by a mechanism: Newton iterations on positions, so that nothing drifts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from make_recordings.arms import Arm

TOLERANCE = 1e-10  # [m] and [rad]
ITERATIONS = 12
LARGEST_STEP = 0.35  # [rad]; a larger one means that the arm is at a singularity or out of reach
WEAKEST = 0.05  # least singular value of the held rows of J, [m/rad] and [rad/rad]
CHECKED_EVERY = 15  # samples


class UnreachableError(RuntimeError):
    """The arm cannot go where the mechanism is, or not well; the draw is to be done again."""


@final
@dataclass(frozen=True)
class TipPath:
    """Where a mechanism and the person put the tip at each sample, in the base frame.

    Attributes:
        position: shape (T, 3) [m].
        rotation: shape (T, 3, 3), or None where the hand may turn.
        direction: shape (T, 3), unit vectors that `in_hand` has to point along, or None.
        in_hand: shape (3,), unit vector in the tip's frame that follows `direction`.
    """

    position: Float[np.ndarray, "T 3"]
    rotation: Float[np.ndarray, "T 3 3"] | None = None
    direction: Float[np.ndarray, "T 3"] | None = None
    in_hand: Float[np.ndarray, " 3"] | None = None

    def error(self, k: int, pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " r"]:
        """What is missing to sample k [m], [rad]; to first order the rows of `held` times a joint step."""
        missing = self.position[k] - pose[:3, 3]
        if self.rotation is not None:
            turn = _turn(self.rotation[k] @ pose[:3, :3].T)
        elif self.direction is not None:
            turn = _across(self.direction[k]) @ _cross(pose[:3, :3] @ self.in_hand, self.direction[k])
        else:
            return missing
        return np.concatenate([missing, turn])

    def held(self, k: int, J: Float[np.ndarray, "6 nv"]) -> Float[np.ndarray, "r nv"]:
        """The rows of the tip's Jacobian (base axes) that the path prescribes."""
        if self.rotation is not None:
            return J
        if self.direction is not None:
            return np.concatenate([J[:3], _across(self.direction[k]) @ J[3:]])
        return J[:3]


def follow(
    arm: Arm, start: Float[np.ndarray, " nv"], path: TipPath, wander: Float[np.ndarray, "T nv"]
) -> Float[np.ndarray, "T nv"]:
    """Joint motion [rad] along a path of the tip, wandering where the path leaves the arm free.

    At each sample the joints take the wander's step and are put back on the path by minimum-norm Newton steps
    q <- q + J^+ e(q), to 1e-10. The start is brought onto the path in the same way.

    Raises:
        UnreachableError: Out of reach, or too close to a singularity.
    """
    q, motion = np.array(start), np.empty((len(path.position), len(start)))
    steps = np.diff(wander, axis=0, prepend=wander[:1])
    for k in range(len(motion)):
        q = _onto(arm, path, k, q + steps[k])
        motion[k] = q
        if k % CHECKED_EVERY == 0:
            rows = path.held(k, arm.jacobian(q))
            if np.linalg.svd(rows, compute_uv=False)[-1] < WEAKEST:
                raise UnreachableError(f"near a singularity at sample {k}")
    return motion


def put(arm: Arm, start: Float[np.ndarray, " nv"], position: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " nv"]:
    """The posture [rad] near a start that has the tip at a position [m], the hand turned as it comes.

    Raises:
        UnreachableError: There is none near by.
    """
    return _onto(arm, TipPath(np.array([position])), 0, start)


def _onto(arm: Arm, path: TipPath, k: int, q: np.ndarray) -> np.ndarray:
    for _ in range(ITERATIONS):
        error = path.error(k, arm.pose(q))
        if np.abs(error).max() < TOLERANCE:
            return q
        rows = path.held(k, arm.jacobian(q))
        try:
            step = rows.T @ np.linalg.solve(rows @ rows.T, error)
        except np.linalg.LinAlgError as singular:
            raise UnreachableError(f"singular at sample {k}") from singular
        largest = np.abs(step).max()
        if k and largest > LARGEST_STEP:
            break
        q = q + step * min(1.0, LARGEST_STEP / largest)
    raise UnreachableError(f"out of reach at sample {k}")


def _turn(rotation: np.ndarray) -> np.ndarray:
    """sin(angle) times axis: the rotation vector to third order."""
    return 0.5 * np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _across(axis: np.ndarray) -> np.ndarray:
    """Two unit rows across an axis and each other."""
    other = np.zeros(3)
    other[int(np.argmin(np.abs(axis)))] = 1.0
    first = _cross(axis, other)
    first /= np.sqrt(first @ first)
    return np.array([first, _cross(axis, first)])
