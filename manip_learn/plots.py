"""Pictures of results, drawn with matplotlib (extra `plots`) on axes that are given, or on new ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.command import Status
from manip_learn.control.rollout import Rollout
from manip_learn.errors import ManipLearnError, MissingExtraError, an
from manip_learn.learning.report import LearningReport
from manip_learn.learning.table import BELIEVED, CLEAR_GAP
from manip_learn.playback.palette import COLOURS, rollout_colours

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HELD, FREE = COLOURS["blue"], COLOURS["vermilion"]
_MARKS = "xv^s+*<>dpPXD"  # one for each status that is not ok


def manipulability(rollouts: Rollout | Sequence[Rollout] | Mapping[str, Rollout], ax: Axes | None = None) -> Axes:
    """Draw mu over time along one rollout or several, with its status and what was shown.

    A mark stands where the status begins to be something else than `ok`. The band is where mu of the same rows was in
    the middle 90 % of the postures in which the task was shown, if the first rollout knows them and its robot.

    Args:
        rollouts: One, several, or name -> rollout.
        ax: Axes to draw on; None for new ones.

    Returns:
        The axes.

    Raises:
        ManipLearnError: Something that is no rollout, or none.
        MissingExtraError: matplotlib is not installed.
    """
    several = rollouts if isinstance(rollouts, Mapping | Sequence) else [rollouts]
    named = dict(several if isinstance(several, Mapping) else {f"rollout {n + 1}": r for n, r in enumerate(several)})
    wrong = next((each for each in named.values() if not isinstance(each, Rollout)), None)
    if wrong is not None or not named:
        raise ManipLearnError(f"give plots.manipulability a rollout, several, or name -> rollout, not {an(wrong)}")
    ax = _axes(ax)
    seen: list[Status] = [s for s in Status if s is not Status.OK and any(s in r.status for r in named.values())]
    for (name, rollout), (_, colour) in zip(named.items(), rollout_colours(list(named), {}), strict=True):
        ax.plot(rollout.time, rollout.mu, color=colour, label=name if len(named) > 1 else None)
        before = (Status.OK, *rollout.status[:-1])
        for status in seen:
            at = [i for i, pair in enumerate(zip(before, rollout.status, strict=True)) if pair[0] != status == pair[1]]
            ax.plot(rollout.time[at], rollout.mu[at], _MARKS[seen.index(status)], color=colour, markersize=5)
    for status in seen:  # once each, whatever the colour of its rollout
        ax.plot([], [], _MARKS[seen.index(status)], color=COLOURS["grey"], markersize=5, label=str(status))
    band = _mu_shown(next(iter(named.values())))
    if band is not None:
        ax.axhspan(*band, color=COLOURS["grey"], alpha=0.15, linewidth=0, label="as shown")
    ax.set(xlabel="time [s]", ylabel="manipulability μ")
    ax.set_ylim(bottom=0.0)  # a singularity is on the ground
    if ax.get_legend_handles_labels()[0]:
        ax.legend(frameon=False, fontsize="small")
    return ax


def gap(report: LearningReport, ax: Axes | None = None) -> Axes:
    """Draw how much the recordings move along each direction, held ones and free ones, and the gap between them.

    The joint estimator has no such levels: there each number of rows has a bar, its gap.

    Args:
        report: That of a learner, `learner.report_`.
        ax: Axes to draw on; None for new ones.

    Returns:
        The axes.

    Raises:
        ManipLearnError: Something that is no report.
        MissingExtraError: matplotlib is not installed.
    """
    ax, s = _axes(ax, report), report.n_constraints
    said = f"gap {report.gap:.3g}"
    if report.levels:
        number = np.arange(1, len(report.levels) + 1)
        for rows, colour, name in ((slice(s), HELD, "held"), (slice(s, None), FREE, "free")):
            ax.plot(number[rows], report.levels[rows], "o", color=colour, label=name)
        above = report.levels[s] if s < len(report.levels) else 1.0  # of a motion as strong in all joints
        ends = (s + 0.5, above), (s + 0.5, report.levels[s - 1])
        ax.annotate("", *ends, arrowprops={"arrowstyle": "<->", "color": COLOURS["grey"]})
        middle = float(np.sqrt(above * report.levels[s - 1]))
        ax.annotate(f" {said}\n ({CLEAR_GAP:g} is clear)", (s + 0.5, middle), va="center", fontsize="small")
        ax.set(xlabel="direction, least moved first", ylabel="motion (1: as strong in all joints)", xticks=number)
        ax.set_xlim(0.5, max(len(number), s + 1) + 0.7)
        ax.legend(frameon=False, fontsize="small", loc="lower right")
    else:
        counts, gaps = list(report.gap_table), list(report.gap_table.values())
        ax.bar(counts, gaps, color=[HELD if n == s else COLOURS["grey"] for n in counts], width=0.6)
        ax.set(xlabel="number of rows", ylabel=f"gap ({s}: {said})", xticks=counts)
    ax.set_yscale("log")
    return ax


def evidence(report: LearningReport, ax: Axes | None = None) -> Axes:
    """Draw how strongly each row is held, and the chance that it only seems to be (recombination test).

    Args:
        report: That of a learner, `learner.report_`.
        ax: Axes to draw on; None for new ones.

    Returns:
        The axes.

    Raises:
        ManipLearnError: Something that is no report, or that of rows which the demonstrator moves on purpose: they are
            not tested so.
        MissingExtraError: matplotlib is not installed.
    """
    ax, rows = _axes(ax, report), report.row_evidence
    if not rows:
        raise ManipLearnError(
            f"the {report.estimator} estimator does not test its rows by recombination: plots.gap(report) shows what "
            "its answer rests on",
            code="no-evidence",
        )
    number = np.arange(1, len(rows) + 1)
    colours = [HELD if row.state == "held" else FREE if row.state == "free" else COLOURS["grey"] for row in rows]
    ax.barh(number, [row.strength - 1.0 for row in rows], left=1.0, color=colours, height=0.6)
    for n, row in zip(number, rows, strict=True):
        ax.annotate(f" p = {row.p_value:.2g}", (max(row.strength, 1.0), n), va="center", fontsize="small")
    ax.axvline(BELIEVED, color=COLOURS["grey"], linestyle=":", linewidth=1.0)
    ax.set_xscale("log")
    ax.set(xlabel=f"strength (1: as by chance; dotted: {BELIEVED:g}, believed)", ylabel="row")
    ax.set_yticks(number, [f"{n}: {row.state}" for n, row in zip(number, rows, strict=True)])
    ax.invert_yaxis()
    ax.set_xlim(1.0, 30.0 * max(BELIEVED, *(row.strength for row in rows)))  # room for the words
    return ax


def _axes(ax: Axes | None, report: Any = None) -> Axes:
    """The axes that were given, or new ones; what is drawn is checked first."""
    if report is not None and not isinstance(report, LearningReport):
        raise ManipLearnError(f"give the report of a learner, learner.report_, not {an(report)}")
    if ax is not None:
        return ax
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise MissingExtraError("a plot", "plots") from error
    return plt.subplots(layout="constrained")[1]


def _mu_shown(rollout: Rollout) -> Float[np.ndarray, " 2"] | None:
    """Where mu was in the middle 90 % of the postures shown; None where they, or the robot, are not known."""
    content = rollout.constraint or {}
    postures = content.get("provenance", {}).get("postures")
    if not postures or rollout.robot is None:
        return None
    try:
        constraint = Constraint.from_dict(content, rollout.robot.load())
    except ManipLearnError:  # another machine, where the robot's file is not
        return None
    return np.quantile([constraint.manipulability(q) for q in postures], [0.05, 0.95])
