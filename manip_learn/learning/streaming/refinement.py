"""An answer from a few samples, improved on all of them: Gauss-Newton, one pass over the samples a step."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.learning.estimators.estimate import Estimate
from manip_learn.learning.estimators.policy_model import PolicyModel
from manip_learn.learning.estimators.variable_projection import JointFit
from manip_learn.learning.samples import Samples
from manip_learn.learning.streaming.accumulator import Tally
from manip_learn.learning.streaming.executor import Passes
from manip_learn.learning.streaming.joint_normal_equations import Evidence, JointTally, Regressors
from manip_learn.learning.streaming.null_space_normal_equations import NullSpaceTally
from manip_learn.learning.streaming.summary_pass import Extent
from manip_learn.learning.streaming.trajectory_pools import Pools
from manip_learn.linalg import complement_rows, orthonormal_rows

MAX_PASSES = 20
# length of a step [rad on the Grassmann manifold] that no longer counts, and from which rounding is all that is left
SETTLED, ROUNDING = 1e-12, 1e-13
WITHIN_ROUNDING = 1e-9  # shorter steps are not judged by the cost
# directions of the normal equations, scaled to ones on the diagonal, that the samples do not determine
UNDETERMINED = 1e-12
# combinations of regressors that vary less than this are left out
FLAT = 1e-9
# sets of trajectories for the bootstrap; a set of the joint estimator has a Hessian for Theta, too
HELD_POOLS, JOINT_POOLS = 512, 100
TITLE = "all samples, pass {}"


@final
@dataclass(frozen=True, eq=False)
class Look:
    """What a pass has seen.

    Attributes:
        cost, energy: Sums of the squares of what is left, and of what there was.
        gradients, hessians: For all unknowns, of each pool of trajectories; the last unknowns are B, with
            dLambda = B Lambda_perp.
    """

    cost: float
    energy: float
    gradients: Float[np.ndarray, "g w"]
    hessians: Float[np.ndarray, "g w w"]


class Point(ABC):
    """A place on the way: Lambda in whitened coordinates, and what else is unknown."""

    selection: Float[np.ndarray, "s r"]

    @abstractmethod
    def look(self, total: Any) -> Look:
        """What a pass from here has gathered."""

    @abstractmethod
    def tally(self, features: FeatureMap, whitening: Float[np.ndarray, "r p"], n_groups: int) -> Tally:
        """The pass to make from here."""

    @abstractmethod
    def moved(self, step: Float[np.ndarray, " w"]) -> Point:
        """The place after a step from here."""


@final
@dataclass(frozen=True, eq=False)
class HeldPoint(Point):
    """On the way to the least sum u^T A^+ A u."""

    selection: Float[np.ndarray, "s r"]

    def look(self, total: Any) -> Look:
        """The sums of a `NullSpaceTally`."""
        cost, energy, gradients, hessians = total
        return Look(float(cost), float(energy), gradients, hessians)

    def tally(self, features: FeatureMap, whitening: Float[np.ndarray, "r p"], n_groups: int) -> NullSpaceTally:
        """A `NullSpaceTally`."""
        pools = Pools(n_groups, HELD_POOLS)
        return NullSpaceTally(features, _mixing(self.selection, whitening), len(self.selection), pools)

    def moved(self, step: Float[np.ndarray, " w"]) -> HeldPoint:
        """Lambda after a step."""
        return HeldPoint(_turned(self.selection, step))


@final
@dataclass(frozen=True, eq=False)
class JointPoint(Point):
    """On the way to the least sum |N (u - Theta^T beta)|^2.

    Attributes:
        selection: Lambda.
        theta: shape (k', nv).
        regressors: beta'.
    """

    selection: Float[np.ndarray, "s r"]
    theta: Float[np.ndarray, "j nv"]
    regressors: Regressors

    def look(self, total: Evidence) -> Look:
        """The sums of a `JointTally`."""
        cost, energy, parts = total
        pools = sorted(parts)
        gradients, hessians = (np.array([parts[pool][i] for pool in pools]) for i in (0, 1))
        return Look(cost, energy, gradients, hessians)

    def tally(self, features: FeatureMap, whitening: Float[np.ndarray, "r p"], n_groups: int) -> JointTally:
        """A `JointTally`."""
        mixing = _mixing(self.selection, whitening)
        pools = Pools(n_groups, JOINT_POOLS)
        return JointTally(features, mixing, len(self.selection), self.regressors, self.theta, pools)

    def moved(self, step: Float[np.ndarray, " w"]) -> JointPoint:
        """Lambda and Theta after a step."""
        width = self.theta.size
        theta = self.theta + step[:width].reshape(self.theta.shape)
        return JointPoint(_turned(self.selection, step[width:]), theta, self.regressors)


def polished(estimate: Estimate, samples: Samples, extent: Extent, passes: Passes) -> tuple[Estimate, str]:
    """The estimate from a few samples, carried on to the optimum over all of them; and a note where that is not done.

    Args:
        estimate: From `samples`.
        samples: The few; or all, and nothing is to be done.
        extent: Of all samples.
        passes: Over all samples.
    """
    if len(samples) == extent.n_samples:
        return estimate, ""
    if estimate.joint is not None:
        start: Point = _joint_start(estimate.joint, samples)
    elif estimate.name == "null-space":
        start = HeldPoint(estimate.selection)
    else:
        return estimate, f"learnt from {len(samples)} samples, chosen evenly out of {extent.n_samples}"
    point, seen = _descended(start, samples, extent, passes)
    gradients, hessians = _in_own_basis(seen, len(point.selection) * (samples.n_rows - len(point.selection)))
    better = dataclasses.replace(
        estimate,
        selection=point.selection,
        unexplained=seen.cost / seen.energy if seen.energy > 0.0 else 0.0,
        gradients=gradients,
        hessians=hessians,
        joint=None,
    )
    return better, ""


def _descended(point: Point, samples: Samples, extent: Extent, passes: Passes) -> tuple[Point, Look]:
    """Steps until the next one would be shorter than `SETTLED`, as judged by how fast they have become shorter."""
    m = len(point.selection) * (samples.n_rows - len(point.selection))

    def looked(here: Point, number: int) -> Look:
        tally = here.tally(samples.features, samples.whitening, extent.n_groups)
        return here.look(passes.total(tally, extent.first_groups, TITLE.format(number)))

    seen, before, damping = looked(point, 1), np.inf, 0.0
    for number in range(2, MAX_PASSES + 1):
        step = -_solved(seen.hessians.sum(axis=0), seen.gradients.sum(axis=0)[:, None], damping)[:, 0]
        length = float(np.linalg.norm(step[len(step) - m :]))
        trial = point.moved(step)
        if length < ROUNDING or (number > 2 and length * min(length / before, 1.0) < SETTLED):
            return trial, seen  # what a further pass would change is below rounding
        found = looked(trial, number)
        if found.cost <= seen.cost * (1.0 + 1e-9) or length < WITHIN_ROUNDING:
            point, seen, before, damping = trial, found, length, 0.0
        else:
            damping = max(1e-3, 10.0 * damping)
    return point, seen


def _in_own_basis(seen: Look, m: int) -> tuple[Float[np.ndarray, "g d"], Float[np.ndarray, "g d d"]]:
    """The pools' gradients and Hessians, with those combinations of Theta only that the samples determine.

    These are orthonormal and what B would move Theta along is taken off, for the bootstrap leaves pools out.
    """
    width = seen.gradients.shape[1] - m
    if width == 0:
        return seen.gradients, seen.hessians
    H = seen.hessians.sum(axis=0)
    scale, V, eigenvalues = _determined(H[:width, :width])
    basis = scale[:, None] * V / np.sqrt(eigenvalues)
    turn = np.zeros((width + m, basis.shape[1] + m))
    turn[:width, : basis.shape[1]] = basis
    turn[:width, basis.shape[1] :] = -basis @ (basis.T @ H[:width, width:])
    turn[width:, basis.shape[1] :] = np.eye(m)
    return seen.gradients @ turn, turn.T @ seen.hessians @ turn


def _joint_start(fit: JointFit, samples: Samples) -> JointPoint:
    mixing, back = _orthonormal_regressors(fit.model, samples)
    return JointPoint(fit.selection, back @ fit.theta, Regressors(fit.model, samples.centre, samples.spread, mixing))


def _orthonormal_regressors(
    model: PolicyModel, samples: Samples
) -> tuple[Float[np.ndarray, "j k"], Float[np.ndarray, "j k"]]:
    """T with T beta orthonormal over the samples, and T^{+T}, which takes Theta along."""
    beta = np.concatenate([model(block.x, block.group) for block in samples.blocks()])
    _, sigma, Vt = np.linalg.svd(beta / np.sqrt(len(beta)), full_matrices=False)
    kept = sigma > FLAT * sigma[0]
    return Vt[kept] / sigma[kept, None], Vt[kept] * sigma[kept, None]


def _mixing(selection: np.ndarray, whitening: np.ndarray) -> Float[np.ndarray, "r p"]:
    return np.concatenate([selection, complement_rows(selection)]) @ whitening


def _turned(selection: np.ndarray, turn: np.ndarray) -> Float[np.ndarray, "s r"]:
    s, r = selection.shape
    return orthonormal_rows(selection + turn.reshape(s, r - s) @ complement_rows(selection))


def _solved(H: np.ndarray, y: np.ndarray, damping: float = 0.0) -> Float[np.ndarray, "w c"]:
    """H^+ y; directions that the samples do not determine stay as they are."""
    if y.size == 0:
        return np.zeros_like(y)
    scale, V, eigenvalues = _determined(H)
    return scale[:, None] * (V @ ((V.T @ (scale[:, None] * y)) / (eigenvalues[:, None] + damping)))


def _determined(H: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scale of each unknown, and eigenvectors and eigenvalues of the scaled H that are not rounding."""
    size = np.sqrt(np.maximum(np.diag(H), 0.0))
    scale = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0.0)
    eigenvalues, vectors = np.linalg.eigh(scale[:, None] * H * scale)
    kept = eigenvalues > UNDETERMINED * eigenvalues[-1]
    return scale, vectors[:, kept], eigenvalues[kept]
