"""`manip-learn control`: one rollout of a learnt or hand-written constraint."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike

from manip_learn.commands.robot_loading import robot_of_constraint
from manip_learn.commands.robot_options import RobotOptions
from manip_learn.constraint.constraint import Constraint
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent, NullSpacePolicy, ZeroPolicy
from manip_learn.control.policies.manipulability_ascent import ASCENT_GAIN
from manip_learn.control.rollout import Rollout
from manip_learn.control.simulation import simulate
from manip_learn.control.status import Status
from manip_learn.control.tasks import Hold, PointAttractor, Task
from manip_learn.control.tasks.straight_motion import in_words
from manip_learn.errors import ManipLearnError, TargetError
from manip_learn.linalg import complement_rows
from manip_learn.recordings.trajectory_source import Progress
from manip_learn.robot import Robot

POLICIES = ("manipulability", "zero", "attractor")


@final
@dataclass(frozen=True)
class Aim:
    """How a typed target and the end of a motion compare.

    Attributes:
        distance: Full distance from the tip to the target, over the directions that the constraint ignores too [m];
            None if the target has no position.
        ignored: Directions of the target that the constraint leaves free, in words; reaching does not count them.
    """

    distance: float | None
    ignored: tuple[str, ...]


@final
@dataclass(frozen=True)
class Controlled:
    """A rollout and whether it arrived.

    Attributes:
        rollout: The motion.
        out: File that it was written to.
        tolerance: Final error that counts as reached [m or rad].
        aim: What became of the typed target; None without one.
    """

    rollout: Rollout
    out: Path | None
    tolerance: float
    aim: Aim | None = None

    @property
    def final_error(self) -> float:
        """Distance to the target at the end, along the constrained rows [m or rad]."""
        return float(self.rollout.task_error[-1])

    @property
    def reached(self) -> bool:
        """Whether the final error along the constrained rows is within the tolerance."""
        return self.final_error <= self.tolerance

    @property
    def stalled(self) -> bool:
        """Whether the arm ended at rest, or nearly, short of the target."""
        last = self.rollout.status[-max(1, len(self.rollout) // 20) :]
        return not self.reached and last.count(Status.STALLED) + last.count(Status.SINGULAR) > 0.5 * len(last)

    def to_dict(self) -> dict[str, Any]:
        """The JSON answer."""
        r = self.rollout
        return {
            "reached": self.reached,
            "stalled": self.stalled,
            "tip_to_target": None if self.aim is None else self.aim.distance,
            "ignored_target_axes": [] if self.aim is None else list(self.aim.ignored),
            "final_error": self.final_error,
            "tolerance": self.tolerance,
            "min_manipulability": float(r.manipulability.min()),
            "mean_manipulability": float(r.manipulability.mean()),
            "max_velocity": float(np.abs(r.u).max()),
            "status_counts": r.status_counts,
            "duration": float(r.time[-1]),
            "final_posture": r.q[-1].tolist(),
            "out": None if self.out is None else str(self.out),
        }


def control(
    robot_name: str,
    constraint_file: str,
    *,
    start: list[float] | None = None,
    target: list[float] | None = None,
    policy: str = "manipulability",
    rest: list[float] | None = None,
    gain: float = ASCENT_GAIN,
    task_gain: float = 1.0,
    duration: float = 5.0,
    dt: float = 0.01,
    inverse: str = "damped",
    tolerance: float = 0.01,
    out: Path | None = None,
    robot_options: RobotOptions | None = None,
    progress: Progress | None = None,
) -> Controlled:
    """Simulate a controller and write the rollout to a file if one is named.

    Raises:
        ManipLearnError: Anything that is wrong with the robot, the constraint file, the numbers or the output.
    """
    robot = robot_of_constraint(robot_name, constraint_file, robot_options or RobotOptions())
    constraint = Constraint.load(constraint_file, robot)
    q0 = robot.neutral() if start is None else robot.checked_posture(start)
    _check_start(robot, q0)
    task: Task = Hold() if target is None else PointAttractor(target, task_gain)
    if isinstance(task, PointAttractor):
        task.displacement(constraint, q0)  # a wrong size is refused before the simulation
    controller = ResolvedRateController(
        constraint,
        task,
        null_policy(policy, constraint, robot, gain, rest),
        inverse,  # type: ignore[arg-type]  # checked by the controller
        dt=dt,
    )
    rollout = simulate(robot, controller, q0, duration, dt, progress=progress)
    written = rollout.save(out) if out is not None else None
    aim = aim_of(constraint, task, rollout.q[-1]) if isinstance(task, PointAttractor) else None
    return Controlled(rollout, written, tolerance, aim)


def aim_of(constraint: Constraint, task: PointAttractor, q: np.ndarray) -> Aim:
    """What became of a target at posture q."""
    features = constraint.features
    if task.target.shape != (features.n_rows,):  # given along the constrained rows: nothing of it is ignored
        return Aim(task.error(constraint, q, 0.0), ())
    error = features.error_to(task.target, q)
    linear = [i for i, name in enumerate(features.row_names) if name in ("x", "y", "z")]
    free = complement_rows(constraint.selection)
    weights = np.linalg.norm(free, axis=0)
    whole = weights > 1.0 - 1e-6
    if np.count_nonzero(whole) == len(free):  # the free directions are axes of the target
        ignored = tuple(name for name, counts in zip(features.row_names, whole, strict=True) if counts)
    else:
        ignored = tuple(in_words(row, features.row_names) for row in free)
    return Aim(float(np.linalg.norm(error[linear])) if linear else None, ignored)


def null_policy(
    name: str, constraint: Constraint, robot: Robot, gain: float, rest: ArrayLike | None
) -> NullSpacePolicy:
    """A null-space policy by its name on the command line.

    Raises:
        ManipLearnError: Unknown name.
    """
    if name == "manipulability":
        return ManipulabilityAscent(constraint, gain)
    if name == "zero":
        return ZeroPolicy(constraint.nv)
    if name == "attractor":
        return JointAttractor(robot.neutral() if rest is None else rest, gain, robot)
    raise ManipLearnError(f"unknown policy {name!r}: use one of {', '.join(POLICIES)}")


def _check_start(robot: Robot, q0: np.ndarray) -> None:
    positions = robot.positions(q0)
    outside = (positions < robot.position_lower - 1e-9) | (positions > robot.position_upper + 1e-9)
    if np.any(outside):
        i = int(np.argmax(outside))
        raise TargetError(
            f"the start puts joint {robot.joint_names[i]!r} at {positions[i]:.4g}, outside its limits "
            f"{robot.position_lower[i]:.4g} .. {robot.position_upper[i]:.4g} (are these degrees?)"
        )
