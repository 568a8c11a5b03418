"""Draw the pictures of docs/benchmarks.md and docs/mathematics.md from their tables: `python docs/figures/plot.py`.

The tables (`*.csv`) are what the scripts in `benchmarks/` have measured; nothing is measured here. Needs the extra
`experiments`. Grounds are transparent, and all colours have a contrast of 3 and more on white and on black.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from manip_learn.playback.palette import COLOURS

HERE = Path(__file__).parent
INK = "#808080"  # of words and axes: 3.9 on white, 5.3 on black
WIDTH = 8.0  # [inch]
Row = dict[str, str]


def main() -> None:
    """Draw all of them again."""
    matplotlib.rcParams.update({"font.size": 9, "svg.hashsalt": "manip_learn", "svg.fonttype": "none"})
    matplotlib.rcParams.update({"axes.facecolor": "none", "axes.edgecolor": INK, "axes.labelcolor": INK})
    matplotlib.rcParams.update({"axes.titlecolor": INK, "text.color": INK, "xtick.color": INK, "ytick.color": INK})
    matplotlib.rcParams.update({"grid.color": INK})
    for draw in (servos, speed, method):
        figure = draw()
        figure.savefig(HERE / f"{draw.__name__}.svg", transparent=True, metadata={"Date": None})


def read(name: str) -> list[Row]:
    """Rows of a table."""
    with (HERE / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def tidy(axes: Axes, labels: Sequence[str], title: str, x: str) -> None:
    """One line a label, the first on top."""
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.set_title(title, fontsize=9)
    axes.set_xlabel(x)
    axes.grid(axis="x", alpha=0.3, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)


def servos() -> Figure:
    """Force across the way with each fault of the servos, the median and the largest."""
    rows = read("servos_faults")
    figure = Figure(figsize=(WIDTH, 4.0), layout="constrained")
    axes = figure.subplots()
    for y, r in enumerate(rows):
        median, largest = map(float, r["across the way, median and largest [N]"].split(", "))
        whole = r["whole ways"].split()
        colour = COLOURS["blue" if whole[0] == whole[-1] else "vermilion"]
        axes.plot([median, largest], [y, y], color=colour, linewidth=2)
        axes.plot(median, y, "o", color=colour)
    for label, colour in (("all ways gone to the end", "blue"), ("one or two of nine stopped", "vermilion")):
        axes.plot([], [], "o-", color=COLOURS[colour], label=label)
    tidy(axes, [r["servos"] for r in rows], "", "force of the hand across its way [N], median and largest of nine ways")
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    return figure


def speed() -> Figure:
    """One control step of each library, in five states."""
    rows = [r for r in read("speed_peers") if r["rows"].startswith("x, y") and r["arm"] == "all"]
    methods, states = (list(dict.fromkeys(r[key] for r in rows)) for key in ("method", "state"))
    figure = Figure(figsize=(WIDTH, 4.6), layout="constrained")
    axes = figure.subplots()
    for state, mark in zip(states, "o^sDv", strict=True):
        part = {r["method"]: float(r["of a bare step"]) for r in rows if r["state"] == state}
        for ours, colour in ((True, "blue"), (False, "purple")):
            names = [m for m in part if m.startswith("ours") == ours]
            places = [methods.index(m) for m in names]
            axes.plot([part[m] for m in names], places, mark, color=COLOURS[colour], markersize=5, fillstyle="none")
        axes.plot([], [], mark, color=INK, fillstyle="none", label=state)
    axes.axvline(1.0, color=INK, linewidth=0.8)
    axes.set_xscale("log")
    tidy(axes, methods, "", "time of a step for x, y and z of the tip; 1 is the bare step")
    figure.legend(loc="outside upper center", ncols=5, frameon=False)
    return figure


def method() -> Figure:
    """What is left of 1/σ near a singularity: of driven rows, of held ones, and exactly."""
    threshold, damping, held = 0.05, 0.05, 0.1  # the defaults of the controller
    sigma = [0.0005 * k for k in range(1, 201)]
    figure = Figure(figsize=(WIDTH, 2.6), layout="constrained")
    axes = figure.subplots()
    axes.plot(sigma, [1.0 / x for x in sigma], color=INK, linewidth=1, label="exact, 1/σ")
    for share, colour, label in ((held, "green", "held rows"), (1.0, "blue", "driven rows")):
        left = [max(0.0, 1.0 - (x / threshold) ** 2) * damping * share for x in sigma]
        values = [x / (x**2 + y**2) for x, y in zip(sigma, left, strict=True)]
        axes.plot(sigma, values, color=COLOURS[colour], label=label)
    axes.axvline(threshold, color=INK, linewidth=0.8, linestyle=":")
    axes.set_ylim(0.0, 110.0)
    axes.set_xlabel("smallest singular value σ of A; dotted: the threshold")
    axes.set_ylabel("joint speed for\na task velocity of 1")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    main()
