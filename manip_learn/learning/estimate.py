"""The answer of every estimator of Lambda, with the evidence for the number of its rows; and the estimator of rows that
are held, from a motion that obeys A(q) u = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, final

import numpy as np
from jaxtyping import Float

from manip_learn.learning.descent import descend
from manip_learn.learning.samples import Samples, rows_beside
from manip_learn.linalg import complement_rows, inverse_triangles_beside, orthonormal_rows, row_bases, turned

# ratios of singular values, noise directions against free ones, that are clear, and weak. Set by hand
CLEAR_GAP, WEAK_GAP = 10.0, 3.0
# root mean square of residuals over that of the noise, from which it is more than noise: the ratio of the energies,
# 1.69, is three standard deviations sqrt(2 / n) of a variance that is estimated from n = 38 samples
RESIDUAL_RATIO = 1.3
# share of the motion's energy that breaks A u = 0 below which the rows are held beyond doubt: a hundredth of the
# velocity; and above which they are called soft: a tenth. Set by hand
HELD_ENERGY, SOFT_ENERGY = 1e-4, 1e-2
# ratio up to which two answers are equally good, so that the first feature map and the simpler model are taken. Set
# by hand
EQUALLY_GOOD = 1.1
# share of the motion of left-out recordings that a policy may leave to explain it, beside the mean motion, which has no
# posture in it. Set by hand
EXPLAINED = 0.3

_MAX_ITERATIONS = 50  # of Gauss-Newton, which ends by itself before
MAX_FOLDS = 10  # parts that are left out in turn
SAME_COST = 1e-13  # a relative rise of the cost below this is rounding: the step counts as no gain
# length of the last step [rad on the Grassmann manifold], and the relative gain that is none: both are rounding
_SHORTEST, GAIN = 1e-14, 1e-12

Verdict = Literal["clear", "weak", "none"]


@final
@dataclass(frozen=True)
class GapTable:
    """Evidence for each number of rows.

    Attributes:
        counts: Candidate numbers of rows s.
        gaps: Ratio that supports each.
        weak_from: Gap from which a weak answer is given.
        best: The number of rows that the gaps support.
    """

    counts: tuple[int, ...]
    gaps: tuple[float, ...]
    weak_from: float
    best: int

    @property
    def by_count(self) -> dict[int, float]:
        """Number of rows -> gap."""
        return dict(zip(self.counts, self.gaps, strict=True))

    def gap(self, count: int) -> float:
        """Gap of a number of rows; 0 if it is no candidate."""
        return self.by_count.get(count, 0.0)

    def verdict(self, count: int) -> Verdict:
        """How sure a number of rows is."""
        gap = self.gap(count)
        return "clear" if gap >= CLEAR_GAP else "weak" if gap >= self.weak_from else "none"


def gaps_of_levels(levels: Float[np.ndarray, " r"], nv: int) -> GapTable:
    """Gaps between the levels of a motion with b = 0, least level first.

    s = p (nothing of Phi moves) has no free direction to be compared with; there the level of a motion that is equally
    strong in all joints, 1, takes its place.
    """
    r = len(levels)
    # levels are roots of eigenvalues: below this they are rounding, and a gap among them says nothing
    floor = 3e-8 * max(float(levels[-1]), 1.0)
    padded = np.maximum(np.append(levels, 1.0), floor)
    counts = [s for s in range(1, r + 1) if s < nv]
    gaps = tuple(float(padded[s] / padded[s - 1]) for s in counts)
    return GapTable(tuple(counts), gaps, WEAK_GAP, counts[int(np.argmax(gaps))])


@final
@dataclass(frozen=True, eq=False)
class PolicyPrior:
    """Gaussian prior of the policy's parameters, independent of each other.

    Attributes:
        precision: Noise variance over the variance of each unknown, 0 for those of Lambda, shape (d,).
        noise: Noise variance [(rad/s)^2].
    """

    precision: Float[np.ndarray, " d"]
    noise: float

    def errors(
        self, hessians: Float[np.ndarray, "g d d"], m: int, repetitions: int, rng: np.random.Generator
    ) -> Float[np.ndarray, "k m"]:
        """Errors of the last m unknowns since the parameters are drawn towards zero, as often as asked for.

        With M = sum H_i + P the estimate is off by M^-1 P times the parameters, whose covariance is sigma^2 P^-1.
        """
        total = hessians.sum(axis=0) + np.diag(self.precision)
        own = np.linalg.solve(total, np.eye(len(total))[:, len(total) - m :])
        factor = own * np.sqrt(self.precision * self.noise)[:, None]
        return rng.standard_normal((repetitions, len(factor))) @ factor


@final
@dataclass(frozen=True, eq=False)
class Estimate:
    """A learnt row space with its evidence, in whitened coordinates.

    Attributes:
        name: Of the estimator.
        whitened_selection: Lambda, shape (s, p').
        table: Evidence for the number of rows.
        unexplained: Share of the energy that is not explained on the data it was fitted to.
        held_out: The same on trajectories that were left out.
        gradients, hessians: Of each trajectory at the optimum, for the bootstrap.
        policy_model: Name of the policy model, or what the data determine of the general prior.
        policy_residuals: Policy model -> held-out share of unexplained energy.
        nats: Joint estimator: log-likelihood of the motion, see `imposed`.
        prior: Joint estimator: of the policy's parameters, where they were integrated out.
        levels: Null-space estimator: levels of the whitened directions, least first [1], see `null_space.levels`.
    """

    name: str
    whitened_selection: Float[np.ndarray, "s r"]
    table: GapTable
    unexplained: float
    held_out: float
    gradients: Float[np.ndarray, "g m"]
    hessians: Float[np.ndarray, "g m m"]
    policy_model: str | None = None
    policy_residuals: dict[str, float] = field(default_factory=dict)
    nats: float = 0.0
    prior: PolicyPrior | None = None
    levels: Float[np.ndarray, " r"] = field(default_factory=lambda: np.zeros(0))

    @property
    def n_rows(self) -> int:
        """Number of rows s."""
        return len(self.whitened_selection)

    @property
    def gap(self) -> float:
        """Gap that supports the number of rows."""
        return self.table.gap(self.n_rows)

    @property
    def is_held(self) -> bool:
        """Whether the motion obeys A u = 0 beyond doubt."""
        return self.name == "null-space" and self.gap >= CLEAR_GAP and self.unexplained < HELD_ENERGY


@final
@dataclass(frozen=True, eq=False)
class NullSpaceFit:
    """Result of the null-space estimator.

    Attributes:
        whitened_selection: Lambda in whitened coordinates, orthonormal rows, shape (s, p').
        cost: Mean of w^T A^+ A w, equation (10).
        energy: Mean of |w|^2; cost / energy is the share of the motion that breaks the constraint.
        scores: shape (groups, s, p'-s), gradient of each trajectory: sum (A^{+T} w)(Lambda_perp Phi N w)^T.
        curvatures: shape (groups, m, m), Gauss-Newton Hessian of each trajectory, m = s (p'-s).
    """

    whitened_selection: Float[np.ndarray, "s r"]
    cost: float
    energy: float
    scores: Float[np.ndarray, "g s k"]
    curvatures: Float[np.ndarray, "g m m"]

    @property
    def unexplained(self) -> float:
        """Share of the energy that breaks A u = 0."""
        return self.cost / self.energy if self.energy > 0.0 else 0.0

    def equations(self) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
        """Gauss-Newton Hessian and gradient of all trajectories."""
        return self.curvatures.sum(axis=0), self.scores.sum(axis=0).reshape(-1)


def split(
    A: Float[np.ndarray, "s nv n"], w: Float[np.ndarray, "nv n"]
) -> tuple[Float[np.ndarray, "s n"], Float[np.ndarray, "nv n"], Float[np.ndarray, "s s n"]]:
    """Q^T w, N w and R^-1 of A^T = Q R, the samples side by side in the last axis."""
    Q, R = row_bases(A.transpose(1, 0, 2))
    along = np.einsum("vsn,vn->sn", Q, w)
    return along, w - np.einsum("vsn,sn->vn", Q, along), inverse_triangles_beside(R)


def levels(
    samples: Samples, moments: Float[np.ndarray, "g r r"] | None = None
) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r r"]]:
    """How much the motion uses each whitened direction, least first, and the directions as rows.

    A level is the root mean square of the motion's velocity along a direction, relative to a motion that is equally
    strong in all joints: about 1 along a free direction, about the noise along a constrained one. In whitened
    coordinates this is the generalised eigenproblem sum Phi w w^T Phi^T x = e sum Phi Phi^T x.
    The samples' `trajectory_moments` are taken from the caller where they are known.
    """
    moment = (trajectory_moments(samples) if moments is None else moments).sum(axis=0)
    eigenvalues, vectors = np.linalg.eigh(moment / len(samples))
    scale = samples.nv / max(samples.energy, np.finfo(np.float64).tiny)
    return np.sqrt(np.maximum(eigenvalues, 0.0) * scale), vectors.T


def trajectory_moments(samples: Samples) -> Float[np.ndarray, "g r r"]:
    """sum Phi u u^T Phi^T of each trajectory: enough for the closed-form start on any choice of trajectories."""
    moments = np.zeros((samples.n_trajectories, samples.n_rows, samples.n_rows))
    for block in samples.blocks():
        r = np.einsum("pvn,vn->pn", block.Phi.transpose(1, 2, 0), np.ascontiguousarray(block.u.T))
        block.add_to(moments, r[:, None] * r)
    return moments


def fit_null_space(
    samples: Samples, start: Float[np.ndarray, "s r"], max_iterations: int = _MAX_ITERATIONS
) -> NullSpaceFit:
    """Gauss-Newton on the Grassmann manifold for equation (10), E = sum w^T A^+ A w, from a start.

    With dLambda = B Lambda_perp the gradient is 2 sum (A^{+T} w)(Lambda_perp Phi N w)^T; its steps: `descend`.
    The samples hold w in place of u: the motion itself, or the null-space part that a separation found. The start is in
    whitened coordinates; no iterations judge it as it is.
    """
    s, r = start.shape
    return descend(
        _fit_at(samples, orthonormal_rows(start)),
        lambda here, B: _fit_at(samples, turned(here.whitened_selection, B)),
        max_iterations if 0 < s < r else 0,
        tolerance=_SHORTEST,
        gain=GAIN,
        rise=SAME_COST,
    )


def _fit_at(samples: Samples, Lambda: np.ndarray) -> NullSpaceFit:
    """Lambda as it is, with what a Gauss-Newton step needs."""
    s, k = len(Lambda), samples.n_rows - len(Lambda)
    both = np.concatenate([Lambda, complement_rows(Lambda)])
    scores = np.zeros((samples.n_trajectories, s, k))
    curvatures = np.zeros((samples.n_trajectories, s * k, s * k))
    cost = energy = 0.0
    for block in samples.blocks():
        rows, w = rows_beside(both, block.Phi), np.ascontiguousarray(block.u.T)
        along, null, R_inverse = split(rows[:s], w)
        a = np.einsum("ijn,jn->in", R_inverse, along)  # A^{+T} w
        g = np.einsum("kvn,vn->kn", rows[s:], null)
        inverse_gram = np.einsum("iln,jln->ijn", R_inverse, R_inverse)  # (A A^T)^-1
        H = inverse_gram[:, None, :, None] * (g[:, None] * g)[None, :, None]
        cost, energy = cost + float(np.sum(along**2)), energy + float(np.sum(w**2))
        block.add_to(scores, a[:, None] * g)
        block.add_to(curvatures, H.reshape(s * k, s * k, w.shape[1]))
    n = len(samples)
    return NullSpaceFit(Lambda, cost / n, energy / n, scores, curvatures)


def estimate_null_space(samples: Samples, n_constraints: int | None = None) -> Estimate:
    """Closed-form start, number of rows from the gap of the levels by default, Gauss-Newton, and the residual of
    trajectories that are left out.
    """
    moments = trajectory_moments(samples)
    sizes, directions = levels(samples, moments)
    table = gaps_of_levels(sizes, samples.nv)
    s = n_constraints or table.best
    fit = fit_null_space(samples, directions[:s])
    return Estimate(
        "null-space",
        fit.whitened_selection,
        table,
        fit.unexplained,
        held_out_share(samples, s, moments),
        fit.scores.reshape(samples.n_trajectories, s * (samples.n_rows - s)),
        fit.curvatures,
        levels=sizes,
    )


def held_out_share(samples: Samples, s: int, moments: Float[np.ndarray, "g r r"]) -> float:
    """Share of the energy that breaks a constraint of s rows learnt, in closed form, from the other trajectories."""
    n_folds = min(MAX_FOLDS, samples.n_trajectories)
    if n_folds < 2:
        return float("nan")
    fold_of_trajectory = np.arange(samples.n_trajectories) % n_folds
    total = moments.sum(axis=0)
    others = np.stack([total - moments[fold_of_trajectory == fold].sum(axis=0) for fold in range(n_folds)])
    selections = np.linalg.eigh(others)[1][:, :, :s].transpose(2, 1, 0)
    broken = energy = 0.0
    for block in samples.blocks():
        Lambda = selections[:, :, fold_of_trajectory[block.trajectory]]
        Q, _ = row_bases(np.einsum("srn,rvn->vsn", Lambda, block.Phi.transpose(1, 2, 0)))
        broken += float(np.sum(np.einsum("vsn,vn->sn", Q, np.ascontiguousarray(block.u.T)) ** 2))
        energy += float(np.sum(block.u**2))
    return broken / energy if energy > 0.0 else float("nan")
