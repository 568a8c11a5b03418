"""Where one joint lives in the configuration and in the tangent vector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, final

JointKind = Literal["revolute", "prismatic", "continuous", "floating", "planar", "other"]

COORDINATE_SUFFIXES: dict[str, tuple[str, ...]] = {
    "floating": (".x", ".y", ".z", ".rx", ".ry", ".rz"),
    "planar": (".x", ".y", ".rz"),
}


@final
@dataclass(frozen=True)
class JointBlock:
    """Slices of one independent joint.

    Attributes:
        name: Joint name in the URDF.
        kind: What moves.
        index: Pinocchio joint id.
        q: Slice in the public configuration (size nq).
        v: Slice in the public tangent vector (size nv).
        pin_q: Slice in Pinocchio's configuration, which also holds the mimic joints.
        pin_v: Slice in Pinocchio's tangent vector.
    """

    name: str
    kind: JointKind
    index: int
    q: slice
    v: slice
    pin_q: slice
    pin_v: slice

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        """One name a tangent coordinate: the joint's own, or `base.x`, `base.y`, ... for a floating or planar base."""
        width = self.v.stop - self.v.start
        if width == 1:
            return (self.name,)
        suffixes = COORDINATE_SUFFIXES.get(self.kind, tuple(f".{i}" for i in range(width)))
        return tuple(self.name + s for s in suffixes)


def joint_kind(short_name: str) -> JointKind:
    """Kind of a Pinocchio joint from its `shortname()`."""
    if short_name.startswith("JointModelRUB") or short_name == "JointModelRevoluteUnboundedUnaligned":
        return "continuous"
    if short_name.startswith(("JointModelR", "JointModelRevolute")):
        return "revolute"
    if short_name.startswith(("JointModelP", "JointModelPrismatic")) and short_name != "JointModelPlanar":
        return "prismatic"
    if short_name == "JointModelFreeFlyer":
        return "floating"
    if short_name == "JointModelPlanar":
        return "planar"
    return "other"
