"""The paper's demonstrations with noise: our learner, the published ones, and how well Lambda can be known at all.

Every trial has one set of demonstrations that all learners get, the Cramer-Rao bound of that very set, and answers
drawn at the bound, whose NMIE is that of an efficient estimator.

The model: recorded u_n = A_n^+ b_n + N_n pi(q_n) + e_n with e_n ~ N(0, Sigma), A_n = Lambda Phi(q_n) and pi(q) =
Theta^T beta(q). Every b_n and Theta are unknown; the class beta of the policy is known, and so is Sigma up to a factor.
With L L^T = Sigma everything is written for L^-1 u, L^-1 pi and Phi L^-T. What an unknown b_n can imitate is the row
space of A_n, so that Z_n^T u_n, with Z_n the null basis of A_n, is all there is to learn from. For dLambda = B
Lambda_perp, B (s, p - s), y = (mean of u) - pi and K_n = d(Z_n^T pi) / dTheta,

    J_n,ij = -Z_n^T (Lambda_perp,j Phi_n)^T (A_n^{+T} y_n)_i,    J~ = (I - K K^+) J,    cov vec(B) >= (J~^T J~)^-1

for unbiased estimators: the inverse Fisher information of B with the nuisance parameters eliminated (Kay, Fundamentals
of Statistical Signal Processing: Estimation Theory, 1993, sections 3.7 and 3.9). One step of a Gauss-Newton method from
the truth would reach it if the error of Lambda were small; where the bound itself is not small, it is optimistic. Parts
of the policy that show nowhere (along the rows, at every posture) are taken as they truly are; to leave them open too
raises the bound by a few per cent.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.experiments.charts import Panel, strips
from manip_learn.experiments.experiment_result import (
    TrialsResult,
    compare_pairs,
    markdown_table,
    median_interval,
    number,
    percent,
    said_pair,
    said_rows,
    share,
    summary,
)
from manip_learn.experiments.paper_setup import (
    REST,
    SELECTIONS,
    Setup,
    demonstrate,
    noise_deviations,
    null_policy,
    planar_features,
    with_noise,
)
from manip_learn.experiments.table import answers, dots, judge
from manip_learn.experiments.trial_runner import of_trials
from manip_learn.experiments.ways import SAID, fit_told_noise
from manip_learn.linalg import complement_rows, orthonormal_rows
from manip_learn.recordings.demonstrations import Demonstrations

if TYPE_CHECKING:
    from matplotlib.figure import Figure

UNSEEN = 1e-11  # share of the largest singular value below which a policy parameter shows nowhere
LEAST_INFORMATION = 1e-12  # of what the motion does not tell: an angle of 90 degrees
BLOCK = 20_000  # numbers of postures times draws that are worked on at once


@final
@dataclass(frozen=True, eq=False)
class NoiseFreeMotion:
    """The truth behind noisy samples.

    Attributes:
        features: Phi.
        selection: Lambda, orthonormal rows.
        q: Postures.
        u: Velocities without noise [rad/s].
        pi: The null-space policy at these postures [rad/s].
        beta: Regressors of the class that the policy is of, pi = Theta^T beta.
    """

    features: FeatureMap
    selection: Float[np.ndarray, "s p"]
    q: Float[np.ndarray, "n nq"]
    u: Float[np.ndarray, "n nv"]
    pi: Float[np.ndarray, "n nv"]
    beta: Float[np.ndarray, "n k"]


def affine_regressors(q: Float[np.ndarray, "n nq"]) -> Float[np.ndarray, "n k"]:
    """beta(q) = (1, q): the class of an attractor."""
    return np.concatenate([np.ones((len(q), 1)), q], axis=1)


def information(motion: NoiseFreeMotion, covariance: Float[np.ndarray, "nv nv"]) -> Float[np.ndarray, "m m"]:
    """Fisher information J~^T J~ of vec(B), B (s, p - s) row by row, the policy and every b_n unknown.

    Args:
        motion: The truth.
        covariance: Sigma of the noise on one sample of u [(rad/s)^2].
    """
    Lambda, back = motion.selection, np.linalg.inv(np.linalg.cholesky(covariance))
    # u has its task part in the range of A^T: the range of L^-1 A^T is that of (A L^-T)^T
    Phi = motion.features.batch(motion.q) @ back.T
    A = Lambda @ Phi
    Z = np.linalg.svd(A)[2][:, len(Lambda) :].transpose(0, 2, 1)
    task = np.einsum("nvs,nv->ns", np.linalg.pinv(A), (motion.u - motion.pi) @ back.T)
    F = np.einsum("nvz,kp,npv->nzk", Z, complement_rows(Lambda), Phi, optimize=True)
    J = -np.einsum("ns,nzk->nzsk", task, F).reshape(-1, task.shape[1] * F.shape[2])
    K = np.einsum("nk,nvz,vw->nzkw", motion.beta, Z, back, optimize=True).reshape(len(J), -1)
    rest = _unexplained(J, K)
    return rest.T @ rest


def _unexplained(J: Float[np.ndarray, "r m"], K: Float[np.ndarray, "r k"]) -> Float[np.ndarray, "r m"]:
    """(I - K K^+) J, twice for what rounding leaves."""
    K = K / np.maximum(np.linalg.norm(K, axis=0), np.finfo(np.float64).tiny)
    # by the singular values of K itself: reaches of 0.2 s hardly tell some parameters, and K^T K would lose these
    basis, values, _ = np.linalg.svd(K, full_matrices=False)
    basis = basis[:, values > UNSEEN * values[0]]
    for _ in range(2):
        J = J - basis @ (basis.T @ J)
    return J


def least_covariance(motion: NoiseFreeMotion, covariance: Float[np.ndarray, "nv nv"]) -> Float[np.ndarray, "m m"]:
    """Cramer-Rao bound on the covariance of vec(B); 1e12 where the motion does not tell at all.

    Args:
        motion: The truth.
        covariance: Sigma of the noise on one sample of u [(rad/s)^2].
    """
    values, vectors = np.linalg.eigh(information(motion, covariance))
    return (vectors / np.maximum(values, LEAST_INFORMATION)) @ vectors.T


def draw_selections(
    Lambda: Float[np.ndarray, "s p"], bound: Float[np.ndarray, "m m"], n: int, rng: np.random.Generator
) -> Float[np.ndarray, "n s p"]:
    """Answers of an estimator at the bound: orthonormal rows of Lambda + B Lambda_perp, B ~ N(0, bound)."""
    perp = complement_rows(Lambda)
    values, vectors = np.linalg.eigh(bound)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    B = (rng.standard_normal((n, len(bound))) @ root.T).reshape(n, len(Lambda), len(perp))
    return np.linalg.qr((Lambda + B @ perp).transpose(0, 2, 1))[0].transpose(0, 2, 1)


def implied_nmie(
    features: FeatureMap,
    Lambda: Float[np.ndarray, "s p"],
    learnt: Float[np.ndarray, "n s p"],
    q: Float[np.ndarray, "t nq"],
) -> Float[np.ndarray, " n"]:
    """NMIE at the postures q of many answers, NMIE = 1/(t var(mu)) sum (mu - mu~)^2 with mu = sqrt(det(A A^T)).

    Args:
        features: Phi.
        Lambda: The true one.
        learnt: Orthonormal rows of each answer, see `draw_selections`.
        q: Test postures.
    """
    Phi = features.batch(q)
    gram = Phi @ Phi.transpose(0, 2, 1)

    def mu(rows: Float[np.ndarray, "k s p"]) -> Float[np.ndarray, "k t"]:
        AAT = np.einsum("ksp,tpr,kvr->ktsv", rows, gram, rows, optimize=True)
        return np.sqrt(np.maximum(np.linalg.det(AAT), 0.0))

    true, step = mu(Lambda[None]), max(1, BLOCK // len(q))
    errors = [np.mean((mu(learnt[i : i + step]) - true) ** 2, axis=1) for i in range(0, len(learnt), step)]
    return np.concatenate(errors) / np.var(true)


def angle_of(bound: Float[np.ndarray, "m m"]) -> float:
    """Root of the trace of the bound as an angle [deg]: the least root mean square error of the row space."""
    return float(np.degrees(np.arctan(np.sqrt(max(float(np.trace(bound)), 0.0)))))


WITHIN = 2.0  # of the NMIE that the bound implies: the aim
UNKNOWABLE = 15.0  # angle of the bound beyond which the recordings do not tell the rows [deg]
OURS, TOLD = "auto", "joint-told"
OTHERS = ("separate-row-by-row", "closed-form")


def cell(setup: Setup, trials: list[dict[str, Any]]) -> dict[str, Any]:
    """One combination of noise, number of trajectories and rows.

    Returns:
        `bound` (`nmie` that it implies, median over trials and draws, and `angle_deg`); learner -> `nmie` (summary),
        `interval` of the median, `ratio` of the median to the bound's, `refused`, `angle_deg`, `efficiency`, the root
        of the mean of |B|^2 over the trace of the bound; `pairs`, other learner -> `compare_pairs`; `inside`, the
        share of the trials in which the stated 68 % angle of `auto` holds the truth; and `why` not within twice.
    """
    nmie = float(np.median([v for t in trials for v in t["bound"]["nmie"]]))
    out: dict[str, Any] = {
        "noise": setup.noise,
        "trajectories": setup.trajectories,
        "bound": {"nmie": nmie, "angle_deg": float(np.median([t["bound"]["angle_deg"] for t in trials]))},
    }
    for name in (OURS, TOLD, "joint-affine", *OTHERS):
        out[name] = _learner(name, nmie, trials)
    ours = [t[OURS].get("test") for t in trials]
    out["pairs"] = {name: compare_pairs(ours, [t[name].get("test") for t in trials]) for name in (TOLD, *OTHERS)}
    stated = [t[OURS]["angle_deg"] <= t[OURS]["stated_deg"] for t in trials if t[OURS].get("stated_deg") is not None]
    out["inside"] = share(stated)
    out["stated"] = len(stated)
    out["why"] = _reason(out)
    return out


def _learner(name: str, bound: float, trials: list[dict[str, Any]]) -> dict[str, Any]:
    said = [t[name] for t in trials]
    nmie = summary(one.get("test") for one in said)
    shares = [one["b2"] / t["bound"]["trace"] for one, t in zip(said, trials, strict=True) if one.get("b2") is not None]
    return {
        "nmie": nmie,
        "interval": list(median_interval([one["test"] for one in said if "test" in one])),
        "ratio": nmie["median"] / bound if nmie["n"] else None,
        "refused": share("refused" in one for one in said),
        "warned": share(bool(one.get("warned")) for one in said),
        "angle_deg": summary(one.get("angle_deg") for one in said),
        "efficiency": float(np.sqrt(np.mean(shares))) if shares else None,
    }


def _reason(one: dict[str, Any]) -> str:
    """Why the median of `auto` is not within twice what the bound implies; empty where it is."""
    ours, told = one[OURS], one[TOLD]
    if one["bound"]["angle_deg"] > UNKNOWABLE:
        return "not determined: the bound itself is beyond 15 degrees" + _refusals(ours)
    if ours["ratio"] is None:
        return "all refused"
    if ours["ratio"] <= WITHIN:
        return ""
    low = ours["interval"][0]
    if low is not None and low <= WITHIN * one["bound"]["nmie"]:
        return "chance: the 95 % interval of the median holds twice the bound" + _refusals(ours)
    if told["ratio"] is not None and told["ratio"] <= WITHIN:
        return f"the noise differs between joints and is taken as equal: told so, {told['ratio']:.2g} times"
    return "no estimator here is at the bound: it holds for small errors" + _refusals(ours)


def _refusals(learner: dict[str, Any]) -> str:
    return f"; {percent(learner['refused'])} refused" if learner["refused"] else ""


NOISES = (0.001, 0.005, 0.01, 0.02, 0.05, 0.10)  # shares of each joint's root mean square action
TRAJECTORIES = (1, 2, 5, 10, 20, 50, 100, 200)  # demonstrations of 10 samples
NOISE, SIZE = 0.01, 100  # of the line over trajectories, of the line over noise
LEARNERS = ("auto", "joint-affine", "separate-row-by-row", "closed-form")
DRAWS = 50  # answers at the bound for each trial


@final
@dataclass(frozen=True)
class NoisyCase:
    """A kind of noisy demonstrations.

    Attributes:
        setup: Rows, noise and number of trajectories.
    """

    setup: Setup


BETWEEN = " | "  # noise and number of trajectories, and the rows, in the name of a case
CASES = {
    f"noise {100.0 * noise:g} %, {n} trajectories{BETWEEN}{rows}": NoisyCase(Setup(rows, trajectories=n, noise=noise))
    for noise, n in (*((noise, SIZE) for noise in NOISES), *((NOISE, n) for n in TRAJECTORIES if n != SIZE))
    for rows in SELECTIONS
}


def bounds_trial(case: NoisyCase, rng: np.random.Generator) -> dict[str, Any]:
    """Learn from one noisy set in all ways.

    Returns:
        Learner -> what `table.answers` says, and `b2`, the squared error |B|^2 in the coordinates of the bound.
        `bound`: `trace`, `angle_deg`, and `nmie` of answers drawn at the bound.
    """
    setup, features = case.setup, planar_features()
    Lambda = setup.selection(rng)
    clean = demonstrate(dataclasses.replace(setup, noise=0.0), Lambda, rng)
    deviations = noise_deviations(clean, setup.noise)
    noisy = with_noise(clean, setup.noise, rng)
    test = demonstrate(dataclasses.replace(setup, noise=0.0, trajectories=SIZE), Lambda, rng)
    seen = [np.concatenate([t.q for t in demos]) for demos in (clean, test)]
    bound = _bound(clean, Lambda, deviations, seen[1], rng)
    out, learnt = answers(LEARNERS, features, noisy, Lambda, seen, rng)
    out |= {"bound": bound, TOLD: {"refused": "no start"}}
    if "joint-affine" in learnt:
        learnt[TOLD] = fit_told_noise(features, noisy, learnt["joint-affine"], deviations)
        out[TOLD] = judge(features, Lambda, learnt[TOLD], seen)
    for name, rows in learnt.items():
        out[name]["b2"] = _squared_error(Lambda, rows)
    return out


def _bound(
    clean: Demonstrations,
    Lambda: Float[np.ndarray, "s 3"],
    deviations: Float[np.ndarray, " 3"],
    test: Float[np.ndarray, "t 3"],
    rng: np.random.Generator,
) -> dict[str, Any]:
    q = np.concatenate([t.q for t in clean])
    u = np.concatenate([t.u for t in clean if t.u is not None])
    pi = null_policy("attractor", q, REST)
    motion = NoiseFreeMotion(planar_features(), Lambda, q, u, pi, affine_regressors(q))
    covariance = least_covariance(motion, np.diag(deviations**2))
    nmie = implied_nmie(planar_features(), Lambda, draw_selections(Lambda, covariance, DRAWS, rng), test)
    return {"trace": float(np.trace(covariance)), "angle_deg": angle_of(covariance), "nmie": nmie.tolist()}


def _squared_error(Lambda: Float[np.ndarray, "s p"], learnt: Float[np.ndarray, "k p"]) -> float | None:
    """|B|^2 of the learnt row space as the graph of B over the true one; None for another number of rows."""
    if learnt.shape != Lambda.shape:
        return None
    rows = orthonormal_rows(learnt)
    along = rows @ Lambda.T
    if abs(float(np.linalg.det(along))) < np.finfo(np.float64).eps:
        return None
    return float(np.sum(np.linalg.solve(along, rows @ complement_rows(Lambda).T) ** 2))


@final
class BoundsResult(TrialsResult):
    """Outcome of every trial, see `bounds_trial`."""

    def to_dict(self) -> dict[str, Any]:
        """Noise and trajectories -> rows -> what `cell` says; the paper has no noise."""
        ours: dict[str, Any] = {}
        for case, trials in self.outcomes.items():
            key, rows = case.split(BETWEEN)
            ours.setdefault(key, {})[rows] = cell(CASES[case].setup, trials)
        return {"paper": None, "ours": ours}

    def markdown(self) -> str:
        """Learners beside the bound, then the paired comparisons."""
        near, pairs = [], []
        for key, block in self.to_dict()["ours"].items():
            for rows, one in block.items():
                begin, bound = [key.removeprefix("noise "), said_rows(rows)], one["bound"]
                near.append([*begin, number(bound["angle_deg"]), number(bound["nmie"])])
                near[-1] += [_beside(one[OURS]), _beside(one[TOLD])]
                near[-1] += [*(number(one[name]["nmie"]["median"]) for name in OTHERS), one["why"] or "within twice"]
                pairs.append([*begin, *(_pair(one["pairs"][name]) for name in OTHERS)])
        header = ["noise, trajectories", "rows", "bound: angle [deg]", "bound: NMIE"]
        header += [f"{SAID[name]}: NMIE (times the bound)" for name in (OURS, TOLD)]
        header += [*(f"{SAID[name]}: NMIE" for name in OTHERS), f"{SAID[OURS]} against the bound"]
        against = ["noise, trajectories", "rows", *(f"{SAID[name]} / {SAID[OURS]}" for name in OTHERS)]
        words = (
            f"The other learners against *{SAID[OURS]}*, seed by seed: median ratio of the NMIE [95 % interval], seeds "
            f"at which *{SAID[OURS]}* is better, p of Wilcoxon's signed-rank test. A ratio below 1 is a loss of ours."
        )
        first = "Medians over the trials; the bound is that of the same recordings."
        return "\n\n".join([first, markdown_table(header, near), words, markdown_table(against, pairs)])

    def figures(self) -> dict[str, Figure]:
        """Every answer of *as shipped* as a dot; the bound beside it is drawn for the documentation."""
        panels = [
            Panel(
                {
                    case.split(BETWEEN)[0].removeprefix("noise "): dots(trials, OURS)
                    for case, trials in self.outcomes.items()
                    if case.endswith(BETWEEN + rows)
                },
                f"NMIE on the test set (no unit),\n{SAID[OURS]}",
                f"constrained rows {said_rows(rows)}",
            )
            for rows in SELECTIONS
        ]
        return {"bounds": strips([panels], "noise and trajectories; a dot is a trial, a bar the median")}


def _beside(learner: dict[str, Any]) -> str:
    if learner["ratio"] is None:
        return "refused"
    return f"{number(learner['nmie']['median'])} ({number(learner['ratio'])})"


def _pair(pair: dict[str, Any]) -> str:
    if not pair["n"]:
        return "refused"
    return said_pair(pair) + ("" if pair["p"] is None else f", p {number(pair['p'])}")


BOUNDS = of_trials("bounds", bounds_trial, CASES, BoundsResult, 0.4)
