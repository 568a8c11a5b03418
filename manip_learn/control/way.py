"""A way along what was learnt, simulated to its end: how far it came, how straight, how fast, and what stopped it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.control.command import Posture, Status, Vector
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.rollout import Rollout
from manip_learn.control.simulation import simulate
from manip_learn.control.tasks.driven_motion import Unit
from manip_learn.control.tasks.motion import DONE, FreeDirection
from manip_learn.errors import ConfigurationError
from manip_learn.recordings.load import Progress
from manip_learn.robot.robot import Robot

# [m or rad] that a hand may be off what holds it: the play of a drawer's rails; 5 mm press with 18 N on a stiff arm
STRAY = 2e-3
_AT_LIMIT = 2e-3  # [rad or m] a joint this near to its position limit stands at it: braking is exponential in the end
SLACK = 1.5  # [s] beyond the time that the way takes where nothing slows it down
_STANDING = 2.0  # [s] without progress after which the arm counts as stopped: a singular start is left within one
AT_REST = 0.3  # [s] that a motion is shown after its end
FROM_THE_BASE = 0.5  # cosine of the angle between the way and the direction from the base, from which on it leads away
_LONGEST = 4.0  # times the time that the way takes where nothing slows it down: then it counts as stopped
_BLOCKED = {Status.STALLED, Status.POSITION_LIMITED, Status.REROUTED, Status.OUTSIDE_LIMITS, Status.NULL_SCALED}
_SINGULAR = {Status.SINGULAR, Status.DAMPED, Status.STALLED}


@final
@dataclass(frozen=True)
class WayDone:
    """What became of a way.

    Attributes:
        wanted: The whole way [m or rad].
        done: How far it came [m or rad], with the sign of `wanted` if it went the right way.
        unit: `"m"` or `"rad"`.
        begins: Time at which the hand was at the mechanism [s]; None if it never was.
        seconds: Time from there until the way was done [s]; None if it was not.
        deviation: Largest distance off the held rows on the way [m or rad].
        least_manipulability: Of the rows held and driven, on the way.
        fastest: Name of the joint that came nearest to its velocity limit, and its speed as a share of that limit.
        stopped_by: What ended it before it was done, in words; None if it was done.
    """

    wanted: float
    done: float
    unit: Unit
    begins: float | None
    seconds: float | None
    deviation: float
    least_manipulability: float
    fastest: tuple[str, float]
    stopped_by: str | None

    @property
    def is_done(self) -> bool:
        """Whether the whole way was done, to a millimetre or 0.2 degrees."""
        return self.stopped_by is None

    @property
    def strays(self) -> bool:
        """Whether the hand left what holds it by more than that gives way."""
        return self.deviation > STRAY

    def to_dict(self) -> dict[str, Any]:
        """The JSON answer: lengths in m, angles in degrees."""
        size, unit = (1.0, "m") if self.unit == "m" else (float(np.degrees(1.0)), "deg")
        told = vars(self) | {"wanted": size * self.wanted, "done": size * self.done, "unit": unit}
        name, share = told.pop("fastest")
        return told | {"fastest_joint": {"name": name, "share_of_limit": share}}


def leads_away(handle: Float[np.ndarray, " 3"], way: Float[np.ndarray, " 3"]) -> bool:
    """Whether a hand goes away from the robot's base: it pushes a drawer in, for chests face who opens them."""
    out = handle * [1.0, 1.0, 0.0]
    return bool(way @ out > FROM_THE_BASE * np.linalg.norm(way) * np.linalg.norm(out))


def simulate_way(
    robot: Robot,
    controller: ResolvedRateController,
    q0: Sequence[float] | Posture,
    dt: float = 0.01,
    duration: float | None = None,
    *,
    progress: Progress | None = None,
) -> tuple[Rollout, WayDone]:
    """Simulate a controller whose task is a `FreeDirection`, until its way is done or no more of it comes.

    Args:
        robot: The robot.
        controller: Its task is the way.
        q0: Start posture.
        dt: Step [s].
        duration: [s]; None for as long as the way needs.
        progress: As for `simulate`.

    Returns:
        The rollout, cut shortly after the way was done or stood still, and what became of the way, as it keeps it.

    Raises:
        ConfigurationError: Another task; or as `simulate` raises it.
    """
    task = controller.task
    if not isinstance(task, FreeDirection):
        raise ConfigurationError(f"the task must be a way along what is free, as motion() makes it, not {task!r}")
    nominal = task.duration_from(robot.checked_posture(q0))
    longest = max(_LONGEST * nominal, nominal + SLACK)
    lengths = {nominal + SLACK, min(2.0 * (nominal + SLACK), longest), longest} if duration is None else {duration}
    for length in sorted(lengths):
        rollout = simulate(robot, controller, q0, length, dt, progress=progress)
        places, end = _places_of(task, rollout)
        if end is not None:
            break
    if end is not None and duration is None:
        rollout = rollout.until(end)
    done = _way_done(task, rollout, places[: len(rollout)], robot)
    return replace(rollout, ways=(done.to_dict(),)), done


def _places_of(task: FreeDirection, rollout: Rollout) -> tuple[Float[np.ndarray, " T"], float | None]:
    """Return how far the way had come at each sample [m or rad], NaN before it began, and when it ended [s].

    It ends a moment after it was done, or when the hand stood still for good; None if it goes on.
    """
    time, places, done = rollout.time, np.full(len(rollout), np.nan), DONE[task.unit]
    first = len(time) if task.way_begins is None else int(np.searchsorted(time, task.way_begins - 1e-9))
    meant = np.array([task.meant(t) for t in time.tolist()])
    place = 0.0
    # a path may come back to where it was: the goal says on which part it is
    for i, step in enumerate(np.diff(meant[first:], prepend=meant[first : first + 1]).tolist(), first):
        places[i] = place = task.progress_near(rollout.q[i], place + step)
    there = np.flatnonzero(np.abs(places - task.wanted) <= done)
    if len(there):
        return places, float(time[there[0]]) + AT_REST
    before = np.interp(time - _STANDING + 1e-9, time, places, left=np.nan)  # 1e-9 s against rounding
    still = np.flatnonzero((np.abs(places - before) < done) & (np.abs(places - meant) > done))  # and not as shown
    return places, float(time[still[0]]) if len(still) else None


def _way_done(task: FreeDirection, rollout: Rollout, places: Float[np.ndarray, " T"], robot: Robot) -> WayDone:
    """Return what became of a way, by how far it had come at each sample."""
    time, on = rollout.time, np.flatnonzero(np.isfinite(places))
    there = np.abs(places - task.wanted) <= DONE[task.unit]
    shares = np.max(np.abs(rollout.u) / robot.velocity_limit, axis=0)
    fastest = int(np.argmax(shares))
    return WayDone(
        task.counts * task.wanted,
        task.counts * float(places[-1] if len(on) else 0.0),
        task.unit,
        float(time[on[0]]) if len(on) else None,
        float(time[np.argmax(there)] - time[on[0]]) if there[-1] else None,
        max((task.deviation(rollout.q[i], places[i]) for i in on), default=0.0),
        float(np.min(rollout.manipulability[on if len(on) else [-1]])),
        (robot.joint_names[fastest], float(shares[fastest])),
        None if there[-1] else _reason(task, rollout, robot),
    )


def joint_at_limit(robot: Robot, positions: Vector) -> str | None:
    """The first joint that stands at a position limit, in words; None if none does."""
    for i, name in enumerate(robot.joint_names):
        for side, limit in (("lower", robot.position_lower[i]), ("upper", robot.position_upper[i])):
            if abs(positions[i] - limit) < _AT_LIMIT:
                return f"joint {name!r} at its {side} limit of {limit:.4g} {robot.joint_units[i]}"
    return None


def _reason(task: FreeDirection, rollout: Rollout, robot: Robot) -> str:
    """What stops the arm at the end of a rollout, in words."""
    last = rollout.status[-max(1, len(rollout) // 20) :]
    short = "" if task.way_begins is not None else "on its way to the mechanism: "
    joint = joint_at_limit(robot, robot.positions(rollout.q[-1]))
    if joint is not None and _BLOCKED.intersection(last):
        return short + joint
    if _SINGULAR.intersection(last):
        return f"{short}a singularity, or the end of the arm's reach"
    return f"{short}the time: still moving after {rollout.time[-1]:.4g} s"
