"""The paper's table: error of the learnt manipulability for three constraints, 50 trials each, learnt in eight ways.

The paper's own route is `separate-row-by-row`: the null-space part of the motion by Towell, Howard and Vijayakumar
(2010), then `fit_row_by_row`, as Lin, Howard and Vijayakumar (2015) describe it: each new row is the unit vector,
orthogonal to the rows before, that lowers equation (10) of the rows so far most; its spherical angles are found by
Levenberg-Marquardt from several starts. All but `auto` are told the number of rows.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, final

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.errors import NotIdentifiableError
from manip_learn.experiments.experiment_result import (
    Panel,
    TrialsResult,
    markdown_table,
    mean_and_sd,
    number,
    said_rows,
    share,
    strips,
    summary,
)
from manip_learn.experiments.metrics import manipulability_along, nmie, scale_free_nmie
from manip_learn.experiments.paper_setup import (
    PAPER_NMIE,
    SELECTIONS,
    Setup,
    demonstrate,
    null_parts,
    planar_features,
)
from manip_learn.experiments.trial_runner import of_trials
from manip_learn.learning.estimate import fit_null_space, levels
from manip_learn.learning.imposed import estimate_imposed
from manip_learn.learning.learner import ConstraintLearner
from manip_learn.learning.samples import Samples
from manip_learn.learning.separate import estimate_separate, separate_null_motion
from manip_learn.linalg import batch_row_spaces, complement_rows, orthonormal_rows, row_space_angle
from manip_learn.recordings.trajectory import Demonstrations

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# name -> what tables and pictures call it
SAID: dict[str, str] = {
    "joint-affine": "joint, affine policy",
    "joint-quadratic": "joint, quadratic policy",
    "joint-cubic": "joint, cubic policy",
    "joint-rbf": "joint, 32 radial functions",
    "separate": "separate, then all rows at once",
    "separate-row-by-row": "separate, then row by row",
    "true-w": "true null-space part",
    "auto": "as shipped",
}
Learnt = tuple[np.ndarray, dict[str, Any]]  # Lambda, and remarks
Matrix = Float[np.ndarray, "s p"]


def fit_row_by_row(samples: Samples, n_rows: int) -> Float[np.ndarray, "s r"]:
    """Lambda in whitened coordinates, one row after the other.

    Args:
        samples: The velocities of these samples are null-space motion.
        n_rows: Number of rows s.
    """
    Phi = np.concatenate([block.Phi for block in samples.blocks()])
    Lambda = np.zeros((0, samples.n_rows))
    for _ in range(n_rows):
        # the new row lives in the complement of the others: a unit vector there is a point on a smaller sphere
        frame, rest = np.eye(samples.n_rows), Phi
        if s := len(Lambda):
            frame = complement_rows(Lambda)
            along = batch_row_spaces(np.einsum("sr,nrv->nsv", Lambda, Phi, optimize=True))[0][:, :, :s]
            rest = Phi - np.einsum("nrv,nvs,nws->nrw", Phi, along, along, optimize=True)  # Phi N
        Lambda = np.concatenate([Lambda, _best_row(rest, samples.u, frame)[None]])
    return Lambda


def unit_vector(angles: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k+1"]:
    """The point of the unit sphere with these spherical angles [rad]."""
    sines = np.concatenate([[1.0], np.cumprod(np.sin(angles))])
    return sines * np.append(np.cos(angles), 1.0)


def _best_row(Phi: np.ndarray, w: np.ndarray, frame: np.ndarray) -> Float[np.ndarray, " r"]:
    k = len(frame) - 1
    if k == 0:
        return frame[0]
    rows = np.einsum("kr,nrv->nkv", frame, Phi, optimize=True)

    def residuals(angles: np.ndarray) -> np.ndarray:
        # what the new row adds to |A^+ A w|^2: the part of w along the row, beside the rows before
        a = np.einsum("k,nkv->nv", unit_vector(angles), rows)
        return np.einsum("nv,nv->n", a, w) / np.linalg.norm(a, axis=1)

    # the search has local minima; more than three starts an angle found no lower ones on the paper's reaches: a grid
    # over the half sphere where that is small, its diagonals where it is not
    values = np.pi * (np.arange(3) + 0.5) / 3
    grid = np.stack(np.meshgrid(*[values] * k), -1).reshape(-1, k) if k <= 2 else None
    starts = [np.roll(np.resize(values, k), shift) for shift in range(3)] if grid is None else list(grid)
    stop: dict[str, float] = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-15)  # relative: at rounding
    fits = [least_squares(residuals, start, method="lm", **stop) for start in starts]
    return unit_vector(min(fits, key=lambda fit: fit.cost).x) @ frame


def _of_samples(learn: Callable[[Samples, int, np.random.Generator], np.ndarray]) -> Callable[..., Learnt]:
    """A way that takes samples and a number of rows, and answers in whitened coordinates."""

    def way(features: FeatureMap, demos: Demonstrations, true: Matrix, rng: np.random.Generator) -> Learnt:
        samples = Samples.collect(features, demos)
        return samples.selection(learn(samples, len(true), rng)), {}

    return way


def _joint(model: str) -> Callable[..., Learnt]:
    return _of_samples(lambda samples, s, rng: estimate_imposed(samples, s, rng, model).whitened_selection)


def _true_null_part(features: FeatureMap, demos: Demonstrations, true: Matrix, rng: np.random.Generator) -> Learnt:
    samples = Samples.collect(features, demos)
    motion = replace(samples, u=null_parts(features, demos, true))
    return samples.selection(fit_null_space(motion, levels(motion)[1][: len(true)]).whitened_selection), {}


def _auto(features: FeatureMap, demos: Demonstrations, true: Matrix, rng: np.random.Generator) -> Learnt:
    learner = ConstraintLearner(features, velocities="recorded", seed=int(rng.integers(2**31))).fit(demos)
    return learner.constraint_.selection, {"warned": bool(learner.report_.warnings)}


# name -> (features, demonstrations, true Lambda, rng) -> Lambda
ESTIMATORS: dict[str, Callable[..., Learnt]] = {
    "joint-affine": _joint("affine"),
    "joint-quadratic": _joint("quadratic"),
    "joint-cubic": _joint("cubic"),
    "joint-rbf": _joint("rbf"),
    "separate": _of_samples(lambda samples, s, rng: estimate_separate(samples, s, rng).whitened_selection),
    "separate-row-by-row": _of_samples(
        lambda samples, s, rng: orthonormal_rows(fit_row_by_row(separate_null_motion(samples, rng)[0], s))
    ),
    "true-w": _true_null_part,
    "auto": _auto,
}
COMPARED = tuple(ESTIMATORS)


@final
@dataclass(frozen=True)
class LearningCase:
    """Demonstrations, and the ways to learn from them, names of `ESTIMATORS`."""

    setup: Setup
    estimators: tuple[str, ...]


def learning_trial(case: LearningCase, rng: np.random.Generator) -> dict[str, Any]:
    """Train on one set of demonstrations, judge on it and on another one.

    Returns:
        Estimator -> `train` and `test` NMIE, `scale_free` NMIE on the test set, `angle_deg` between the row spaces,
        `rows` found, `seconds`, and for `auto` whether it `warned`; or `refused`, the reason.
    """
    features, Lambda = planar_features(), case.setup.selection
    train, test = demonstrate(case.setup, Lambda, rng), demonstrate(replace(case.setup, noise=0.0), Lambda, rng)
    seen = {name: np.concatenate([t.q for t in demos]) for name, demos in (("train", train), ("test", test))}
    out: dict[str, Any] = {}
    for estimator in case.estimators:
        own, started = np.random.default_rng(rng.integers(2**63)), time.perf_counter()
        try:
            learnt, remarks = ESTIMATORS[estimator](features, train, Lambda, own)
        except NotIdentifiableError as error:
            out[estimator] = {"refused": error.code}
            continue
        answer = {"seconds": time.perf_counter() - started, "rows": len(learnt), **remarks}
        answer["angle_deg"] = float(np.degrees(row_space_angle(Lambda, learnt)))
        for name, q in seen.items():
            mu, other = manipulability_along(features, Lambda, q), manipulability_along(features, learnt, q)
            answer[name], answer["scale_free"] = nmie(mu, other), scale_free_nmie(mu, other)
        out[estimator] = answer
    return out


def statistics(trials: list[dict[str, Any]], estimator: str, rows: str) -> dict[str, Any]:
    """Of one way to learn: the NMIE on the test set, then the other numbers, and the shares of what became of it."""
    outcomes = [t[estimator] for t in trials]
    return summary(o.get("test") for o in outcomes) | {
        **{what: summary(o.get(what) for o in outcomes) for what in ("train", "scale_free", "angle_deg")},
        "seconds_per_fit": summary(o.get("seconds") for o in outcomes)["median"],
        "rows_right": share(o.get("rows") == len(rows.split()) for o in outcomes),
        "warned": share(bool(o.get("warned")) for o in outcomes),
        "refused": share("refused" in o for o in outcomes),
    }


@final
class TableResult(TrialsResult):
    """Outcome of every trial of the paper's three constraints, see `learning_trial`."""

    def to_dict(self) -> dict[str, Any]:
        """Constraint -> paper and ours, test set first."""
        return {
            rows: {
                "paper": dict(PAPER_NMIE[rows]),
                "ours": {name: statistics(trials, name, rows) for name in COMPARED},
            }
            for rows, trials in self.outcomes.items()
        }

    def markdown(self) -> str:
        """The table with the paper's column, one block per constraint."""
        header = ["way to learn", "NMIE, mean +- s.d.", "median", "worst", "on the training set", "s a fit"]
        parts = []
        for rows, block in self.to_dict().items():
            lines = [["**paper, as printed**", mean_and_sd(block["paper"]), "", "", "", ""]]
            for name, s in block["ours"].items():
                lines.append([SAID[name], mean_and_sd(s), number(s["median"]), number(s["worst"])])
                lines[-1] += [mean_and_sd(s["train"]), number(s["seconds_per_fit"])]
            parts.append(f"**Constrained rows {said_rows(rows)}**\n\n{markdown_table(header, lines)}")
        return "\n\n".join(parts)

    def figures(self) -> dict[str, Figure]:
        """Every trial as a dot."""
        panels = [
            Panel(
                {SAID[name]: [t[name]["test"] for t in trials if "test" in t[name]] for name in COMPARED},
                "NMIE on the test set (no unit)",
                f"constrained rows {said_rows(rows)}",
                PAPER_NMIE[rows]["mean"],
            )
            for rows, trials in self.outcomes.items()
        ]
        return {"table": strips([panels], "way to learn; a dot is a trial, a bar the median")}


TABLE = of_trials(
    "table", learning_trial, {rows: LearningCase(Setup(rows), COMPARED) for rows in SELECTIONS}, TableResult
)
