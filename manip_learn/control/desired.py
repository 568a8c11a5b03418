"""The law at one posture before bounds, and the command that became of it."""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.manipulability import SINGULAR_RATIO
from manip_learn.control.command import SCALED_BELOW, Command, status_of
from manip_learn.control.limits import FINE, Bounds

AT_GOAL = 1e-6  # [m/s or rad/s] a task that asks for less than this has reached its goal


@final
class Desired(NamedTuple):
    """The law at one posture before bounds, and what the program needs of it.

    Attributes:
        A: Rows whose velocity is b: those of the constraint, or of the error (see `Task.error_jacobian`).
        b: Wanted of them.
        task: A^# b.
        null: The policy's part in the null space of A.
        escape: The policy's part along directions that are nearly lost; None away from singularities.
        mu: Manipulability of the constraint.
        smallest: Its smallest singular value.
        basis: X (s, nv) with X A^T = 1 where A is well conditioned, or an orthonormal basis of its rows.
        gain: Y (s, nv), so that A^# b = Y^T b.
        is_damped: Whether a smallest singular value of the constraint below the threshold damps the law.
        damping: lambda of the driven rows; 0 away from singularities.
    """

    A: Float[np.ndarray, "s nv"]
    b: Float[np.ndarray, " s"]
    task: Float[np.ndarray, " nv"]
    null: Float[np.ndarray, " nv"]
    escape: Float[np.ndarray, " nv"] | None
    mu: float
    smallest: float
    basis: Float[np.ndarray, "s nv"]
    gain: Float[np.ndarray, "s nv"]
    is_damped: bool = False
    damping: float = 0.0

    @property
    def is_lost(self) -> bool:
        """Whether A loses a direction: at a singularity, or with more rows than joints that b does not fit."""
        s, nv = self.A.shape
        if self.escape is None:
            return False
        if s > nv:
            return self.progress(self.task) < SCALED_BELOW
        return self.smallest <= SINGULAR_RATIO * float(np.abs(self.A).max())

    @property
    def velocity(self) -> Float[np.ndarray, " nv"]:
        """u*, the sum of its parts [rad/s or m/s]."""
        regular = self.task + self.null
        return regular if self.escape is None else regular + self.escape

    def progress(self, u: Float[np.ndarray, " nv"]) -> float:
        """Velocity along b over the velocity asked for, b^T A u / |b|^2; 1 where nothing is asked for."""
        square = float(self.b.dot(self.b))
        return float(self.b.dot(self.A.dot(u))) / square if square > AT_GOAL * AT_GOAL else 1.0

    def as_wished(self, u: Float[np.ndarray, " nv"], outside: float) -> Command:
        """The command where no bound changes the law.

        Args:
            u: u*.
            outside: Largest distance of a joint beyond a position limit [rad or m].
        """
        progress = 1.0 if self.escape is None else self.progress(u)
        status = status_of(progress, outside, self.is_lost, self.is_damped)
        return Command(
            *(u, status, self.mu, self.b, self.task, self.null, 1.0, 1.0, self.smallest, self.escape, progress, outside)
        )

    def within(
        self, bounds: Bounds, wish: Float[np.ndarray, " nv"], u: Float[np.ndarray, " nv"], cause: int
    ) -> Command:
        """The command where bounds change the law.

        Args:
            bounds: Of the joints.
            wish: u*.
            u: What is left of it.
            cause: The limit that counts where no joint is at a bound; -1 for the approach to a singularity.
        """
        null_part, escape = self._null_part(u), self.escape
        task_part = u - null_part
        if escape is not None:
            share = float(u.dot(escape)) / max(float(escape.dot(escape)), 1e-300)
            escape = escape * min(1.0, max(0.0, share))
            task_part = task_part - escape
        square = float(self.null.dot(self.null))
        asks = square > AT_GOAL**2  # what rounding leaves of a policy that asks for nothing is not scaled
        null_scale = min(1.0, max(0.0, float(self.null.dot(null_part)) / square)) if asks else 1.0
        progress = self.progress(u)
        before = 1.0 if self.escape is None else self.progress(self.task)
        scale = min(1.0, max(0.0, progress / before)) if before > 0.0 else 1.0
        joint, limit = bounds.binding(u, wish)
        status = status_of(
            *(progress, bounds.outside, self.is_lost, self.is_damped),
            changed=True,
            scale=scale,
            cause=cause if joint < 0 else limit,
            fits=bounds.excess(self.task) <= FINE,
        )
        return Command(
            *(u, status, self.mu, self.b, task_part, null_part, scale, null_scale, self.smallest, escape, progress),
            outside=bounds.outside,
            limiting_joint=joint,
        )

    def _null_part(self, u: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
        """The component of a velocity in the null space of A."""
        X = self.basis
        return u - (self.A.dot(u).dot(X) if self.escape is None else X.dot(u).dot(X))
