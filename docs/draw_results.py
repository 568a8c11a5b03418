"""Draws the pictures of the pages about the reproduction that need more than one result: bounds, and curves.

`docs/fill_pages.py` calls these; all other pictures are those that `manip-learn reproduce` writes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

import manip_learn as ml
from manip_learn.experiments import charts
from manip_learn.experiments.beyond import CURVES, curve_demonstrations, curve_features, monomials
from manip_learn.experiments.bounds import OURS, TOLD
from manip_learn.experiments.experiment_result import said_rows
from manip_learn.experiments.ways import SAID
from manip_learn.playback.palette import COLOURS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOOKS = {
    OURS: ("blue", "o-"),
    TOLD: ("green", "s-"),
    "separate-row-by-row": ("vermilion", "^--"),
    "closed-form": ("purple", "v:"),
}
LOW, HIGH = -2.2, 2.6  # of the pictures of curves [m]


def bounds(result: dict[str, Any]) -> Figure:
    """NMIE over the noise (above) and over the number of trajectories (below), one column a constraint."""
    cells = [one | {"rows": rows} for block in result["ours"].values() for rows, one in block.items()]
    selections = list(dict.fromkeys(one["rows"] for one in cells))
    # the number of trajectories of the line over noise, and the noise of the line over trajectories
    most, noise = most_frequent([c["trajectories"] for c in cells]), most_frequent([c["noise"] for c in cells])
    figure, axes = charts.new_figure(11.0, 6.8, 2, len(selections), sharey="col")
    for (above, below), rows in zip(axes.T, selections, strict=True):
        own = [one for one in cells if one["rows"] == rows]
        _lines(above, [one for one in own if one["trajectories"] == most], "noise", 100.0)
        _lines(below, [one for one in own if one["noise"] == noise], "trajectories", 1.0)
        above.set_title(f"constrained rows {said_rows(rows)}")
        above.set_xlabel(f"noise on the action [%], {most} trajectories")
        below.set_xlabel(f"number of trajectories of 10 samples, noise {100 * noise:g} %")
    for ax in axes[:, 0]:
        ax.set_ylabel("median NMIE on the test set (no unit)")
    axes[0, 0].legend(fontsize=6.5)
    return figure


def most_frequent(values: Sequence[float]) -> float:
    """The value that occurs most often."""
    return max(set(values), key=values.count)


def _lines(ax: Any, cells: list[dict[str, Any]], key: str, factor: float) -> None:
    cells = sorted(cells, key=lambda one: one[key])
    x = [factor * one[key] for one in cells]
    for name, (colour, style) in LOOKS.items():
        values = [(a, one[name]["nmie"]["median"]) for a, one in zip(x, cells, strict=True)]
        shown = np.array([(a, y) for a, y in values if y is not None])
        if len(shown):
            ax.plot(*shown.T, style, color=COLOURS[colour], markersize=4, label=SAID[name])
    ax.plot(x, [one["bound"]["nmie"] for one in cells], color=charts.INK, linewidth=2.2, label="Cramer-Rao bound")
    ax.set(xscale="log", yscale="log")
    ax.set_xticks(x, [f"{v:g}" for v in x])
    ax.minorticks_off()


def curves(noise: float = 0.01) -> Figure:
    """The recorded points of each curve, the curve itself and what is learnt of it, through the first point."""
    figure, axes = charts.new_figure(9.0, 5.0, 1, len(CURVES), sharey=True)
    x, y = np.meshgrid(np.linspace(LOW, HIGH, 300), np.linspace(LOW, HIGH, 300))
    grid = np.array([x, y, x * x, x * y, y * y]).reshape(5, -1)
    for ax, task in zip(axes[0], CURVES, strict=True):
        demos, true = curve_demonstrations(task, noise, np.random.default_rng(0))
        learnt = ml.ConstraintLearner(curve_features()).fit(demos).constraint_.selection
        ax.plot(*np.concatenate([t.q for t in demos]).T, ".", color=COLOURS["grey"], markersize=2, label="recorded")
        for rows, colour, width, said in (
            (true, "sky", 4.0, "true"),
            (learnt, "vermilion", 1.2, "learnt (as shipped)"),
        ):
            level = float(rows[0] @ monomials(demos[0].q[0]))
            ax.contour(
                x, y, (rows[0] @ grid).reshape(x.shape), levels=[level], colors=[COLOURS[colour]], linewidths=width
            )
            ax.plot([], [], color=COLOURS[colour], linewidth=width, label=said)
        ax.set(aspect="equal", title=f"{task}, noise {100 * noise:g} %", xlabel="x [m]")
    axes[0, 0].set_ylabel("y [m]")
    axes[0, 0].legend(fontsize=6.5, loc="upper left")
    return figure
