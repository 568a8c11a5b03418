"""The paper's table: error of the learnt manipulability for three constraints, 50 trials each, learnt in eight ways.

The paper's own method is `separate-row-by-row`: the null-space part of the motion by Towell, Howard and Vijayakumar
(2010), then `fit_row_by_row`, as Lin, Howard and Vijayakumar (2015) describe it: each new row is the unit vector,
orthogonal to the rows before, that lowers equation (10) of the rows so far most; its spherical angles are found by
Levenberg-Marquardt from several starts. All but `auto` are told the number of rows.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments.charts import Figures, Panel, strips
from manip_learn.experiments.metrics import manipulability_along, nmie, scale_free_nmie
from manip_learn.experiments.paper_setup import PAPER_NMIE, SELECTIONS, Setup, demonstrate, null_parts, planar_features
from manip_learn.experiments.results import TrialsResult, markdown_table, mean_and_sd, number, row_words, share, summary
from manip_learn.experiments.trials import Trials
from manip_learn.learning.fit import view_levels
from manip_learn.learning.imposed import separate_null_motion
from manip_learn.learning.learner import ConstraintLearner
from manip_learn.learning.table import Stretch, Table, View
from manip_learn.linalg import complement_rows, row_space_angle
from manip_learn.recordings.trajectory import Demonstrations

# estimator -> its name in tables and figures
LABELS = {f"joint-{degree}": f"joint, {degree} policy" for degree in ("affine", "quadratic", "cubic")}
LABELS |= {"joint-rbf": "joint, 32 radial functions", "separate": "separate, then all rows at once"}
LABELS |= {"separate-row-by-row": "separate, then row by row", "true-w": "true null-space part", "auto": "as shipped"}
Matrix = Float[np.ndarray, "s p"]


def fit_row_by_row(Phi: Float[np.ndarray, "n p nv"], w: Float[np.ndarray, "n nv"], n_rows: int) -> Matrix:
    """Fit Lambda to null-space motion one row after the other, the method of the paper.

    Args:
        Phi: Features of each sample (n, p, nv).
        w: Null-space component of the velocity of each sample (n, nv) [rad/s].
        n_rows: Number of rows to fit.

    Returns:
        Lambda (n_rows, p).
    """
    Lambda = np.zeros((0, Phi.shape[1]))
    for _ in range(n_rows):
        A = Lambda @ Phi
        rest = Phi - Phi @ np.linalg.pinv(A) @ A  # Phi N
        # search the new row in the complement of the others, where a unit vector is a point on a smaller sphere
        Lambda = np.concatenate([Lambda, _best_row(rest, w, complement_rows(Lambda))[None]])
    return Lambda


def unit_vector(angles: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k+1"]:
    """Return the unit vector (k + 1,) with the given spherical angles.

    Args:
        angles: Spherical angles (k,) [rad].
    """
    sines = np.concatenate([[1.0], np.cumprod(np.sin(angles))])
    return sines * np.append(np.cos(angles), 1.0)


def _best_row(Phi: np.ndarray, w: np.ndarray, frame: np.ndarray) -> Float[np.ndarray, " p"]:
    rows = frame @ Phi

    def residuals(angles: np.ndarray) -> np.ndarray:
        # contribution of the new row to |A^+ A w|^2: the part of w along the row, without the rows before
        a = np.einsum("k,nkv->nv", unit_vector(angles), rows)
        return np.einsum("nv,nv->n", a, w) / np.linalg.norm(a, axis=1)

    # the search has local minima; more than three starts per angle found no lower ones on the paper's reaches
    starts = itertools.product(np.pi * (np.arange(3) + 0.5) / 3, repeat=len(frame) - 1)
    fits = [least_squares(residuals, x, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15) for x in starts]
    return unit_vector(min(fits, key=lambda fit: fit.cost).x) @ frame


def learn(
    estimator: str, features: FeatureMap, demonstrations: Demonstrations, true: Matrix, seed: int
) -> tuple[Matrix, bool]:
    """Learn Lambda from demonstrations with one of the compared methods.

    Args:
        estimator: A key of `LABELS`.
        features: Feature map Phi with p rows.
        demonstrations: Demonstrations with velocities.
        true: True Lambda (s, p). The method `true-w` uses its null-space motion, and all methods but `auto` use its
            number of rows.
        seed: Seed of k-means and of random initial guesses.

    Returns:
        Lambda, and True if the learner warned.

    Raises:
        NotIdentifiableError: The demonstrations do not determine Lambda.
    """
    s, (kind, _, policy) = len(true), estimator.partition("-")
    if estimator in ("true-w", "separate-row-by-row"):
        view = View(features, Table(list(demonstrations)))
        w = null_parts(features, demonstrations, true) if estimator == "true-w" else separate_null_motion(view, seed)
        if isinstance(w, NotIdentifiableError):
            raise w
        if estimator == "separate-row-by-row":
            return view.selection(fit_row_by_row(view.Phi, w, s)), False
        view.table.u = w
        every = [Stretch(i, *ends) for i, ends in enumerate(view.table.ends)]
        return view.selection(view_levels(View(features, view.table), every)[1][:s]), False
    settings: dict[str, Any] = {} if kind == "auto" else {"estimator": kind, "n_constraints": s}
    settings |= {"policy_model": policy} if policy else {}
    learner = ConstraintLearner(features, velocities="recorded", seed=seed, **settings).fit(demonstrations)
    return learner.constraint_.selection, bool(learner.report_.warnings)


@dataclass(frozen=True)
class LearningCase:
    """Case of the experiment.

    Attributes:
        setup: Settings of the simulated demonstrations.
        estimators: Methods to learn from them, keys of `LABELS`.
    """

    setup: Setup
    estimators: tuple[str, ...]


def learning_trial(case: LearningCase, rng: np.random.Generator) -> dict[str, Any]:
    """Learn from one set of demonstrations with several methods, and evaluate on it and on a second set.

    Args:
        case: Settings of the demonstrations, and the methods.
        rng: Random generator of the trial.

    Returns:
        Method -> dictionary with the NMIE (see `metrics`) on the training set `train` and the test set `test`,
        `scale_free` NMIE on the test set, angle to the true row space `angle_deg`, number of `rows`, computing time
        `seconds`, and `warned`; or only `refused`, the reason why nothing was learnt.
    """
    features, Lambda = planar_features(), case.setup.selection
    train, test = demonstrate(case.setup, Lambda, rng), demonstrate(replace(case.setup, noise=0.0), Lambda, rng)
    out: dict[str, Any] = {}
    for estimator in case.estimators:
        seed, started = int(rng.integers(2**63)), time.perf_counter()
        try:
            estimate, warned = learn(estimator, features, train, Lambda, seed)
        except NotIdentifiableError as error:
            out[estimator] = {"refused": error.code}
            continue
        answer = {"seconds": time.perf_counter() - started, "rows": len(estimate), "warned": warned}
        answer["angle_deg"] = float(np.degrees(row_space_angle(Lambda, estimate)))
        for name, demonstrations in (("train", train), ("test", test)):
            q = np.concatenate([t.q for t in demonstrations])
            mu, other = manipulability_along(features, Lambda, q), manipulability_along(features, estimate, q)
            answer[name], answer["scale_free"] = nmie(mu, other), scale_free_nmie(mu, other)
        out[estimator] = answer
    return out


def statistics(trials: list[dict[str, Any]], estimator: str, rows: str) -> dict[str, Any]:
    """Return the statistics of one method over all trials: NMIE on the test set first, shares of trials last.

    Args:
        trials: Results of `learning_trial`.
        estimator: A key of `LABELS`.
        rows: True constrained rows, words of `"x y rz"`.
    """
    outcomes = [t[estimator] for t in trials]
    numbers = {key: summary(o.get(key) for o in outcomes) for key in ("test", "train", "scale_free", "angle_deg")}
    out = numbers.pop("test") | numbers | {"seconds_per_fit": summary(o.get("seconds") for o in outcomes)["median"]}
    out["rows_right"] = share(o.get("rows") == len(rows.split()) for o in outcomes)
    out["warned"] = share(bool(o.get("warned")) for o in outcomes)
    return out | {"refused": share("refused" in o for o in outcomes)}


class TableResult(TrialsResult):
    """Outcome of every trial of the paper's three constraints, see `learning_trial`."""

    def to_dict(self) -> dict[str, Any]:
        """Return for each constraint the paper's numbers (`paper`) and our statistics (`ours`) as a dictionary."""
        every = self.outcomes.items()
        ours = {rows: {name: statistics(trials, name, rows) for name in LABELS} for rows, trials in every}
        return {rows: {"paper": dict(PAPER_NMIE[rows]), "ours": block} for rows, block in ours.items()}

    def markdown(self) -> str:
        """Return the table as Markdown with the paper's numbers, one block per constraint."""
        header = ["estimator", "NMIE, mean +- s.d.", "median", "worst", "on the training set", "s a fit"]
        parts = []
        for rows, block in self.to_dict().items():
            lines = [["**paper, as printed**", mean_and_sd(block["paper"]), "", "", "", ""]]
            for name, s in block["ours"].items():
                cells = [number(s["median"]), number(s["worst"]), mean_and_sd(s["train"]), number(s["seconds_per_fit"])]
                lines.append([LABELS[name], mean_and_sd(s), *cells])
            parts.append(f"**Constrained rows {row_words(rows)}**\n\n{markdown_table(header, lines)}")
        return "\n\n".join(parts)

    def figures(self) -> Figures:
        """Draw every trial as a dot.

        Returns:
            Dictionary from the name of the figure to the figure.
        """
        panels, label = list[Panel](), "NMIE on the test set (no unit)"
        for rows, trials in self.outcomes.items():
            values = {LABELS[name]: [t[name]["test"] for t in trials if "test" in t[name]] for name in LABELS}
            panels.append(Panel(values, label, f"constrained rows {row_words(rows)}", PAPER_NMIE[rows]["mean"]))
        return {"table": strips([panels], "estimator; a dot is a trial, a bar the median")}


CASES = {rows: LearningCase(Setup(rows), tuple(LABELS)) for rows in SELECTIONS}
TABLE = Trials("table", learning_trial, CASES, TableResult)
