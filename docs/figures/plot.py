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
    learning = (whole_recordings, uncertainty)
    controlling = (opening_drawers, when_it_helps, law, planned_ways, control, servos, speed, method)
    for draw in (*learning, *controlling):
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


def law() -> Figure:
    """Ways done near singularities, and how far the hand strayed at most, by the law before and by this one."""
    policies = {"none": "no null-space motion", "learnt": "ascent of μ"}
    cases = [(part, policy) for part in ("way", "firm grip") for policy in policies]
    figure = Figure(figsize=(WIDTH, 2.2), layout="constrained")
    done, off = figure.subplots(1, 2, sharey=True)
    for name, colour, shift in (("law_before", "purple", -0.2), ("law", "blue", 0.2)):
        for y, (part, policy) in enumerate(cases):
            wanted = ("41000", part, policy)
            rows = [r for r in read(name) if (r["seed"], r["part"], r["policy"]) == wanted and r["task"] != "reach"]
            share = 100.0 * sum(r["good"] == "True" for r in rows) / len(rows)
            label = {"law_before": "before", "law": "now"}[name] if y == 0 else None
            done.barh(y + shift, share, 0.35, color=COLOURS[colour], label=label)
            off.plot(sorted(float(r["off"]) for r in rows), [y + shift] * len(rows), "|", color=COLOURS[colour])
    off.axvline(2.0, color=INK, linewidth=0.8)
    off.set_xscale("log")
    tidy(done, [f"{part}s, {policies[policy]}" for part, policy in cases], "ways done", "[%]")
    tidy(
        off,
        [f"{part}s, {policies[policy]}" for part, policy in cases],
        "strayed by",
        "[mm] of each way; 2 counts as lost",
    )
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    return figure


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


def uncertainty() -> Figure:
    """How often the true rows lie within the stated angle."""
    # higher rates were measured with shorter windows for velocities than those of today
    rows = [r for r in read("uncertainty_null_space") if r["rate"] in ("50 Hz", "100 Hz")]
    kinds = [key for key in rows[0] if key not in ("noise", "rate")]
    figure = Figure(figsize=(WIDTH, 2.0), layout="constrained")
    for axes, kind in zip(figure.subplots(1, len(kinds), sharey=True), kinds, strict=True):
        for y, r in enumerate(rows):
            shares = [float(x) for x in r[kind].split("%")[0].split(",")]
            for share, size, shift in zip(shares, (3, 5, 7), (-0.15, 0.0, 0.15), strict=True):
                axes.plot(share, y + shift, "o", color=COLOURS["blue"], markersize=size, fillstyle="none")
        axes.axvspan(60.0, 76.0, color=INK, alpha=0.2, linewidth=0)
        axes.set_xlim(40.0, 100.0)
        tidy(axes, [f"{r['noise']}, {r['rate']}" for r in rows], kind, "inside [%]")
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
