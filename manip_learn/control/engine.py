"""The law compiled: `manip_learn_fast`, built from `fast/`, in the place of `law.Law` where it is installed.

It is never needed: the law in Python is the text, the compiled one follows it section by section and gives the same
numbers. What it does not know (rows, tasks and policies of users, ways) is computed in Python and handed in.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any, final

import numpy as np

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.command import Command, Status
from manip_learn.control.law import Law
from manip_learn.control.limits import Limits

_LOGGER = logging.getLogger("manip_learn")
LAW_VERSION = 1  # of the numbers that the law gives: fast/src/law.hpp has the same


@cache
def _compiled() -> tuple[Any, str]:
    """The compiled module, or None and why; says once what is wrong with one that is there."""
    try:
        module = import_module("manip_learn_fast")
        version = module.LAW_VERSION
    except Exception as error:  # whatever is wrong with it, the law in Python does the work
        if isinstance(error, ModuleNotFoundError) and error.name == "manip_learn_fast":
            return None, "manip_learn_fast is not installed"
        module, version, reason = None, None, f"manip_learn_fast cannot be loaded ({error!r})"
    else:
        reason = f"manip_learn_fast has version {version!r} of the law, this library needs {LAW_VERSION}"
    if version == LAW_VERSION:
        return module, ""
    _LOGGER.warning("%s: build it again with pip install ./fast; until then the law runs in Python", reason)
    return None, reason


@final
class NativeLaw:
    """`Law.command` of one law within one set of limits, compiled.

    Args:
        law: The law.
        limits: Its limits, or None.

    Attributes:
        step: (q, dt, previous, slide) -> command, of plain postures and where nothing is left to Python; else None.
        roll: Whole rollouts, or None where something is left to Python (see `simulation`).

    Raises:
        LookupError: The law in Python has to do the work; says why.
    """

    def __init__(self, law: Law, limits: Limits | None):
        if os.environ.get("MANIP_LEARN_ENGINE") == "python":
            raise LookupError("MANIP_LEARN_ENGINE=python")
        module, reason = _compiled()
        if module is None:
            raise LookupError(reason)
        self._law, self._limits = law, limits
        described = module.description(law, limits)
        self._unknown = tuple(described[part] is None for part in ("rows", "task", "policy"))
        self._engine = module.Engine(described, Command, list(Status))
        whole = not any(self._unknown)
        self.step: Callable[..., Command | None] = self._engine.step if whole else _left_to_python
        self.roll = self._engine.roll if whole and limits is not None and law.inverse == "damped" else None

    def command(self, q: np.ndarray, t: float, dt: float, previous: np.ndarray | None, slide: float) -> Command | None:
        """As `Law.command`, q checked; None where that has to do it."""
        law, constraint, plain = self._law, self._law.constraint, np.ascontiguousarray
        rows, task, policy = self._unknown
        robot, A, rates, b, E, D, w = constraint.robot, None, None, None, None, None, None
        x = q if robot is None else robot.positions(q)
        if rows:
            A, rates = plain(constraint(q), np.float64), _Rates(constraint, q)
        if task:
            b, E = law.task_velocity(q, t, dt)
            D = plain(law.task.driven_rows(constraint), np.float64)
            b, E = plain(b), None if E is None else plain(E, np.float64)
        if policy:
            w = plain(law.policy_velocity(q, t, dt))
        return self._engine.command(plain(x), dt, previous, slide, b, E, D, w, A, rates)

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


def native_law(law: Law, limits: Limits | None) -> NativeLaw | None:
    """The compiled law; None where the law in Python has to do the work."""
    try:
        return NativeLaw(law, limits)
    except LookupError as reason:
        _LOGGER.debug("the law runs in Python: %s", reason)
        return None
