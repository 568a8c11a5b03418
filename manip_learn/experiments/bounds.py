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
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments import charts
from manip_learn.experiments.experiment_result import (
    ExperimentResult,
    compare_pairs,
    markdown_table,
    median_interval,
    number,
    percent,
    said_pair,
    said_rows,
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
from manip_learn.experiments.table import judge
from manip_learn.experiments.trial_runner import of_trials, two_fifths
from manip_learn.experiments.ways import ESTIMATORS, SAID, fit_told_noise
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


def cell(noise: float, trajectories: int, trials: list[dict[str, Any]]) -> dict[str, Any]:
    """One combination of noise, number of trajectories and rows.

    Returns:
        `bound` (`nmie` that it implies, median over trials and draws, and `angle_deg`); learner -> `nmie` (summary),
        `interval` of the median, `ratio` of the median to the bound's, `refused`, `angle_deg`, `efficiency`, the root
        of the mean of |B|^2 over the trace of the bound; `pairs`, other learner -> `compare_pairs`; `inside`, the
        share of the trials in which the stated 68 % angle of `auto` holds the truth; and `why` not within twice.
    """
    nmie = float(np.median([v for t in trials for v in t["bound"]["nmie"]]))
    out: dict[str, Any] = {
        "noise": noise,
        "trajectories": trajectories,
        "bound": {"nmie": nmie, "angle_deg": float(np.median([t["bound"]["angle_deg"] for t in trials]))},
    }
    for name in (OURS, TOLD, "joint-affine", *OTHERS):
        out[name] = _learner(name, nmie, trials)
    ours = [t[OURS].get("test") for t in trials]
    out["pairs"] = {name: compare_pairs(ours, [t[name].get("test") for t in trials]) for name in (TOLD, *OTHERS)}
    stated = [t[OURS]["angle_deg"] <= t[OURS]["stated_deg"] for t in trials if t[OURS].get("stated_deg") is not None]
    out["inside"] = float(np.mean(stated)) if stated else None
    out["stated"] = len(stated)
    out["why"] = _reason(out)
    return out


def _learner(name: str, bound: float, trials: list[dict[str, Any]]) -> dict[str, Any]:
    answered = [t for t in trials if "test" in t[name]]
    values = [t[name]["test"] for t in answered]
    low, high = median_interval(values)
    shares = [t[name]["b2"] / t["bound"]["trace"] for t in answered if t[name].get("b2") is not None]
    return {
        "nmie": summary(values),
        "interval": [low, high],
        "ratio": float(np.median(values)) / bound if values else None,
        "refused": 1.0 - len(answered) / len(trials),
        "warned": sum(bool(t[name].get("warned")) for t in trials) / len(trials),
        "angle_deg": summary(t[name]["angle_deg"] for t in answered),
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


def bounds_markdown(ours: dict[str, Any]) -> str:
    """Two tables: learners beside the bound, and paired comparisons."""
    near, pairs = [], []
    for key, block in ours.items():
        for rows, one in block.items():
            begin = [key.removeprefix("noise "), said_rows(rows)]
            bound = one["bound"]
            near.append([*begin, number(bound["angle_deg"]), number(bound["nmie"]), _beside(one[OURS])])
            near[-1] += [_beside(one[TOLD]), *(number(one[name]["nmie"]["median"]) for name in OTHERS)]
            near[-1].append(one["why"] or "within twice")
            pairs.append([*begin, *(_pair(one["pairs"][name]) for name in OTHERS)])
    header = ["noise, trajectories", "rows", "bound: angle [deg]", "bound: NMIE"]
    header += [f"{SAID[OURS]}: NMIE (times the bound)", f"{SAID[TOLD]}: NMIE (times the bound)"]
    header += [*(f"{SAID[name]}: NMIE" for name in OTHERS), f"{SAID[OURS]} against the bound"]
    against = ["noise, trajectories", "rows", *(f"{SAID[name]} / {SAID[OURS]}" for name in OTHERS)]
    return "\n\n".join(
        [
            "Medians over the trials; the bound is that of the same recordings.",
            markdown_table(header, near),
            f"The other learners against *{SAID[OURS]}*, seed by seed: median ratio of the NMIE [95 % interval], seeds "
            f"at which *{SAID[OURS]}* is better, p of Wilcoxon's signed-rank test. A ratio below 1 is a loss of ours.",
            markdown_table(against, pairs),
        ]
    )


def _beside(learner: dict[str, Any]) -> str:
    if learner["ratio"] is None:
        return "refused"
    return f"{number(learner['nmie']['median'])} ({number(learner['ratio'])})"


def _pair(pair: dict[str, Any]) -> str:
    if not pair["n"]:
        return "refused"
    return said_pair(pair) + ("" if pair["p"] is None else f", p {number(pair['p'])}")


def bounds_figure(ours: dict[str, Any]) -> Figure:
    """NMIE over the noise (above) and over the number of trajectories (below), one column a constraint."""
    cells = [one | {"rows": rows} for block in ours.values() for rows, one in block.items()]
    selections = list(dict.fromkeys(one["rows"] for one in cells))
    figure, axes = charts.new_figure(11.0, 6.8, 2, len(selections), sharey="col")
    most = max(one["trajectories"] for one in cells if _count(cells, "trajectories", one) > 1)
    for i, rows in enumerate(selections):
        own = [one for one in cells if one["rows"] == rows]
        _lines(axes[0, i], [c for c in own if c["trajectories"] == most], "noise", 100.0)
        _lines(axes[1, i], [c for c in own if c["noise"] == _common(own)], "trajectories", 1.0)
        axes[0, i].set_title(f"constrained rows {rows.replace('rz', 'theta').replace(' ', ', ')}")
        axes[0, i].set_xlabel(f"noise on the action [%], {most} trajectories")
        axes[1, i].set_xlabel(f"number of trajectories of 10 samples, noise {100 * _common(own):g} %")
    for ax in axes[:, 0]:
        ax.set_ylabel("median NMIE on the test set (no unit)")
    axes[0, 0].legend(fontsize=6.5)
    return figure


def _common(cells: Sequence[dict[str, Any]]) -> float:
    noises = [one["noise"] for one in cells]
    return max(set(noises), key=noises.count)


def _count(cells: Sequence[dict[str, Any]], key: str, one: dict[str, Any]) -> int:
    return len({other["noise"] for other in cells if other[key] == one[key]})


def _lines(ax: Any, cells: list[dict[str, Any]], key: str, factor: float) -> None:
    cells = sorted(cells, key=lambda one: one[key])
    looks = {
        OURS: ("blue", "o-"),
        TOLD: ("green", "s-"),
        "separate-row-by-row": ("vermilion", "^--"),
        "closed-form": ("purple", "v:"),
    }
    x = [factor * one[key] for one in cells]
    for name, (colour, style) in looks.items():
        points = [(a, one[name]["nmie"]["median"]) for a, one in zip(x, cells, strict=True)]
        shown = [(a, y) for a, y in points if y is not None]
        if shown:
            ax.plot(*zip(*shown, strict=True), style, color=charts.colour(name=colour), markersize=4, label=SAID[name])
    ax.plot(x, [one["bound"]["nmie"] for one in cells], color=charts.INK, linewidth=2.2, label="Cramer-Rao bound")
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xticks(x, [f"{v:g}" for v in x])
    ax.minorticks_off()


NOISES = (0.001, 0.005, 0.01, 0.02, 0.05, 0.10)
TRAJECTORIES = (1, 2, 5, 10, 20, 50, 100, 200)
NOISE, SIZE = 0.01, 100  # of the line over trajectories, of the line over noise
LEARNERS = ("auto", "joint-affine", "separate-row-by-row", "closed-form")
DRAWS = 50  # answers at the bound for each trial


@final
@dataclass(frozen=True)
class NoisyCase:
    """What is demonstrated.

    Attributes:
        setup: Rows, noise and number of trajectories.
    """

    setup: Setup


CASES = tuple(
    NoisyCase(Setup(rows, trajectories=n, noise=noise))
    for noise, n in (*((noise, SIZE) for noise in NOISES), *((NOISE, n) for n in TRAJECTORIES if n != SIZE))
    for rows in SELECTIONS
)


def bounds_trial(case: NoisyCase, rng: np.random.Generator) -> dict[str, Any]:
    """Learn from one noisy set in all ways.

    Returns:
        Learner -> what `table.judge` says, `b2`, the squared error |B|^2 in the coordinates of the bound, and
        `seconds`; or `refused`. `bound`: `trace`, `angle_deg`, and `nmie` of answers drawn at the bound.
    """
    setup, features = case.setup, planar_features()
    Lambda = setup.selection(rng)
    clean = demonstrate(dataclasses.replace(setup, noise=0.0), Lambda, rng)
    deviations = noise_deviations(clean, setup.noise)
    noisy = with_noise(clean, setup.noise, rng)
    test = demonstrate(dataclasses.replace(setup, noise=0.0, trajectories=SIZE), Lambda, rng)
    seen = [np.concatenate([t.q for t in demos]) for demos in (clean, test)]
    out: dict[str, Any] = {"bound": _bound(clean, Lambda, deviations, seen[1], rng)}
    answers: dict[str, np.ndarray] = {}
    for name in LEARNERS:
        own, started = np.random.default_rng(rng.integers(2**63)), time.perf_counter()
        try:
            answers[name], remarks = ESTIMATORS[name](features, noisy, Lambda, own)
        except NotIdentifiableError as error:
            out[name] = {"refused": error.code}
            continue
        out[name] = judge(features, Lambda, answers[name], seen) | remarks | {"seconds": time.perf_counter() - started}
    out["joint-told"] = {"refused": "no start"}
    if "joint-affine" in answers:
        answers["joint-told"] = fit_told_noise(features, noisy, answers["joint-affine"], deviations)
        out["joint-told"] = judge(features, Lambda, answers["joint-told"], seen)
    for name, learnt in answers.items():
        out[name]["b2"] = _squared_error(Lambda, learnt)
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
    answers = draw_selections(Lambda, covariance, DRAWS, rng)
    nmie = implied_nmie(planar_features(), Lambda, answers, test)
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
@dataclass(frozen=True, eq=False)
class BoundsResult(ExperimentResult):
    """Outcome of every trial.

    Attributes:
        outcomes: Case -> one dictionary per trial, see `bounds_trial`.
    """

    outcomes: dict[NoisyCase, list[dict[str, Any]]]

    def to_dict(self) -> dict[str, Any]:
        """Noise and trajectories -> rows -> what `cell` says; the paper has no noise."""
        ours: dict[str, Any] = {}
        for case, trials in self.outcomes.items():
            setup = case.setup
            key = f"noise {100.0 * setup.noise:g} %, {setup.trajectories} trajectories"
            ours.setdefault(key, {})[setup.rows] = cell(setup.noise, setup.trajectories, trials)
        return {"paper": None, "ours": ours}

    def rows(self) -> list[dict[str, Any]]:
        """One line per trial and learner."""
        return [
            {
                "noise": case.setup.noise,
                "trajectories": case.setup.trajectories,
                "rows": case.setup.rows,
                "trial": i,
                "learner": name,
                "nmie_test": t[name].get("test"),
                "angle_deg": t[name].get("angle_deg"),
                "rows_found": t[name].get("rows"),
                "refused": t[name].get("refused", ""),
                "bound_angle_deg": t["bound"]["angle_deg"],
                "bound_nmie_median": float(np.median(t["bound"]["nmie"])),
            }
            for case, trials in self.outcomes.items()
            for i, t in enumerate(trials)
            for name in t
            if name != "bound"
        ]

    def markdown(self) -> str:
        """Bound and learners, then the paired comparisons."""
        return bounds_markdown(self.to_dict()["ours"])

    def figures(self) -> dict[str, Figure]:
        """Medians over noise and over the number of trajectories, with the bound."""
        return {"bounds": bounds_figure(self.to_dict()["ours"])}


BOUNDS = of_trials("bounds", bounds_trial, {case: case for case in CASES}, BoundsResult, two_fifths)
