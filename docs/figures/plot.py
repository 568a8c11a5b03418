"""Draw one picture for each page of figures from its table: `python docs/figures/plot.py`.

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
    for draw in (when_it_helps, whole_recordings, opening_drawers, planned_ways, planned_worlds, control):
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


def when_it_helps() -> Figure:
    """Share of the ways that were done, sums over arms and tasks, with 95 % intervals."""
    rows = [r for r in read("when_it_helps") if (r["arm"], r["task"]) == ("all", "all")]
    policies = list(dict.fromkeys(r["policy"] for r in rows))
    figure = Figure(figsize=(WIDTH, 5.2), layout="constrained")
    for line, hand in zip(figure.subplots(2, 2, sharex=True, sharey=True), ("may turn", "held"), strict=True):
        for axes, starts in zip(line, ("anywhere", "near"), strict=True):
            for r in (r for r in rows if (r["hand"], r["starts"]) == (hand, starts)):
                y, colour = policies.index(r["policy"]), COLOURS["blue"]
                if r["policy"] in ("Pink, its μ", "mink", "PlaCo, its μ"):
                    colour = COLOURS["purple"]
                elif r["policy"] in ("plan", "whole path"):
                    colour = COLOURS["green"]
                axes.plot([float(r["low %"]), float(r["high %"])], [y, y], color=colour, linewidth=2)
                axes.plot(100.0 * int(r["done"]) / int(r["of"]), y, "o", color=colour)
            where = "near a singularity" if starts == "near" else "anywhere"
            tidy(axes, policies, f"hand {hand}, starts {where}", "")
    figure.supxlabel("ways done [%], 95 % interval", fontsize=9)
    return figure


def whole_recordings() -> Figure:
    """Error of the learnt rows, one line from the median to the worst for each kind of set."""
    rows = [r for r in read("whole_recordings") if r["table"].startswith("whole") and r["direction deg"]]
    studies = list(dict.fromkeys(r["study"] for r in rows))
    words = {
        "mechanisms": "twelve mechanisms",
        "clean": "whole and cut",
        "phases": "several tasks in a file",
        "apart": "tasks 2 to 20 degrees apart",
        "lone": "a contact in one recording",
        "contaminated": "odd recordings among others",
        "evidence": "noise of 1e-3 and 3e-3 rad",
        "small-turn": "5 degrees of turn",
        "phases-pose": "held firmly, several tasks",
    }
    figure = Figure(figsize=(WIDTH, 4.2), layout="constrained")
    axes = figure.subplots()
    for y, study in enumerate(studies):
        part = [r for r in rows if r["study"] == study]
        for number, r in enumerate(part):
            place = y + 0.8 * ((number + 0.5) / len(part) - 0.5)
            colour = COLOURS["blue" if r["rows right"] == r["sets"] == r["type right"] else "vermilion"]
            median, worst = float(r["direction deg"]), float(r["direction deg, worst"] or r["direction deg"])
            axes.plot([median, worst], [place, place], color=colour, linewidth=1)
            axes.plot(median, place, "o", color=colour, markersize=3)
    axes.set_xscale("log")
    tidy(
        axes,
        [words[study] for study in studies],
        "",
        "largest angle between learnt and true rows [degrees], median to worst of four sets",
    )
    for label, colour in (("all sets right", "blue"), ("some sets have other rows, or no type", "vermilion")):
        axes.plot([], [], "o-", color=COLOURS[colour], markersize=3, label=label)
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    return figure


def opening_drawers() -> Figure:
    """How many of 100 drawers open."""
    rows = read("opening_drawers")
    cases = list(dict.fromkeys(r["start, grip"] for r in rows))
    figure = Figure(figsize=(WIDTH, 2.4), layout="constrained")
    for axes, case in zip(figure.subplots(1, len(cases), sharey=True), cases, strict=True):
        part = [r for r in rows if r["start, grip"] == case]
        bars = axes.barh(range(len(part)), [int(r["opened"].split()[0]) for r in part], color=COLOURS["blue"])
        bars[-1].set_color(COLOURS["green"])
        axes.bar_label(bars, padding=2)
        axes.set_xlim(0, 115)
        tidy(axes, [r["policy"] for r in part], case.replace(", ", ",\n", 1), "opened of 100")
    return figure


def planned_ways() -> Figure:
    """How many of 20 drawers open as they are, climbing, and with a plan; and how many anything can open."""
    rows = read("planned_ways")
    figure = Figure(figsize=(WIDTH, 3.6), layout="constrained")
    axes = figure.subplots()
    for r, y in zip(rows, range(len(rows)), strict=True):
        can = 20 - int(r["none of 2,000 (out of reach)"].split()[0])
        axes.barh(y, can, color=INK, alpha=0.25, label="" if y else "an exhaustive search finds a way")
        for key, mark, colour in (("zero", "o", "blue"), ("mu", "^", "vermilion"), ("plan", "D", "green")):
            said = {"zero": "spare joints at rest", "mu": "climbing μ", "plan": "plan"}[key]
            shift = {"zero": -0.2, "mu": 0.2, "plan": 0.0}[key]
            axes.plot(int(r[key]), y + shift, mark, color=COLOURS[colour], label="" if y else said, linestyle="none")
    tidy(axes, [f"{r['arm']}, hand {r['hand']}" for r in rows], "", "drawers opened of 20")
    axes.set_xticks(range(0, 21, 5))
    figure.legend(loc="outside upper center", ncols=4, frameon=False)
    return figure


def planned_worlds() -> Figure:
    """Starts that are planned, by arm, and how near the plans come to each kind of thing."""
    rows = read("planned_worlds")
    worlds, arms = ("scene", "assumed"), list(dict.fromkeys(r["arm"] for r in rows))
    figure = Figure(figsize=(WIDTH, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    kinds = ["nearest obstacle [mm]", "nearest own link [mm]", "hand to what it holds [mm]", "leaf [mm]"]
    for shift, world, colour in zip((-0.2, 0.2), worlds, ("blue", "purple"), strict=True):
        part = [r for r in rows if r["world"] == world]
        done = [sum(r["outcome"] == "plan" for r in part if r["arm"] == arm) for arm in arms]
        bars = left.barh([y + shift for y in range(len(arms))], done, 0.35, color=COLOURS[colour])
        left.bar_label(bars, padding=2)
        for y, kind in enumerate(kinds):
            near = [float(r[kind]) for r in part if r[kind]]
            right.plot([min(x, 60.0) for x in near], [y + shift] * len(near), "|", color=COLOURS[colour])
        right.plot([], [], "|", color=COLOURS[colour], label={"scene": "given as a scene", "assumed": "assumed"}[world])
    starts = sum(r["arm"] == arms[0] and r["world"] == "scene" for r in rows)
    left.set_xlim(0, 1.15 * starts)
    right.axvline(5.0, color=INK, linewidth=0.8)
    tidy(left, arms, "planned", f"of {starts} starts")
    tidy(
        right,
        [k.removesuffix(" [mm]") for k in kinds],
        "least distance of each plan",
        "[mm], at most 60; 5 is promised",
    )
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    return figure


def control() -> Figure:
    """The controller beside others: least manipulability, deviation and runs that reach their target."""
    rows = read("control_peers")
    figure = Figure(figsize=(WIDTH, 3.8), layout="constrained")
    reached, least, off = figure.subplots(1, 3, sharey=True)
    for y, r in enumerate(rows):
        colour = COLOURS["blue" if r["method"].startswith("ours") else "purple"]
        reached.plot(100.0 * int(r["within 1 cm"]) / int(r["runs"]), y, "o", color=colour)
        for axes, name in ((least, "least μ after 1 s / plain"), (off, "deviation [mm]")):
            ends = [float(r[f"{name}, {side} quartile"]) for side in ("lower", "upper")]
            axes.plot(ends, [y, y], color=colour, linewidth=2)
            axes.plot(float(r[name]), y, "o", color=colour)
    labels = [r["method"] for r in rows]
    tidy(reached, labels, "within 1 cm of the target", "runs of 144 [%]")
    tidy(least, labels, "least μ over that of the\npseudo-inverse", "median and quartiles")
    tidy(off, labels, "deviation from the way", "[mm], median and quartiles")
    return figure


if __name__ == "__main__":
    main()
