"""The law at many starts at once, in NumPy: a table of simulations, each as it is by itself.

Arrays have the starts last, so that every call of NumPy runs over contiguous memory.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.constraint.features import FrameJacobian
from manip_learn.constraint.small_matrices import LEAST_SINGULAR_RATIO
from manip_learn.control.box_programs import nearest_in_boxes
from manip_learn.control.command import Controller, Status, status_of
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.law import ACROSS, ALONG, AT_GOAL, STABLE_SLOPE, next_slide
from manip_learn.control.limits import BoundsTable, Limits, approach_bounds
from manip_learn.control.policies import GROWTH, ManipulabilityAscent, ZeroPolicy
from manip_learn.control.tasks import Hold, PointAttractor
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.robot import Robot

# starts at once: below, a step of all of them takes longer than one start after the other; above, memory is the limit
FEWEST_STARTS, MOST_STARTS = 4, 2048


@final
class Motions(NamedTuple):
    """What a table of starts did, T samples each.

    Attributes:
        q: shape (T, nv, n), postures.
        u: shape (T, nv, n), velocities.
        mu: shape (T, n), manipulability.
        error: shape (T, n), distance to the goal.
        status: shape (T, n), of `Status`.
        alone: shape (T, n), whether the controller took the step by itself.
    """

    q: Float[np.ndarray, "T nv n"]
    u: Float[np.ndarray, "T nv n"]
    mu: Float[np.ndarray, "T n"]
    error: Float[np.ndarray, "T n"]
    status: np.ndarray
    alone: Bool[np.ndarray, "T n"]


@final
class _Desired(NamedTuple):
    """`Desired` at n postures away from singularities; `well` says which are, `slope` is the gradient of `smallest`."""

    A: Float[np.ndarray, "s nv n"]
    b: Float[np.ndarray, "s n"]
    task: Float[np.ndarray, "nv n"]
    wish: Float[np.ndarray, "nv n"]
    mu: Float[np.ndarray, " n"]
    smallest: Float[np.ndarray, " n"]
    slope: Float[np.ndarray, "nv n"]
    well: Bool[np.ndarray, " n"]


@final
class BatchLaw:
    """A `ResolvedRateController` from many starts at once, in steps of one length.

    A start that is near a singularity, outside its limits, or about to approach a singularity too fast goes through the
    controller itself for that step, and comes back. All other steps are the same law in bulk; where bounds change it,
    with the same program (without its rows G).

    Args:
        controller: One that is served, see `of`.
    """

    def __init__(self, controller: ResolvedRateController):
        features: FrameJacobian = controller.constraint.features  # type: ignore[assignment]  # `of` has seen to it
        task = controller.task
        self.controller, self._kinematics = controller, batch_kinematics(features.robot, features.frame)
        selection = controller.constraint.selection
        self._rows = features.padded(selection)[:, :3]
        self._goal = np.zeros((len(selection), 1))
        if isinstance(task, PointAttractor):
            controller.task_error(features.robot.neutral())  # a target of the wrong size is refused here
            own = task.target.shape == (features.n_rows,)
            self._goal = (selection @ task.target if own else task.target)[:, None]

    @staticmethod
    def of(controller: Controller, robot: Robot) -> BatchLaw | None:
        """The law in bulk; None for a controller that has none.

        It must be a `ResolvedRateController` of this robot along x, y, z of a frame in the base, which a chain of
        joints carries that turn or slide; its task `Hold`, or a `PointAttractor` with numbers; its policy none, or the
        `ManipulabilityAscent` of its own rows; its limits none, or those of the joints without a jerk.
        """
        if not isinstance(controller, ResolvedRateController):
            return None
        constraint, task, policy = controller.constraint, controller.task, controller.null_policy
        features, limits = constraint.features, controller.limits
        if not (isinstance(features, FrameJacobian) and features.only_linear and features.robot is robot):
            return None
        served = (
            controller.robot is robot
            and constraint.n_constraints <= features.nv
            and (isinstance(task, Hold) or (isinstance(task, PointAttractor) and task.target.ndim == 1))
            and (isinstance(policy, ZeroPolicy) or getattr(policy, "constraint", None) is constraint)
            and isinstance(policy, ZeroPolicy | ManipulabilityAscent)
            and (limits is None or (limits.position and limits.tip is None and limits.jerk is None))
            and all(block.kind in ("revolute", "prismatic", "continuous") for block in robot.blocks)
            and batch_kinematics(robot, features.frame).fast
        )
        return BatchLaw(controller) if served else None

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
        (n, nv), T = starts.shape, steps + 1
        q, u, mu, error = (np.empty(shape) for shape in ((T, nv, n), (T, nv, n), (T, n), (T, n)))
        out = Motions(q, u, mu, error, status=np.empty((T, n), object), alone=np.zeros((T, n), bool))
        for first in range(0, n, MOST_STARTS):
            x = starts[first : first + MOST_STARTS].T.copy()
            m = x.shape[1]
            previous, slide, z = np.zeros((nv, m)), np.zeros(m), np.zeros((len(self._rows), m))
            for i in range(T):
                here = Motions(*(array[i, ..., first : first + m] for array in out))
                here.q[...] = x
                self._step(i * dt, dt, here, previous, slide, z)
                previous = here.u
                x += dt * previous
                report((first + m * (i + 1) / T) / n)
        return out

    def _step(self, t: float, dt: float, here: Motions, previous: np.ndarray, slide: np.ndarray, z: np.ndarray) -> None:
        """One step from the postures `here`, written into the rest of it, and into slide and z for the next."""
        controller, limits = self.controller, self.controller.limits
        with np.errstate(all="ignore"):  # of starts at a singularity, which go through the controller
            law = self._desired(here, dt)
        here.u[...], here.mu[...], here.status[...], here.alone[...] = law.wish, law.mu, Status.OK, ~law.well
        progress = np.ones(len(slide))
        if limits is not None:
            bounds = limits.bounds_table(here.q, dt, previous)
            here.alone[...] |= bounds.outside > 0.0
            least = np.full(len(slide), -np.inf)
            if controller.inverse == "damped":
                least = -approach_bounds(law.smallest, law.slope, limits.acceleration, dt)
                here.alone[...] |= ~(np.einsum("jn,jn->n", law.slope, law.wish) >= least)
            changed = np.flatnonzero(~(here.alone | bounds.admit(law.wish)))
            if changed.size:
                part = _Desired(*(array[..., changed] for array in law))
                u, z[:, changed], words, progress[changed], solved = self._bounded(
                    part, bounds.of(changed), limits, z[:, changed], slide[changed], dt
                )
                solved &= np.einsum("jn,jn->n", part.slope, u) >= least[changed]
                here.u[:, changed], here.status[changed], here.alone[changed] = u, words, ~solved
        for i in np.flatnonzero(here.alone).tolist():
            before = None if limits is None else previous[:, i].copy()
            command = controller(here.q[:, i].copy(), t, dt, before, float(slide[i]))
            here.u[:, i], here.mu[i], here.status[i] = command.velocity, command.manipulability, command.status
            progress[i] = command.progress
        stalls = here.status == Status.STALLED
        for i in np.flatnonzero(stalls | (slide > 0.0)).tolist():
            slide[i] = next_slide(float(slide[i]), bool(stalls[i]), float(progress[i]), dt)

    def _desired(self, here: Motions, dt: float) -> _Desired:
        """The law before bounds; writes the distance to the goal."""
        controller, policy, nv = self.controller, self.controller.null_policy, len(here.q)
        J, position, vjp = self._kinematics.linear_rows(here.q.T)
        A, b = np.tensordot(self._rows, J, axes=1), self._task_velocity(position, here.error)
        values, vectors = _eigen(np.einsum("sjn,tjn->stn", A, A))
        smallest, mu = np.sqrt(values[0]), np.sqrt(np.prod(values, axis=0))
        along = np.einsum("skn,sjn->kjn", vectors, A)  # sigma_k v_k^T
        X = np.einsum("skn,kjn->sjn", vectors, along / values[:, None])
        well = values[0] > LEAST_SINGULAR_RATIO**2 * values[-1]
        task = wish = np.einsum("sn,sjn->jn", b, X)
        if isinstance(policy, ManipulabilityAscent):
            w = _ascent(policy, vjp(np.tensordot(self._rows.T, X, axes=1)), mu, dt)
            wish = task + (w - np.einsum("sn,sjn->jn", np.einsum("sjn,jn->sn", A, w), X))
        slope = np.zeros((nv, len(mu)))
        if controller.inverse == "damped":
            well &= smallest >= controller.threshold
            if controller.limits is not None:  # u_min v_min^T : dA / dq
                slope = vjp(np.tensordot(self._rows.T, vectors[:, :1] * (along[0] / smallest), axes=1))
        return _Desired(A, b, task, wish, mu, smallest, slope, well)

    def _task_velocity(self, position: np.ndarray, error: np.ndarray) -> Float[np.ndarray, "s n"]:
        task, b = self.controller.task, self._goal - self._rows @ position
        if not isinstance(task, PointAttractor):
            error[...] = 0.0
            return np.zeros_like(b)
        error[...] = np.sqrt(np.einsum("sn,sn->n", b, b))
        b = task.gain * b
        if task.max_speed is not None:
            b *= task.max_speed / np.maximum(np.sqrt(np.einsum("sn,sn->n", b, b)), task.max_speed)
        return b

    def _bounded(
        self, law: _Desired, bounds: BoundsTable, limits: Limits, z: np.ndarray, slide: np.ndarray, dt: float
    ) -> tuple[np.ndarray, np.ndarray, list[Status], np.ndarray, np.ndarray]:
        """Velocities within bounds, z of the next programs, status, progress, and which programs were solved."""
        wish, W, asked = law.wish, law.A / ACROSS, np.sqrt(np.einsum("sn,sn->n", law.b, law.b))
        goes = asked > AT_GOAL
        if isinstance(self.controller.task, PointAttractor):  # it drives all rows; see `Law._slowed` and `Law._metric`
            size, limit, rest = np.abs(law.task), limits.velocity[:, None], wish - law.task
            fastest = np.maximum(1.0, np.max(size / limit, axis=0))
            left = np.min((limit - np.sign(law.task) * rest) / np.maximum(size, 1e-300), axis=0)
            wish = rest + law.task * np.where(fastest > 1.0, np.clip(left, 1.0 / fastest, 1.0), 1.0)
            blur = np.maximum(self.controller.damping, np.sqrt(0.5 * dt / STABLE_SLOPE * asked))
            across, speed = (cost + slide * (blur - cost) for cost in (ACROSS, ALONG))
            d = law.b / np.maximum(asked, AT_GOAL)
            more = np.where(goes, 1.0 / speed - 1.0 / across, 0.0) * np.einsum("sn,sjn->jn", d, law.A)
            W = law.A / across + d[:, None] * more
        y, z, solved = nearest_in_boxes(W, bounds.low - wish, bounds.high - wish, z)
        u = np.clip(wish + y, bounds.low, bounds.high)
        driven = np.einsum("sn,sn->n", law.b, np.einsum("sjn,jn->sn", law.A, u))
        progress = np.where(goes, driven / np.maximum(asked, AT_GOAL) ** 2, 1.0)
        facts = (progress, np.clip(progress, 0.0, 1.0), bounds.binding(u, law.wish), bounds.admit(law.task))
        words = [
            status_of(share, 0.0, False, False, changed=True, scale=scale, cause=cause, fits=fits)
            for share, scale, cause, fits in zip(*(fact.tolist() for fact in facts), strict=True)
        ]
        return u, z, words, progress, solved


def _ascent(policy: ManipulabilityAscent, slope: np.ndarray, mu: np.ndarray, dt: float) -> Float[np.ndarray, "nv n"]:
    """`ManipulabilityAscent.from_inverse`, from grad log mu."""
    if not policy.logarithmic:
        return slope * (policy.gain * mu)
    if policy.max_speed is None:
        return slope * policy.gain
    steepness = np.sqrt(np.einsum("jn,jn->n", slope, slope))
    longest = policy.max_speed / np.sqrt(1.0 + (dt * policy.max_speed / GROWTH * steepness) ** 2)
    return slope * np.minimum(policy.gain, longest / np.maximum(steepness, 1e-300))


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
