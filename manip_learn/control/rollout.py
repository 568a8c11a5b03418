"""Rollouts: motions of a controlled robot, and their files."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.manipulability import manipulability
from manip_learn.control.command import Status
from manip_learn.errors import FeatureError, printable, spoken
from manip_learn.recordings.guards import refusal
from manip_learn.recordings.saved_motion import FileHeader, SavedMotion, check_robot, read_saved
from manip_learn.recordings.trajectory import TRAJECTORY, PandasFrame, Trajectory, pandas_frame_of
from manip_learn.recordings.writers.write_motion import write_motion
from manip_learn.robot import html_card
from manip_learn.robot.identity import RobotIdentity
from manip_learn.robot.robot import Robot

# fields with a value per sample, and fields of a file's header
_CURVES = ("time", "q", "u", "manipulability", "task_error", "status", "following_error")
_HEADER = ("joint_names", "robot", "frame", "constraint", "phases", "ways", "around")


@final
@dataclass(frozen=True, eq=False, repr=False)
class Rollout:
    """Motion of a controlled robot.

    Attributes:
        time: shape (T,) [s].
        q: shape (T, n), postures: joint positions [rad or m] or configurations, as the start of the motion.
        u: shape (T, nv), commanded velocities [rad/s or m/s].
        manipulability: shape (T,), manipulability of the controller's constraint.
        status: shape (T,), see `Status`.
        joint_names: One name per column of `u`.
        task_error: shape (T,), distance to the task's goal along the constrained rows [m or rad]; NaN if the controller
            has no `task_error`.
        frame: Name of the frame that the constraint refers to, whose path a replay draws; empty if there is none.
        robot: Identity of the robot, with its locked joints; None for a system without a robot.
        target: Target of the task, as `Task.goal` returns it; None for a task without a target.
        constraint: Constraint of the controller, as a dictionary from `Constraint.to_dict` without the phases of the
            demonstrations (`Constraint.from_dict` builds the constraint); None if that is not known or cannot be
            written.
        following_error: shape (T,), largest distance between commanded and measured joint positions, from the commands
            of a `ServoLoop` [rad or m]; None if it is not known.
        phases: `(name, start [s], end [s])` of the consecutive parts, e.g. of a plan; empty for a single part.
        ways: Outcome of each motion along a mechanism, as `WayDone.to_dict` returns it; `begins` is on the same clock
            as `time` [s].
        around: Obstacles that a plan avoided, as `Obstacle.to_dict` returns them, and the smallest distance to each
            [m].

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("planar3")
        >>> constraint = ml.Constraint([[0, 1]], ml.FrameJacobian(robot, "tip", axes="x y"))
        >>> controller = ml.ResolvedRateController(constraint, ml.PointAttractor([1.0, 1.5]))
        >>> rollout = ml.simulate(robot, controller, [0.3, 0.8, 0.4])
        >>> path = rollout.save("run.npz")
        >>> again = ml.Rollout.load("run.npz", robot)
        >>> bool((again.q == rollout.q).all())
        True
    """

    time: Float[np.ndarray, " T"]
    q: Float[np.ndarray, "T n"]
    u: Float[np.ndarray, "T nv"]
    manipulability: Float[np.ndarray, " T"]
    status: tuple[Status, ...]
    joint_names: tuple[str, ...]
    task_error: Float[np.ndarray, " T"]
    frame: str = ""
    robot: RobotIdentity | None = None
    target: Float[np.ndarray, "..."] | None = None
    constraint: Mapping[str, Any] | None = None
    following_error: Float[np.ndarray, " T"] | None = None
    phases: tuple[tuple[str, float, float], ...] = ()
    ways: tuple[Mapping[str, Any], ...] = ()
    around: tuple[Mapping[str, Any], ...] = ()

    def __post_init__(self) -> None:
        for name in (*_CURVES, "target"):
            if name != "status" and getattr(self, name) is not None:
                array = np.array(getattr(self, name), dtype=np.float64)
                array.setflags(write=False)
                object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return int(self.time.shape[0])

    def _curves(self) -> dict[str, Any]:
        """Return the fields with a value per sample, by name, as far as they are known."""
        return {name: values for name in _CURVES if (values := getattr(self, name)) is not None}

    @property
    def mu(self) -> Float[np.ndarray, " T"]:
        """Manipulability of each sample, shape (T,); the same as `manipulability`."""
        return self.manipulability

    @property
    def status_counts(self) -> dict[str, int]:
        """Number of samples with each status, by the status as text."""
        return {str(s): self.status.count(s) for s in dict.fromkeys(self.status)}

    def __repr__(self) -> str:
        return f"Rollout({'; '.join(f'{name} {value}' for name, value in self._facts() if value is not None)})"

    def _repr_html_(self) -> str:
        least = f"μ over time, {np.nanmin(self.mu):.3g} at the least" if np.any(np.isfinite(self.mu)) else ""
        picture = html_card.curve(self.time.tolist(), self.mu.tolist(), least)
        return html_card.card("Rollout", html_card.facts(self._facts()), picture)

    def _facts(self) -> list[tuple[str, str | None]]:
        """Return names and values in words; None where there is no value."""
        mu, span = self.manipulability, self.time[-1] - self.time[0] if len(self) else 0.0
        ends = self.task_error[-1] if len(self) else np.nan
        return [
            ("robot", None if self.robot is None else self.robot.name),
            ("motion", f"{len(self):,} samples over {span:.4g} s, {len(self.joint_names)} joints"),
            ("frame", self.frame or None),
            ("manipulability", f"{np.nanmin(mu):.4g} to {np.nanmax(mu):.4g}" if np.any(np.isfinite(mu)) else None),
            ("error at the end", f"{ends:.3g} (in m or rad)" if np.isfinite(ends) else None),
            ("status", ", ".join(f"{word} {count:,}" for word, count in self.status_counts.items()) or None),
        ]

    def trajectory(self, name: str = "rollout") -> Trajectory:
        """Return the motion as a demonstration from which a constraint can be learnt.

        Args:
            name: Name of the demonstration.
        """
        return Trajectory(self.time, self.q, self.u, self.joint_names, name, exact=True)

    def to_frame(self) -> PandasFrame:
        """Return a pandas data frame with one row per sample.

        Its columns are `time` [s], `<joint>` [rad or m] and `<joint>_velocity` [rad/s or m/s] for each joint, `mu`,
        `task_error` [m or rad] and `status`.

        Raises:
            RecordingError: Postures that are not joint positions (nq differs from nv) have no column names.
            MissingExtraError: pandas is not installed.
        """
        table: Any = pandas_frame_of([self.trajectory()]).drop(columns=TRAJECTORY)
        return table.assign(mu=self.mu, task_error=self.task_error, status=list(map(str, self.status)))

    def until(self, end: float) -> Rollout:
        """Return the part of the motion up to a time.

        Args:
            end: The time [s]; samples at that time are included.
        """
        n = int(np.searchsorted(self.time, end + 1e-9))
        return replace(self, **{name: values[:n] for name, values in self._curves().items()})

    def followed_by(self, other: Rollout) -> Rollout:
        """Return this motion followed by another one of the same robot, which begins where this one ends.

        The result has the `phases`, `ways` and `around` of both motions, and no `following_error`; its other fields are
        the second motion's.

        Args:
            other: The second motion; its times are shifted to follow the first.
        """
        shift = float(self.time[-1])
        time, status = np.concatenate([self.time[:-1], other.time + shift]), (*self.status[:-1], *other.status)
        arrays = ("q", "u", "manipulability", "task_error")
        joined = {name: np.concatenate([getattr(self, name)[:-1], getattr(other, name)]) for name in arrays}
        phases = (*self.phases, *((name, start + shift, end + shift) for name, start, end in other.phases))
        later = ({**way, "begins": None if way["begins"] is None else way["begins"] + shift} for way in other.ways)
        # of an obstacle in both motions, the entry with the smaller distance counts
        avoided = dict[str, Mapping[str, Any]]()
        for thing in sorted((*self.around, *other.around), key=lambda thing: thing.get("nearest", np.inf)):
            avoided.setdefault(json.dumps({k: v for k, v in thing.items() if k not in ("nearest", "link")}), thing)
        parts = {"phases": phases, "ways": (*self.ways, *later), "around": tuple(avoided.values())}
        return replace(other, time=time, status=status, **joined, following_error=None, **parts)

    def violation(self, constraint: Constraint) -> Float[np.ndarray, " T"]:
        """Return the speed with which each step violates a constraint A u = 0, in the rows' units per second.

        It is the norm of A u, where A is the mean of A(q) at both ends of the step; at the last sample it is A(q).

        Args:
            constraint: The constraint.

        Returns:
            shape (T,).

        Raises:
            ConfigurationError: The constraint is of a robot with another number of joints.
        """
        A = np.array([constraint(q) for q in self.q])
        A[:-1] = 0.5 * (A[:-1] + A[1:])
        return np.linalg.norm(np.einsum("tij,tj->ti", A, self.u), axis=1)

    def manipulability_of(self, constraint: Constraint) -> Float[np.ndarray, " T"]:
        """Return the manipulability of another constraint at each sample of this motion, shape (T,).

        Args:
            constraint: The constraint.

        Raises:
            ConfigurationError: The constraint is of a robot with another number of joints.
        """
        return np.array([manipulability(constraint, q) for q in self.q])

    def save(self, path: str | Path) -> Path:
        """Write the motion to a file. An existing file is replaced only when the new one is complete.

        Args:
            path: The file. Its ending selects the format: `.npz` (NumPy) and `.csv` (text table) can be read by
                `Rollout.load` and `load_demonstrations` without loss; `.mcap` is a bag for ROS 2 (JointState messages).

        Returns:
            The path of the file.

        Raises:
            OutputError: The file cannot be written, or has another ending.
            MissingExtraError: `.mcap` needs the extra `ros`.
        """
        fields = {name: getattr(self, name) for name in _HEADER}
        fields |= {"target": None if self.target is None else self.target.tolist(), "nq": self.q.shape[1]}
        header = FileHeader("rollout", following_error=self.following_error is not None, **fields)
        return write_motion(path, SavedMotion(header, self._curves() | {"status": np.array(self.status, dtype=str)}))

    @staticmethod
    def load(path: str | Path, robot: Robot | None = None) -> Rollout:
        """Read a file that `save` wrote.

        Args:
            path: The file.
            robot: Robot that the rollout must belong to: a file of another robot, or of other locked joints, raises.
                None accepts any robot; `load_robot(name, locked=rollout.robot.locked)` then loads that robot.

        Returns:
            The rollout.

        Raises:
            RecordingError: The file does not exist, was not written by `save`, or belongs to another robot.

        Warns:
            UserWarning: The file does not name the robot that it was made with.
        """
        rollout, notes = Rollout.load_with_notes(path, robot)
        for note in notes:
            warnings.warn(printable(f"{Path(path).name}: {note}"), UserWarning, stacklevel=2)
        return rollout

    @staticmethod
    def load_with_notes(path: str | Path, robot: Robot | None = None) -> tuple[Rollout, tuple[str, ...]]:
        """Read a file as `load` does, but return the warnings instead of issuing them.

        Args:
            path: The file.
            robot: Robot that the rollout must belong to; None accepts any robot.

        Returns:
            The rollout and the warnings, in sentences.

        Raises:
            RecordingError: The file does not exist, was not written by `save`, or belongs to another robot.
        """
        path, motion = Path(path), read_saved(Path(path))
        header = motion.header
        if header.kind != "rollout":
            fix = spoken(": load_demonstrations reads it", ": name a file that `manip-learn control --out` wrote")
            raise refusal(path, "not-a-rollout", f"it is a recording, no rollout{fix}")
        notes = check_robot(path, header, robot) if robot is not None else ()
        if robot is not None and header.joint_names != robot.joint_names:
            file_joints, robot_joints = (", ".join(names) for names in (header.joint_names, robot.joint_names))
            text = f"it was made with the joints {file_joints}, robot {robot.name!r} has {robot_joints}"
            raise refusal(path, "other-robot", f"{text}: load the robot it was made with, with the same locked joints")
        statuses, words = set(Status), motion.arrays["status"].tolist()
        if (number := next((i for i, word in enumerate(words) if word not in statuses), None)) is not None:
            text = f"the status is {words[number]!r:.40}, it must be one of {', '.join(Status)}"
            raise refusal(path, "status", text, where=f"{path.name} sample {number}")
        fields = {name: getattr(header, name) for name in (*_HEADER, "target")}
        fields |= {name: motion.arrays[name] for name in _CURVES if name in motion.arrays}
        phases = tuple((name, float(start), float(end)) for name, start, end in header.phases or ())
        fields |= {"phases": phases, "ways": tuple(header.ways or ()), "around": tuple(header.around or ())}
        fields["status"] = tuple(map(Status, words))
        return Rollout(**fields), notes


def written_constraint(constraint: Constraint) -> Mapping[str, Any] | None:
    """Return a constraint as the dictionary that `Rollout.constraint` stores; None if it cannot be written.

    Args:
        constraint: The constraint.
    """
    provenance = {k: v for k, v in constraint.provenance.items() if k not in ("phases", "odd_trajectories")}
    try:
        json.dumps(provenance, allow_nan=False)
        return constraint.to_dict() | {"provenance": provenance}
    except (FeatureError, TypeError, ValueError):  # Python functions; an entry of the user's own
        return None
