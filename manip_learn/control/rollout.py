"""What a controlled robot did: a rollout, and its file."""

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

# what there is of each sample, and what a file has in its header
_CURVES = ("time", "q", "u", "manipulability", "task_error", "status", "following_error")
_HEADER = ("joint_names", "robot", "frame", "constraint", "phases", "ways", "around")


@final
@dataclass(frozen=True, eq=False, repr=False)
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
        robot: Which robot it was made with, and which joints were locked where; None for a system without a robot.
        target: Where the task was to arrive, as `Task.goal` says it; None for a task without such a place.
        constraint: What guided it, as `Constraint.to_dict` writes it but for the phases of the recordings that it was
            learnt from (`Constraint.from_dict` builds it); None if that is not known or cannot be written.
        following_error: shape (T,), largest distance between commanded and measured joint positions, as a `ServoLoop`'s
            commands give it [rad or m]; None if it is not known.
        phases: Name, start and end [s] of the parts that follow each other, e.g. of a plan; empty where it is one.
        ways: What became of each way along a mechanism, as `WayDone.to_dict` says it, `begins` on this clock [s].
        around: What a plan kept clear of, as `Obstacle.to_dict` says it, and how near it came to each [m].

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
        """Return by name what is known of each sample."""
        return {name: values for name in _CURVES if (values := getattr(self, name)) is not None}

    @property
    def mu(self) -> Float[np.ndarray, " T"]:
        """The manipulability, by its letter."""
        return self.manipulability

    @property
    def status_counts(self) -> dict[str, int]:
        """How often each status occurred."""
        return {str(s): self.status.count(s) for s in dict.fromkeys(self.status)}

    def __repr__(self) -> str:
        return f"Rollout({'; '.join(f'{name} {value}' for name, value in self._facts() if value is not None)})"

    def _repr_html_(self) -> str:
        least = f"μ over time, {np.nanmin(self.mu):.3g} at the least" if np.any(np.isfinite(self.mu)) else ""
        picture = html_card.curve(self.time.tolist(), self.mu.tolist(), least)
        return html_card.card("Rollout", html_card.facts(self._facts()), picture)

    def _facts(self) -> list[tuple[str, str | None]]:
        """Name -> value in words; None where there is nothing to say."""
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
        """Return the motion as a demonstration, so that it can be learnt from again."""
        return Trajectory(self.time, self.q, self.u, self.joint_names, name, exact=True)

    def to_frame(self) -> PandasFrame:
        """Return one row per sample: `time`, joint positions and velocities by name, `mu`, `task_error` and `status`.

        Raises:
            RecordingError: Postures that are no joint positions (nq differs from nv) have no column names.
            MissingExtraError: pandas is not installed.
        """
        table: Any = pandas_frame_of([self.trajectory()]).drop(columns=TRAJECTORY)
        return table.assign(mu=self.mu, task_error=self.task_error, status=list(map(str, self.status)))

    def until(self, end: float) -> Rollout:
        """Return the samples up to a time [s]."""
        n = int(np.searchsorted(self.time, end + 1e-9))
        return replace(self, **{name: values[:n] for name, values in self._curves().items()})

    def followed_by(self, other: Rollout) -> Rollout:
        """Join this motion and another one of the same robot that begins where it ends; phases and ways of both."""
        shift = float(self.time[-1])
        time, status = np.concatenate([self.time[:-1], other.time + shift]), (*self.status[:-1], *other.status)
        arrays = ("q", "u", "manipulability", "task_error")
        joined = {name: np.concatenate([getattr(self, name)[:-1], getattr(other, name)]) for name in arrays}
        phases = (*self.phases, *((name, start + shift, end + shift) for name, start, end in other.phases))
        later = ({**way, "begins": None if way["begins"] is None else way["begins"] + shift} for way in other.ways)
        around = dict[str, Mapping[str, Any]]()  # of what stands around in both, where the arm comes nearer to it
        for thing in sorted((*self.around, *other.around), key=lambda thing: thing.get("nearest", np.inf)):
            around.setdefault(json.dumps({k: v for k, v in thing.items() if k not in ("nearest", "link")}), thing)
        parts = {"phases": phases, "ways": (*self.ways, *later), "around": tuple(around.values())}
        return replace(other, time=time, status=status, **joined, following_error=None, **parts)

    def violation(self, constraint: Constraint) -> Float[np.ndarray, " T"]:
        """Return the speed at which each step breaks a constraint with b = 0, in the rows' units per second.

        |A u| with the mean of A(q) at both ends of the step for which u is held; at the last sample A(q).
        """
        A = np.array([constraint(q) for q in self.q])
        A[:-1] = 0.5 * (A[:-1] + A[1:])
        return np.linalg.norm(np.einsum("tij,tj->ti", A, self.u), axis=1)

    def manipulability_of(self, constraint: Constraint) -> Float[np.ndarray, " T"]:
        """Return mu of another constraint along the same motion."""
        return np.array([manipulability(constraint, q) for q in self.q])

    def save(self, path: str | Path) -> Path:
        """Write a file, whole or not at all.

        Args:
            path: Its ending says the format: `.npz` (NumPy) and `.csv` (text table) are read by `Rollout.load` and
                `load_demonstrations`, bit for bit; `.mcap` is a bag for ROS 2 (JointState messages).

        Raises:
            OutputError: It cannot be written, or has another ending.
            MissingExtraError: `.mcap` needs the extra `ros`.
        """
        told = {name: getattr(self, name) for name in _HEADER}
        told |= {"target": None if self.target is None else self.target.tolist(), "nq": self.q.shape[1]}
        header = FileHeader("rollout", following_error=self.following_error is not None, **told)
        return write_motion(path, SavedMotion(header, self._curves() | {"status": np.array(self.status, dtype=str)}))

    @staticmethod
    def load(path: str | Path, robot: Robot | None = None) -> Rollout:
        """Read what `save` wrote.

        Args:
            path: The file.
            robot: The robot that it will be used with: another one, or other locked joints, are refused. Without one
                the rollout still knows its own: `load_robot(name, locked=rollout.robot.locked)` is that robot.

        Raises:
            RecordingError: No such file, another kind of file, or another robot.

        Warns:
            UserWarning: The file does not say which robot it was made with.
        """
        rollout, notes = Rollout.load_with_notes(path, robot)
        for note in notes:
            warnings.warn(printable(f"{Path(path).name}: {note}"), UserWarning, stacklevel=2)
        return rollout

    @staticmethod
    def load_with_notes(path: str | Path, robot: Robot | None = None) -> tuple[Rollout, tuple[str, ...]]:
        """Read as `load` does, but what it warns of is returned, in sentences.

        Raises:
            RecordingError: No such file, another kind of file, or another robot.
        """
        path, motion = Path(path), read_saved(Path(path))
        header = motion.header
        if header.kind != "rollout":
            fix = spoken(": load_demonstrations reads it", ": name a file that `manip-learn control --out` wrote")
            raise refusal(path, "not-a-rollout", f"it is a recording, no rollout{fix}")
        notes = check_robot(path, header, robot) if robot is not None else ()
        if robot is not None and header.joint_names != robot.joint_names:
            made, has = (", ".join(names) for names in (header.joint_names, robot.joint_names))
            text = f"it was made with the joints {made}, robot {robot.name!r} has {has}"
            raise refusal(path, "other-robot", f"{text}: load the robot it was made with, with the same locked joints")
        known, words = set(Status), motion.arrays["status"].tolist()
        if (number := next((i for i, word in enumerate(words) if word not in known), None)) is not None:
            text = f"the status is {words[number]!r:.40}, it must be one of {', '.join(Status)}"
            raise refusal(path, "status", text, where=f"{path.name} sample {number}")
        told = {name: getattr(header, name) for name in (*_HEADER, "target")}
        told |= {name: motion.arrays[name] for name in _CURVES if name in motion.arrays}
        phases = tuple((name, float(start), float(end)) for name, start, end in header.phases or ())
        told |= {"phases": phases, "ways": tuple(header.ways or ()), "around": tuple(header.around or ())}
        told["status"] = tuple(map(Status, words))
        return Rollout(**told), notes


def written_constraint(constraint: Constraint) -> Mapping[str, Any] | None:
    """Return a constraint as a rollout keeps it; None if its features, or what it came from, cannot be written."""
    provenance = {k: v for k, v in constraint.provenance.items() if k not in ("phases", "odd_trajectories")}
    try:
        json.dumps(provenance, allow_nan=False)
        return constraint.to_dict() | {"provenance": provenance}
    except (FeatureError, TypeError, ValueError):  # Python functions; an entry of the user's own
        return None
