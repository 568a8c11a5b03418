"""Simulation of a controller from one start or many, and of a motion along a free direction until it is complete."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Any, final, overload

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.command import Command, Controller, LimitedController, Posture, Status, Vector
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.rollout import Rollout, written_constraint
from manip_learn.control.servo_loop import ServoLoop
from manip_learn.control.tasks.driven_motion import Unit
from manip_learn.control.tasks.motion import DONE, FreeDirection
from manip_learn.errors import ConfigurationError, advice, an
from manip_learn.recordings.load import Progress
from manip_learn.robot.identity import RobotIdentity
from manip_learn.robot.robot import Robot

Start = Sequence[float] | Posture
Starts = Sequence[Sequence[float]]
Sample = tuple[float, Posture, Command, float]  # time [s], posture, command, distance to the task's goal [m or rad]


@overload
def simulate(
    robot: Robot | None, controller: Controller, q0: Start, duration: float = ..., dt: float = ..., **options: Any
) -> Rollout: ...


@overload
def simulate(
    robot: Robot | None, controller: Controller, q0: Starts, duration: float = ..., dt: float = ..., **options: Any
) -> tuple[Rollout, ...]: ...


def simulate(
    robot: Robot | None,
    controller: Controller,
    q0: ArrayLike,
    duration: float = 5.0,
    dt: float = 0.01,
    *,
    progress: Progress | None = None,
    **removed: Any,
) -> Rollout | tuple[Rollout, ...]:
    """Simulate a controller: integrate its commands on the robot's configuration manifold, in steps of dt.

    Args:
        robot: The robot; None for a system whose state is a plain vector.
        controller: A `ResolvedRateController`, a `ServoLoop`, or any callable `(q, t, dt) -> Command`.
        q0: Start posture: joint positions (nv,) [rad or m] or a configuration (nq,); the rollout has the same kind of
            postures. Or a table of starts, one per row.
        duration: Simulated time [s].
        dt: Step, for which each command is applied [s].
        progress: Function that is called with a title and the completed fraction, 0 to 1; None for none.
        **removed: The former argument `method`, valid until 0.3.

    Returns:
        A `Rollout` of round(duration / dt) + 1 samples, including the start; for a table of starts a tuple of rollouts,
        one per start.

    Raises:
        ConfigurationError: The arguments are in the wrong order; the start has the wrong size or is not finite; the
            step is not positive or the duration is negative.
        TypeError: An unknown argument.

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("planar3")
        >>> constraint = ml.Constraint([[0, 1]], ml.FrameJacobian(robot, "tip", axes="x y"))
        >>> controller = ml.ResolvedRateController(constraint, ml.PointAttractor([1.0, 1.5]))
        >>> rollout = ml.simulate(robot, controller, [0.3, 0.8, 0.4], duration=2.0, dt=0.01)
        >>> rollout.q.shape, rollout.u.shape
        ((201, 3), (201, 3))
    """
    runs = isinstance(controller, ServoLoop) or (callable(controller) and not isinstance(controller, Constraint | type))
    is_start = not (q0 is None or callable(q0) or isinstance(q0, Robot | str))
    if not ((robot is None or isinstance(robot, Robot)) and runs and is_start):
        got = f"{an(robot)}, {an(controller)} and {an(q0)}"
        raise ConfigurationError(f"call simulate(robot, controller, q0): got {got}, in this order")
    if not (np.isfinite(dt) and dt > 0.0 and np.isfinite(duration) and duration >= 0.0):
        raise ConfigurationError(f"duration and dt must be positive numbers of seconds, got {duration!r} and {dt!r}")
    if removed and removed != {"method": "euler"}:
        raise TypeError(f"simulate has no {removed}: each command is held for its step, give a smaller dt")
    size = 16.0 * np.size(q0) * (duration / dt)  # [bytes] of postures and velocities
    try:
        np.empty(int(min(size, 2.0**62)), dtype=np.uint8)
    except MemoryError as error:
        fix = advice("take {}", "a shorter duration or a larger dt", "a shorter --duration or a larger --dt")
        raise ConfigurationError(f"{duration / dt:.3g} steps take {size / 1e9:.3g} GB of memory: {fix}") from error
    steps, table = round(duration / dt), np.ndim(q0) == 2
    # a wrong row is named before any work is done
    checked = q0 if robot is None else robot.checked_postures(q0) if table else robot.checked_posture(q0)
    starts = np.array(checked, dtype=np.float64, ndmin=2)
    native = controller.native if isinstance(controller, ResolvedRateController) and controller.robot is robot else None
    rollouts, inner = list[Rollout](), None if table else progress
    # blocks of 256 starts: larger ones hold memory twice, smaller ones leave cores idle at the end of each block
    for block in np.split(starts, range(256, len(starts), 256)) if len(starts) else ():
        whole = repeat(None) if native is None else native.rollouts(controller, block, dt, steps, inner)
        for start, rollout in zip(block, whole, strict=False):  # None where single steps are needed
            rollouts.append(rollout or _rollout(robot, controller, start, steps, dt, inner))
            if table and progress is not None:
                progress("simulating", len(rollouts) / len(starts))
    return tuple(rollouts) if table else rollouts[0]


def _rollout(robot: Robot | None, controller: Any, q: Posture, n: int, dt: float, report: Progress | None) -> Rollout:
    """Return the rollout from one start, in n steps; the library's own controllers run in a servo loop."""
    step, task_error = (lambda q, t: controller(q, t, dt)), getattr(controller, "task_error", lambda q, t: np.nan)
    if isinstance(controller, ServoLoop):
        controller.reset(q)
        step = controller.update
    elif isinstance(controller, LimitedController) and controller.limits is not None:
        step = ServoLoop(controller, dt, stale_after=max(0.1, 10.0 * dt)).step
    samples = list[Sample]()
    for t in (np.arange(n + 1) * dt).tolist():
        command = step(q, t)
        samples.append((t, q, command, task_error(q, t)))
        if len(samples) <= n:
            q = q + dt * command.velocity if robot is None else robot.integrate(q, dt * command.velocity)
        if report is not None:
            report("simulating", len(samples) / (n + 1))
    return rollout_of(robot, controller, samples)


def rollout_of(robot: Robot | None, controller: Controller | ServoLoop, samples: Sequence[Sample]) -> Rollout:
    """Return samples as a rollout, with the description of their controller.

    Args:
        robot: The robot; None for a system without a robot.
        controller: Controller that computed the commands.
        samples: T samples: time [s], posture, command, and distance to the task's goal [m or rad]. At least one if
            there is no robot.
    """
    time, q, commands, errors = zip(*samples, strict=True) if samples else ((),) * 4
    names = tuple(f"q{i}" for i in range(len(samples[0][2].velocity))) if robot is None else robot.joint_names
    q, u = (np.reshape(x, (len(samples), -1 if samples else len(names))) for x in (q, [c.velocity for c in commands]))
    mu, following = (np.array([getattr(c, name) for c in commands]) for name in ("manipulability", "following_error"))
    fields, identity = guided(controller), None if robot is None else RobotIdentity.of(robot)
    fields |= {"robot": identity, "following_error": following if isinstance(controller, ServoLoop) else None}
    return Rollout(np.array(time), q, u, mu, tuple(c.status for c in commands), names, np.array(errors), **fields)


def guided(controller: Controller | ServoLoop) -> dict[str, Any]:
    """Return the frame, target and constraint of a controller, as fields of a `Rollout`.

    Args:
        controller: A controller, or a `ServoLoop` with one.

    Returns:
        The fields `frame`, `target` and `constraint`; empty for a joint motion or a controller of your own.
    """
    law = controller.controller if isinstance(controller, ServoLoop) else controller
    if not isinstance(law, LimitedController) or law.law is None:
        return {}
    return {"frame": law.frame or "", "target": law.law.task.goal(), "constraint": written_constraint(law.constraint)}


@final
@dataclass(frozen=True)
class WayDone:
    """Outcome of a motion along a free direction.

    Attributes:
        wanted: Requested distance [m or rad], signed.
        done: Distance covered [m or rad], with the sign of `wanted` if the hand moved in the requested direction.
        unit: Unit of both distances, `"m"` or `"rad"`.
        begins: Time at which the hand was at the mechanism and the motion began [s]; None if it did not begin.
        seconds: Duration from `begins` until the motion was complete [s]; None if it was not completed.
        deviation: Largest deviation of the held rows during the motion [m or rad].
        least_manipulability: Smallest manipulability of held and driven rows together during the motion.
        fastest: Name of the joint that came nearest to its velocity limit, and its speed as a share of that limit.
        stopped_by: Reason for an incomplete motion, in words; None if it was complete.
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
        """True if the whole distance was covered, within a tolerance of 1 mm or 0.2 degrees."""
        return self.stopped_by is None

    @property
    def strays(self) -> bool:
        """True if the hand left its constraint by more than 2 mm or 2 mrad, the typical backlash of a mechanism."""
        return self.deviation > 2e-3  # [m or rad] play of a drawer's rails; 5 mm press with 18 N on a stiff arm

    def to_dict(self) -> dict[str, Any]:
        """Return the outcome as a dictionary for JSON; `wanted` and `done` are in m or degrees, as `unit` states.

        Returns:
            The attributes by name (`deviation` in m or rad); instead of `fastest`, `fastest_joint` with `name` and
            `share_of_limit`.
        """
        size, unit = (1.0, "m") if self.unit == "m" else (float(np.degrees(1.0)), "deg")
        content = vars(self) | {"wanted": size * self.wanted, "done": size * self.done, "unit": unit}
        name, share = content.pop("fastest")
        return content | {"fastest_joint": {"name": name, "share_of_limit": share}}


def leads_away(handle: Float[np.ndarray, " 3"], way: Float[np.ndarray, " 3"]) -> bool:
    """Return True if a hand moves away from the robot's base, so that it pushes a drawer in rather than pulls it out.

    Args:
        handle: Position of the handle in the base frame (3,) [m].
        way: Displacement of the hand in the base frame (3,) [m].
    """
    out = handle * [1.0, 1.0, 0.0]
    return bool(way @ out > 0.5 * np.linalg.norm(way) * np.linalg.norm(out))  # cosine of the angle between them


def simulate_way(
    robot: Robot,
    controller: ResolvedRateController,
    q0: Start,
    dt: float = 0.01,
    duration: float | None = None,
    *,
    progress: Progress | None = None,
) -> tuple[Rollout, WayDone]:
    """Simulate a controller whose task is a `FreeDirection`, until the motion is complete or makes no more progress.

    Args:
        robot: The robot.
        controller: Controller with the `FreeDirection` as its task.
        q0: Start posture: a configuration (nq,) or joint positions (nv,) [rad or m].
        dt: Step [s].
        duration: Simulated time [s]; None for as long as the motion needs.
        progress: Function that is called with a title and the completed fraction, 0 to 1; None for none.

    Returns:
        The rollout and the outcome. Without `duration` the rollout ends shortly after the motion was complete or
        stopped. The outcome is also in the rollout's `ways`.

    Raises:
        ConfigurationError: The task is not a `FreeDirection`, or an error of `simulate`.
    """
    task = controller.task
    if not isinstance(task, FreeDirection):
        raise ConfigurationError(f"expected the task returned by motion(), got {task!r}")
    nominal, slack = task.duration_from(robot.checked_posture(q0)), 1.5  # [s] slack: beyond the undisturbed duration
    longest = max(4.0 * nominal, nominal + slack)  # [s] after which it counts as stopped
    lengths = {min(times * (nominal + slack), longest) for times in (1.0, 2.0, 4.0)}
    for length in sorted(lengths) if duration is None else [duration]:
        rollout = simulate(robot, controller, q0, length, dt, progress=progress)
        places, end = _measure_progress(task, rollout)
        if end < np.inf:
            break
    rollout = rollout.until(end if duration is None else np.inf)
    outcome = _describe_outcome(task, rollout, places[: len(rollout)], robot)
    return replace(rollout, ways=(outcome.to_dict(),)), outcome


def _measure_progress(task: FreeDirection, rollout: Rollout) -> tuple[Float[np.ndarray, " T"], float]:
    """Return the progress of the motion at each sample [m or rad], NaN before it began, and the time of its end [s].

    It ends a moment after it is complete, or when the hand has come to a permanent stop; inf if it goes on.
    """
    time, places, tolerance = rollout.time, np.full(len(rollout), np.nan), DONE[task.unit]
    first = len(time) if task.way_begins is None else int(np.searchsorted(time, task.way_begins - 1e-9))
    goals = np.array([task.meant(t) for t in time.tolist()])
    place = 0.0
    # a path may cross itself: the goal determines the branch
    for i, step in enumerate(np.diff(goals[first:], prepend=goals[first : first + 1]).tolist(), first):
        places[i] = place = task.progress_near(rollout.q[i], place + step)
    there = np.abs(places - task.wanted) <= tolerance
    # 2 s without progress count as stopped, because a singular start is left within one; 1e-9 s against rounding
    before = np.interp(time - 2.0 + 1e-9, time, places, left=np.nan)
    # a pause of the demonstration is no stop
    still = (np.abs(places - before) < tolerance) & (np.abs(places - goals) > tolerance)
    pause = 0.3  # [s] that a motion is shown after its end
    return places, next(iter([*(time[there] + pause), *time[still]]), np.inf)


def _describe_outcome(task: FreeDirection, rollout: Rollout, places: Float[np.ndarray, " T"], robot: Robot) -> WayDone:
    """Return the outcome of a motion, from its progress at each sample."""
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
        None if there[-1] else _describe_stop(task, rollout, robot),
    )


def joint_at_limit(robot: Robot, positions: Vector) -> str | None:
    """Return a text that names the first joint at a position limit; None if no joint is at a limit.

    Args:
        robot: The robot.
        positions: Joint positions (nv,) [rad or m].
    """
    for i, name in enumerate(robot.joint_names):
        for side, limit in (("lower", robot.position_lower[i]), ("upper", robot.position_upper[i])):
            if abs(positions[i] - limit) < 2e-3:  # [rad or m] braking is exponential in the end
                return f"joint {name!r} at its {side} limit of {limit:.4g} {robot.joint_units[i]}"
    return None


def _describe_stop(task: FreeDirection, rollout: Rollout, robot: Robot) -> str:
    """Return the reason why the arm stops at the end of a rollout, in words."""
    last = rollout.status[-max(1, len(rollout) // 20) :]
    short = "" if task.way_begins is not None else "on its way to the mechanism: "
    joint = joint_at_limit(robot, robot.positions(rollout.q[-1]))
    blocked = {Status.STALLED, Status.POSITION_LIMITED, Status.REROUTED, Status.OUTSIDE_LIMITS, Status.NULL_SCALED}
    if joint is not None and blocked.intersection(last):
        return short + joint
    if {Status.SINGULAR, Status.DAMPED, Status.STALLED}.intersection(last):
        return f"{short}a singularity, or the end of the arm's reach"
    return f"{short}the time: still moving after {rollout.time[-1]:.4g} s"
