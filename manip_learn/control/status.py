"""What a controller had to do to the command that it gives."""

from __future__ import annotations

from enum import StrEnum
from typing import final


@final
class Status(StrEnum):
    """The most serious thing that was done to a command; the members are in that order, most serious first.

    Members are strings: `command.status == "ok"` works, and files hold the words.

    Attributes:
        INVALID_INPUT: The posture or the time is not a number, or the controller failed: the arm brakes and stands
            (`ServoLoop`).
        STALE: No new state for too long: the arm brakes and stands (`ServoLoop`).
        FOLLOWING_ERROR: The measured posture is too far from the commanded one: the arm brakes and stands
            (`ServoLoop`).
        STOPPED: `ServoLoop.stop` was called: the arm brakes and stands.
        OUTSIDE_LIMITS: A joint is outside its position limits, and returns where it can.
        SINGULAR: A task direction is lost at this posture.
        STALLED: The task has not reached its goal and does not approach it: less than a hundredth of the velocity asked
            for is left along it, because limits or a singularity block the rest.
        POSITION_LIMITED: The task was slowed down for a position limit.
        VELOCITY_LIMITED: The task was slowed down for a velocity limit.
        ACCELERATION_LIMITED: The task was slowed down for an acceleration limit.
        DAMPED: The task part was damped near a singularity.
        REROUTED: Null-space motion keeps limits from slowing the task down (saturation in the null space).
        NULL_SCALED: The null-space part was changed to what the limits leave beside the task.
        OK: The law as it stands.
    """

    INVALID_INPUT = "invalid-input"
    STALE = "stale"
    FOLLOWING_ERROR = "following-error"
    STOPPED = "stopped"
    OUTSIDE_LIMITS = "outside-limits"
    SINGULAR = "singular"
    STALLED = "stalled"
    POSITION_LIMITED = "position-limited"
    VELOCITY_LIMITED = "velocity-limited"
    ACCELERATION_LIMITED = "acceleration-limited"
    DAMPED = "damped"
    REROUTED = "rerouted"
    NULL_SCALED = "null-scaled"
    OK = "ok"


STATUSES = tuple(Status)  # the kernel returns a place in this table
