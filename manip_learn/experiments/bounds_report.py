"""Statistics, tables and the picture of the noisy experiments beside the Cramer-Rao bound."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from manip_learn.experiments import charts
from manip_learn.experiments.experiment_result import markdown_table, number, summary
from manip_learn.experiments.paired import compare_pairs, median_interval
from manip_learn.experiments.ways import SAID

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
    return f"; {100.0 * learner['refused']:.0f} % refused" if learner["refused"] else ""


def bounds_markdown(ours: dict[str, Any]) -> str:
    """Two tables: learners beside the bound, and paired comparisons."""
    near, pairs = [], []
    for key, block in ours.items():
        for rows, one in block.items():
            begin = [key.removeprefix("noise "), rows.replace("rz", "theta").replace(" ", ", ")]
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
    interval = "" if pair["low"] is None else f" [{number(pair['low'])}, {number(pair['high'])}]"
    p = "" if pair["p"] is None else f", p {number(pair['p'])}"
    return f"{number(pair['ratio'])}{interval}, {pair['wins']} of {pair['n']}{p}"


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
