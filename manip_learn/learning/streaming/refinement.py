"""An estimate from an even choice of the samples, refined on all of them: Gauss-Newton, one pass per step.

The first pass makes the choice. Each further one gathers the normal equations of Lambda, and of the null-space policy
where there is one, at the point that has been reached; what is summed is what the estimators sum in memory. Normal
equations square the condition number: the regressors are made orthonormal beforehand, and since the residual is formed
sample by sample, each further pass takes off what rounding has left (iterative refinement).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Float, UInt

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import counted
from manip_learn.learning.answer import Candidate
from manip_learn.learning.estimators.estimate import JointFit
from manip_learn.learning.estimators.null_space import Terms
from manip_learn.learning.estimators.policy_equations import OrthonormalRegressors, Projections
from manip_learn.learning.estimators.policy_model import PolicyModel
from manip_learn.learning.estimators.variable_projection import MAX_BLOCKS
from manip_learn.learning.samples import IN_MEMORY_SAMPLES, DataSummary, Samples, TrajectoryBlocks, rows_beside
from manip_learn.learning.streaming.sample_stream import Accumulator, Chunk, Executor, LocalExecutor, SampleStream
from manip_learn.linalg import complement_rows, turned, whitener
from manip_learn.recordings.readers.read_request import refuse_unmatched
from manip_learn.recordings.trajectory_source import Progress

# multiples of the golden ratio (Fibonacci hashing): the smallest of any number of them are spread evenly over the
# samples, and no rhythm of the recording is met, which every k-th sample might
GOLDEN = np.uint64(11_400_714_819_323_198_485)
MAX_PASSES = 20  # through the data; a Gauss-Newton step takes one
# length of a step [rad on the Grassmann manifold] that no longer counts, and from which rounding is all that is left
SETTLED, ROUNDING = 1e-12, 1e-13
WITHIN_ROUNDING = 1e-9  # shorter steps are not judged by the cost
# blocks of trajectories for the bootstrap of the null-space estimator; those of the joint one hold more each
NULL_SPACE_BLOCKS = 512


@final
@dataclass(frozen=True, eq=False)
class PassSummary:
    """Summary of the samples of a part, or of all.

    Attributes:
        counts: Part -> number of its trajectories.
        data: Numbers of the samples, and those chosen.
        order: Multiple of the golden ratio of each chosen sample, shape (k,).
    """

    counts: dict[int, int]
    data: DataSummary
    order: UInt[np.ndarray, " k"]

    @property
    def first_trajectories(self) -> dict[int, int]:
        """Part -> number of trajectories in the parts before it."""
        parts = sorted(self.counts)
        starts = np.cumsum([0, *(self.counts[part] for part in parts)]).tolist()
        return dict(zip(parts, starts, strict=False))


@final
@dataclass(frozen=True)
class SummaryAccumulator(Accumulator):
    """Accumulates the summary of the samples.

    Attributes:
        n_chosen: Number of samples to choose.
    """

    n_chosen: int = IN_MEMORY_SAMPLES

    def of(self, chunk: Chunk) -> PassSummary:
        """The summary of a chunk; its samples and trajectories are counted from the start of the part."""
        data = DataSummary.of_samples(chunk.q, chunk.u, chunk.trajectory, chunk.first)
        order = np.arange(chunk.first, chunk.first + len(chunk), dtype=np.uint64) * GOLDEN
        return PassSummary({chunk.part: data.n_trajectories}, data, order)

    def merge(self, before: PassSummary, after: PassSummary) -> PassSummary:
        """Samples and trajectories of a later part are counted on; those of the same part are already."""
        a, b = before.data, after.data
        counts = {**before.counts, **after.counts}
        same_part = not after.counts.keys().isdisjoint(before.counts)
        samples, trajectories = (0, 0) if same_part else (a.n_samples, a.n_trajectories)
        faster = float(b.fastest @ b.fastest) > float(a.fastest @ a.fastest)
        fastest_at = (b.fastest_at[0] + samples, b.fastest_at[1] + trajectories)
        # once enough are chosen, few of a new chunk can be among the smallest
        full = len(before.order) == self.n_chosen
        new = after.order < before.order.max() if full else np.ones(len(after.order), dtype=bool)
        order = np.concatenate([before.order, after.order[new]])
        kept = np.sort(np.argsort(order, kind="stable")[: self.n_chosen])
        chosen = ((a.q, b.q[new]), (a.u, b.u[new]), (a.trajectory, b.trajectory[new] + trajectories))
        q, u, trajectories = (np.concatenate(pair)[kept] for pair in chosen)
        data = DataSummary(
            *(a.n_samples + b.n_samples, sum(counts.values())),
            *(np.minimum(a.low, b.low), np.maximum(a.high, b.high), a.squares + b.squares),
            *((b.fastest, fastest_at) if faster else (a.fastest, a.fastest_at)),
            *(q, u, trajectories),
        )
        return PassSummary(counts, data, order[kept])


class Evidence(NamedTuple):
    """The sums that a pass at a point of the descent has gathered.

    Attributes:
        cost, energy: Sums of the squares of the residuals, and of the motion.
        parts: Block of trajectories -> gradient and Gauss-Newton Hessian for (Theta, B), B alone without a policy.
    """

    cost: float
    energy: float
    parts: dict[int, tuple[np.ndarray, np.ndarray]]


@final
@dataclass(frozen=True, eq=False)
class Policy:
    """pi(q) = Theta^T T beta((q - centre) / spread), T beta orthonormal on some samples.

    Attributes:
        model: beta.
        centre, spread: shape (m,).
        mixing: T^T, shape (k, k').
        theta: shape (k', nv).
    """

    model: PolicyModel
    centre: Float[np.ndarray, " m"]
    spread: Float[np.ndarray, " m"]
    mixing: Float[np.ndarray, "k j"]
    theta: Float[np.ndarray, "j nv"]

    @staticmethod
    def of(fit: JointFit, samples: Samples) -> Policy:
        """The policy of a fit to some samples."""
        regressors = OrthonormalRegressors.of(samples, fit.model)
        return Policy(fit.model, samples.centre, samples.spread, regressors.mixing, regressors.back @ fit.theta)


@final
@dataclass(frozen=True, eq=False)
class Iterate(Accumulator):
    """A point of the descent, and the pass that gathers the normal equations there.

    Its cost is sum u^T A^+ A u, equation (10), or with a policy sum |N (u - pi)|^2. dLambda = B Lambda_perp.

    Attributes:
        features: Phi.
        whitening: Of the features.
        blocks: Pool of each trajectory.
        whitened_selection: Lambda in whitened coordinates.
        policy: Null-space policy; None where the world holds the rows.
    """

    features: FeatureMap
    whitening: Float[np.ndarray, "r p"]
    blocks: TrajectoryBlocks
    whitened_selection: Float[np.ndarray, "s r"]
    policy: Policy | None

    def of(self, chunk: Chunk) -> Evidence:
        """What a chunk says."""
        s, runs = len(self.whitened_selection), self.blocks.runs(chunk.trajectory)
        both = np.concatenate([self.whitened_selection, complement_rows(self.whitened_selection)])
        rows = rows_beside(both @ self.whitening, self.features.batch(chunk.q))
        if self.policy is None:
            terms, starts = Terms.of(rows, s, np.ascontiguousarray(chunk.u.T)), [part.start for _, part in runs]
            gradients = np.add.reduceat(terms.scores, starts, axis=-1).reshape(-1, len(runs)).T
            hessians = np.moveaxis(np.add.reduceat(terms.curvatures, starts, axis=-1), -1, 0)
            found = zip((block for block, _ in runs), gradients, hessians, strict=True)
            return Evidence(terms.cost, terms.energy, {block: (g, H) for block, g, H in found})
        projections, policy = Projections.of_rows(rows, s), self.policy
        beta = policy.model((chunk.q - policy.centre) / policy.spread) @ policy.mixing
        y = chunk.u - beta @ policy.theta
        parts = {block: (g, H) for block, g, H in projections.blockwise(beta, y, runs)}
        return Evidence(projections.energy(y), projections.energy(chunk.u), parts)

    def merge(self, before: Evidence, after: Evidence) -> Evidence:
        """Sums, block by block."""
        parts = dict(before.parts)
        for block, (gradient, hessian) in after.parts.items():
            if block in parts:
                gradient, hessian = parts[block][0] + gradient, parts[block][1] + hessian
            parts[block] = gradient, hessian
        return Evidence(before.cost + after.cost, before.energy + after.energy, parts)

    def stepped(self, step: Float[np.ndarray, " w"]) -> Iterate:
        """Lambda and Theta after a step."""
        width = 0 if self.policy is None else self.policy.theta.size
        policy = self.policy
        if policy is not None:
            policy = dataclasses.replace(policy, theta=policy.theta + step[:width].reshape(policy.theta.shape))
        Lambda = turned(self.whitened_selection, step[width:])
        return dataclasses.replace(self, whitened_selection=Lambda, policy=policy)


def learn_from_all(
    stream: SampleStream,
    learn: Callable[[DataSummary], Candidate],
    n_chosen: int = IN_MEMORY_SAMPLES,
    client: Any = None,
    progress: Progress | None = None,
) -> tuple[Candidate, DataSummary]:
    """The candidate learnt from an even choice of the samples, refined on all of them; and their summary.

    Args:
        stream: The samples.
        learn: Learns from a choice.
        n_chosen: Number of samples to choose.
        client: A dask client whose workers make the passes; None for this process.
        progress: Told how far each pass is.

    Raises:
        RecordingError: A reading option that matched nothing in any part.
        MissingExtraError: A client is given, and dask is not installed.
    """
    executor: Executor = LocalExecutor(stream, progress)
    if client is not None:
        from manip_learn.learning.streaming.dask_executor import DaskExecutor

        executor = DaskExecutor(client, stream, progress)
    summary, notes = executor.total(SummaryAccumulator(n_chosen), "all samples, first pass")
    data = dataclasses.replace(summary.data, notes=tuple(refuse_unmatched(notes, stream.source.n_parts)))
    return refine(learn(data), dataclasses.replace(summary, data=data), executor)


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
    if estimate.joint is None and estimate.name != "null-space":
        note = f"learnt from {counted(len(samples), 'sample')}, chosen evenly out of {data.n_samples}"
        return candidate, dataclasses.replace(data, notes=(*data.notes, note))
    policy = None if estimate.joint is None else Policy.of(estimate.joint, samples)
    blocks = TrajectoryBlocks(data.n_trajectories, NULL_SPACE_BLOCKS if policy is None else MAX_BLOCKS)
    Lambda = estimate.whitened_selection if estimate.joint is None else estimate.joint.whitened_selection
    start = Iterate(samples.features, samples.whitening, blocks, Lambda, policy)
    end, found = _descend(start, summary, executor)
    gradients, hessians = (np.array(one) for one in zip(*(found.parts[b] for b in sorted(found.parts)), strict=True))
    refined = dataclasses.replace(
        estimate,
        whitened_selection=end.whitened_selection,
        unexplained=found.cost / found.energy if found.energy > 0.0 else 0.0,
        gradients=gradients,
        hessians=hessians,
        joint=None,
        prior=None,
    )
    return dataclasses.replace(candidate, estimate=refined), data


def _descend(here: Iterate, summary: PassSummary, executor: Executor) -> tuple[Iterate, Evidence]:
    """Gauss-Newton steps until the next would be shorter than `SETTLED`, extrapolated from the last two lengths."""

    def gather(at: Iterate, number: int) -> Evidence:
        return executor.total(at, f"all samples, pass {number}", summary.first_trajectories)[0]

    s, r = here.whitened_selection.shape
    found, before, damping = gather(here, 1), np.inf, 0.0
    for number in range(2, MAX_PASSES + 1):
        gradient, H = (sum(part[i] for part in found.parts.values()) for i in (0, 1))
        # directions that the samples do not determine stay as they are
        W = whitener(H + damping * np.diag(np.diag(H)))
        step = -W.T @ (W @ gradient)
        length = float(np.linalg.norm(step[len(step) - s * (r - s) :]))
        trial = here.stepped(step)
        if length < ROUNDING or (number > 2 and length * min(length / before, 1.0) < SETTLED):
            return trial, found  # what a further pass would change is below rounding
        after = gather(trial, number)
        if after.cost <= found.cost * (1.0 + 1e-9) or length < WITHIN_ROUNDING:
            here, found, before, damping = trial, after, length, 0.0
        else:
            damping = max(1e-3, 10.0 * damping)
    return here, found
