"""What a controlled robot did: a rollout, and its file."""

from __future__ import annotations

import io
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.atomic_write import write_atomically
from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.manipulability import manipulability
from manip_learn.control.status import Status
from manip_learn.errors import RecordingError
from manip_learn.recordings.trajectory import Trajectory

FORMAT = "manip_learn.rollout"
# what NumPy and zipfile raise for files that are broken, cut short, or of another kind
DAMAGE = (
    *(OSError, ValueError, KeyError, AttributeError, TypeError, EOFError, NotImplementedError, RuntimeError),
    *(MemoryError, zipfile.BadZipFile, zlib.error),
)


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
