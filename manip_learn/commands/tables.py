"""Tables and sentences printed by the commands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markdown import Markdown
from rich.markup import escape
from rich.table import Table

if TYPE_CHECKING:  # so that printing one command's answer does not load the others
    from manip_learn.commands.audit import Audited
    from manip_learn.commands.control import Controlled
    from manip_learn.commands.demo import Demo
    from manip_learn.commands.export import Exported
    from manip_learn.commands.learn import Learnt
    from manip_learn.commands.reproduce import Reproduction
    from manip_learn.learning.mechanisms.mechanism import Mechanism
    from manip_learn.playback import ReplayResult
    from manip_learn.robot.robot_summary import RobotSummary

MOST_ROWS = 20  # of an audit on a terminal
UNDER_WAY = 0.1  # the nearly singular start is not due to the policy: evaluated from here on [s]


def print_learnt(console: Console, learnt: Learnt) -> None:
    """The sentence, the evidence, the warnings."""
    from manip_learn.learning.estimators.estimate import CLEAR_GAP
    from manip_learn.learning.overview import RecordingOverview

    report = learnt.report
    console.print(f"[bold]{escape(report.sentence)}[/bold]", highlight=False)
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    rank = "clear" if report.gap >= CLEAR_GAP else "weak"
    table.add_row("estimator", f"{report.estimator} ({report.kind})")
    table.add_row(
        "constraints", f"{report.n_constraints} of {len(report.row_names)} rows, gap {report.gap:.3g} ({rank})"
    )
    if report.reference:
        table.add_row("reference", report.reference)
    if report.policy_model:
        table.add_row("policy model", report.policy_model)
    if math.isfinite(report.held_out_residual):
        table.add_row("left-out trajectories", f"{100 * report.held_out_residual:.2g} % of the motion unexplained")
    if report.uncertainty_deg is not None:
        table.add_row("uncertainty", f"{report.uncertainty_deg:.2g} degrees (68 %, bootstrap over trajectories)")
    if report.row_evidence:
        held = [row for row in report.row_evidence if row.state == "held"]
        strengths = ", ".join(f"{row.strength:.3g}" for row in held) or "none"
        p_value = f", p = {max(row.p_value for row in held):.2g}" if held else ""
        table.add_row("evidence per row", f"strength {strengths}{p_value} (recombination test)")
    if report.mechanism is not None:
        table.add_row("mechanism", f"{report.mechanism.sentence}{_spread(report.mechanism)}")
    table.add_row(
        "learnt from", f"{report.n_samples} samples of {report.n_trajectories} trajectories in {report.seconds:.2g} s"
    )
    console.print(table)
    for number, other in enumerate(learnt.reports[1:], start=2):
        console.print(f"constraint {number}: {escape(other.sentence)}", highlight=False)
    for sentence in RecordingOverview(report.phases).sentences():
        console.print(escape(sentence), highlight=False)
    for note in (*learnt.notes, *report.notes):
        console.print(f"[dim]note: {escape(note)}[/dim]", highlight=False)
    for warning in report.warnings:
        console.print(f"[yellow]warning: {escape(warning)}[/yellow]", highlight=False)
    if learnt.out is not None:
        console.print(f"written: {escape(str(learnt.out))}", highlight=False, soft_wrap=True)
    if learnt.page is not None:
        page = learnt.page
        console.print(f"replay: {escape(str(page.html))} ({page.bytes / 1e6:.1f} MB)", highlight=False, soft_wrap=True)


def _spread(mechanism: Mechanism) -> str:
    """The uncertainty of each parameter, one standard deviation."""
    units = {"axis": (1.0, "degrees"), "point": (1e3, "mm"), "radius": (1e3, "mm"), "pitch": (1e3, "mm/rad")}
    parts = [f"{name} {units[name][0] * x:.2g} {units[name][1]}" for name, x in mechanism.uncertainty.items()]
    return f" (+- {', '.join(parts)})" if parts else ""


def rollout_table(rollouts: dict[str, Controlled]) -> Table:
    """Policies side by side."""
    table = Table(header_style="bold", box=SIMPLE_HEAD, padding=(0, 1))
    for name in ("policy", "reached", "error", "min mu", "mean mu", "peak", "unhindered"):
        table.add_column(name, justify="left" if name == "policy" else "right", no_wrap=True)
    for name, controlled in rollouts.items():
        r = controlled.rollout
        mu = r.manipulability[r.time >= min(UNDER_WAY, r.time[-1])]
        table.add_row(
            escape(name),
            "yes" if controlled.reached else "[red]no[/red]",
            f"{controlled.final_error:.4f}",
            f"{mu.min():.4f}",
            f"{r.manipulability.mean():.3f}",
            f"{abs(r.u).max():.2f}/s",
            f"{100 * r.status.count('ok') / len(r):.0f} %",
        )
    return table


def print_demo(console: Console, demo: Demo) -> None:
    """What was learnt, the comparison, and where the replay is."""
    print_learnt(console, demo.learnt)
    console.print()
    start = next(iter(demo.rollouts.values())).rollout.manipulability[0]
    console.print(f"from a start with mu = {start:.1g} (min mu: after the first {UNDER_WAY:g} s)", highlight=False)
    console.print(rollout_table(demo.rollouts))
    console.print(
        f"replay: {escape(str(demo.page.html))} ({demo.page.bytes / 1e6:.1f} MB)", highlight=False, soft_wrap=True
    )


def print_robot(console: Console, summary: RobotSummary) -> None:
    """Joints, frames and warnings."""
    console.print(f"[bold]{escape(summary.name)}[/bold]: nq {summary.nq}, nv {summary.nv}", highlight=False)
    if summary.source is not None:
        console.print(f"[dim]{escape(str(summary.source))}[/dim]", highlight=False, soft_wrap=True)
    table = Table(header_style="bold")
    for name in ("joint", "kind", "lower", "upper", "velocity", "unit"):
        table.add_column(name, justify="right" if name in ("lower", "upper", "velocity") else "left")
    for joint in summary.joints:
        table.add_row(
            escape(joint.name), joint.kind, _limit(joint.lower), _limit(joint.upper), _limit(joint.velocity), joint.unit
        )
    console.print(table)
    for mimic in summary.mimics:
        console.print(
            f"mimic: {escape(mimic.joint)} = {mimic.multiplier:g} {escape(mimic.leader)} + {mimic.offset:g}",
            highlight=False,
        )
    for name, position in summary.locked.items():
        console.print(f"locked: {escape(name)} at {position:g}", highlight=False)
    console.print(f"likely tips: {escape(', '.join(summary.tips) or 'none')}", highlight=False)
    console.print(f"frames: {escape(', '.join(summary.frames))}", highlight=False)
    _print_warnings(console, summary.warnings)


def print_cross_check(console: Console, summary: RobotSummary) -> None:
    """What another reader of the URDF makes of it, after `print_robot`."""
    if summary.cross_check is not None and summary.cross_check.agrees:
        worst = summary.cross_check.largest_difference
        console.print(f"forward kinematics: agrees with yourdfpy to {worst:.1e}", highlight=False)
    else:
        _print_warnings(console, summary.warnings[-1:])


def _print_warnings(console: Console, warnings: Sequence[str]) -> None:
    for warning in warnings:
        console.print(f"[yellow]warning: {escape(warning)}[/yellow]", highlight=False)


def print_controlled(console: Console, controlled: Controlled) -> None:
    """One rollout."""
    console.print(rollout_table({"rollout": controlled}))
    counts = ", ".join(f"{status} {n}" for status, n in controlled.rollout.status_counts.items())
    console.print(f"steps: {counts}", highlight=False)
    aim = controlled.aim
    if aim is not None and aim.distance is not None:
        console.print(f"from the tip to the target: {aim.distance:.4g} m", highlight=False)
    if aim is not None and aim.ignored:
        console.print(
            f"[yellow]the constraint leaves {escape(', '.join(aim.ignored))} of the target free: only the distance "
            "along its rows counts as the error[/yellow]",
            highlight=False,
        )
    if controlled.stalled:
        console.print(
            f"[yellow]stalled: {controlled.final_error:.3g} left, and limits or a singularity block the rest; "
            "the target may be out of reach, or try another --start[/yellow]",
            highlight=False,
        )
    elif not controlled.reached:
        console.print(
            f"[yellow]the target was not reached: {controlled.final_error:.3g} left after "
            f"{controlled.rollout.time[-1]:g} s, still moving; try a longer --duration[/yellow]",
            highlight=False,
        )
    if controlled.out is not None:
        console.print(f"written: {escape(str(controlled.out))}", highlight=False, soft_wrap=True)


def print_audit(console: Console, audited: Audited) -> None:
    """The worst episodes, and what to leave out and why."""
    report = audited.report
    table = Table(header_style="bold", box=SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
    for name in ("episode", "score", "sigma", "broken", "mm", "deg", "margin", "speed", "jerk", "rest", "s"):
        is_name = name == "episode"
        table.add_column(name, justify="left" if is_name else "right", no_wrap=True, min_width=12 if is_name else None)
    for e in report.episodes[:MOST_ROWS]:
        cells = (
            _number(e.score, ".1f"),
            _number(e.sigma_min, ".3f"),
            _number(100 * e.residual, ".1f", " %"),
            _number(e.displacement_mm, ".1f"),
            _number(e.displacement_deg, ".1f"),
            _number(100 * e.limit_margin, ".0f", " %"),
            _number(100 * e.peak_speed, ".0f", " %"),
            _number(e.jerk_rms, ".1f"),
            _number(100 * e.rest_share, ".0f", " %"),
            _number(e.duration, ".1f"),
        )
        table.add_row(escape(e.episode), *cells, style="red" if e.leave_out else None)
    console.print(table)
    if len(report.episodes) > MOST_ROWS:
        console.print(f"and {len(report.episodes) - MOST_ROWS} better episodes (--csv FILE lists all)", highlight=False)
    left = report.leave_out
    threshold = f"robust z above {report.threshold:.1f}" if math.isfinite(report.threshold) else "too few to tell"
    console.print(
        f"[bold]leave out {len(left)} of {len(report.episodes)} episodes[/bold] ({threshold})", highlight=False
    )
    for e in left:
        console.print(
            f"[red]{escape(e.episode)}[/red]: {escape('; '.join(e.reasons))}", highlight=False, soft_wrap=True
        )
    for note in report.notes:
        console.print(f"[dim]note: {escape(note)}[/dim]", highlight=False)
    if audited.out is not None:
        console.print(f"written: {escape(str(audited.out))}", highlight=False, soft_wrap=True)


def print_replayed(console: Console, page: ReplayResult) -> None:
    """What was noticed, the file and its size."""
    for note in page.notes:
        console.print(f"note: {escape(note)}", highlight=False)
    console.print(f"replay: {escape(str(page.html))} ({page.bytes / 1e6:.1f} MB)", highlight=False, soft_wrap=True)


def _number(value: float, form: str, unit: str = "") -> str:
    return f"{value:{form}}{unit}" if math.isfinite(value) else "-"


def print_reproduction(console: Console, reproduction: Reproduction) -> None:
    """Each part's own page: our numbers next to those of the paper."""
    for part, page in reproduction.pages.items():
        console.rule(part)
        console.print(Markdown(page))
    if reproduction.out is not None:
        console.print(f"written: {escape(str(reproduction.out))}", highlight=False, soft_wrap=True)


def _limit(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else "none"


def print_exported(console: Console, exported: Exported) -> None:
    """What was written, and what was noticed."""
    for note in exported.notes:
        console.print(f"note: {escape(note)}", highlight=False, soft_wrap=True)
    for file in exported.files:
        console.print(f"{exported.format}: {escape(str(file))}", highlight=False, soft_wrap=True)
    console.print(f"{exported.trajectories} trajectories, {exported.samples} samples", highlight=False)
