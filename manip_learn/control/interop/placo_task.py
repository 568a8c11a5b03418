"""A learnt task inside PlaCo's kinematics solver, through plain numbers.

PlaCo pins a version of Pinocchio that manip_learn does not run with, so the two live in environments of their own. This
file needs NumPy and PlaCo only: A(q), b and pi come from the other side, e.g. through a socket or shared memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from manip_learn.errors import TargetError

PRIORITIES = ("hard", "soft")


@final
class PlacoTask:
    """A u = b, and pi in its null space, as a constraint and a task of a `placo.KinematicsSolver`.

    PlaCo's tasks cannot be written in Python, but its half-spaces of joint positions are general: with dq = dt u,

        A (q + dq) <= A q + dt b   and   -A (q + dq) <= -A q - dt b

    are equation (1), A u = b, and the joints task (q + dt pi - q - dq)^2 makes of all u with A u = b the one nearest to
    pi, which is u = A^+ b + N pi, equation (2). The solver's own regularisation of 1e-8 pulls it off by 1e-8 of pi;
    `solver.problem.regularization = 0` leaves 1e-13.

    Other tasks, limits and constraints of the solver work beside it.

    Args:
        solver: The `placo.KinematicsSolver`; its `dt` must be set.
        joint_names: Joint of each column of A, as `robot.joint_names`.
        priority: `"hard"` for rows that must hold, `"soft"` to weigh them against other tasks.
        weight: Of the rows, if soft.
        policy_weight: Of the null-space policy.

    Raises:
        TargetError: The solver has no dt, or an unknown priority.
    """

    def __init__(
        self,
        solver: Any,
        joint_names: Sequence[str],
        priority: str = "hard",
        *,
        weight: float = 1e6,
        policy_weight: float = 1.0,
    ):
        if not solver.dt > 0.0:
            raise TargetError("the PlaCo solver needs its time step: set solver.dt [s]")
        if priority not in PRIORITIES:
            raise TargetError(f"priority must be 'hard' or 'soft', not {priority!r}")
        self.joint_names = tuple(joint_names)
        self._solver, self._priority, self._weight = solver, priority, float(weight)
        self._columns = [solver.robot.get_joint_offset(n) for n in self.joint_names]
        self._velocities = [solver.robot.get_joint_v_offset(n) for n in self.joint_names]
        self._half_spaces: Any = None
        self._policy = solver.add_joints_task()
        self._policy.configure("null-space policy", "soft", float(policy_weight))

    def update(self, A: ArrayLike, b: ArrayLike, pi: ArrayLike | None = None) -> None:
        """The rows, their velocities and the policy at the posture of the solver's robot; call it before each `solve`.

        Args:
            A: Constraint matrix at this posture, shape (s, nv).
            b: Task velocity, shape (s,).
            pi: Null-space policy, shape (nv,) [rad/s or m/s]; None for zero, the plain pseudo-inverse.

        Raises:
            TargetError: Sizes that do not fit, or numbers that are not finite.
        """
        rows, rate, policy = _checked(A, b, pi, len(self.joint_names))
        robot, dt = self._solver.robot, self._solver.dt
        q = np.array([robot.get_joint(n) for n in self.joint_names])
        lhs = np.zeros((2 * len(rows), robot.state.q.shape[0]))
        lhs[: len(rows), self._columns], lhs[len(rows) :, self._columns] = rows, -rows
        bound = rows @ q + dt * rate
        if self._half_spaces is not None:
            self._solver.remove_constraint(self._half_spaces)
        self._half_spaces = self._solver.add_joint_space_half_spaces_constraint(lhs, np.concatenate([bound, -bound]))
        self._half_spaces.configure("learnt task", self._priority, self._weight)
        self._policy.set_joints(dict(zip(self.joint_names, (q + dt * policy).tolist(), strict=True)))

    def velocity(self, solution: ArrayLike) -> Float[np.ndarray, " nv"]:
        """Joint velocities, in the order of `joint_names`, out of what `solver.solve` returned [rad/s or m/s]."""
        return np.asarray(solution, dtype=np.float64)[self._velocities] / self._solver.dt


def _checked(A: ArrayLike, b: ArrayLike, pi: ArrayLike | None, nv: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rows, rate = np.asarray(A, dtype=np.float64), np.asarray(b, dtype=np.float64)
    policy = np.zeros(nv) if pi is None else np.asarray(pi, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != nv or rate.shape != rows.shape[:1] or policy.shape != (nv,):
        raise TargetError(
            f"A must have {nv} columns, b one number per row and pi {nv} numbers; "
            f"got shapes {rows.shape}, {rate.shape} and {policy.shape}"
        )
    if not all(np.all(np.isfinite(x)) for x in (rows, rate, policy)):
        raise TargetError("A, b and pi must be finite numbers")
    return rows, rate, policy
