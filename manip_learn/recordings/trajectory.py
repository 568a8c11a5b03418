"""A recorded motion: frozen, validated, NumPy only."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.errors import RecordingError


@final
@dataclass(frozen=True, eq=False)
class Trajectory:
    """One demonstration.

    Attributes:
        time: shape (T,), strictly increasing [s].
        q: shape (T, n), postures: joint positions, one column per name [rad or m]; or configurations (nq columns) of a
            robot whose nq differs from nv.
        u: shape (T, nv), joint velocities [rad/s or m/s]; None if they were not recorded.
        joint_names: One name per velocity column, the robot's own names.
        name: Where it came from, for messages.

    Raises:
        RecordingError: Shapes that do not fit, fewer than one row, time that does not increase, NaN or infinity.
    """

    time: Float[np.ndarray, " T"]
    q: Float[np.ndarray, "T n"]
    u: Float[np.ndarray, "T nv"] | None
    joint_names: tuple[str, ...]
    name: str = field(default="trajectory")

    def __post_init__(self) -> None:
        object.__setattr__(self, "joint_names", tuple(self.joint_names))
        object.__setattr__(self, "time", self._array("time", self.time, 1))
        object.__setattr__(self, "q", self._array("q", self.q, 2))
        if self.u is not None:
            object.__setattr__(self, "u", self._array("u", self.u, 2))
        self._check_shapes()
        steps = np.diff(self.time)
        if steps.size and np.min(steps) <= 0.0:
            i = int(np.argmax(steps <= 0.0))
            raise RecordingError(
                f"{self.name}: time must increase, sample {i + 1} is at {self.time[i + 1]} s after {self.time[i]} s",
                code="time-order",
            )

    def _array(self, what: str, values: object, ndim: int) -> np.ndarray:
        try:
            array = np.array(values, dtype=np.float64, order="C")  # a copy: the caller cannot change it
        except (TypeError, ValueError) as error:
            raise RecordingError(f"{self.name}: {what} must be numbers: {error}", code="not-a-number") from error
        if array.ndim != ndim:
            raise RecordingError(
                f"{self.name}: {what} must have {ndim} dimension(s), got shape {array.shape}", code="shape"
            )
        if not np.all(np.isfinite(array)):
            where = np.argwhere(~np.isfinite(array))[0]
            column = ""
            if ndim == 2 and array.shape[1] == len(self.joint_names):
                column = f", joint {self.joint_names[where[1]]!r}"
            raise RecordingError(
                f"{self.name}: {what} of sample {where[0]}{column} is {array[tuple(where)]}, a finite number is "
                "needed: remove the sample or repair the recording",
                code="not-finite",
            )
        array.setflags(write=False)
        return array

    def _check_shapes(self) -> None:
        T, nv = self.time.shape[0], len(self.joint_names)
        if len(set(self.joint_names)) != nv:
            raise RecordingError(
                f"{self.name}: joint names must differ, got {self.joint_names}", code="duplicate-joint"
            )
        if T == 0:
            raise RecordingError(f"{self.name}: there are no samples", code="empty")
        if self.q.shape[0] != T or self.q.shape[1] < nv:
            raise RecordingError(
                f"{self.name}: q must have shape ({T}, {nv}): {T} times and {nv} joint names; got {self.q.shape}",
                code="shape",
            )
        if self.u is not None and self.u.shape != (T, nv):
            raise RecordingError(f"{self.name}: u must have shape ({T}, {nv}), got {self.u.shape}", code="shape")

    def __reduce__(self):
        # through the constructor: a pickled array comes back writeable
        return Trajectory, (self.time, self.q, self.u, self.joint_names, self.name)

    def __len__(self) -> int:
        return int(self.time.shape[0])

    @property
    def duration(self) -> float:
        """Time from first to last sample [s]."""
        return float(self.time[-1] - self.time[0])

    def part(self, samples: slice | np.ndarray, name: str | None = None) -> Trajectory:
        """The chosen samples as a trajectory of their own."""
        u = None if self.u is None else self.u[samples]
        return Trajectory(self.time[samples], self.q[samples], u, self.joint_names, name or self.name)
