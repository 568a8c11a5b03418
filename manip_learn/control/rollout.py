"""Rolling a controller out in time."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, final, overload

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.atomic_write import write_atomically
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.constraint.manipulability import manipulability
from manip_learn.control.batch import pays, run_batch
from manip_learn.control.controller import Command, ResolvedRateController
from manip_learn.errors import ConfigurationError, RecordingError
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.batch.postures import checked_postures
from manip_learn.robot.robot import Robot

FORMAT = "manip_learn.rollout"
# what NumPy and zipfile raise for files that are broken, cut short, or of another kind
DAMAGE = (
    *(OSError, ValueError, KeyError, AttributeError, TypeError, EOFError, NotImplementedError, RuntimeError),
    *(MemoryError, zipfile.BadZipFile, zlib.error),
)
MOVING_BASES = ("floating", "planar", "other")  # joints whose positions do not simply add up
Progress = Callable[[float], None]


@final
@dataclass(frozen=True, eq=False)
class Rollout:
    """What a controlled robot did.

    Attributes:
        time: shape (T,) [s].
        q: shape (T, n), postures, the same kind of vector as the start.
        u: shape (T, nv), commanded velocities [rad/s or m/s].
        manipulability: shape (T,), of the controller's constraint.
        status: T words, see `Command.status`.
        joint_names: One name a velocity.
        task_error: shape (T,), distance to the task's goal along the constrained rows [m or rad].
        frame: Frame that the constraint holds, whose path a replay draws; empty if its features have no frame.
    """

    time: Float[np.ndarray, " T"]
    q: Float[np.ndarray, "T n"]
    u: Float[np.ndarray, "T nv"]
    manipulability: Float[np.ndarray, " T"]
    status: tuple[str, ...]
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
        return {s: self.status.count(s) for s in dict.fromkeys(self.status)}

    def trajectory(self, name: str = "rollout") -> Trajectory:
        """The motion as a demonstration, so that it can be learnt from again."""
        return Trajectory(self.time, self.q, self.u, self.joint_names, name)

    def violation(self, constraint: Constraint) -> Float[np.ndarray, " T"]:
        """|A(q) u| along the motion: how far it breaks a constraint with b = 0, in the rows' units a second."""
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
                    tuple(str(s) for s in content["status"]),
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
    controller: ResolvedRateController,
    q0: Sequence[float] | Float[np.ndarray, " n"],
    duration: float = ...,
    dt: float = ...,
    method: Literal["euler", "rk4"] = ...,
    *,
    progress: Progress | None = ...,
) -> Rollout: ...


@overload
def simulate(
    robot: Robot | None,
    controller: ResolvedRateController,
    q0: Sequence[Sequence[float]],
    duration: float = ...,
    dt: float = ...,
    method: Literal["euler", "rk4"] = ...,
    *,
    progress: Progress | None = ...,
) -> tuple[Rollout, ...]: ...


def simulate(
    robot: Robot | None,
    controller: ResolvedRateController,
    q0: ArrayLike,
    duration: float = 5.0,
    dt: float = 0.01,
    method: Literal["euler", "rk4"] = "euler",
    *,
    progress: Progress | None = None,
) -> Rollout | tuple[Rollout, ...]:
    """Integrate the controller on the configuration manifold.

    Args:
        robot: The robot; None for a system whose state is a plain vector.
        controller: What commands it.
        q0: Start posture; the rollout's postures are the same kind of vector. Or a table of starts, one a row.
        duration: [s].
        dt: Step [s].
        method: `"euler"` holds each command for a step, as a real arm's interface does; `"rk4"` approximates the
            continuous system.
        progress: Called with the share done, 0 to 1.

    Returns:
        A `Rollout` of round(duration / dt) + 1 samples, the start included; a tuple of them, one a start, for a table
        of starts (they are rolled out together, several times as fast as one by one).

    Raises:
        ConfigurationError: The start has the wrong size or is not finite; a step or duration that is not positive.
    """
    if not (np.isfinite(dt) and dt > 0.0 and np.isfinite(duration) and duration >= 0.0):
        raise ConfigurationError(f"duration and dt must be positive numbers of seconds, got {duration!r} and {dt!r}")
    if method not in ("euler", "rk4"):
        raise ConfigurationError(f"method must be 'euler' or 'rk4', not {method!r}")
    steps = round(duration / dt)
    if np.ndim(q0) == 2:
        return _simulate_all(robot, controller, np.asarray(q0), steps, dt, method, progress)
    q = np.array(q0, dtype=np.float64) if robot is None else np.array(robot.checked_posture(q0))
    postures = np.empty((steps + 1, q.shape[0]))
    commands: list[Command] = []
    errors = np.empty(steps + 1)
    for i in range(steps + 1):
        t = i * dt
        command = controller(q, t, dt)
        postures[i] = q
        commands.append(command)
        errors[i] = controller.task.error(controller.constraint, q, t)
        if i < steps:
            q = _stepped(robot, controller, q, t, dt, method, command)
        if progress is not None:
            progress((i + 1) / (steps + 1))
    return Rollout(
        np.arange(steps + 1) * dt,
        postures,
        np.array([c.velocity for c in commands]),
        np.array([c.manipulability for c in commands]),
        tuple(c.status for c in commands),
        robot.joint_names if robot is not None else tuple(f"q{i}" for i in range(controller.constraint.nv)),
        errors,
        _frame_of(controller.constraint),
    )


def _simulate_all(
    robot: Robot | None,
    controller: ResolvedRateController,
    starts: np.ndarray,
    steps: int,
    dt: float,
    method: Literal["euler", "rk4"],
    progress: Progress | None,
) -> tuple[Rollout, ...]:
    simple = robot is not None and controller.robot is robot and all(b.kind not in MOVING_BASES for b in robot.blocks)
    if robot is None or not simple or not pays(controller, len(starts), steps, method):
        if robot is not None:
            checked_postures(robot, starts)  # names the row before any work is done
        return tuple(simulate(robot, controller, start, steps * dt, dt, method, progress=progress) for start in starts)
    run = run_batch(robot, controller, starts, steps, dt, method)
    if progress is not None:
        progress(1.0)
    time = np.arange(steps + 1) * dt
    rows = zip(run.q, run.u, run.mu, run.status, run.error, strict=True)
    frame = _frame_of(controller.constraint)
    return tuple(
        Rollout(time, q, u, mu, tuple(status), robot.joint_names, error, frame) for q, u, mu, status, error in rows
    )


def _frame_of(constraint: Constraint) -> str:
    """Name of the frame whose rows are constrained; empty for features that belong to no frame."""
    features = constraint.features
    return features.frame.name if isinstance(features, FrameJacobian) else ""


def _stepped(
    robot: Robot | None,
    controller: ResolvedRateController,
    q: np.ndarray,
    t: float,
    dt: float,
    method: str,
    first: Command,
) -> np.ndarray:
    if method == "euler":
        return _moved(robot, q, dt * first.velocity)
    # Munthe-Kaas form of the classic scheme: stages are tangent displacements from q; exact order 4 where the
    # tangent coordinates commute (all joints but floating bases), order 2 otherwise
    k1 = first.velocity
    k2 = controller(_moved(robot, q, 0.5 * dt * k1), t + 0.5 * dt, dt).velocity
    k3 = controller(_moved(robot, q, 0.5 * dt * k2), t + 0.5 * dt, dt).velocity
    k4 = controller(_moved(robot, q, dt * k3), t + dt, dt).velocity
    return _moved(robot, q, dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4))


def _moved(robot: Robot | None, q: np.ndarray, step: np.ndarray) -> np.ndarray:
    return q + step if robot is None else robot.integrate(q, step)
