"""An answer from a few samples, improved on all of them: Gauss-Newton, one pass over the samples a step."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.features.feature_map import FeatureMap
from manip_learn.learning.estimate import Estimate
from manip_learn.learning.joint import JointFit
from manip_learn.learning.joint_tally import JointTally, Regressors
from manip_learn.learning.null_space_tally import NullSpaceTally
from manip_learn.learning.passes import Passes
from manip_learn.learning.policy_model import PolicyModel
from manip_learn.learning.pools import Pools
from manip_learn.learning.samples import Samples
from manip_learn.learning.survey import Extent
from manip_learn.learning.tally import Sums
from manip_learn.linalg import complement_rows, orthonormal_rows

MAX_PASSES = 20
# length of a step [rad on the Grassmann manifold] that no longer counts, and from which rounding is all that is left
SETTLED, ROUNDING = 1e-12, 1e-13
# directions of the normal equations, scaled to ones on the diagonal, that the samples do not determine
UNDETERMINED = 1e-12
# combinations of regressors that vary less than this are left out
FLAT = 1e-9
TITLE = "all samples, pass {}"


@final
@dataclass(frozen=True, eq=False)
class Look:
    """What a pass has seen.

    Attributes:
        cost, energy: Sums of the squares of what is left, and of what there was.
        gradient, hessian: For all unknowns; the last m are B, with dLambda = B Lambda_perp.
        gradients, hessians: For B, of each pool of trajectories.
    """

    cost: float
    energy: float
    gradient: Float[np.ndarray, " w"]
    hessian: Float[np.ndarray, "w w"]
    gradients: Float[np.ndarray, "g m"]
    hessians: Float[np.ndarray, "g m m"]


class Point(ABC):
    """A place on the way: Lambda in whitened coordinates, and what else is unknown."""

    selection: Float[np.ndarray, "s r"]

    @abstractmethod
    def look(self, total: Any) -> Look:
        """What a pass from here has gathered."""

    @abstractmethod
    def tally(
        self, features: FeatureMap, whitening: Float[np.ndarray, "r p"], pools: Pools
    ) -> Sums:
        """The pass to make from here."""

    @abstractmethod
    def moved(self, step: Float[np.ndarray, " w"], seen: Look) -> Point:
        """The place after a step from here."""


@final
@dataclass(frozen=True, eq=False)
class HeldPoint(Point):
    """On the way to the least sum u^T A^+ A u."""

    selection: Float[np.ndarray, "s r"]

    def look(self, total: Any) -> Look:
        """The sums of a `NullSpaceTally`."""
        cost, energy, gradients, hessians = total
        return Look(float(cost), float(energy), gradients.sum(axis=0), hessians.sum(axis=0), gradients, hessians)

    def tally(self, features: FeatureMap, whitening: Float[np.ndarray, "r p"], pools: Pools) -> NullSpaceTally:
        """A `NullSpaceTally`."""
        return NullSpaceTally(features, _mixing(self.selection, whitening), len(self.selection), pools)

    def moved(self, step: Float[np.ndarray, " w"], seen: Look) -> HeldPoint:
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
        projection: dTheta/dB at the place before.
    """

    selection: Float[np.ndarray, "s r"]
    theta: Float[np.ndarray, "j nv"]
    regressors: Regressors
    projection: Float[np.ndarray, "w m"] | None = None

    def look(self, total: Any) -> Look:
        """The sums of a `JointTally`."""
        cost, energy, gradient, hessian, gradients, hessians = total
        return Look(float(cost), float(energy), gradient, hessian, gradients, hessians)

    def tally(self, features: FeatureMap, whitening: Float[np.ndarray, "r p"], pools: Pools) -> JointTally:
        """A `JointTally`."""
        mixing = _mixing(self.selection, whitening)
        s = len(self.selection)
        return JointTally(features, mixing, s, self.regressors, self.theta, self.projection, pools)

    def moved(self, step: Float[np.ndarray, " w"], seen: Look) -> JointPoint:
        """Lambda and Theta after a step."""
        width = self.theta.size
        H = seen.hessian
        projection = -_solved(H[:width, :width], H[:width, width:])
        theta = self.theta + step[:width].reshape(self.theta.shape)
        return JointPoint(_turned(self.selection, step[width:]), theta, self.regressors, projection)


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
    better = dataclasses.replace(
        estimate,
        selection=point.selection,
        unexplained=seen.cost / seen.energy if seen.energy > 0.0 else 0.0,
        gradients=seen.gradients,
        hessians=seen.hessians,
        joint=None,
    )
    return better, ""


def _descended(point: Point, samples: Samples, extent: Extent, passes: Passes) -> tuple[Point, Look]:
    """Steps until the next one would be shorter than `SETTLED`, as judged by how fast they have become shorter."""
    pools, first_groups = Pools(extent.n_groups), extent.first_groups

    def looked(here: Point, number: int) -> Look:
        tally = here.tally(samples.features, samples.whitening, pools)
        return here.look(passes.total(tally, first_groups, TITLE.format(number)))

    seen, before, damping = looked(point, 1), np.inf, 0.0
    for number in range(2, MAX_PASSES + 1):
        step = -_solved(seen.hessian, seen.gradient[:, None], damping)[:, 0]
        turn = step[len(step) - seen.gradients.shape[1] :]
        length = float(np.linalg.norm(turn))
        trial = point.moved(step, seen)
        if number > 2 and (length < ROUNDING or length * min(length / before, 1.0) < SETTLED):
            return trial, seen  # what a further pass would change is below rounding
        found = looked(trial, number)
        if found.cost <= seen.cost * (1.0 + 1e-9) + np.finfo(np.float64).tiny or length < ROUNDING:
            point, seen, before, damping = trial, found, length, 0.0
        else:
            damping = max(1e-3, 10.0 * damping)
    return point, seen


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
    if H.size == 0 or y.size == 0:
        return np.zeros_like(y)
    size = np.sqrt(np.maximum(np.diag(H), 0.0))
    scale = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0.0)
    eigenvalues, vectors = np.linalg.eigh(scale[:, None] * H * scale)
    kept = eigenvalues > UNDETERMINED * eigenvalues[-1]
    V = vectors[:, kept]
    return scale[:, None] * (V @ ((V.T @ (scale[:, None] * y)) / (eigenvalues[kept, None] + damping)))
