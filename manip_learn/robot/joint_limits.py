"""Limits of the independent joints, those of their followers included."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import pinocchio as pin
from jaxtyping import Float

from manip_learn.robot.description.coupling import Mimic
from manip_learn.robot.joint_block import JointBlock


@final
@dataclass(frozen=True, eq=False)
class JointLimits:
    """One entry a degree of freedom.

    Attributes:
        lower: shape (nv,) [rad or m], -inf where there is no limit.
        upper: shape (nv,) [rad or m], inf where there is no limit.
        velocity: shape (nv,) [rad/s or m/s], inf where there is no limit.
        warnings: Where followers narrow the limits of their leaders, or contradict them.
    """

    lower: Float[np.ndarray, " nv"]
    upper: Float[np.ndarray, " nv"]
    velocity: Float[np.ndarray, " nv"]
    warnings: tuple[str, ...]

    def __post_init__(self) -> None:
        for array in (self.lower, self.upper, self.velocity):
            array.setflags(write=False)


def joint_limits(model: pin.Model, blocks: Sequence[JointBlock], mimics: Sequence[Mimic]) -> JointLimits:
    """Limits of a model in which mimic joints are joints of their own, bound to their leaders."""
    nv = sum(b.v.stop - b.v.start for b in blocks)
    lower, upper, velocity = np.full(nv, -np.inf), np.full(nv, np.inf), np.full(nv, np.inf)
    for b in blocks:
        if b.kind in ("revolute", "prismatic"):
            lower[b.v], upper[b.v] = model.lowerPositionLimit[b.pin_q], model.upperPositionLimit[b.pin_q]
        limit = np.asarray(model.velocityLimit[b.pin_v])
        velocity[b.v] = np.where(limit > 0, limit, np.inf)
    leaders = {b.name: b for b in blocks}
    warnings: list[str] = []
    for m in mimics:
        warnings += _bind(m, leaders[m.leader], model, lower, upper, velocity)
    return JointLimits(lower, upper, velocity, tuple(warnings))


def _bind(
    m: Mimic, leader: JointBlock, model: pin.Model, lower: np.ndarray, upper: np.ndarray, velocity: np.ndarray
) -> list[str]:
    """A follower's limits bind its leader, seen through the multiplier."""
    joint, k = model.joints[model.getJointId(m.joint)], leader.v.start
    limit = float(model.velocityLimit[joint.idx_v])
    if m.multiplier == 0.0:
        return []
    if limit > 0:
        velocity[k] = min(velocity[k], limit / abs(m.multiplier))
    if joint.nq != 1:
        return []
    ends = (model.lowerPositionLimit[joint.idx_q], model.upperPositionLimit[joint.idx_q])
    if leader.kind == "continuous":
        if all(math.isinf(end) for end in ends):
            return []
        return [f"joint {m.leader!r} turns without end, so the limits of its follower {m.joint!r} are not enforced"]
    low, high = sorted((float(end) - m.offset) / m.multiplier for end in ends)
    # files round: a follower's limit may cut a hair off its leader's
    room = 1e-6 + 1e-4 * (high - low) if math.isfinite(high - low) else 0.0
    if low <= lower[k] + room and high >= upper[k] - room:
        return []
    narrow = max(low, lower[k]), min(high, upper[k])
    if narrow[0] >= narrow[1]:
        return [
            f"joint {m.joint!r} would need {m.leader!r} in {low:.4g} ... {high:.4g}, outside that joint's limits "
            f"{lower[k]:.4g} ... {upper[k]:.4g}; the limits of {m.joint!r} are ignored"
        ]
    lower[k], upper[k] = narrow
    return [f"joint {m.leader!r} is limited to {narrow[0]:.4g} ... {narrow[1]:.4g} by its follower {m.joint!r}"]
