"""Who solves the programs that keep limits: DAQP, the library's own method, or that method compiled (extra `fast`)."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.util import find_spec
from typing import Literal, final

import numpy as np
from jaxtyping import Float

from manip_learn.control.bounded_velocity import Desired
from manip_learn.control.limits import Limits
from manip_learn.control.outcome import Outcome
from manip_learn.control.resolved_rate_law import Law, LawSettings
from manip_learn.errors import ConstraintError, MissingExtraError

Solver = Literal["qp", "active-set", "compiled"]
_contiguous = np.ascontiguousarray


def checked_solver(solver: Solver) -> Solver:
    """A solver by its name.

    Raises:
        ConstraintError: Unknown name.
    """
    if solver not in ("qp", "active-set", "compiled"):
        raise ConstraintError(f"solver must be 'qp', 'active-set' or 'compiled', not {solver!r}")
    return solver


@final
class CompiledLimits:
    """`outcome.within_limits` compiled, behind a law that Python computes: for any features, task and policy.

    Args:
        settings: Of the law.
        limits: The limits.
        report: Called with a sentence where the code has to be compiled first; by default a line of the logger.

    Raises:
        MissingExtraError: numba is not installed.
    """

    def __init__(self, settings: LawSettings, limits: Limits, report: Callable[[str], object] | None = None):
        if find_spec("numba") is None:
            raise MissingExtraError("the solver 'compiled'", "fast")
        from manip_learn.control.compiled_step import bounded_law
        from manip_learn.robot.batch.kernel_cache import announce_compilation, entry_point

        announce_compilation(bounded_law, report)
        self._settings, self._limits = settings, limits
        nv = limits.velocity.shape[0]
        rows, zero = np.eye(1, nv), np.zeros(nv)
        law = Law(
            A=rows,
            b=np.zeros(1),
            desired=Desired(zero, zero, zero),
            escapes=False,
            mu=1.0,
            smallest=1.0,
            singular=False,
            regular=True,
            basis=rows,
            sloped=False,
            slope=zero,
            barred=True,
        )
        self._idle = np.zeros(nv)
        self._bounded = entry_point(bounded_law, *self._arguments(law, zero, 0.01, None, 0.0, math.inf, zero))

    def __call__(
        self,
        law: Law,
        q: Float[np.ndarray, " n"],
        dt: float,
        previous: Float[np.ndarray, " nv"] | None,
        slide: float,
        bound: float,
        slope: Float[np.ndarray, " nv"],
    ) -> Outcome:
        """The outcome at a posture.

        Args:
            law: Of no more rows than joints.
            q: The posture, checked.
            dt: Time for which the command is held [s].
            previous: Velocity in the step before [rad/s or m/s]; None bounds no acceleration.
            slide: See `ResolvedRateController`.
            bound: On the approach to a singularity, see `approach_bound`; inf for none.
            slope: Gradient of the smallest singular value, where there is a bound.
        """
        return self._bounded(*self._arguments(law, q, dt, previous, slide, bound, slope))

    def _arguments(
        self,
        law: Law,
        q: np.ndarray,
        dt: float,
        previous: np.ndarray | None,
        slide: float,
        bound: float,
        slope: np.ndarray,
    ) -> tuple[object, ...]:
        """In the types that machine code has been made for."""
        packed = Law(
            A=_contiguous(law.A),
            b=_contiguous(law.b),
            desired=Desired(*map(_contiguous, law.desired)),
            escapes=law.escapes,
            mu=law.mu,
            smallest=law.smallest,
            singular=bool(law.singular),
            regular=law.regular,
            basis=_contiguous(law.basis),
            sloped=bool(law.sloped),
            slope=_contiguous(slope),
            barred=law.barred,
        )
        x = _contiguous(q if q.shape[0] == self._idle.shape[0] else self._limits.robot.positions(q))
        before = self._idle if previous is None else _contiguous(previous, np.float64)
        known = previous is not None
        return self._settings, self._limits.table(dt), packed, x, before, known, float(slide), float(bound)

    def __reduce__(self) -> tuple[object, ...]:
        return CompiledLimits, (self._settings, self._limits)  # machine code stays in its process
