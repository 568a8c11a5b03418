"""The constraint that the demonstrator imposes: Lambda and the null-space policy together, from raw (q, u), b unknown.

A Lambda of s rows accounts for all of u_n = Q_n c_n + Z_n w_n, Q_n and Z_n orthonormal bases of the rows and of the
null space of A_n = Lambda Phi(q_n). w_n is a policy of the posture and white noise of variance sigma^2; c_n is the
task's own motion, of which nothing is known but that it is a signal in time. [Q Z] is orthonormal, so that the
likelihoods of all Lambda, whatever their number of rows, are those of the same numbers: in nats

    l(Lambda) = - sum_k N_k / 2 (log S_k + 1) - d / 2 log n + log N(Z^T u; 0, sigma^2 I + K T K^T)

S_k is the mean square, per row, of Q c in octave k of the cosine transform of each trajectory, which has N_k entries;
d is the number of these octaves and of the entries of Lambda (Schwarz, 1978). A row too many takes a direction that the
policy predicts to the noise for one of which nothing is known: it costs log(S / sigma^2) / 2 a sample. Rows that are
held are judged by the same l, with Z w for the signal in time and c for the noise.

The policy is pi(q) = Theta^T beta(q), Theta ~ N(0, T) with one variance tau_g^2 for all parameters of grade g (the
monomials of one degree, the waves of one frequency), K = d (Z^T pi) / d Theta; Theta is integrated out. With
C = K^T K = sum beta beta^T (x) N, P = sigma^2 T^-1 and theta the posterior mean of Theta,

    - 2 log N = n z log sigma^2 + log |C + P| - log |P| + (|Z^T (u - pi)|^2 + theta^T P theta) / sigma^2

tau and sigma by maximum likelihood too (MacKay, 1992, Neural Computation 4(3), eq. (2.33) and following). No degree has
to be chosen: one that the data do not need has tau = 0, one of which they cannot tell widens the angle. Lambda moves by
Gauss-Newton steps on the Grassmann manifold with Theta eliminated (Golub and Pereyra, 1973; Kaufman, 1975).

Noise may be stronger in some joints than in others. With covariance L L^T all this holds for L^-1 u, Phi L^-T and
L^-1 pi, and l less log |L| a sample is the likelihood of the same u.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Sequence
from statistics import NormalDist
from typing import final

import numpy as np
from jaxtyping import Float
from scipy.linalg import eigh
from scipy.spatial import cKDTree

from manip_learn.errors import NotIdentifiableError
from manip_learn.learning.descent import descend
from manip_learn.learning.estimate import Estimate, GapTable, PolicyPrior
from manip_learn.learning.policy import (
    GRADES,
    LEAST,
    MODELS,
    MOST_COLUMNS,
    OWN,
    POLYNOMIALS,
    ExactPolicy,
    Grade,
    Posterior,
    Regressors,
    grades_of,
    n_columns,
    parts_of,
    resolved,
)
from manip_learn.learning.samples import CUBIC, Samples, runs
from manip_learn.linalg import orthonormal_rows

# samples that the search looks at; more of them only sharpen what it found
COMPARE_LIMIT = 1_500
MOST_LEFT_OUT = 10  # that are left out in turn, at most
# left-out motion over that of no policy up to which a policy predicts it: 1 where there is noise alone to predict
PREDICTS = 1.2
# variance over that of the noise up to which a fit leaves noise alone: 22 % in amplitude. Set by hand
ABOVE_NOISE = 1.5
# share of the motion below which a residual is no noise, and least squares answer; and that is rounding
NO_NOISE, _ROUNDING = 1e-8, 1e-24
VANISHING = 1e-16  # share of the energy that is rounding where nothing moves in the null space
_SETTLED = 1e-6  # squared length of the last step in standard errors
LOOK_STEPS, _STEPS = 6, 40  # of a first look at a start, and of a descent
RICHER = 0.5  # of what a smaller model leaves without noise, that a richer one may leave to be taken
EXACT_STEPS = 30  # of the descent by least squares, which ends by itself before
RANDOM_STARTS, SUBSPACES = 3, 4  # starts where no closed-form one leads to the noise; within the rows that were found
# a rest posture for each trajectory makes the cost bumpy: many starts on a few trajectories and samples
_FEW, FEW_SAMPLES, MANY_STARTS = 16, 600, 40
OWN_SHARE = 1e-6  # of what is noise enough elsewhere
COVARIANCES = 2  # of the noise, each by the residual of a fit with the one before
# largest variance of a joint's noise over the least below which equal weights cost a few per cent at most
UNEQUAL_NOISE = 2.0
NOISE_RANGE = (1e-2, 1e2)  # variances of the joints' noise beside their mean. Set by hand
PRIOR = 1e-3  # weight of the isotropic covariance in samples per sample, for entries that the null spaces hardly show
RESIDUALS_PER_ENTRY, TYLER_STEPS = 20, 10  # differences for each joint, below which no shape is estimated; its steps
DIFFERENCES = CUBIC - 1  # of neighbouring samples: motion that is a parabola over four samples leaves nothing
MEDIAN = NormalDist().inv_cdf(0.75)  # of the absolute value of a standard normal variable
# root mean square distance from a path over its extent within which a motion repeats it: replays with 3 % of another
# motion in them have 0.05 to 0.14, generated reaches in threes and more 0.32 and above (12, 192 sets, seeds from 30000)
SAME_PATH = 0.15
MOST_POSTURES = 2_000  # between the samples of a path, against noise that makes it long


def conditional_pca(samples: Samples, beta: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "r r"]:
    """A closed-form start: directions of whitened feature space by how much the task moved along them, most first.

    g = (Phi Phi^T)^-1 Phi u = G pi(q) + Lambda^T c, so that what a regression of g on the posture leaves over lies in
    the row space of Lambda. Its covariance C is compared with that of isotropic noise: C x = e (sum G G^T) x, and the
    row space is spanned by (sum G G^T) x of the largest e.
    """
    r = samples.n_rows
    Phi = np.concatenate([block.Phi for block in samples.blocks()])
    gram = np.einsum("npv,nqv->npq", Phi, Phi, optimize=True)
    GG = np.linalg.pinv(gram, rcond=1e-10, hermitian=True)
    g = np.einsum("npq,nqv,nv->np", GG, Phi, samples.u, optimize=True)
    # near-singular postures count little
    weight = 1.0 / np.maximum(np.einsum("npp->n", GG), np.finfo(np.float64).tiny)
    root = np.sqrt(weight)[:, None]
    left = g * root - beta * root @ np.linalg.lstsq(beta * root, g * root, rcond=1e-12)[0]
    S = np.einsum("n,nij->ij", weight, GG, optimize=True)
    S += 1e-14 * np.trace(S) / r * np.eye(r)
    eigenvalues, vectors = eigh(left.T @ left, S)
    return (S @ vectors[:, ::-1]).T


def noise_in_time(samples: Samples) -> float:
    """Variance of what in u is no smooth motion, mean over the joints; bursts do not count [(rad/s)^2]."""
    e = _differences(samples)
    return float(np.mean((np.median(np.abs(e), axis=0) / MEDIAN) ** 2)) if len(e) else 0.0


def _differences(samples: Samples) -> Float[np.ndarray, "k nv"]:
    """Of neighbouring samples of a trajectory, with the variance of white noise."""
    inside = samples.trajectory[DIFFERENCES:] == samples.trajectory[:-DIFFERENCES]
    return np.diff(samples.u, DIFFERENCES, axis=0)[inside] / np.sqrt(math.comb(2 * DIFFERENCES, DIFFERENCES))


def shape_in_time(samples: Samples) -> Float[np.ndarray, "nv nv"] | None:
    """Covariance over its mean variance of what in u is no smooth motion; None for too few neighbouring samples.

    Whatever moves the arm, policy or task, moves it smoothly, and noise does not: differences of neighbouring samples
    show it without any model. Bursts at singular postures have their direction, not their length, in it (Tyler, 1987,
    Annals of Statistics 15(1): the shape S with mean e e^T / (e^T S^-1 e) = S / nv).
    """
    e, nv = _differences(samples), samples.nv
    e = e[np.any(e != 0.0, axis=1)]
    if len(e) < RESIDUALS_PER_ENTRY * nv:
        return None
    S = np.eye(nv)
    for _ in range(TYLER_STEPS):
        length = np.einsum("ni,ni->n", e, np.linalg.solve(S, e.T).T)
        S = (e / length[:, None]).T @ e
        S *= nv / np.trace(S)
    return S


def shape_of_residual(fit: Posterior) -> Float[np.ndarray, "nv nv"]:
    """Least squares of e e^T = N Sigma N over all samples, drawn to the unit matrix where they say nothing."""
    N, e = fit.at.N, fit.at.project(fit.y) / math.sqrt(fit.noise)
    n, nv = e.shape
    M = np.einsum("nij,nkl->ikjl", N, N, optimize=True).reshape(nv * nv, nv * nv) / n
    right = (e.T @ e / n).reshape(-1) - M @ np.eye(nv).reshape(-1)
    deviation = np.linalg.solve(M + PRIOR * np.eye(nv * nv), right).reshape(nv, nv)
    values, vectors = np.linalg.eigh(np.eye(nv) + 0.5 * (deviation + deviation.T))
    Sigma = (vectors * np.clip(values, *NOISE_RANGE)) @ vectors.T
    return Sigma * nv / np.trace(Sigma)


def whitened(samples: Samples, Sigma: Float[np.ndarray, "nv nv"]) -> Samples:
    """The samples as L^-1 u and Phi L^-T, Sigma = L L^T: A u = 0 does not hold for these."""
    back = np.linalg.inv(np.linalg.cholesky(Sigma))
    mixing = back.T if samples.mixing is None else samples.mixing @ back.T
    return dataclasses.replace(samples, u=samples.u @ back.T, mixing=mixing)


@final
class Search:
    """Lambda of each number of rows, on some samples, with the grades of a prior.

    Args:
        samples: Few enough for many descents.
        grades: Of the prior.
        rng: For the random starts.
        own: Whether these are offsets of each trajectory, which make the cost bumpy, and follow nearly anything: what
            they leave of the true motion alone is rounding.
    """

    def __init__(self, samples: Samples, grades: Sequence[Grade], rng: np.random.Generator, own: bool):
        floor = OWN_SHARE * resolved(samples) if own else resolved(samples)
        self._samples, self._floor, self._left_out = samples, floor, dict[Posterior, float]()
        self._parts = parts_of(samples, MOST_LEFT_OUT, own)
        self._regressors = Regressors.of(samples, grades)
        self.enough = ABOVE_NOISE * (floor if own else max(noise_in_time(samples), floor))
        beta, affine = self._regressors.values, np.concatenate([np.ones((len(samples), 1)), samples.x], axis=1)
        starts = [conditional_pca(samples, one) for one in (affine, beta) if 2 * one.shape[1] < len(samples)]
        self.found = {s: self._look(one[:s] for one in starts) for s in range(min(samples.n_rows, samples.nv - 1) + 1)}
        if self.best.noise > self.enough:
            for s, before in self.found.items():
                random = (
                    rng.standard_normal((s, samples.n_rows)) for _ in range(MANY_STARTS if own else RANDOM_STARTS)
                )
                self.found[s] = self._look(random, before)
        # one row less, within the rows of the best: they hold the true ones where these are fewer. What falls: the
        # number of rows of the best, for nothing but what has one row less is found anew
        while (s := len(self.best.Lambda)) > 1:
            rows, before = self.best.Lambda, self.found[s - 1]
            self.found[s - 1] = self._look((rng.standard_normal((s - 1, s)) @ rows for _ in range(SUBSPACES)), before)
            if len(self.best.Lambda) == s:
                break

    @property
    def best(self) -> Posterior:
        """The one with the most evidence, of those whose policy predicts recordings that it was not fitted to.

        Evidence alone believes in a rich policy that follows each of a few recordings.
        """
        n, nv = len(self._samples), self._samples.nv
        predicting = [
            s
            for s, one in self.found.items()
            if self.left_out(s) <= PREDICTS * max(one.energy / n, (nv - s) * resolved(self._samples))
        ]
        if not predicting:
            return self.found[min(self.found, key=self.left_out)]
        return max((self.found[s] for s in predicting), key=lambda one: one.nats(self._floor))

    def left_out(self, s: int) -> float:
        """Mean of |Z^T (u - pi)|^2 on recordings that the policy of s rows was not fitted to."""
        one = self.found[s]
        if one not in self._left_out:
            self._left_out[one] = one.held_out(self._parts)
        return self._left_out[one]

    def gaps(self) -> GapTable:
        """Ratio by which each row lowers what is left of left-out recordings [root mean square per direction].

        A ratio that is no chance, three standard deviations of the variances of so many samples, is weak evidence.
        """
        nv, n, least = self._samples.nv, len(self._samples), LEAST * self._samples.energy
        left = [math.sqrt(max(self.left_out(s), least) / (nv - s)) for s in sorted(self.found)]
        gaps = tuple(before / after for before, after in itertools.pairwise(left))
        weak_from = math.sqrt(1.0 + 6.0 * math.sqrt(2.0 / n))
        return GapTable(tuple(range(1, len(left))), gaps, weak_from, max(len(self.best.Lambda), 1))

    def _look(self, starts: Iterable[Float[np.ndarray, "s r"]], best: Posterior | None = None) -> Posterior:
        """The most likely after a few steps, from one start after the other until noise alone is left."""
        for start in starts:
            if best is not None and (best.noise <= self.enough or len(start) in (0, start.shape[1])):
                break
            here = descended(Posterior(self._samples, self._regressors, orthonormal_rows(start)), LOOK_STEPS)
            best = here if best is None or here.cost < best.cost else best
        if best is None:
            raise ValueError("there is no start")
        return best


def descended(here: Posterior, steps: int = _STEPS) -> Posterior:
    """The most likely Lambda from here."""
    s, r = here.Lambda.shape
    steps = steps if 0 < s < r else 0
    return descend(here, Posterior.moved, steps, settled=lambda _, step, H: float(step @ H @ step) < _SETTLED)


def estimate_imposed(
    samples: Samples,
    n_constraints: int | None,
    rng: np.random.Generator,
    policy_model: str = "auto",
    unexplained: float = math.inf,
) -> Estimate:
    """Number of rows by evidence on a choice of samples, then the most likely Lambda on all.

    Args:
        samples: What was recorded.
        n_constraints: Number of rows; found from the data by default.
        rng: For k-means and the random starts.
        policy_model: `"auto"` (the general prior), `"constant"`, `"affine"`, `"quadratic"`, `"cubic"`, `"quartic"`,
            `"quintic"` or `"rbf"`; or `"affine-offset"`: affine, with an offset per trajectory, where demonstrators
            rest in different postures.
        unexplained: Share of the energy of left-out recordings that a policy may leave.

    Raises:
        NotIdentifiableError: One trajectory or motion only, too few samples for an affine policy, no task in them, or
            no policy explains them.
    """
    refuse_what_cannot_show_it(samples, n_constraints)
    floor, own, given = resolved(samples), policy_model == OWN, samples
    few = _few(samples) if own else samples.thinned(COMPARE_LIMIT)
    grades = grades_of(few, policy_model, rng)

    def searched(some: Samples) -> tuple[Search, Posterior]:
        search = Search(some, list(grades.values()), rng, own)
        return search, descended(search.best if n_constraints is None else search.found[n_constraints])

    search, chosen = searched(few)
    is_noisy = chosen.noise > NO_NOISE * samples.energy
    S = shape_in_time(samples) if is_noisy else None
    if S is not None and np.linalg.cond(S) >= UNEQUAL_NOISE:
        other, weighted = searched(whitened(few, S))
        if weighted.nats(floor) > chosen.nats(floor):
            search, chosen, samples = other, weighted, whitened(samples, S)
    if len(chosen.Lambda) == 0:
        raise NotIdentifiableError(
            "a policy of the posture alone explains the motion: nothing in it is steered on purpose, or too few "
            "trajectories show what is; record more, from other starts to other targets",
            code="no-task",
        )
    if policy_model == "auto" and chosen.noise > search.enough and _rest_apart(samples, chosen.Lambda, grades):
        return estimate_imposed(given, n_constraints, rng, OWN, unexplained)
    regressors = Regressors.of(samples, list(grades.values()))
    if is_noisy:
        fit = _with_its_noise(descended(Posterior(samples, regressors, chosen.Lambda)), floor)
        # of the general prior, the largest degree of which the data determine a parameter, and the waves
        used = [name for name, number in zip(grades, fit.determined, strict=False) if number >= 1.0]
        said = [name for name in used if name in POLYNOMIALS][-1:] + [name for name in used if name not in POLYNOMIALS]
        nats, name = fit.nats(floor), "+".join(said) or next(iter(grades))
    else:
        models = [(next(iter(grades)), list(grades.values()))]
        if policy_model == "auto":  # those that may describe a policy exactly, fewest parameters first
            sizes = {name: n_columns(few, some) for name, some in MODELS.items() if name not in ("constant", OWN)}
            names = [name for name in sorted(sizes, key=lambda name: sizes[name]) if sizes[name] <= MOST_COLUMNS]
            models = [(name, [GRADES[one] for one in MODELS[name]]) for name in names]
        name, fit = without_noise(samples if own else few, chosen.Lambda, models)
        nats = Posterior(samples, regressors, fit.Lambda).nats(floor)
    name = name if policy_model in ("auto", "rbf") else policy_model
    gradients, hessians = fit.scores()
    prior = None
    if isinstance(fit, Posterior):
        prior = PolicyPrior(np.append(fit.precision, np.zeros(hessians.shape[1] - len(fit.precision))), fit.noise)
    energy = max(fit.energy / len(fit.samples), VANISHING * samples.energy)
    held_out = fit.held_out(parts_of(fit.samples, MOST_LEFT_OUT, own)) / energy
    if held_out > unexplained:
        raise NotIdentifiableError("no policy explains left-out recordings", code="unexplained")
    left = fit.residual / len(fit.samples) / energy
    residuals = {name: held_out}
    return Estimate(
        "joint", fit.Lambda, search.gaps(), left, held_out, gradients, hessians, name, residuals, nats, prior
    )


def _few(samples: Samples) -> Samples:
    return samples.subset(samples.trajectory < _FEW).thinned(FEW_SAMPLES)


def _rest_apart(samples: Samples, Lambda: Float[np.ndarray, "s r"], grades: dict[str, Grade]) -> bool:
    """Whether offsets of each trajectory explain more than the general prior, where this leaves more than noise."""
    few, floor = _few(samples), OWN_SHARE * resolved(samples)
    own = [GRADES[name] for name in MODELS[OWN]]
    shared, apart = (Posterior(few, Regressors.of(few, one), Lambda) for one in (list(grades.values()), own))
    return apart.nats(floor) > shared.nats(floor)


def _with_its_noise(fit: Posterior, floor: float) -> Posterior:
    """The fit with the covariance of the noise that its residual shows, where that makes the motion more likely."""
    for _ in range(COVARIANCES):
        Sigma = shape_of_residual(fit)
        if np.linalg.cond(Sigma) < UNEQUAL_NOISE:
            break
        other = descended(Posterior(whitened(fit.samples, Sigma), fit.regressors, fit.Lambda))
        if other.nats(floor) <= fit.nats(floor):
            break
        fit = other
    return fit


def without_noise(
    samples: Samples, Lambda: Float[np.ndarray, "s r"], models: Iterable[tuple[str, Sequence[Grade]]]
) -> tuple[str, ExactPolicy]:
    """The first model that leaves rounding alone, or the one that leaves least, by least squares; with its name."""
    best: tuple[str, ExactPolicy] | None = None
    s, r = Lambda.shape
    for name, grades in models:
        here = ExactPolicy(samples, Regressors.of(samples, grades), Lambda)
        here = descend(here, ExactPolicy.moved, EXACT_STEPS if 0 < s < r else 0, tolerance=1e-13, gain=1e-9)
        best = (name, here) if best is None or here.cost < RICHER * best[1].cost else best
        if here.cost <= _ROUNDING * len(samples) * samples.energy:
            break
    if best is None:
        raise ValueError("there is no model")
    return best


def refuse_what_cannot_show_it(samples: Samples, n_constraints: int | None) -> None:
    """Refuse recordings in which nothing tells the policy from the task.

    Raises:
        NotIdentifiableError: One trajectory or motion only, or too few samples for an affine policy.
    """
    if samples.n_trajectories < 2:
        raise NotIdentifiableError(
            "one trajectory does not identify a constraint whose task velocity is unknown: give several, from "
            "different starts to different targets",
            code="one-trajectory",
        )
    # whether all trajectories lie on the path of the longest one, whatever their time, direction and rate
    paths = [samples.q[part] for _, part in runs(samples.trajectory)]
    extents = [float(np.sum(np.var(path, axis=0))) ** 0.5 for path in paths]
    longest, most = paths[int(np.argmax(extents))], SAME_PATH * max(extents)
    # with postures added between its samples, until none are farther apart than that [rad]
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(longest, axis=0), axis=1)))
    n = min(int(along[-1] / most) + 1, MOST_POSTURES) if most > 0.0 else 0
    places = np.union1d(along, np.linspace(0.0, along[-1], n + 1))
    tree = cKDTree(np.column_stack([np.interp(places, along, column) for column in longest.T]))
    if all(float(np.mean(tree.query(path)[0] ** 2)) <= most**2 for path in paths):
        raise NotIdentifiableError(
            f"the {samples.n_trajectories} recordings repeat one motion: like a single one they cannot show which part "
            "of it is steered on purpose; record motions that differ, from other starts to other targets",
            code="repeated-motion",
        )
    if len(samples) * (samples.nv - (n_constraints or 1)) < 2 * samples.nv * (1 + samples.q.shape[1]):
        raise NotIdentifiableError(
            f"{len(samples)} samples are too few for the joint estimator on {samples.n_rows} rows and {samples.nv} "
            "joints: record more trajectories, or name fewer axes",
            code="too-few-samples",
        )
