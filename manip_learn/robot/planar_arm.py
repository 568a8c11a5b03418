"""URDF text of a planar arm with any number of links and lengths."""

from __future__ import annotations

from collections.abc import Sequence


def planar_arm_urdf(lengths: Sequence[float] = (1.0, 1.0, 1.0), name: str = "planar3") -> str:
    raise NotImplementedError
