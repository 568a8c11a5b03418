"""An estimate from a choice of the samples, refined on all of them: Gauss-Newton, one pass per step."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import counted
from manip_learn.learning.bootstrap import TrajectoryBlocks
from manip_learn.learning.candidate import Candidate
from manip_learn.learning.data_summary import DataSummary
from manip_learn.learning.estimators.joint_fit import JointFit
from manip_learn.learning.estimators.policy_model import PolicyModel
from manip_learn.learning.estimators.variable_projection import MAX_BLOCKS
from manip_learn.learning.samples import Samples
from manip_learn.learning.streaming.accumulator import Accumulator
from manip_learn.learning.streaming.executor import Executor
from manip_learn.learning.streaming.normal_equations import (
    Evidence,
    JointAccumulator,
    NullSpaceAccumulator,
    Regressors,
)
from manip_learn.learning.streaming.summary_pass import PassSummary
from manip_learn.linalg import complement_rows, orthonormal_rows

MAX_PASSES = 20
# length of a step [rad on the Grassmann manifold] that no longer counts, and from which rounding is all that is left
SETTLED, ROUNDING = 1e-12, 1e-13
WITHIN_ROUNDING = 1e-9  # shorter steps are not judged by the cost
# directions of the normal equations, scaled to ones on the diagonal, that the samples do not determine
UNDETERMINED = 1e-12
# combinations of regressors that vary less than this are left out
FLAT = 1e-9
# blocks of trajectories for the bootstrap of the null-space estimator; those of the joint one hold more each
NULL_SPACE_BLOCKS = 512
TITLE = "all samples, pass {}"


@final
@dataclass(frozen=True, eq=False)
class NormalEquations:
    """What a pass has gathered.

    Attributes:
        cost, energy: Sums of the squares of what is left, and of what there was.
        gradients, hessians: For all unknowns, of each block of trajectories; the last unknowns are B, with
            dLambda = B Lambda_perp.
    """

    cost: float
    energy: float
    gradients: Float[np.ndarray, "g w"]
    hessians: Float[np.ndarray, "g w w"]


class Iterate(ABC):
    """A point of the descent: Lambda in whitened coordinates, and what else is unknown."""

    whitened_selection: Float[np.ndarray, "s r"]

    @abstractmethod
    def accumulator(
        self, features: FeatureMap, whitening: Float[np.ndarray, "r p"], n_trajectories: int
    ) -> Accumulator:
        """The pass that gathers the normal equations at this point."""

    @abstractmethod
    def normal_equations(self, total: Any) -> NormalEquations:
        """What that pass has gathered."""

    @abstractmethod
    def stepped(self, step: Float[np.ndarray, " w"]) -> Iterate:
        """The point after a step."""


@final
@dataclass(frozen=True, eq=False)
class NullSpaceIterate(Iterate):
    """On the way to the least sum u^T A^+ A u, equation (10)."""

    whitened_selection: Float[np.ndarray, "s r"]

    def accumulator(
        self, features: FeatureMap, whitening: Float[np.ndarray, "r p"], n_trajectories: int
    ) -> NullSpaceAccumulator:
        """Equation (10) and its derivatives."""
        blocks = TrajectoryBlocks(n_trajectories, NULL_SPACE_BLOCKS)
        mixing = _mixing(self.whitened_selection, whitening)
        return NullSpaceAccumulator(features, mixing, len(self.whitened_selection), blocks)

    def normal_equations(self, total: Any) -> NormalEquations:
        """From the sums of a `NullSpaceAccumulator`."""
        cost, energy, gradients, hessians = total
        return NormalEquations(float(cost), float(energy), gradients, hessians)

    def stepped(self, step: Float[np.ndarray, " w"]) -> NullSpaceIterate:
        """Lambda after a step."""
        return NullSpaceIterate(_retract(self.whitened_selection, step))


@final
@dataclass(frozen=True, eq=False)
class JointIterate(Iterate):
    """On the way to the least sum |N (u - Theta^T beta)|^2.

    Attributes:
        whitened_selection: Lambda in whitened coordinates.
        theta: shape (k', nv).
        regressors: beta'.
    """

    whitened_selection: Float[np.ndarray, "s r"]
    theta: Float[np.ndarray, "j nv"]
    regressors: Regressors

    def accumulator(
        self, features: FeatureMap, whitening: Float[np.ndarray, "r p"], n_trajectories: int
    ) -> JointAccumulator:
        """Variable projection with Theta among the unknowns."""
        mixing = _mixing(self.whitened_selection, whitening)
        blocks = TrajectoryBlocks(n_trajectories, MAX_BLOCKS)
        return JointAccumulator(features, mixing, len(self.whitened_selection), self.regressors, self.theta, blocks)

    def normal_equations(self, total: Evidence) -> NormalEquations:
        """From the sums of a `JointAccumulator`."""
        cost, energy, parts = total
        blocks = sorted(parts)
        gradients, hessians = (np.array([parts[block][i] for block in blocks]) for i in (0, 1))
        return NormalEquations(cost, energy, gradients, hessians)

    def stepped(self, step: Float[np.ndarray, " w"]) -> JointIterate:
        """Lambda and Theta after a step."""
        width = self.theta.size
        theta = self.theta + step[:width].reshape(self.theta.shape)
        return JointIterate(_retract(self.whitened_selection, step[width:]), theta, self.regressors)


def refine(candidate: Candidate, summary: PassSummary, executor: Executor) -> tuple[Candidate, DataSummary]:
    """The estimate from a choice of the samples, refined to the optimum over all of them.

    Args:
        candidate: Learnt from the choice; or from all samples, and nothing is to be done.
        summary: Of all samples.
        executor: Makes the passes over all samples.

    Returns:
        The refined candidate, and the summary, with a note where an estimate cannot be refined.
    """
    estimate, samples, data = candidate.estimate, candidate.samples, summary.data
    if len(samples) == data.n_samples:
        return candidate, data
    if estimate.joint is not None:
        start: Iterate = _joint_start(estimate.joint, samples)
    elif estimate.name == "null-space":
        start = NullSpaceIterate(estimate.whitened_selection)
    else:
        note = f"learnt from {counted(len(samples), 'sample')}, chosen evenly out of {data.n_samples}"
        return candidate, dataclasses.replace(data, notes=(*data.notes, note))
    end, equations = _descend(start, samples, summary, executor)
    s = len(end.whitened_selection)
    gradients, hessians = _in_own_basis(equations, s * (samples.n_rows - s))
    refined = dataclasses.replace(
        estimate,
        whitened_selection=end.whitened_selection,
        unexplained=equations.cost / equations.energy if equations.energy > 0.0 else 0.0,
        gradients=gradients,
        hessians=hessians,
        joint=None,
        prior=None,
    )
    return dataclasses.replace(candidate, estimate=refined), data


def _descend(
    here: Iterate, samples: Samples, summary: PassSummary, executor: Executor
) -> tuple[Iterate, NormalEquations]:
    """Gauss-Newton steps until the next would be shorter than `SETTLED`, extrapolated from the last two lengths."""
    m = len(here.whitened_selection) * (samples.n_rows - len(here.whitened_selection))

    def gather(at: Iterate, number: int) -> NormalEquations:
        accumulator = at.accumulator(samples.features, samples.whitening, summary.data.n_trajectories)
        total = executor.total(accumulator, summary.first_trajectories, TITLE.format(number))
        return at.normal_equations(total)

    equations, before, damping = gather(here, 1), np.inf, 0.0
    for number in range(2, MAX_PASSES + 1):
        step = -_solve(equations.hessians.sum(axis=0), equations.gradients.sum(axis=0)[:, None], damping)[:, 0]
        length = float(np.linalg.norm(step[len(step) - m :]))
        trial = here.stepped(step)
        if length < ROUNDING or (number > 2 and length * min(length / before, 1.0) < SETTLED):
            return trial, equations  # what a further pass would change is below rounding
        found = gather(trial, number)
        if found.cost <= equations.cost * (1.0 + 1e-9) or length < WITHIN_ROUNDING:
            here, equations, before, damping = trial, found, length, 0.0
        else:
            damping = max(1e-3, 10.0 * damping)
    return here, equations


def _in_own_basis(equations: NormalEquations, m: int) -> tuple[Float[np.ndarray, "g d"], Float[np.ndarray, "g d d"]]:
    """The blocks' gradients and Hessians, with those combinations of Theta only that the samples determine.

    These are orthonormal and what B would move Theta along is taken off, for the bootstrap leaves blocks out.
    """
    width = equations.gradients.shape[1] - m
    if width == 0:
        return equations.gradients, equations.hessians
    H = equations.hessians.sum(axis=0)
    scale, V, eigenvalues = _determined_directions(H[:width, :width])
    basis = scale[:, None] * V / np.sqrt(eigenvalues)
    turn = np.zeros((width + m, basis.shape[1] + m))
    turn[:width, : basis.shape[1]] = basis
    turn[:width, basis.shape[1] :] = -basis @ (basis.T @ H[:width, width:])
    turn[width:, basis.shape[1] :] = np.eye(m)
    return equations.gradients @ turn, turn.T @ equations.hessians @ turn


def _joint_start(fit: JointFit, samples: Samples) -> JointIterate:
    mixing, back = _orthonormal_regressors(fit.model, samples)
    return JointIterate(
        fit.whitened_selection, back @ fit.theta, Regressors(fit.model, samples.centre, samples.spread, mixing)
    )


def _orthonormal_regressors(
    model: PolicyModel, samples: Samples
) -> tuple[Float[np.ndarray, "j k"], Float[np.ndarray, "j k"]]:
    """T with T beta orthonormal over the samples, and T^{+T}, which takes Theta along."""
    beta = np.concatenate([model(block.x, block.trajectory) for block in samples.blocks()])
    _, sigma, Vt = np.linalg.svd(beta / np.sqrt(len(beta)), full_matrices=False)
    kept = sigma > FLAT * sigma[0]
    return Vt[kept] / sigma[kept, None], Vt[kept] * sigma[kept, None]


def _mixing(whitened_selection: np.ndarray, whitening: np.ndarray) -> Float[np.ndarray, "r p"]:
    return np.concatenate([whitened_selection, complement_rows(whitened_selection)]) @ whitening


def _retract(whitened_selection: np.ndarray, step: np.ndarray) -> Float[np.ndarray, "s r"]:
    """The row space after dLambda = B Lambda_perp."""
    s, r = whitened_selection.shape
    return orthonormal_rows(whitened_selection + step.reshape(s, r - s) @ complement_rows(whitened_selection))


def _solve(H: np.ndarray, y: np.ndarray, damping: float = 0.0) -> Float[np.ndarray, "w c"]:
    """H^+ y; directions that the samples do not determine stay as they are."""
    if y.size == 0:
        return np.zeros_like(y)
    scale, V, eigenvalues = _determined_directions(H)
    return scale[:, None] * (V @ ((V.T @ (scale[:, None] * y)) / (eigenvalues[:, None] + damping)))


def _determined_directions(H: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scale of each unknown, and eigenvectors and eigenvalues of the scaled H that are not rounding."""
    size = np.sqrt(np.maximum(np.diag(H), 0.0))
    scale = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0.0)
    eigenvalues, vectors = np.linalg.eigh(scale[:, None] * H * scale)
    kept = eigenvalues > UNDETERMINED * eigenvalues[-1]
    return scale, vectors[:, kept], eigenvalues[kept]
