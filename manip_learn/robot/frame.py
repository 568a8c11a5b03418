"""A frame of a robot, looked up once so that a wrong name can never reach Pinocchio (which would crash)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final


@final
@dataclass(frozen=True)
class Frame:
    """A named frame.

    Attributes:
        name: Name in the URDF (a link, else a joint).
        index: Pinocchio frame id.
        parent_joint: Pinocchio id of the joint that carries it; 0 is the fixed world.
    """

    name: str
    index: int
    parent_joint: int


FrameLike = str | Frame  # what every method of `Robot` takes; a `Frame` saves the look-up
