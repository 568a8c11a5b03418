"""A way along whatever was learnt, in one call: by metres where it slides, by radians where it turns."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.mechanism_rows import MechanismRows
from manip_learn.constraint.mechanism import Mechanism
from manip_learn.control.tasks.driven_motion import Unit
from manip_learn.control.tasks.free_direction import FreeDirection
from manip_learn.control.tasks.mechanism_motion import place_about
from manip_learn.errors import ConstraintError, TargetError, advice

HAND_SPEED = 0.1  # [m/s] of the hand where none is asked for: a drawer of 0.3 m in 3.5 s, less than half of ISO 10218-1
TURN_SPEED = 0.5  # [rad/s] at most, of a hand near the axis: 0.1 m/s at 0.2 m
# what a mechanism allows; the others (a cylinder, a held orientation) slide and turn
SLIDES, TURNS = ("line", "plane"), ("hinge", "screw", "ball")


def motion(
    constraint: Constraint,
    along: float | None = None,
    turn: float | None = None,
    *,
    direction: ArrayLike | str | None = None,
    speed: float | None = None,
    keep_orientation: bool = False,
    pause: float = 0.0,
) -> FreeDirection:
    """A task: the hand goes along what the constraint leaves free, and holds what it holds.

    If the hand is not on the mechanism, it first goes straight to the nearest place at which the task was shown and
    from which the way stays within what was shown; that place is known for constraints that were learnt with a loose
    grip. Where several translations are free, those beside the way stand still.

    Args:
        constraint: Learnt or written by hand; the controller gets the same.
        along: Way [m], of a line, a plane, or another mechanism that slides; negative for the other way. Along a line
            the positive sense is that of the largest number of its direction.
        turn: Angle [rad], of a hinge, a screw, a ball; right-handed about its axis.
        direction: Which way, where several are free: along a plane three numbers, or one per row of the features; about
            a ball the axis of the turn; of a cylinder the name of a row (`"tangential"`, `"axial"`).
        speed: Largest rate [m/s or rad/s]; by default the hand moves at 0.1 m/s.
        keep_orientation: The hand does not turn either, as of a gripper that has closed on a handle.
        pause: Time at rest on the mechanism before the way begins, as to close a gripper [s]; the null-space policy
            uses it to leave a bad posture.

    Returns:
        A `FreeDirection`.

    Raises:
        TargetError: Neither of `along` and `turn`, or both; a number that is none; a direction that is held.
        ConstraintError: The mechanism does not move that way, nothing is free, or several directions are and none was
            named; says which are.

    >>> import manip_learn as ml
    >>> robot = ml.load_robot("sawyer")
    >>> drawer = ml.Constraint([[0, 1, 0], [0, 0, 1]], ml.FrameJacobian(robot, "right_gripper_tip"))
    >>> ml.motion(drawer, along=0.3)
    FreeDirection(distance=0.3 m, speed=0.1 m/s)
    """
    if (along is None) == (turn is None):
        raise TargetError(
            "say how far to go, once"
            + advice(": {}", "along=0.3 [m] or turn=0.7 [rad]", "--along 0.3 (metres) or --turn 40 (degrees)")
        )
    unit: Unit = "m" if turn is None else "rad"
    known = constraint.mechanism
    _check_way(known, unit)
    if speed is None:
        lever = 0.0 if known is None or known.radius is None else known.radius
        speed = HAND_SPEED if unit == "m" else min(TURN_SPEED, HAND_SPEED / lever if lever > 0.0 else math.inf)
    return FreeDirection(
        constraint,
        along if along is not None else turn,  # type: ignore[arg-type]  # one of the two was given
        speed,
        direction=direction,
        unit=unit,
        straight=True,
        keep_orientation=keep_orientation,
        pause=pause,
        take_hold=True,
    )


def motion_to(
    constraint: Constraint,
    point: ArrayLike,
    q: ArrayLike,
    *,
    speed: float | None = None,
    keep_orientation: bool = False,
) -> FreeDirection:
    """A task: a hand on a hinge or a screw turns it until it is as near to a point as the mechanism allows.

    Args:
        constraint: Of rows of a mechanism.
        point: shape (3,), in the base frame [m].
        q: Posture of the hand at the start, on the mechanism.
        speed: As for `motion`.
        keep_orientation: As for `motion`.

    Raises:
        TargetError: Not three finite numbers, a hand that is not on the mechanism or next to the point already.
        ConstraintError: A mechanism that does not turn about an axis.
    """
    rows, known = constraint.about_its_mechanism().features, constraint.mechanism
    if not isinstance(rows, MechanismRows) or known is None or known.type not in ("hinge", "screw"):
        raise ConstraintError(
            "what was learnt turns about no one axis, towards a point: say how far to go"
            + advice(" with {}", "motion(constraint, along=... | turn=...)", "--along or --turn")
        )
    try:
        place = np.array(point, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise TargetError(f"the point must be three numbers, got {point!r}") from error
    if place.shape != (3,) or not np.all(np.isfinite(place)):
        raise TargetError(f"the point must be three finite numbers (x, y, z) [m], got {point!r}")
    g, here = rows.geometry, rows.robot.position(q, rows.frame)
    angle = place_about(here - g.point, place - g.point, g, 0.0)["tangential"]
    if abs(angle) < 1e-6:
        raise TargetError("the hand is as near to the point as the mechanism allows: name another")
    task = motion(constraint, turn=angle, speed=speed, keep_orientation=keep_orientation)
    far = task.hold(q)
    if far > 0.0:
        raise TargetError(
            f"the hand is {far:.3g} m away from the {known.type}: start on it, or say how far to turn"
            + advice(" with {}, which goes there first", "motion(constraint, turn=...)", "--turn")
        )
    return task


def _check_way(known: Mechanism | None, unit: Unit) -> None:
    """Refuse to turn what slides, and to slide what turns."""
    if known is None or known.type not in (TURNS if unit == "m" else SLIDES):
        return
    does, fits = (
        ("turns and does not slide", advice(": use {}", "turn= [rad]", "--turn DEGREES"))
        if unit == "m"
        else ("slides and does not turn", advice(": use {}", "along= [m]", "--along METRES"))
    )
    raise ConstraintError(f"what was learnt {does} ({known.sentence}){fits}")
