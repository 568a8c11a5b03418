"""Tables and sentences printed by the commands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markdown import Markdown
from rich.markup import escape
from rich.table import Table

from manip_learn.commands.wide_tables import UNDER_WAY, audit_table, rollout_table
from manip_learn.commands.words import print_words
from manip_learn.errors import counted, listed

if TYPE_CHECKING:  # so that printing one command's answer does not load the others
    from manip_learn.commands.audit import Audited
    from manip_learn.commands.control import Controlled
    from manip_learn.commands.demo import Demo
    from manip_learn.commands.export import Exported
    from manip_learn.commands.learn import Learnt
    from manip_learn.commands.reproduce import Reproduction
    from manip_learn.commands.robots import KnownRobots
    from manip_learn.playback import ReplayResult
    from manip_learn.robot.robot_summary import RobotSummary

MOST_ROWS = 20  # of an audit on a terminal
ROLLOUT_TERMS = ("error", "mu", "peak", "unhindered")
AUDIT_TERMS = ("score", "sigma", "broken", "mm, deg", "margin", "speed", "jerk", "rest")


def print_learnt(console: Console, learnt: Learnt, explain: bool = False) -> None:
    """The sentence, the evidence, the warnings."""
    from manip_learn.learning.overview import RecordingOverview

    report = learnt.report
    console.print(f"[bold]{escape(report.sentence)}[/bold]", highlight=False)
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    terms = []
    for called, said, term in _learnt_facts(learnt):
        if said:
            table.add_row(called, escape(said))
            terms += [term] if term else []
    console.print(table)
    print_words(console, terms, explain)
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


def _learnt_facts(learnt: Learnt) -> list[tuple[str, str | None, str]]:
    """What each fact is called, the fact or nothing, and the term that explains it."""
    from manip_learn.learning.estimators.estimate import CLEAR_GAP

    report = learnt.report
    rank = f"{CLEAR_GAP:g} is clear" if report.gap >= CLEAR_GAP else f"weak: {CLEAR_GAP:g} is clear"
    held = [row for row in report.row_evidence if row.state == "held"]
    strengths = listed(f"{row.strength:.3g}" for row in held) if held else "none"
    p_value = f", p = {max(row.p_value for row in held):.2g}" if held else ""
    amount = f"{report.n_constraints} of {len(report.row_names)}"
    left_out = report.held_out_residual
    source = f"{counted(report.n_samples, 'sample')} of {counted(report.n_trajectories, 'recording')}"
    return [
        ("estimator", f"{report.estimator} ({report.kind})", ""),
        ("reference", report.reference, ""),
        ("policy model", report.policy_model, ""),
        (
            "held rows" if report.kind == "motion-constrained" else "steered rows",
            learnt.constraint.rows_in_words(),
            "row",
        ),
        ("number of rows", f"{amount}, gap {_readable(report.gap)} ({rank})", "gap"),
        ("left out", f"{_share(left_out)} of the motion unexplained" if math.isfinite(left_out) else "", "left-out"),
        ("uncertainty", report.known_to(), "uncertainty"),
        (
            "evidence",
            f"strength {strengths}{p_value} (recombination test)" if report.row_evidence else "",
            "strength",
        ),
        ("mechanism", report.mechanism_in_words(), ""),
        ("learnt from", f"{source} in {report.seconds:.2g} s", ""),
    ]


def print_demo(console: Console, demo: Demo, explain: bool = False) -> None:
    """What was learnt, the comparison, and where the replay is."""
    print_learnt(console, demo.learnt, explain)
    console.print()
    start = next(iter(demo.rollouts.values())).rollout.manipulability[0]
    console.print(f"from a start with mu = {start:.1g} (min mu: after the first {UNDER_WAY:g} s)", highlight=False)
    console.print(rollout_table(demo.rollouts, console.width))
    print_words(console, ROLLOUT_TERMS, explain)
    console.print(
        f"replay: {escape(str(demo.page.html))} ({demo.page.bytes / 1e6:.1f} MB)", highlight=False, soft_wrap=True
    )


def print_robots(console: Console, listed: KnownRobots) -> None:
    """Names and numbers of joints, those of the package first."""
    for robot in listed.robots:
        joints = f"{counted(len(robot.joints), 'joint')}" if not robot.refused else "refused: see `manip-learn inspect`"
        origin = "" if robot.origin == "package" else "  (extra robots)"
        console.print(f"{escape(robot.name):24} {joints}{origin}", highlight=False)
    if not listed.extra:
        console.print("more with: pip install 'manip_learn[robots]'", highlight=False, markup=False)


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


def print_controlled(console: Console, controlled: Controlled, explain: bool = False) -> None:
    """One rollout."""
    console.print(rollout_table({"rollout": controlled}, console.width))
    print_words(console, ROLLOUT_TERMS, explain)
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


def print_audit(console: Console, audited: Audited, explain: bool = False) -> None:
    """The worst episodes, and what to leave out and why."""
    report = audited.report
    table, hidden = audit_table(report.episodes[:MOST_ROWS], console.width)
    console.print(table)
    if hidden:
        console.print(f"not shown for want of width: {', '.join(hidden)} (--csv FILE has all)", highlight=False)
    if len(report.episodes) > MOST_ROWS:
        console.print(f"and {len(report.episodes) - MOST_ROWS} better episodes (--csv FILE lists all)", highlight=False)
    print_words(console, [t for t in AUDIT_TERMS if t.split(",")[0] not in hidden], explain)
    left = report.leave_out
    threshold = f"robust z above {report.threshold:.1f}" if math.isfinite(report.threshold) else "too few to tell"
    console.print(
        f"[bold]leave out {len(left)} of {counted(len(report.episodes), 'episode')}[/bold] ({threshold})",
        highlight=False,
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


def print_reproduction(console: Console, reproduction: Reproduction) -> None:
    """Each part's own page: our numbers next to those of the paper."""
    for part, page in reproduction.pages.items():
        console.rule(part)
        console.print(Markdown(page))
    if reproduction.out is not None:
        console.print(f"written: {escape(str(reproduction.out))}", highlight=False, soft_wrap=True)


def _readable(value: float) -> str:
    """A ratio as a person reads it: 3,940, 12 or 2.7."""
    return f"{value:,.0f}" if value >= 10 else f"{value:.2g}"


def _share(value: float) -> str:
    """A share in percent: 0.16 %, less than 0.001 %."""
    return f"{100 * value:.2g} %" if value >= 1e-5 else "less than 0.001 %"


def _limit(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else "none"


def print_exported(console: Console, exported: Exported) -> None:
    """What was written, and what was noticed."""
    for note in exported.notes:
        console.print(f"note: {escape(note)}", highlight=False, soft_wrap=True)
    for file in exported.files:
        console.print(f"{exported.format}: {escape(str(file))}", highlight=False, soft_wrap=True)
    console.print(
        f"{counted(exported.trajectories, 'trajectory')}, {counted(exported.samples, 'sample')}", highlight=False
    )
