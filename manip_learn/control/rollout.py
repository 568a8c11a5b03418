"""Rollouts: a controller run in time, from one start or many."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TypeGuard, final, overload

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.atomic_write import write_atomically
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.manipulability import manipulability
from manip_learn.control.command import Command, Controller, TaskController
from manip_learn.control.compiled_controller import CompiledController, why_not
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.integration import Method, next_posture
from manip_learn.control.servo_loop import ServoLoop
from manip_learn.control.status import Status
from manip_learn.errors import ConfigurationError, RecordingError
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.trajectory_source import Progress
from manip_learn.robot.batch.postures import checked_postures, positions_of
from manip_learn.robot.robot import Robot

FORMAT = "manip_learn.rollout"
# what NumPy and zipfile raise for files that are broken, cut short, or of another kind
DAMAGE = (
    *(OSError, ValueError, KeyError, AttributeError, TypeError, EOFError, NotImplementedError, RuntimeError),
    *(MemoryError, zipfile.BadZipFile, zlib.error),
)
COMPILED_FROM = 5_000  # commands of a table of starts: fewer take less time one by one than loading numba does


@final
@dataclass(frozen=True, eq=False)
class Rollout:
    """What a controlled robot did.

    Attributes:
        time: shape (T,) [s].
        q: shape (T, n), postures, the same kind of vector as the start.
        u: shape (T, nv), commanded velocities [rad/s or m/s].
        manipulability: shape (T,), as the commands give it: of the controller's constraint.
        status: shape (T,), see `Status`.
        joint_names: One name per velocity.
        task_error: shape (T,), distance to the task's goal along the constrained rows [m or rad]; NaN if the controller
            has no `task_error`.
        frame: Frame that the constraint holds, whose path a replay draws; empty if its features have no frame.
    """

    time: Float[np.ndarray, " T"]
    q: Float[np.ndarray, "T n"]
    u: Float[np.ndarray, "T nv"]
    manipulability: Float[np.ndarray, " T"]
    status: tuple[Status, ...]
    joint_names: tuple[str, ...]
    task_error: Float[np.ndarray, " T"]
    frame: str = ""

    def __post_init__(self) -> None:
        for name in ("time", "q", "u", "manipulability", "task_error"):
            array = np.array(getattr(self, name), dtype=np.float64)
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return int(self.time.shape[0])

    @property
    def status_counts(self) -> dict[str, int]:
        """How often each status occurred."""
        return {str(s): self.status.count(s) for s in dict.fromkeys(self.status)}

    def trajectory(self, name: str = "rollout") -> Trajectory:
        """The motion as a demonstration, so that it can be learnt from again."""
        return Trajectory(self.time, self.q, self.u, self.joint_names, name)

    def violation(self, constraint: Constraint) -> Float[np.ndarray, " T"]:
        """|A(q) u| along the motion: how far it breaks a constraint with b = 0, in the rows' units per second."""
        return np.array([np.linalg.norm(constraint(q) @ u) for q, u in zip(self.q, self.u, strict=True)])

    def manipulability_of(self, constraint: Constraint) -> Float[np.ndarray, " T"]:
        """mu of another constraint along the same motion."""
        return np.array([manipulability(constraint, q) for q in self.q])

    def save(self, path: str | Path) -> Path:
        """Write an NPZ file, whole or not at all; `Rollout.load` and `load_demonstrations` read it.

        Raises:
            OutputError: It cannot be written.
        """
        stream = io.BytesIO()
        np.savez_compressed(
            stream,
            format=np.array(FORMAT),
            time=self.time,
            q=self.q,
            u=self.u,
            manipulability=self.manipulability,
            status=np.array(self.status),
            joint_names=np.array(self.joint_names),
            task_error=self.task_error,
            frame=np.array(self.frame),
        )
        return write_atomically(path, stream.getvalue())

    @staticmethod
    def load(path: str | Path) -> Rollout:
        """Read what `save` wrote.

        Raises:
            RecordingError: No such file, or another kind of file.
        """
        try:
            # opened here: np.load leaves a damaged file open
            with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as content:
                if "format" not in content or str(content["format"]) != FORMAT:
                    raise RecordingError(f"{path} is no rollout; `manip-learn control ... --out FILE.npz` writes one")
                return Rollout(
                    content["time"],
                    content["q"],
                    content["u"],
                    content["manipulability"],
                    tuple(Status(s) for s in content["status"]),
                    tuple(str(n) for n in content["joint_names"]),
                    content["task_error"],
                    str(content["frame"]) if "frame" in content else "",
                )
        except FileNotFoundError as error:
            raise RecordingError(f"rollout file {path} does not exist", code="missing") from error
        except DAMAGE as error:
            raise RecordingError(f"{path} is no rollout file: {error}", code="not-a-rollout") from error


@overload
def simulate(
    robot: Robot | None,
    controller: Controller,
    q0: Sequence[float] | Float[np.ndarray, " n"],
    duration: float = ...,
    dt: float = ...,
    method: Method = ...,
    *,
    progress: Progress | None = ...,
) -> Rollout: ...


@overload
def simulate(
    robot: Robot | None,
    controller: Controller,
    q0: Sequence[Sequence[float]],
    duration: float = ...,
    dt: float = ...,
    method: Method = ...,
    *,
    progress: Progress | None = ...,
) -> tuple[Rollout, ...]: ...


def simulate(
    robot: Robot | None,
    controller: Controller,
    q0: ArrayLike,
    duration: float = 5.0,
    dt: float = 0.01,
    method: Method = "euler",
    *,
    progress: Progress | None = None,
) -> Rollout | tuple[Rollout, ...]:
    """Integrate the controller on the configuration manifold.

    Args:
        robot: The robot; None for a system whose state is a plain vector.
        controller: A `ResolvedRateController`, a `CompiledController`, or any `(q, t, dt) -> Command`.
        q0: Start posture; the rollout's postures are the same kind of vector. Or a table of starts, one per row.
        duration: [s].
        dt: Step [s].
        method: `"euler"` holds each command for a step, as a real arm's interface does; `"rk4"` approximates the
            continuous system.
        progress: Called with a title and the completed fraction, 0 to 1.

    Returns:
        A `Rollout` of round(duration / dt) + 1 samples, the start included; for a table of starts a tuple of them, one
        per start. A large table is computed by compiled code where numba is installed and the controller can be
        compiled (see `CompiledController`), and start by start otherwise.

    Raises:
        ConfigurationError: The start has the wrong size or is not finite; a step or duration that is not positive.
    """
    if not (np.isfinite(dt) and dt > 0.0 and np.isfinite(duration) and duration >= 0.0):
        raise ConfigurationError(f"duration and dt must be positive numbers of seconds, got {duration!r} and {dt!r}")
    if method not in ("euler", "rk4"):
        raise ConfigurationError(f"method must be 'euler' or 'rk4', not {method!r}")
    steps = round(duration / dt)
    report = progress or _silent
    if np.ndim(q0) == 2:
        return _simulate_table(robot, controller, np.asarray(q0), steps, dt, method, report)
    if isinstance(controller, CompiledController) and controller.robot is robot:
        rollout = _compiled_rollout(controller, np.asarray(controller.robot.checked_posture(q0)), steps, dt, method)
        report("simulating", 1.0)
        return rollout
    q = np.array(q0, dtype=np.float64) if robot is None else np.array(robot.checked_posture(q0))
    return _integrated(robot, controller, q, steps, dt, method, report)


def _integrated(
    robot: Robot | None,
    controller: Controller,
    q: np.ndarray,
    steps: int,
    dt: float,
    method: Method,
    report: Progress,
) -> Rollout:
    task_error = controller.task_error if isinstance(controller, TaskController) else None
    command_at = _loop_of(controller, dt, method)
    postures, errors = np.empty((steps + 1, q.shape[0])), np.full(steps + 1, np.nan)
    commands: list[Command] = []
    for i in range(steps + 1):
        t = i * dt
        command = command_at(q, t)
        postures[i] = q
        commands.append(command)
        if task_error is not None:
            errors[i] = task_error(q, t)
        if i < steps:
            q = next_posture(robot, controller, q, t, dt, method, command.velocity)
        report("simulating", (i + 1) / (steps + 1))
    u = np.array([c.velocity for c in commands])
    return Rollout(
        np.arange(steps + 1) * dt,
        postures,
        u,
        np.array([c.manipulability for c in commands]),
        tuple(c.status for c in commands),
        robot.joint_names if robot is not None else tuple(f"q{i}" for i in range(u.shape[1])),
        errors,
        _frame_of(controller),
    )


def _loop_of(controller: Controller | ServoLoop, dt: float, method: Method) -> Callable[[np.ndarray, float], Command]:
    """The rule of one step: a servo loop, the library's controllers in one of their own, others as they are."""
    if isinstance(controller, ServoLoop):
        return controller.update
    law = controller.controller if isinstance(controller, CompiledController) else controller
    if method == "euler" and isinstance(law, ResolvedRateController) and law.limits is not None:
        return ServoLoop(controller, dt, stale_after=max(0.1, 10.0 * dt)).step
    return lambda q, t: controller(q, t, dt)


def _simulate_table(
    robot: Robot | None,
    controller: Controller,
    starts: np.ndarray,
    steps: int,
    dt: float,
    method: Method,
    report: Progress,
) -> tuple[Rollout, ...]:
    if robot is not None:
        starts = checked_postures(robot, starts)  # names the row before any work is done
    commands = len(starts) * (steps + 1) * (4 if method == "rk4" else 1)
    if commands >= COMPILED_FROM and _compiles(controller, robot):
        controller = CompiledController(controller)
    rollouts = []
    for i, start in enumerate(starts):
        rollouts.append(simulate(robot, controller, start, steps * dt, dt, method))
        report("simulating", (i + 1) / len(starts))
    return tuple(rollouts)


def _compiles(controller: Controller, robot: Robot | None) -> TypeGuard[ResolvedRateController]:
    if not isinstance(controller, ResolvedRateController) or controller.robot is not robot:
        return False
    return find_spec("numba") is not None and why_not(controller) is None


def _compiled_rollout(
    controller: CompiledController, start: np.ndarray, steps: int, dt: float, method: Method
) -> Rollout:
    robot = controller.robot
    run = controller.rollout(positions_of(robot, start[None])[0], steps, dt, method)
    q = run.q if start.shape[0] == robot.nv else np.array([robot.configuration(x) for x in run.q])
    time, frame = np.arange(steps + 1) * dt, _frame_of(controller)
    return Rollout(time, q, run.u, run.mu, run.status, robot.joint_names, run.error, frame)


def _frame_of(controller: Controller) -> str:
    """Name of the frame whose rows are constrained; empty if the controller has no such frame."""
    law = controller.controller if isinstance(controller, CompiledController) else controller
    features = law.constraint.features if isinstance(law, ResolvedRateController) else None
    return features.frame.name if isinstance(features, FrameJacobian) else ""


def _silent(_title: str, _fraction: float) -> None:
    pass
