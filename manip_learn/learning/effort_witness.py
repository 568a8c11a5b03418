"""Recorded efforts, a witness that the motion knows nothing of: the share of the contact along the held rows.

An ideal contact does no work, so that what it adds to the joints' efforts is A(q)^T f: it lies in the span of the held
rows. With tau the efforts recorded and tau_free what the same motion needs without contact, tau_ext = tau - tau_free,

    share = sum |P W tau_ext|^2 / sum |W tau_ext|^2,    P the projector on the span of W A^T,

W one over the residual of each joint's effort in free motion. A dense Lambda of as many rows, drawn at random, has the
share of chance. Gravity, inertia and friction have to be taken off: by inverse dynamics where the robot has inertias,
plus an offset and friction (viscous and dry) of each joint fitted to free stretches; without inertias these are fitted
there too, in the regressor of the dynamics. What is fitted is judged on stretches that were left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.features.frame_jacobian import FrameJacobian
from manip_learn.learning import deciding
from manip_learn.linalg import batch_row_spaces, orthonormal_rows
from manip_learn.recordings.local_fit import best_window, local_fit
from manip_learn.recordings.preprocessing import evenly
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.dynamics import has_inertias, inverse_dynamics, torque_regressor
from manip_learn.robot.robot import Robot

# samples of each of contact and free motion: a share is uncertain by its neighbours' likeness long before that
MOST_SAMPLES = 1500
# rows drawn at random; the highest but 5 % are known to a few percent
DRAWS = 200
# samples of the shortest stretch in which accelerations can be had: a window of 5, and its ends
SHORTEST = 12
RANK = 1e-6  # share of the largest singular value below which a combination of parameters is not determined


@final
@dataclass(frozen=True)
class EffortWitness:
    """How much of what the contact exerts lies in the span of the held rows.

    Attributes:
        share: Of the contact's effort, 1 for an ideal contact with the right rows.
        chance: The same for as many rows drawn at random, in the mean.
        high: What 95 % of these stay below.
        free: The share that the same rows have of the residual in free motion; None without free stretches.
        stands_out: Mean square of the effort in contact over that; None without free stretches.
        n_samples: In contact.
    """

    share: float
    chance: float
    high: float
    free: float | None
    stands_out: float | None
    n_samples: int

    def sentence(self) -> str:
        """In words."""
        free = "" if self.free is None else f", {100.0 * self.free:.0f} % of what is left in free motion"
        beside = f"rows drawn at random have {100.0 * self.chance:.0f} % (95 % of them below {100.0 * self.high:.0f} %)"
        verdict = (
            "" if self.share > self.high else "; that is no more than chance, so the efforts do not confirm the rows"
        )
        return f"{100.0 * self.share:.0f} % of the contact's effort is along the held rows; {beside}{free}{verdict}"


def effort_witness(
    features: FeatureMap,
    selection: Float[np.ndarray, "s p"],
    contact: Sequence[Trajectory],
    free: Sequence[Trajectory] = (),
) -> EffortWitness | None:
    """The share of the contact's effort in the span of the held rows, and what chance makes of it.

    Args:
        features: Phi, of a robot.
        selection: Lambda.
        contact: Stretches in which the rows are held, with velocities.
        free: Stretches of free motion.

    Returns:
        None where nothing can be told: no efforts; all rows held; neither inertias nor free motion; or a contact that
        pushes less than the residual of the efforts in free motion.
    """
    robot, around = getattr(features, "robot", None), _around(features, len(selection))
    held, moves = _motions(contact), _motions(free)
    if robot is None or around is None or not held or not (has_inertias(robot) or moves):
        return None
    tau, q, left = _external(robot, held, moves)
    W = np.ones(robot.nv) if left is None else 1.0 / np.sqrt(np.mean(left**2, axis=0) + np.finfo(np.float64).tiny)
    energy = float(np.mean(np.sum((tau * W) ** 2, axis=1)))
    stands_out = None if left is None else energy / robot.nv
    if energy == 0.0 or (stands_out is not None and stands_out < deciding.EFFORT_STANDS_OUT):
        return None
    share, rng = _share(features.batch(q) * W, selection, tau * W), np.random.default_rng(0)
    Phi, s, p = around.batch(q) * W, len(selection), around.n_rows
    # rows of unlike units (m beside rad) are drawn as strong as the features are
    size = 1.0 / np.sqrt(np.mean(np.sum(Phi**2, axis=2), axis=0) + np.finfo(np.float64).tiny)
    drawn = [_share(Phi, orthonormal_rows(rng.standard_normal((s, p))) * size, tau * W) for _ in range(DRAWS)]
    own = None
    if left is not None:
        own = _share(features.batch(np.concatenate([m.q for m in moves])) * W, selection, left * W)
    high = float(np.quantile(drawn, 1.0 - deciding.FALSE_ALARMS))
    return EffortWitness(share, float(np.mean(drawn)), high, own, stands_out, len(tau))


def _around(features: FeatureMap, s: int) -> FeatureMap | None:
    """Features with more than s rows, among which others could be held; None if there are none.

    All rows of a mechanism's place are held: other rows are those of its frame's velocity, or of its twist.
    """
    frame, robot = getattr(features, "frame", None), getattr(features, "robot", None)
    choices = [features]
    if frame is not None and robot is not None:
        choices += [FrameJacobian(robot, frame, axes, "world") for axes in ("xyz", "pose")]
    return next((one for one in choices if s < min(one.n_rows, one.nv)), None)


@final
@dataclass(frozen=True, eq=False)
class _Motion:
    """Samples of one stretch with accelerations and efforts."""

    q: Float[np.ndarray, "T n"]
    u: Float[np.ndarray, "T nv"]
    du: Float[np.ndarray, "T nv"]
    effort: Float[np.ndarray, "T nv"]


def _motions(trajectories: Sequence[Trajectory]) -> list[_Motion]:
    """Of those with efforts; accelerations are slopes of polynomials fitted to the velocities."""
    usable: list[tuple[Trajectory, np.ndarray, np.ndarray]] = [
        (t, t.u, t.effort) for t in trajectories if t.u is not None and t.effort is not None and len(t) >= SHORTEST
    ]
    if not any(np.any(effort) for _, _, effort in usable):  # zeros: what drivers write that measure nothing
        return []
    most, out = max(2, MOST_SAMPLES // len(usable)), []
    for t, u, effort in usable:
        m, degree = best_window(t.time, u, longest=max(5, len(t) // 3))
        du = local_fit(t.time, u, m, degree)[1]
        inner = slice(m, len(t) - m)
        some = evenly(len(du), most)
        out.append(_Motion(t.q[inner][some], u[inner][some], du[some], effort[inner][some]))
    return out


def _external(robot: Robot, held: list[_Motion], moves: list[_Motion]) -> tuple[np.ndarray, np.ndarray, Any]:
    """Effort of the contact (N, nv), its postures, and the residual of free motion, each stretch left out once."""
    q = np.concatenate([m.q for m in held])
    if not moves:
        return np.concatenate([m.effort - inverse_dynamics(robot, m.q, m.u, m.du) for m in held]), q, None
    equations = [_equations(robot, m) for m in moves]
    tau = np.concatenate([y - Y @ _solved(equations) for Y, y in (_equations(robot, m) for m in held)])
    folds = equations if len(equations) > 1 else [(Y[i::2], y[i::2]) for Y, y in equations for i in range(2)]
    left = [Y @ _solved([o for j, o in enumerate(folds) if j != i]) - y for i, (Y, y) in enumerate(folds)]
    if len(equations) == 1:  # back in the order of the samples
        both = np.empty_like(equations[0][1])
        both[0::2], both[1::2] = left
        left = [both]
    return tau, q, -np.concatenate(left)


def _equations(robot: Robot, m: _Motion) -> tuple[Float[np.ndarray, "T nv k"], Float[np.ndarray, "T nv"]]:
    """Matrix and right side of the linear equations of the unknowns."""
    friction = np.concatenate(
        [np.eye(robot.nv) * x[:, None, :] for x in (np.ones_like(m.u), m.u, np.sign(m.u))], axis=2
    )
    if has_inertias(robot):
        return friction, m.effort - inverse_dynamics(robot, m.q, m.u, m.du)
    return np.concatenate([friction, torque_regressor(robot, m.q, m.u, m.du)], axis=2), m.effort


def _solved(equations: Sequence[tuple[np.ndarray, np.ndarray]]) -> Float[np.ndarray, " k"]:
    """Least squares; what the motion does not determine is zero."""
    Y = np.concatenate([Y.reshape(-1, Y.shape[2]) for Y, _ in equations])
    size = np.linalg.norm(Y, axis=0)
    size[size == 0.0] = 1.0
    return np.linalg.lstsq(Y / size, np.concatenate([y.reshape(-1) for _, y in equations]), rcond=RANK)[0] / size


def _share(Phi: Float[np.ndarray, "n p nv"], rows: Float[np.ndarray, "s p"], tau: Float[np.ndarray, "n nv"]) -> float:
    """Share of tau in the span of the rows of Lambda Phi."""
    Q = batch_row_spaces(np.einsum("sp,npv->nsv", rows, Phi, optimize=True))[0][:, :, : len(rows)]
    along = np.einsum("nvs,nv->ns", Q, tau, optimize=True)
    return float(np.sum(along**2) / np.sum(tau**2))
