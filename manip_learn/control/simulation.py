"""Simulation: a controller run in time, from one start or many."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import repeat
from typing import Any, overload

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.command import Command, Controller, LimitedController, Posture
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.rollout import Rollout, written_constraint
from manip_learn.control.servo_loop import ServoLoop
from manip_learn.errors import ConfigurationError, advice, an
from manip_learn.recordings.load import Progress
from manip_learn.robot.batch.postures import checked_postures
from manip_learn.robot.identity import RobotIdentity
from manip_learn.robot.robot import Robot

# rollouts of a table that are made together: more hold memory twice, fewer leave cores idle at the end of each block
_STARTS = 256


Start = Sequence[float] | Posture
Starts = Sequence[Sequence[float]]


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
    """Integrate the controller on the configuration manifold, each command held for a step.

    Args:
        robot: The robot; None for a system whose state is a plain vector.
        controller: A `ResolvedRateController`, or any `(q, t, dt) -> Command`.
        q0: Start posture; the rollout's postures are the same kind of vector. Or a table of starts, one per row.
        duration: [s].
        dt: Step [s].
        progress: Called with a title and the completed fraction, 0 to 1.
        **removed: `method`, which there was until 0.3.

    Returns:
        A `Rollout` of round(duration / dt) + 1 samples, the start included; for a table of starts a tuple of them, one
        per start.

    Raises:
        ConfigurationError: The arguments are in another order; the start has the wrong size or is not finite; a step
            or duration that is not positive.
        TypeError: An argument that there is not.

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("planar3")
        >>> constraint = ml.Constraint([[0, 1]], ml.FrameJacobian(robot, "tip", axes="x y"))
        >>> controller = ml.ResolvedRateController(constraint, ml.PointAttractor([1.0, 1.5]))
        >>> rollout = ml.simulate(robot, controller, [0.3, 0.8, 0.4], duration=2.0, dt=0.01)
        >>> rollout.q.shape, rollout.u.shape
        ((201, 3), (201, 3))
    """
    can_run = (callable(controller) or isinstance(controller, ServoLoop)) and not isinstance(
        controller, Constraint | type
    )
    is_start = not (q0 is None or callable(q0) or isinstance(q0, Robot | str))
    if not ((robot is None or isinstance(robot, Robot)) and can_run and is_start):
        raise ConfigurationError(
            f"call simulate(robot, controller, q0): got {an(robot)}, {an(controller)} and {an(q0)}, in this order"
        )
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
    if robot is None:
        starts = np.array(q0, dtype=np.float64, ndmin=2)
    else:  # names the row before any work is done
        starts = np.array(checked_postures(robot, q0) if table else [robot.checked_posture(q0)])
    native = controller.native if isinstance(controller, ResolvedRateController) and controller.robot is robot else None
    rollouts, own = list[Rollout](), None if table else progress
    for first in range(0, len(starts), _STARTS):
        block = starts[first : first + _STARTS]
        whole = repeat(None) if native is None else native.rollouts(controller, block, dt, steps, own)
        for start, rollout in zip(block, whole, strict=False):  # None where single steps are needed
            rollouts.append(rollout or _stepped(robot, controller, start, np.arange(steps + 1) * dt, dt, own))
            if table and progress is not None:
                progress("simulating", len(rollouts) / len(starts))
    return tuple(rollouts) if table else rollouts[0]


def _stepped(
    robot: Robot | None, controller: Any, q: Posture, time: Float[np.ndarray, " T"], dt: float, report: Progress | None
) -> Rollout:
    """Return the rollout from one start, step by step: in a servo loop, which the library's controllers get anyhow."""
    step, task_error = (lambda q, t: controller(q, t, dt)), getattr(controller, "task_error", lambda q, t: np.nan)
    if isinstance(controller, ServoLoop):
        controller.reset(q)
        step = controller.update
    elif isinstance(controller, LimitedController) and controller.limits is not None:
        step = ServoLoop(controller, dt, stale_after=max(0.1, 10.0 * dt)).step
    postures, errors, commands = np.empty((len(time), len(q))), np.empty(len(time)), list[Command]()
    for i, t in enumerate(time.tolist()):
        command = step(q, t)
        postures[i], errors[i] = q, task_error(q, t)
        commands.append(command)
        if len(commands) < len(time):
            q = q + dt * command.velocity if robot is None else robot.integrate(q, dt * command.velocity)
        if report is not None:
            report("simulating", len(commands) / len(time))
    return rollout_of(robot, controller, time, postures, commands, errors)


def rollout_of(
    robot: Robot | None,
    controller: Controller | ServoLoop,
    time: Float[np.ndarray, " T"],
    q: Float[np.ndarray, "T n"],
    commands: Sequence[Command],
    errors: Float[np.ndarray, " T"],
) -> Rollout:
    """Return what was done, sample by sample, with what guided it.

    Args:
        robot: The robot, or None.
        controller: What gave the commands.
        time: shape (T,) [s].
        q: shape (T, n), postures.
        commands: T of them.
        errors: shape (T,), of the task [m or rad].
    """
    names = tuple(f"q{i}" for i in range(len(commands[0].velocity))) if robot is None else robot.joint_names
    u = np.array([c.velocity for c in commands]).reshape(len(commands), len(names))
    mu, following = (np.array([getattr(c, name) for c in commands]) for name in ("manipulability", "following_error"))
    told, status = guided(controller), tuple(c.status for c in commands)
    told["robot"] = None if robot is None else RobotIdentity.of(robot)
    told["following_error"] = following if isinstance(controller, ServoLoop) else None
    return Rollout(time, q, u, mu, status, names, errors, **told)


def guided(controller: Controller | ServoLoop) -> dict[str, Any]:
    """Return what guided a rollout: the frame, the target and the constraint, as far as they are known."""
    law = controller.controller if isinstance(controller, ServoLoop) else controller
    if not isinstance(law, LimitedController) or law.law is None:
        return {}
    written = written_constraint(law.constraint)
    return {"frame": law.frame or "", "target": law.law.task.goal(), "constraint": written}
