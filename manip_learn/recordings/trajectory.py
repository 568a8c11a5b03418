"""A recorded motion: frozen, validated, NumPy only; and fewer of its samples."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.errors import RecordingError, counted, printable

BESIDE_POSITIONS = ("u", "effort")  # what a trajectory may have beside its positions


@final
@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """One demonstration.

    Attributes:
        time: shape (T,), strictly increasing [s].
        q: shape (T, n), postures: joint positions, one column per name [rad or m]; or configurations (nq columns) of a
            robot whose nq differs from nv.
        u: shape (T, nv), joint velocities [rad/s or m/s]; None if they were not recorded. NaN where one was not
            measured: all are then derived from the positions when the motion is learnt from.
        joint_names: One name per velocity column, the robot's own names.
        name: Where it came from, for messages.
        effort: shape (T, nv), what the motors exert, gravity and friction included [N m or N], by keyword; None if it
            was not recorded. Nothing is learnt from it.
        sha256: By keyword; the SHA-256 of the file that it was read from, empty for what was not read from one.
        judged: By keyword; True where u has been compared with the positions, or is to be taken as it is.

    Raises:
        RecordingError: Shapes that do not fit, fewer than one row, time that does not increase, NaN or infinity.

    Example:
        >>> import numpy as np
        >>> import manip_learn as ml
        >>> time = np.linspace(0.0, 2.0, 201)  # [s]
        >>> demo = ml.Trajectory(time, np.outer(np.sin(time), [0.3, 0.8, 0.4]))  # three joints [rad]
        >>> cut = demo[0.5:1.5]  # by time
        >>> cut.time[0], len(cut.time)
        (np.float64(0.5), 101)
    """

    time: Float[np.ndarray, " T"]
    q: Float[np.ndarray, "T n"]
    u: Float[np.ndarray, "T nv"] | None = None
    joint_names: tuple[str, ...] = ()
    name: str = field(default="trajectory")
    effort: Float[np.ndarray, "T nv"] | None = field(default=None, kw_only=True)
    judged: bool = field(default=False, kw_only=True)
    sha256: str = field(default="", kw_only=True)

    def __post_init__(self) -> None:
        object.__setattr__(self, "joint_names", tuple(self.joint_names))
        object.__setattr__(self, "name", printable(self.name))  # of a file, whose maker may have written anything
        for what in ("time", "q", *BESIDE_POSITIONS):
            given = getattr(self, what)
            if what in ("time", "q") or given is not None:
                object.__setattr__(self, what, self._array(what, given, 1 if what == "time" else 2))
        self._check_shapes()
        steps = np.diff(self.time)
        if steps.size and np.min(steps) <= 0.0:
            i = int(np.argmax(steps <= 0.0))
            text = f"{self.name}: time must increase, sample {i + 1} is at {self.time[i + 1]} s after {self.time[i]} s"
            raise RecordingError(text, code="time-order")

    def _array(self, what: str, values: object, ndim: int) -> np.ndarray:
        try:
            array = np.asarray(values, dtype=np.float64, order="C")
            if array.flags.writeable or array.base is not None:
                array = array.copy()  # so that the caller cannot change it
        except (TypeError, ValueError) as error:
            raise RecordingError(f"{self.name}: {what} must be numbers: {error}", code="not-a-number") from error
        if array.ndim != ndim:
            raise RecordingError(
                f"{self.name}: {what} must have {counted(ndim, 'dimension')}, got shape {array.shape}", code="shape"
            )
        if what != "u" and not np.all(np.isfinite(array)):
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
        T = self.time.shape[0]
        nv = len(self.joint_names) or (self.q if self.u is None else self.u).shape[1]
        if self.joint_names and len(set(self.joint_names)) != nv:
            raise RecordingError(
                f"{self.name}: joint names must differ, got {self.joint_names}", code="duplicate-joint"
            )
        if T == 0:
            raise RecordingError(f"{self.name}: there are no samples", code="empty")
        if self.q.shape[0] != T or self.q.shape[1] < nv:
            text = f"{self.name}: q must have shape ({T}, {nv}): {T} times and {nv} joint names; got {self.q.shape}"
            raise RecordingError(text, code="shape")
        for what, array in self.beside.items():
            if array.shape != (T, nv):
                raise RecordingError(
                    f"{self.name}: {what} must have shape ({T}, {nv}), got {array.shape}", code="shape"
                )

    def __reduce__(self):
        # through the constructor: a pickled array comes back writeable
        kept = self.beside | {"judged": self.judged, "sha256": self.sha256}
        return partial(Trajectory, joint_names=self.joint_names, name=self.name, **kept), (self.time, self.q)

    def __len__(self) -> int:
        return int(self.time.shape[0])

    def __repr__(self) -> str:
        joints = len(self.joint_names) or (self.q if self.u is None else self.u).shape[1]
        velocities = "without" if self.u is None else "with"
        also = "" if self.effort is None else " and efforts"
        amount = f"{counted(len(self), 'sample')} over {self.duration:.4g} s"
        return f"Trajectory({self.name!r}: {amount}, {counted(joints, 'joint')}, {velocities} velocities{also})"

    @property
    def beside(self) -> dict[str, Any]:
        """The arrays beside the positions, by their names: of `u` and `effort` those that are there."""
        return {name: array for name in BESIDE_POSITIONS if (array := getattr(self, name)) is not None}

    @property
    def duration(self) -> float:
        """Time from first to last sample [s]."""
        return float(self.time[-1] - self.time[0])

    def __getitem__(self, span: slice) -> Trajectory:
        """The samples from `start` to `end`, both included, on the recording's own clock: `demo[2.0:5.5]` [s].

        Raises:
            RecordingError: Not a span of time, or no sample lies in it.
        """
        if not isinstance(span, slice) or span.step is not None:
            raise RecordingError(
                f"{self.name}: a trajectory is cut by a span of time in seconds, as in trajectory[2.0:5.5], not by "
                f"{span!r}; use .part for sample numbers",
                code="span",
            )
        start = -np.inf if span.start is None else float(span.start)
        end = np.inf if span.stop is None else float(span.stop)
        inside = np.flatnonzero((self.time >= start) & (self.time <= end))
        if inside.size == 0:
            raise RecordingError(
                f"{self.name}: no sample lies between {start:g} s and {end:g} s; the recording runs from "
                f"{self.time[0]:g} s to {self.time[-1]:g} s",
                code="span",
            )
        return self.part(slice(int(inside[0]), int(inside[-1]) + 1))

    def with_joint_names(self, joint_names: tuple[str, ...]) -> Trajectory:
        """This motion with its columns named, e.g. by the robot it is used with.

        Raises:
            RecordingError: Another number of columns.
        """
        return replace(self, joint_names=joint_names)

    def part(self, samples: slice | np.ndarray, name: str | None = None) -> Trajectory:
        """The chosen samples as a trajectory of their own."""
        cut = {what: array[samples] for what, array in self.beside.items()}
        return replace(self, time=self.time[samples], q=self.q[samples], name=name or self.name, **cut)


def subsample(trajectory: Trajectory, n_samples: int) -> Trajectory:
    """At most n_samples samples, evenly spread.

    Raises:
        RecordingError: n_samples is not positive.
    """
    if n_samples < 1:
        raise RecordingError(f"the number of samples must be positive, got {n_samples}", code="samples")
    if len(trajectory) <= n_samples:
        return trajectory
    return trajectory.part(evenly(len(trajectory), n_samples))


def evenly(n: int, most: int) -> Int[np.ndarray, " k"]:
    """At most so many of n places in order, evenly spread, the first and the last among them; none of none."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(int))
