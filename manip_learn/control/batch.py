"""The law at many starts at once, in NumPy: a table of simulations, each as it is by itself.

Arrays have the starts last, so that every call of NumPy runs over contiguous memory.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float, Int

from manip_learn.constraint.features import FrameJacobian
from manip_learn.constraint.small_matrices import LEAST_SINGULAR_RATIO
from manip_learn.control.command import Status, status_of
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.law import (
    ACROSS,
    ALONG,
    AT_GOAL,
    FINE,
    GOING_ON,
    KEEPING_AFTER,
    SLIDING_AFTER,
    STABLE_SLOPE,
    next_slide,
)
from manip_learn.control.limits import BoundsTable, Limits, approach_bounds
from manip_learn.control.policies import GROWTH, ManipulabilityAscent, ZeroPolicy
from manip_learn.control.tasks import Hold, PointAttractor
from manip_learn.robot.batch.batch_kinematics import batch_kinematics

MOST_STARTS = 512  # at once: the columns of a 7-joint chain then stay in a second-level cache of 1 MB
MOST_ROUNDS = 20  # of Newton's steps; what takes more goes through DAQP


@final
class Motions(NamedTuple):
    """What a table of starts did, T samples each.

    Attributes:
        q: shape (T, nv, n), postures.
        u: shape (T, nv, n), velocities.
        mu: shape (T, n), manipulability.
        error: shape (T, n), distance to the goal.
        status: shape (T, n), of `Status`.
        one_by_one: Share of the steps that the law took by itself.
    """

    q: Float[np.ndarray, "T nv n"]
    u: Float[np.ndarray, "T nv n"]
    mu: Float[np.ndarray, "T n"]
    error: Float[np.ndarray, "T n"]
    status: np.ndarray
    one_by_one: float


@final
class _Free(NamedTuple):
    """The law at n postures before bounds, away from singularities, see `Desired`; `well` says where it is that."""

    A: Float[np.ndarray, "s nv n"]
    b: Float[np.ndarray, "s n"]
    task: Float[np.ndarray, "nv n"]
    wish: Float[np.ndarray, "nv n"]
    mu: Float[np.ndarray, " n"]
    smallest: Float[np.ndarray, " n"]
    slope: Float[np.ndarray, "nv n"] | None
    well: Bool[np.ndarray, " n"]


@final
class BatchLaw:
    """A `ResolvedRateController` at many starts at once, simulated in steps of one length.

    A start that is near a singularity, outside its limits, or approaches a singularity too fast goes through
    `controller(...)` for that step, and comes back. Every other step is the same law in bulk; where bounds change it,
    the program of `Law` without rows G, by block pivoting.

    Args:
        controller: One that `serves` says yes to.
    """

    def __init__(self, controller: ResolvedRateController):
        self.controller, self.constraint = controller, controller.constraint
        features = self.constraint.features
        assert isinstance(features, FrameJacobian) and features.robot is not None
        self._kinematics = batch_kinematics(features.robot, features.frame)
        self._rows = self.constraint.features.padded(self.constraint.selection)[:, :3]
        task, self._goal = controller.task, np.zeros(0)
        if isinstance(task, PointAttractor):
            own = task.target.shape == (features.n_rows,)
            self._goal = (self.constraint.selection @ task.target if own else task.target)[:, None]

    @staticmethod
    def serves(controller: object) -> bool:
        """Whether there is a law in bulk for this controller.

        It must be a `ResolvedRateController` along x, y, z of a frame in the base, carried by a chain of joints that
        turn or slide; its task a `PointAttractor` (of numbers) or `Hold`; its policy none or the
        `ManipulabilityAscent` of its own rows; its limits none, or those of the joints without jerk.
        """
        if not isinstance(controller, ResolvedRateController):
            return False
        features, task, policy = controller.constraint.features, controller.task, controller.null_policy
        if not (isinstance(features, FrameJacobian) and features.only_linear and controller.robot is features.robot):
            return False
        s, nv = controller.constraint.n_constraints, features.nv
        ascends = isinstance(policy, ManipulabilityAscent) and policy.constraint is controller.constraint
        limits = controller.limits
        return (
            s <= nv
            and (isinstance(task, Hold) or (isinstance(task, PointAttractor) and task.target.ndim == 1))
            and (ascends or isinstance(policy, ZeroPolicy))
            and (limits is None or (limits.position and limits.tip is None and limits.jerk is None))
            and all(block.v.stop - block.v.start == 1 and block.kind != "other" for block in features.robot.blocks)
            and batch_kinematics(features.robot, features.frame).fast
        )

    def simulate(
        self, starts: Float[np.ndarray, "n nv"], steps: int, dt: float, report: Callable[[float], None]
    ) -> Motions:
        """Run it, each command held for dt [s], as `simulate` runs one start.

        Args:
            starts: Joint positions, checked and within the robot's limits.
            steps: Their number.
            dt: [s].
            report: Called with the completed fraction.
        """
        n, nv = starts.shape
        out = Motions(*np.empty((2, steps + 1, nv, n)), *np.empty((2, steps + 1, n)), np.empty((steps + 1, n), object), 0.0)
        alone = 0
        for first in range(0, n, MOST_STARTS):
            part = slice(first, min(first + MOST_STARTS, n))
            x, u, slide = starts[part].T.copy(), np.zeros((nv, part.stop - first)), np.zeros(part.stop - first)
            for i in range(steps + 1):
                here = [array[i, ..., part] for array in out[:5]]
                here[0][...] = x
                alone += self._step(i * dt, dt, slide, u, *here)
                u = here[1].copy()
                x += dt * u
                report((first + (part.stop - first) * (i + 1) / (steps + 1)) / n)
        return out._replace(one_by_one=alone / max(1, n * (steps + 1)))

    def _step(
        self,
        t: float,
        dt: float,
        slide: np.ndarray,
        previous: np.ndarray,
        x: np.ndarray,
        u: np.ndarray,
        mu: np.ndarray,
        error: np.ndarray,
        status: np.ndarray,
    ) -> int:
        """One step, written into u, mu, error, status and slide; returns how many starts went by themselves."""
        limits, controller = self.controller.limits, self.controller
        with np.errstate(all="ignore"):  # of starts that are at a singularity, which are looked at below
            law = self._desired(x, dt, error)
        u[...], mu[...], status[...] = law.wish, law.mu, Status.OK
        alone, progress, stalls = ~law.well, np.ones(len(mu)), np.zeros(len(mu), bool)
        if limits is not None:
            bounds = limits.bounds_table(x, dt, previous)
            alone |= bounds.outside > 0.0
            least = None
            if law.slope is not None:
                least = -approach_bounds(law.smallest, law.slope, limits.acceleration, dt)
                alone |= ~(np.einsum("jn,jn->n", law.slope, law.wish) >= least)
            changed = np.flatnonzero(~(alone | bounds.admit(law.wish)))
            if changed.size:
                part = _Free(*(None if array is None else array[..., changed] for array in law))  # type: ignore[arg-type]
                found, progress[changed], words, solved = self._bounded(part, bounds.of(changed), slide[changed], dt)
                if part.slope is not None and least is not None:
                    solved &= np.einsum("jn,jn->n", part.slope, found) >= least[changed]
                u[:, changed], status[changed], alone[changed] = found, words, ~solved
                stalls = status == Status.STALLED
            before = slide.copy()
            going = np.where(progress > GOING_ON, np.maximum(0.0, slide - dt / KEEPING_AFTER), slide)
            slide[...] = np.where(stalls, np.minimum(1.0, slide + dt / SLIDING_AFTER), going)
        rows = np.flatnonzero(alone)
        for i in rows.tolist():
            q = x[:, i].copy()
            if limits is None:
                command = controller(q, t, dt)
            else:
                command = controller(q, t, dt, previous[:, i].copy(), float(before[i]))
                slide[i] = next_slide(float(before[i]), command.status is Status.STALLED, command.progress, dt)
            u[:, i], mu[i], status[i] = command.velocity, command.manipulability, command.status
        return rows.size

    # ---- the law ----------------------------------------------------------------------------------------------------

    def _desired(self, x: np.ndarray, dt: float, error: np.ndarray) -> _Free:
        """The law before bounds; writes the distance to the goal."""
        controller, rows = self.controller, self._kinematics.linear_rows(x.T)
        A = np.tensordot(self._rows, rows.J, axes=1)
        b = self._velocity(rows.position, error)
        values, vectors = _eigen(np.einsum("sjn,tjn->stn", A, A))
        smallest, mu = np.sqrt(values[0]), np.sqrt(np.prod(values, axis=0))
        along = np.einsum("skn,sjn->kjn", vectors, A)  # sigma_k v_k^T, (s, nv, n)
        scaled = along / values[:, None]
        X = np.einsum("skn,kjn->sjn", vectors, scaled)
        well = values[0] > LEAST_SINGULAR_RATIO**2 * values[-1]
        task = np.einsum("sn,sjn->jn", b, X)
        policy, wish = controller.null_policy, task
        if isinstance(policy, ManipulabilityAscent):
            w = _ascent(policy, rows.vjp(np.tensordot(self._rows.T, X, axes=1)), mu, dt)
            wish = task + (w - np.einsum("sn,sjn->jn", np.einsum("sjn,jn->sn", A, w), X))
        slope = None
        if controller.inverse == "damped":
            well &= smallest >= controller.threshold
            if controller.limits is not None:  # u_min v_min^T : dA / dq
                lost = vectors[:, :1] * (along[0] / smallest)[None]
                slope = rows.vjp(np.tensordot(self._rows.T, lost, axes=1))
        return _Free(A, b, task, wish, mu, smallest, slope, well)

    def _velocity(self, position: np.ndarray, error: np.ndarray) -> Float[np.ndarray, "s n"]:
        """B; writes the distance to the goal."""
        task, s = self.controller.task, len(self._rows)
        if not isinstance(task, PointAttractor):
            error[...] = 0.0
            return np.zeros((s, position.shape[1]))
        b = self._goal - self._rows @ position
        error[...] = np.sqrt(np.sum(b * b, axis=0))
        b = task.gain * b
        if task.max_speed is not None:
            b *= task.max_speed / np.maximum(np.sqrt(np.sum(b * b, axis=0)), task.max_speed)
        return b

    def _bounded(
        self, law: _Free, bounds: BoundsTable, slide: np.ndarray, dt: float
    ) -> tuple[np.ndarray, np.ndarray, list[Status], np.ndarray]:
        """Velocities within bounds, their progress and status, and which programs were solved."""
        limits, controller = self.controller.limits, self.controller
        assert isinstance(limits, Limits)
        wish, W, asked = law.wish, law.A / ACROSS, np.sqrt(np.sum(law.b * law.b, axis=0))
        if isinstance(controller.task, PointAttractor):  # which drives all rows
            fastest = np.max(np.abs(law.task / limits.velocity[:, None]), axis=0)
            wish = (wish - law.task) + law.task / np.maximum(fastest, 1.0)
            blur = np.maximum(controller.damping, np.sqrt(0.5 * dt / STABLE_SLOPE * asked))
            across, speed = (c + slide * (blur - c) for c in (ACROSS, ALONG))
            W = law.A / across
            d = law.b / np.maximum(asked, AT_GOAL)
            share = np.where(asked > AT_GOAL, 1.0 / speed - 1.0 / across, 0.0)
            W += d[:, None] * (share * np.einsum("sn,sjn->jn", d, law.A))
        y, _, solved = _nearest(W, bounds.low - wish, bounds.high - wish, np.zeros_like(law.b))
        u = np.clip(wish + y, bounds.low, bounds.high)
        driven = np.einsum("sn,sjn,jn->n", law.b, law.A, u)
        progress = np.where(asked > AT_GOAL, driven / np.maximum(asked, AT_GOAL) ** 2, 1.0)
        scale = np.clip(progress, 0.0, 1.0)
        facts = zip(progress.tolist(), scale.tolist(), bounds.binding(u, wish).tolist(), bounds.admit(law.task), strict=True)
        words = [status_of(p, 0.0, False, False, changed=True, scale=x, cause=c, fits=f) for p, x, c, f in facts]
        return u, progress, words, solved


def _ascent(policy: ManipulabilityAscent, slope: np.ndarray, mu: np.ndarray, dt: float) -> Float[np.ndarray, "nv n"]:
    """`ManipulabilityAscent.from_inverse` from grad log mu."""
    if not policy.logarithmic:
        return slope * (policy.gain * mu)
    if policy.max_speed is None:
        return slope * policy.gain
    steepness = np.sqrt(np.sum(slope * slope, axis=0))
    longest = policy.max_speed / np.sqrt(1.0 + (dt * policy.max_speed * steepness / GROWTH) ** 2)
    return slope * np.where(policy.gain * steepness <= longest, policy.gain, longest / np.maximum(steepness, 1e-300))


def _eigen(G: Float[np.ndarray, "s s n"]) -> tuple[Float[np.ndarray, "s n"], Float[np.ndarray, "s s n"]]:
    """Eigenvalues, smallest first, and eigenvectors as columns."""
    if len(G) != 2:
        values, vectors = np.linalg.eigh(np.moveaxis(G, -1, 0))
        return np.ascontiguousarray(values.T), np.ascontiguousarray(vectors.transpose(1, 2, 0))
    (a, b), (_, c) = G
    largest = 0.5 * (a + c) + np.hypot(0.5 * (a - c), b)
    angle = 0.5 * np.arctan2(2.0 * b, a - c)
    cos, sin = np.cos(angle), np.sin(angle)
    # the smallest eigenvalue is the quotient, not the difference, which cancels
    return np.stack(((a * c - b * b) / largest, largest)), np.array(((-sin, cos), (cos, sin)))


def _solve(K: Float[np.ndarray, "s s n"], r: Float[np.ndarray, "s n"]) -> Float[np.ndarray, "s n"]:
    """The solutions of n systems of equations, K symmetric."""
    if len(K) == 1:
        return r / K[0]
    if len(K) == 2:
        (a, b), (_, c) = K
        return np.stack((c * r[0] - b * r[1], a * r[1] - b * r[0])) / (a * c - b * b)
    return np.linalg.solve(np.moveaxis(K, -1, 0), r.T[..., None])[..., 0].T


def _nearest(
    W: Float[np.ndarray, "s nv n"],
    low: Float[np.ndarray, "nv n"],
    high: Float[np.ndarray, "nv n"],
    z: Float[np.ndarray, "s n"],
) -> tuple[Float[np.ndarray, "nv n"], Float[np.ndarray, "s n"], Bool[np.ndarray, " n"]]:
    """argmin |W y|^2 + |y|^2, low <= y <= high, of n programs at once; z; and which of them were solved.

    With z = W y the solution is y = clip(-W^T z, low, high): as many unknowns as W has rows, the root of the slope of

        f(z) = |z|^2 / 2 + sum_j h_j(-w_j^T z),    dh_j(x) / dx = clip(x, low_j, high_j),

    which is convex, and quadratic where no joint comes to a bound or leaves one. Newton's steps, each as long as f falls
    along it, end in a finite number (Li and Swetits, "A new algorithm for solving strictly convex quadratic programs",
    1997).

    Args:
        W: Rows.
        low: Lowest y.
        high: Highest y.
        z: Where to begin.
    """
    (s, nv, n), left = W.shape, np.arange(z.shape[1])
    y, end, solved = np.zeros((nv, n)), z.copy(), np.zeros(n, bool)
    x = -np.einsum("sjn,sn->jn", W, z)
    for _ in range(MOST_ROUNDS):
        below, above = x < low, x > high
        free = ~(below | above)
        bound = np.where(below, low, np.where(above, high, 0.0))
        K = np.einsum("sjn,tjn->stn", W * free, W)
        K[np.arange(s), np.arange(s)] += 1.0
        newton = _solve(K, np.einsum("sjn,jn->sn", W, bound))
        ahead = -np.einsum("sjn,sn->jn", W, newton)
        found = np.where(free, ahead, bound)
        done = (np.where(free, (low - FINE <= ahead) & (ahead <= high + FINE), np.clip(ahead, low, high) == bound)).all(0)
        y[:, left[done]], end[:, left[done]], solved[left[done]] = found[:, done], newton[:, done], True
        if done.all():
            break
        go = np.flatnonzero(~done)
        W, low, high, z, x, newton, ahead = (a.take(go, axis=-1) for a in (W, low, high, z, x, newton, ahead))
        left, p, e = left[go], newton - z, ahead - x
        share = _least_along(np.einsum("sn,sn->n", z, p), np.einsum("sn,sn->n", p, p), x, e, low, high)
        z, x = z + share * p, x + share * e
    return y, end, solved


def _least_along(
    zp: Float[np.ndarray, " n"],
    pp: Float[np.ndarray, " n"],
    x: Float[np.ndarray, "nv n"],
    e: Float[np.ndarray, "nv n"],
    low: Float[np.ndarray, "nv n"],
    high: Float[np.ndarray, "nv n"],
) -> Float[np.ndarray, " n"]:
    """Where f(z + t p) of `_nearest` is least: its slope z^T p + t p^T p + e^T clip(x + t e) has corners and rises."""
    per = 1.0 / np.where(e == 0.0, np.inf, e)
    corners = np.maximum(np.concatenate(((low - x) * per, (high - x) * per, np.zeros((1, len(zp))))), 0.0)
    slope = zp + corners * pp
    slope += np.einsum("jn,cjn->cn", e, np.clip(x + corners[:, None] * e, low, high))
    before = np.where(slope <= 0.0, corners, 0.0).max(axis=0)
    after = np.where(slope > 0.0, corners, np.inf).min(axis=0)
    inside = np.where(np.isfinite(after), 0.5 * (before + after), before + 1.0)
    place = x + inside * e
    moving = (low < place) & (place < high)
    rate = pp + np.einsum("jn,jn->n", e * e, moving)
    here = zp + before * pp + np.einsum("jn,jn->n", e, np.clip(x + before * e, low, high))
    return np.minimum(before - here / rate, after)
