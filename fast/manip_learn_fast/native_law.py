"""The law compiled, with what it leaves to Python: single commands and whole rollouts."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, final

import numpy as np

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.command import Command, Status
from manip_learn.control.controller import ResolvedRateController, native_law
from manip_learn.control.law import Law
from manip_learn.control.limits import Limits
from manip_learn.control.rollout import Rollout
from manip_learn.robot.identity import RobotIdentity
from manip_learn_fast._engine import Engine  # pyright: ignore[reportMissingImports]
from manip_learn_fast.description import description

SAMPLES = 200  # of a rollout, between two reports
STATUSES = np.array(list(Status), dtype=object)


@final
class NativeLaw:
    """`Law.command` of one law within one set of limits, compiled.

    Args:
        law: The law.
        limits: Its limits, or None.

    Attributes:
        step: (q, dt, previous, slide) -> command, of plain postures and where nothing is left to Python; else None.

    Raises:
        LookupError: The law in Python has to do the work; says why.
    """

    def __init__(self, law: Law, limits: Limits | None):
        self._law, self._limits = law, limits
        described = description(law, limits)
        self._unknown = tuple(described[part] is None for part in ("rows", "task", "policy"))
        self._engine = Engine(described, Command, list(Status))
        self._clears = None if limits is None else limits.barriers.clear
        self._whole = not any(self._unknown) and self._clears is None
        self.step: Callable[..., Command | None] = self._engine.step if self._whole else _left_to_python

    def command(self, q: np.ndarray, t: float, dt: float, previous: np.ndarray | None, slide: float) -> Command | None:
        """As `Law.command`, q checked; None where that has to do it."""
        law, constraint, plain = self._law, self._law.constraint, np.ascontiguousarray
        rows, task, policy = self._unknown
        robot, A, rates, bend, b, E, D, w = constraint.robot, None, None, None, None, None, None, None
        x = q if robot is None else robot.positions(q)
        if rows:
            A, rates = plain(constraint(q), np.float64), _Rates(constraint, q)
            bend = None if previous is None else plain(law.bend(q, dt, A, previous), np.float64)
        if task:
            b, E = law.task_velocity(q, t, dt)
            D = plain(law.task.driven_rows(constraint), np.float64)
            b, E = plain(b), None if E is None else plain(E, np.float64)
        if policy:
            w = plain(law.policy_velocity(q, t, dt))
        clear = None
        if self._clears is not None and self._limits is not None:
            clear = partial(self._clears.rows, q, dt, self._limits.acceleration, previous)
        return self._engine.command(plain(x), dt, previous, slide, b, E, D, w, A, rates, bend, clear)

    def rollouts(
        self,
        controller: ResolvedRateController,
        starts: np.ndarray,
        dt: float,
        steps: int,
        progress: Callable[[str, float], None] | None,
    ) -> Sequence[Rollout | None]:
        """Whole rollouts as a `ServoLoop` in simulation makes them, of tables on all cores; None where Python has to.

        Args:
            controller: Whose law this is.
            starts: shape (k, n).
            dt: Step [s].
            steps: Number of steps.
            progress: Called with a title and the completed fraction.
        """
        from manip_learn.control.simulation import guided  # which asks for this module

        (k, n), robot, limits, law = starts.shape, controller.robot, self._limits, self._law
        left = not self._whole or limits is None or limits.jerk is not None or law.inverse != "damped"
        if left or robot is None or n != robot.nv or not robot.positions_add_up:
            return (None,) * k
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        q, u, slides = np.array(starts, dtype=np.float64), np.zeros((k, n)), np.zeros(k)
        failed, parts, chunk = np.zeros(k, dtype=bool), [], steps + 1 if progress is None else SAMPLES
        for first in range(0, steps + 1, chunk):
            size = min(chunk, steps + 1 - first)
            tables = np.empty((k, size, n)), np.empty((k, size, n)), np.empty((k, size, 3))
            failed |= self._engine.roll(q, u, slides, dt, size, *tables, cores)
            parts.append(tables)
            if progress is not None and not failed.all():
                progress("simulating", (first + size) / (steps + 1))
        postures, velocities, numbers = parts[0] if len(parts) == 1 else map(np.hstack, zip(*parts, strict=True))
        shared = guided(controller) | {"robot": RobotIdentity.of(robot), "joint_names": robot.joint_names}
        time, words = np.arange(steps + 1) * dt, numbers[:, :, 2].astype(int)
        out: list[Rollout | None] = []
        for i, wrong in enumerate(failed.tolist()):
            status = tuple(STATUSES[words[i]])
            curves = {"time": time, "q": postures[i], "u": velocities[i], "manipulability": numbers[i, :, 0]}
            rollout = None if wrong else Rollout(**curves, status=status, task_error=numbers[i, :, 1], **shared)
            out.append(rollout)
        return out

    def __reduce__(self) -> tuple[Any, ...]:
        return native_law, (self._law, self._limits)


def _left_to_python(*_arguments: Any) -> None:
    return None


@final
class _Rates:
    """The vector-Jacobian product of rows at a posture, computed when it is first asked for."""

    def __init__(self, constraint: Constraint, q: np.ndarray):
        self._constraint, self._q, self._vjp = constraint, q, None

    def __call__(self, weights: np.ndarray) -> np.ndarray:
        if self._vjp is None:
            self._vjp = self._constraint.value_and_vjp(self._q)[1]
        return self._vjp(weights)
