"""What a controller had to do to the command that it gives."""

from __future__ import annotations

from enum import StrEnum
from typing import final


@final
class Status(StrEnum):
    """The most serious thing that was done to a command; the members are in that order, most serious first.

    Members are strings: `command.status == "ok"` works, and files hold the words.

    Attributes:
        SINGULAR: A task direction is lost at this posture.
        POSITION_LIMITED: The task was slowed down for a position limit.
        VELOCITY_LIMITED: The task was slowed down for a velocity limit.
        DAMPED: The task part was damped near a singularity.
        REROUTED: Null-space motion keeps joints at their position limits from slowing the task down (saturation in the
            null space).
        NULL_SCALED: The null-space part was scaled down to what the limits leave beside the task, or projected onto the
            joints that are not at a limit.
        OK: The law as it stands.
    """

    SINGULAR = "singular"
    POSITION_LIMITED = "position-limited"
    VELOCITY_LIMITED = "velocity-limited"
    DAMPED = "damped"
    REROUTED = "rerouted"
    NULL_SCALED = "null-scaled"
    OK = "ok"


STATUSES = tuple(Status)  # the kernel returns a place in this table
