"""Recorded efforts and wrenches, witnesses that the motion knows nothing of: where there is contact, along which rows.

An ideal contact does no work, so that what it adds to the joints' efforts is A(q)^T f: it lies in the span of the held
rows. With tau the efforts recorded and tau_free what the same motion needs without contact, tau_ext = tau - tau_free,

    share = sum |P W tau_ext|^2 / sum |W tau_ext|^2,    P the projector on the span of W A^T,

W one over the residual of each joint's effort in free motion. A dense Lambda of as many rows, drawn at random, has the
share of chance. Gravity, inertia and friction have to be taken off: by inverse dynamics where the robot has inertias,
plus an offset and friction (viscous and dry) of each joint fitted to free stretches; without inertias these are fitted
there too, in the regressor of the dynamics. What is fitted is judged on stretches that were left out.

Of a wrench only its size is used, since recordings do not say how the sensor sits on the hand. Its offset and the
tool's weight, however the sensor is turned, are linear in 1 and in the direction of gravity seen from the hand: fitted
to free stretches and taken off as well. A sample is in contact if the rest belongs to the larger of two
populations, into which all samples, of contact and free motion together, are divided where they differ most (Otsu, IEEE
Transactions on Systems, Man, and Cybernetics 9, 1979). Where the motion says that rows are held plays no part in that.
If the two explain no more than two halves of one population would, there is no contact that stands out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, final

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
# what shows contact, the better witness first, and the array of a trajectory that it is in
WITNESSES: dict[Literal["force sensor", "efforts"], Literal["wrench", "effort"]] = {
    "force sensor": "wrench",
    "efforts": "effort",
}
# share of the variance that the means of the halves of an evenly spread population explain; those of one with a peak
# explain less (normal: 2 / pi, logarithms of sizes with 1 to 13 degrees of freedom 0.61 to 0.64), those of two more
ONE_POPULATION = 0.75
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


@final
@dataclass(frozen=True)
class ContactWitness:
    """How well contact by force agrees with contact by motion.

    Attributes:
        by: What shows the force, `"force sensor"` or `"efforts"`.
        held: Share of samples in contact by force where the motion says that the rows are held, 1 in full agreement;
            None if the force does not fall into two populations.
        free: The same where it says that the hand is free, 0 in full agreement.
        n_held, n_free: Numbers of these samples.
    """

    by: Literal["force sensor", "efforts"]
    held: float | None
    free: float | None
    n_held: int
    n_free: int

    def sentence(self) -> str:
        """In words."""
        shows = "efforts show" if self.by == "efforts" else "force sensor shows"
        if self.held is None or self.free is None:
            return f"the {shows} no contact that stands out of free motion, so nothing confirms that the rows are held"
        return (
            f"the {shows} contact in {100.0 * self.held:.0f} % of the samples in which the rows are held and in "
            f"{100.0 * self.free:.0f} % of those of free motion"
        )


def contact_witness(
    features: FeatureMap, contact: Sequence[Trajectory], free: Sequence[Trajectory]
) -> ContactWitness | None:
    """How well recorded forces agree with the motion on where there is contact; by the wrench where there is one.

    Args:
        features: Phi, of a robot.
        contact: Stretches in which the rows are held, with velocities.
        free: Stretches of free motion.

    Returns:
        None where nothing can be told: no free motion, or neither wrench nor efforts.
    """
    robot = getattr(features, "robot", None)
    for by, what in WITNESSES.items():
        held, moves = _motions(contact, what), _motions(free, what)
        if robot is None or not held or not moves:
            continue
        equations = partial(_equations, robot) if what == "effort" else partial(_sensor_equations, features)
        pushed, left = _external(equations, held, moves)
        scale = np.sqrt(np.mean(left**2, axis=0)) + np.finfo(np.float64).tiny
        sizes = [np.linalg.norm(some / scale, axis=1) for some in (pushed, left)]
        least = _parting(np.concatenate(sizes))
        shares = [None if least is None else float(np.mean(size > least)) for size in sizes]
        return ContactWitness(by, shares[0], shares[1], len(pushed), len(left))
    return None


def _parting(sizes: Float[np.ndarray, " n"]) -> float | None:
    """Size at which the mean logarithms of smaller and larger ones explain most; None if there is one population."""
    x = np.log(np.sort(sizes) + np.finfo(np.float64).tiny)
    n = np.arange(1, len(x))
    below, above = np.cumsum(x)[:-1] / n, np.cumsum(x[::-1])[-2::-1] / n[::-1]
    explained = n * n[::-1] * (above - below) ** 2 / len(x) ** 2
    k = int(np.argmax(explained))
    return float(np.exp(0.5 * (x[k] + x[k + 1]))) if explained[k] > ONE_POPULATION * np.var(x) else None


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
    q = np.concatenate([m.q for m in held])
    tau, left = _external(partial(_equations, robot), held, moves)
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
    measured: Float[np.ndarray, "T k"]


def _motions(trajectories: Sequence[Trajectory], what: Literal["wrench", "effort"] = "effort") -> list[_Motion]:
    """Of those with efforts or a wrench; accelerations are slopes of polynomials fitted to the velocities."""
    usable: list[tuple[Trajectory, np.ndarray, np.ndarray]] = [
        (t, t.u, t.beside[what]) for t in trajectories if t.u is not None and what in t.beside and len(t) >= SHORTEST
    ]
    if not any(np.any(measured) for _, _, measured in usable):  # zeros: what drivers write that measure nothing
        return []
    most, out = max(2, MOST_SAMPLES // len(usable)), []
    for t, u, measured in usable:
        m, degree = best_window(t.time, u, longest=max(5, len(t) // 3))
        du = local_fit(t.time, u, m, degree)[1]
        inner = slice(m, len(t) - m)
        some = evenly(len(du), most)
        out.append(_Motion(t.q[inner][some], u[inner][some], du[some], measured[inner][some]))
    return out


Equations = tuple[Float[np.ndarray, "T m k"], Float[np.ndarray, "T m"]]  # matrix and right side


def _external(equations_of: Callable[[_Motion], Equations], held: list[_Motion], moves: list[_Motion]) -> Any:
    """What the contact exerts (N, k), and the residual of free motion, each stretch left out once; else None."""
    if not moves:
        return np.concatenate([equations_of(m)[1] for m in held]), None
    equations = [equations_of(m) for m in moves]
    tau = np.concatenate([y - Y @ _solved(equations) for Y, y in map(equations_of, held)])
    folds = equations if len(equations) > 1 else [(Y[i::2], y[i::2]) for Y, y in equations for i in range(2)]
    left = [Y @ _solved([o for j, o in enumerate(folds) if j != i]) - y for i, (Y, y) in enumerate(folds)]
    if len(equations) == 1:  # back in the order of the samples
        both = np.empty_like(equations[0][1])
        both[0::2], both[1::2] = left
        left = [both]
    return tau, -np.concatenate(left)


def _sensor_equations(features: FeatureMap, m: _Motion) -> Equations:
    """Linear equations of a sensor's offset and of the tool's weight and its moment."""
    robot, frame = getattr(features, "robot", None), getattr(features, "frame", None)
    known = [np.ones((len(m.q), 1))]
    if robot is not None and frame is not None:
        known.append(np.array([robot.pose(q, frame)[2, :3] for q in m.q]))  # up, seen from the hand
    regressor = np.hstack(known)
    return np.einsum("ij,tk->tijk", np.eye(6), regressor).reshape(len(m.q), 6, -1), m.measured


def _equations(robot: Robot, m: _Motion) -> Equations:
    """Linear equations of friction, and of inertias where they are not known."""
    friction = np.concatenate(
        [np.eye(robot.nv) * x[:, None, :] for x in (np.ones_like(m.u), m.u, np.sign(m.u))], axis=2
    )
    if has_inertias(robot):
        return friction, m.measured - inverse_dynamics(robot, m.q, m.u, m.du)
    return np.concatenate([friction, torque_regressor(robot, m.q, m.u, m.du)], axis=2), m.measured


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
