"""Limits whose program is compiled (the optional extra `fast`), behind a law that Python computes."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.util import find_spec
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.control.command import STATUSES, Command
from manip_learn.control.compiled import step_table as table
from manip_learn.control.limits import Limits
from manip_learn.control.resolved_rate_law import Law
from manip_learn.errors import MissingExtraError
from manip_learn.linalg import Inverse
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.frame import Frame

LARGEST_ACCELERATION = 1e12  # [rad/s2] stands for none in the kernel, which must stay finite


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
        self._nv = nv
        law, work = np.ones((table.PARTS + 2, nv)), np.ones((1, table.N_FACTS))
        arguments = (self._constants, np.zeros(nv), 0.01, self._unknown, 0.0, law, work)
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
        s = law.b.shape[0]
        rows, work = np.empty((table.PARTS + 1 + s, self._nv)), np.empty((1, table.N_FACTS))
        rows[table.VELOCITY], rows[table.TASK_PART], rows[table.NULL_PART] = velocity, task, null
        if escape is not None:
            rows[table.ESCAPE_PART] = escape
        rows[table.TASK_VELOCITY, :s] = law.b
        rows[table.PARTS] = math.nan if slope is None else slope
        rows[table.PARTS + 1 :] = law.A
        facts = work[table.FACTS]
        facts[table.SMALLEST], facts[table.HAS_ESCAPE] = law.smallest, escape is not None
        facts[table.RANK] = s if law.decomposition is None else -1.0
        x = np.ascontiguousarray(q if q.shape[0] == self._nv else self._robot.positions(q))
        before = self._unknown if previous is None else np.ascontiguousarray(previous, np.float64)
        code = self._bounded(self._constants, x, float(dt), before, float(slide), rows, work)
        numbers = facts.tolist()
        return Command(
            rows[table.VELOCITY], STATUSES[code], law.mu, law.b, rows[table.TASK_PART], rows[table.NULL_PART],
            numbers[table.TASK_SCALE], numbers[table.NULL_SCALE], law.smallest,
            None if escape is None else rows[table.ESCAPE_PART],
            numbers[table.PROGRESS], numbers[table.OUTSIDE], int(numbers[table.LIMITING_JOINT]),
        )  # fmt: skip

    def __reduce__(self) -> tuple[object, ...]:
        return CompiledLimits, self._settings  # machine code stays in its process


def packed_limits(
    limits: Limits | None, nv: int, inverse: Inverse, threshold: float
) -> tuple[Float[np.ndarray, "2 12"], Float[np.ndarray, "nv 12"]]:
    """The two rows of settings and those of the degrees of freedom, as far as limits set them."""
    header, dofs = np.zeros((table.CHAIN, table.WIDTH)), np.zeros((nv, table.WIDTH))
    header[0, table.INVERSE], header[0, table.THRESHOLD] = table.INVERSES.index(inverse), threshold
    header[0, table.LIMITS] = limits is not None
    if limits is not None:
        dofs[:, :3] = np.stack((limits.velocity, limits.lower, limits.upper), axis=1)
        dofs[:, table.ACCELERATION] = np.minimum(limits.acceleration, LARGEST_ACCELERATION)
    return header, dofs


def tips_are_compiled(limits: Limits | None) -> bool:
    """Whether compiled code knows the chains of all frames whose speed or place is limited; True where none is."""
    return limits is None or limits.tip is None or all(_chain_of(limits, frame) for frame in limits.tip.frames)


def with_tips(constants: Float[np.ndarray, "rows 12"], limits: Limits | None) -> Float[np.ndarray, "all_rows 12"]:
    """A table of constants, with the limits of frames behind it where there are any."""
    if limits is None or limits.tip is None:
        return constants
    from manip_learn.robot.batch.compiled_kinematics import JOINTS  # and with it numba

    tip, numbers = limits.tip, np.zeros((1 + len(limits.tip.walls), table.WIDTH))
    numbers[0, table.N_FRAMES], numbers[0, table.N_WALLS] = len(tip.frames), len(tip.walls)
    numbers[0, table.TIP_SPEED], numbers[1:, :4] = tip.speed, tip.walls
    chains = [batch_kinematics(limits.robot, frame).chain_table("world") for frame in tip.frames]
    for chain in chains:
        chain[1, table.LENGTH] = len(chain) - JOINTS
    constants[table.CHAIN + 1, table.TIPS] = len(constants)
    return np.concatenate([constants, numbers, *chains])


def _chain_of(limits: Limits, frame: Frame) -> bool:
    kinematics = batch_kinematics(limits.robot, frame)
    return kinematics.fast and kinematics.public_columns is not None
