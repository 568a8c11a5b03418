"""The paper's demonstrations with noise: our learner, the published ones, and how well Lambda can be known at all.

Every trial has one set of demonstrations that all learners get, the Cramer-Rao bound of that very set, and answers
drawn at the bound, whose NMIE is what an efficient estimator would have.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.control.rollout import Rollout
from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments.bounds_report import bounds_figure, bounds_markdown, cell
from manip_learn.experiments.cramer_rao import (
    NoiseFreeMotion,
    affine_regressors,
    angle_of,
    draw_selections,
    implied_nmie,
    least_covariance,
)
from manip_learn.experiments.experiment_result import ExperimentResult
from manip_learn.experiments.learning_trial import judge
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
from manip_learn.experiments.trial_runner import TrialRunner
from manip_learn.experiments.ways import ESTIMATORS, fit_told_noise
from manip_learn.linalg import complement_rows, orthonormal_rows
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.robot.robot import Robot

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


def trials_of(trials: int) -> int:
    """Two fifths of the paper's number of trials: 20 of 50, enough for paired tests."""
    return max(1, round(0.4 * trials))


def size(trials: int) -> int:
    """Number of trials that `run` reports as progress."""
    return trials_of(trials) * len(CASES)


def run(trials: int, rng: np.random.Generator, runner: TrialRunner | None = None) -> BoundsResult:
    """All noises and numbers of trajectories.

    Args:
        trials: Two fifths as many trials of each.
        rng: Source of the seeds.
        runner: Where the trials run.
    """
    runner = runner or TrialRunner(workers=1)
    outcomes = runner.map("bounds", bounds_trial, CASES, trials_of(trials), int(rng.integers(2**53)))
    return BoundsResult(dict(zip(CASES, outcomes, strict=True)))


def bounds_trial(case: NoisyCase, rng: np.random.Generator) -> dict[str, Any]:
    """Learn from one noisy set in all ways.

    Returns:
        Learner -> what `learning_trial.judge` says, `b2`, the squared error |B|^2 in the coordinates of the bound, and
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
        """Noise and trajectories -> rows -> what `bounds_report.cell` says; the paper has no noise."""
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

    def replays(self) -> dict[str, tuple[Robot, Mapping[str, Rollout]]]:
        """None: no robot moves in this experiment."""
        return {}
