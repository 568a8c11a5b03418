"""Limits whose program is compiled (the optional extra `fast`), behind a law that Python computes."""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.control.command import STATUSES, Command
from manip_learn.control.compiled import step_table as table
from manip_learn.control.compiled.limits_table import packed_limits, with_tips
from manip_learn.control.limits import Limits
from manip_learn.control.resolved_rate_law import Law
from manip_learn.errors import MissingExtraError
from manip_learn.linalg import Inverse


@final
class CompiledLimits:
    """The command within the limits, as `ResolvedRateController` computes it, for any features, task and policy.

    Args:
        limits: The limits.
        inverse: As for `ResolvedRateController`.
        threshold: As for `ResolvedRateController`.
        damping: As for `ResolvedRateController`.
        report: Called with a sentence where the code has to be compiled first; by default a line of the logger.

    Raises:
        MissingExtraError: numba is not installed.
    """

    def __init__(
        self,
        limits: Limits,
        inverse: Inverse,
        threshold: float,
        damping: float,
        report: Callable[[str], object] | None = None,
    ):
        if find_spec("numba") is None:
            raise MissingExtraError("the solver 'compiled'", "fast")
        from manip_learn.control.compiled.within_limits import bounded_law
        from manip_learn.robot.batch.compiled_kinematics import JOINTS
        from manip_learn.robot.batch.kernel_cache import announce_compilation, entry_point

        announce_compilation(bounded_law, report)
        self._settings = (limits, inverse, threshold, damping)
        self._robot, nv = limits.robot, limits.velocity.shape[0]
        header, dofs = packed_limits(limits, nv, inverse, threshold)
        header[0, table.NV], header[1, table.DAMPING] = nv, damping
        self._constants = with_tips(np.concatenate([header, np.zeros((JOINTS, table.WIDTH)), dofs]), limits)
        self._unknown = np.full(nv, np.nan)
        self._nv, self._shape = nv, (table.PARTS, nv)
        parts, A = np.zeros(self._shape), np.eye(1, nv)
        arguments = (
            self._constants,
            np.zeros(nv),
            0.01,
            self._unknown,
            0.0,
            parts,
            A,
            self._unknown,
            1.0,
            False,
            False,
        )
        self._bounded = entry_point(bounded_law, *arguments)

    def __call__(
        self,
        q: Float[np.ndarray, " n"],
        dt: float,
        law: Law,
        velocity: Float[np.ndarray, " nv"],
        slope: Float[np.ndarray, " nv"] | None,
        previous: Float[np.ndarray, " nv"] | None,
        slide: float,
    ) -> Command:
        """The command at posture q.

        Args:
            q: Posture, checked.
            dt: Time for which the command is held [s].
            law: The law there, of no more rows than joints.
            velocity: Sum of its parts [rad/s or m/s].
            slope: Gradient of the smallest singular value where the approach to a singularity is bounded.
            previous: Velocity in the step before [rad/s or m/s]; None bounds no acceleration.
            slide: As for `ResolvedRateController`.
        """
        task, null, escape = law.desired
        parts, s = np.empty(self._shape), law.b.shape[0]
        parts[table.VELOCITY], parts[table.TASK_PART], parts[table.NULL_PART] = velocity, task, null
        if escape is not None:
            parts[table.ESCAPE_PART] = escape
        parts[table.TASK_VELOCITY, :s] = law.b
        x = np.ascontiguousarray(q if q.shape[0] == self._nv else self._robot.positions(q))
        before = self._unknown if previous is None else np.ascontiguousarray(previous, np.float64)
        steepness = self._unknown if slope is None else np.ascontiguousarray(slope)
        numbers = (float(law.smallest), law.decomposition is not None, escape is not None)
        found = self._bounded(
            self._constants, x, float(dt), before, float(slide), parts, np.ascontiguousarray(law.A), steepness, *numbers
        )
        code, scale, null_scale, progress, outside, joint = found
        u, task, null, *_ = parts
        return Command(
            u, STATUSES[code], law.mu, law.b, task, null, scale, null_scale, law.smallest,
            None if escape is None else parts[table.ESCAPE_PART], progress, outside, joint,
        )  # fmt: skip

    def __reduce__(self) -> tuple[object, ...]:
        return CompiledLimits, self._settings  # machine code stays in its process
