"""Plots of results, drawn with matplotlib (extra `plots`) on given axes or on new ones.

`style="page"` is for screens; `style="column"` is for a column of a printed paper (3.5 in wide, 8 pt, names at the
curves).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.rollout import Rollout
from manip_learn.errors import ManipLearnError, MissingExtraError, an
from manip_learn.learning.report import LearningReport
from manip_learn.learning.table import CLEAR_GAP, STRENGTH
from manip_learn.playback.palette import COLOURS, rollout_colours

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Style = Literal["page", "column"]
HELD, FREE, GREY, SINGULAR = COLOURS["blue"], COLOURS["vermilion"], COLOURS["grey"], "#b00020"
SIZES: dict[str, Any] = {"page": None, "column": (3.5, 2.3)}  # size of a new figure [in]; None: matplotlib's setting


def manipulability(
    rollouts: Rollout | Sequence[Rollout] | Mapping[str, Rollout], ax: Axes | None = None, style: Style = "page"
) -> Axes:
    """Plot the manipulability mu over time for one or several rollouts, with their status.

    The strip below has a row for each rollout that was slowed down (light) or stopped (dark). The grey band is the
    range from the 5th to the 95th percentile of mu at the recorded configurations; it is drawn if the first rollout
    contains these configurations and its robot.

    Args:
        rollouts: A rollout, a sequence of rollouts, or a mapping from names to rollouts.
        ax: Axes to draw on; None for new ones.
        style: `"page"`, or `"column"` for a printed column.

    Returns:
        The axes.

    Raises:
        ManipLearnError: There is no rollout, an object is not a rollout, or the style is unknown.
        MissingExtraError: matplotlib is not installed.
    """
    several = rollouts if isinstance(rollouts, Mapping | Sequence) else [rollouts]
    by_name = dict(several if isinstance(several, Mapping) else {f"rollout {n + 1}": r for n, r in enumerate(several)})
    wrong = next((each for each in by_name.values() if not isinstance(each, Rollout)), None)
    if wrong is not None or not by_name:
        raise ManipLearnError(f"give plots.manipulability a rollout, several, or name -> rollout, not {an(wrong)}")
    ax, first = _axes(ax, style), next(iter(by_name.values()))
    colours = [colour for _, colour in rollout_colours(list(by_name), {})]
    for (name, rollout), colour in zip(by_name.items(), colours, strict=True):
        ax.plot(rollout.time, rollout.mu, color=colour, label=name if len(by_name) > 1 else None)
    ends = {} if len(by_name) == 1 else {n: (r.mu[-1], c) for (n, r), c in zip(by_name.items(), colours, strict=True)}
    if (band := _recorded_mu_range(first)) is not None:
        ax.axhspan(*band, color=GREY, alpha=0.15, linewidth=0, label="as shown")
        ends["as shown"] = (float(np.mean(band)), GREY)
    top = ax.get_ylim()[1]
    rows = [
        (r, colour)
        for r, colour in zip(by_name.values(), colours, strict=True)
        if {s.effect for s in r.status} - {"ok"}
    ]
    for k, (rollout, colour) in enumerate(rows):
        until = np.append(rollout.time[1:], rollout.time[-1])
        for effect, strength in (("slowed", 0.35), ("stopped", 1.0)):
            spans = [
                (a, b - a) for a, b, s in zip(rollout.time, until, rollout.status, strict=True) if s.effect == effect
            ]
            ax.broken_barh(spans, (-(0.05 * k + 0.065) * top, 0.04 * top), color=colour, alpha=strength, linewidth=0)
    ax.axhline(0.0, color=SINGULAR, linewidth=1.0, label="singular")
    ax.set_ylim(-0.05 * (len(rows) + 0.5) * top if rows else 0.0, top)
    ax.set_yticks([tick for tick in ax.get_yticks() if 0.0 <= tick <= top])
    strip = "\nstrip: light slowed, dark stopped" if rows else ""
    ax.set(xlabel=f"time [s]{strip}", ylabel=f"manipulability μ{_unit_of_mu(first)}")
    return _finish(ax, style, ends | {"singular": (0.0, SINGULAR)})


def gap(report: LearningReport, ax: Axes | None = None, style: Style = "page") -> Axes:
    """Plot the size of the recorded motion along each direction, and the gap between held and free directions.

    The joint estimator does not compute these sizes; for it, the gap of each number of rows is drawn as a bar.

    Args:
        report: Report of a learner, `learner.report_`.
        ax: Axes to draw on; None for new ones.
        style: `"page"`, or `"column"` for a printed column.

    Returns:
        The axes.

    Raises:
        ManipLearnError: The object is not a report, or the style is unknown.
        MissingExtraError: matplotlib is not installed.
    """
    ax, s, ends = _axes(ax, style, report), report.n_constraints, {}
    label = f"gap {report.gap:.3g}"
    if report.levels:
        number = np.arange(1, len(report.levels) + 1)
        for rows, colour, name in ((slice(s), HELD, "held"), (slice(s, None), FREE, "free")):
            ax.plot(number[rows], report.levels[rows], "o", color=colour, label=name)
            ends |= {name: (level, colour)} if (level := max(report.levels[rows], default=0.0)) else {}
        above = report.levels[s] if s < len(report.levels) else 1.0  # 1: the same motion in all joints
        ax.annotate(
            "", (s + 0.5, above), (s + 0.5, report.levels[s - 1]), arrowprops={"arrowstyle": "<->", "color": GREY}
        )
        middle = float(np.sqrt(above * report.levels[s - 1]))
        ax.annotate(f" {label}\n ({CLEAR_GAP:g} is clear)", (s + 0.5, middle), va="center", fontsize="small")
        ax.set(xlabel="direction, least moved first", ylabel="motion [share of all joints']", xticks=number)
        ax.set_xlim(0.5, max(len(number), s + 1) + 0.7)
    else:
        counts, gaps = list(report.gap_table), list(report.gap_table.values())
        ax.bar(counts, gaps, color=[HELD if n == s else GREY for n in counts], width=0.6)
        ax.set(xlabel="number of rows", ylabel=f"gap [ratio] ({s}: {label})", xticks=counts)
    ax.set_yscale("log")
    return _finish(ax, style, ends)


def evidence(report: LearningReport, ax: Axes | None = None, style: Style = "page") -> Axes:
    """Plot the evidence that each row is constrained: its strength and p-value from the recombination test.

    The strength is the ratio of the motion along a row if the joints moved independently to the recorded motion. The
    p-value is the probability of as little motion as recorded if the joints moved independently.

    Args:
        report: Report of a learner, `learner.report_`.
        ax: Axes to draw on; None for new ones.
        style: `"page"`, or `"column"` for a printed column.

    Returns:
        The axes.

    Raises:
        ManipLearnError: The object is not a report, the style is unknown, or the demonstrator drives the rows on
            purpose, so that they were not tested by recombination.
        MissingExtraError: matplotlib is not installed.
    """
    ax, rows = _axes(ax, style, report), report.row_evidence
    if not rows:
        raise ManipLearnError(
            f"the {report.estimator} estimator does not test its rows by recombination: plots.gap(report) shows what "
            "its answer rests on",
            code="no-evidence",
        )
    number = np.arange(1, len(rows) + 1)
    colours = [{"held": HELD, "free": FREE}.get(row.state, GREY) for row in rows]
    ax.barh(number, [row.strength - 1.0 for row in rows], left=1.0, color=colours, height=0.6)
    for n, row in zip(number, rows, strict=True):
        ax.annotate(f" p = {row.p_value:.2g}", (max(row.strength, 1.0), n), va="center", fontsize="small")
    ax.axvline(STRENGTH, color=GREY, linestyle=":", linewidth=1.0)
    ax.set_xscale("log")
    ax.set(xlabel=f"strength [ratio], believed above {STRENGTH:g}", ylabel="row")
    ax.set_yticks(number, [f"{n}: {row.state}" for n, row in zip(number, rows, strict=True)])
    ax.invert_yaxis()
    ax.set_xlim(1.0, 30.0 * max(STRENGTH, *(row.strength for row in rows)))  # room for the words
    return _finish(ax, style)


def _axes(ax: Axes | None, style: str, report: Any = None) -> Axes:
    """Check the other arguments, then return the given axes or new ones."""
    if report is not None and not isinstance(report, LearningReport):
        raise ManipLearnError(f"give the report of a learner, learner.report_, not {an(report)}")
    if style not in SIZES:
        raise ManipLearnError(f"style must be one of {', '.join(map(repr, SIZES))}, not {style!r}", code="option")
    if ax is not None:
        return ax
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise MissingExtraError("a plot", "plots") from error
    return plt.subplots(figsize=SIZES[style], layout="constrained")[1]


def _finish(ax: Axes, style: Style, ends: Mapping[str, tuple[float, str]] = MappingProxyType({})) -> Axes:
    """Name the curves, in a legend or, in a column, at their heights, and set the font size.

    Args:
        ax: The axes.
        style: As in the public functions.
        ends: Name in the legend -> (value at the end of a curve or in the middle of a band, colour).
    """
    if style == "page":
        if ends:
            ax.legend(frameon=False, fontsize="small")
        return ax
    figure, size = cast(Any, ax.figure), 8.0  # [pt] font size in a printed column
    # height of a line of text in axes coordinates
    room = 1.15 * size / (72.0 * ax.get_position().height * figure.get_figheight())
    to_axes, lowest = ax.transData + ax.transAxes.inverted(), -1.0
    for name, (value, colour) in sorted(ends.items(), key=lambda end: end[1][0]):
        lowest = max(to_axes.transform((1.0, value))[1], lowest + room)
        ax.annotate(name, (1.02, lowest), xycoords="axes fraction", va="center", color=colour)
    for spine in ("top", "right"):
        ax.spines[spine].set_visible(False)
    for text in (ax.title, ax.xaxis.label, ax.yaxis.label, *ax.texts):
        text.set_fontsize(size)
    ax.tick_params(labelsize=size)
    return ax


def _unit_of_mu(rollout: Rollout) -> str:
    """Return the unit of mu, with a radian counted as 1; empty if a row mixes metres and radians."""
    content = rollout.constraint or {}
    units = content.get("row_units", ())
    rows = [
        {unit for unit, x in zip(units, row, strict=False) if abs(x) > 1e-9} for row in content.get("selection", ())
    ]
    if not rows or any(row not in ({"m/s"}, {"rad/s"}) for row in rows):
        return ""
    metres = rows.count({"m/s"})
    return f" [m{'²³⁴⁵⁶'[metres - 2] if metres > 1 else ''}]" if metres else " [1]"


def _recorded_mu_range(rollout: Rollout) -> Float[np.ndarray, " 2"] | None:
    """Return the range of mu in the middle 90 % of the recorded postures; None without these postures or the robot."""
    content = rollout.constraint or {}
    postures = content.get("provenance", {}).get("postures")
    if not postures or rollout.robot is None:
        return None
    try:
        constraint = Constraint.from_dict(content, rollout.robot.load())
    except ManipLearnError:  # another machine, without the robot's file
        return None
    return np.quantile([constraint.manipulability(q) for q in postures], [0.05, 0.95])
