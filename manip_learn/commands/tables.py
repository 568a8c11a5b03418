"""Tables and sentences printed by the commands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markdown import Markdown
from rich.markup import escape
from rich.table import Table

from manip_learn.commands.wide_tables import audit_table, rollout_table
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
    from manip_learn.commands.warm_up import Warmed
    from manip_learn.control.planning.plan import Plan
    from manip_learn.playback import ReplayResult
    from manip_learn.robot.robot_summary import RobotSummary

MOST_OTHERS = 3  # postures that a plan says more about on a terminal
MOST_ROWS = 20  # of an audit on a terminal
WAY_TERMS = ("off", "fastest", "least mu")
ROLLOUT_TERMS = ("error", "mu", "peak", "unhindered")
AUDIT_TERMS = ("score", "sigma", "broken", "mm, deg", "margin", "speed", "jerk", "rest")


def print_learnt(console: Console, learnt: Learnt, explain: bool = False) -> None:
    """The sentence, the evidence, the warnings."""
    from manip_learn.learning.report import RecordingOverview

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
    from manip_learn.learning.deciding import CLEAR_GAP

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
        ("left out", f"{_share(left_out)} of the motion unexplained" if math.isfinite(left_out) else "", "left out"),
        ("uncertainty", report.known_to(), "uncertainty"),
        (
            "evidence",
            f"strength {strengths}{p_value} (recombination test)" if report.row_evidence else "",
            "strength",
        ),
        ("effort", None if report.effort is None else report.effort.sentence(), ""),
        ("mechanism", report.mechanism_in_words(), ""),
        ("learnt from", f"{source} in {report.seconds:.2g} s", ""),
    ]


def print_demo(console: Console, demo: Demo, explain: bool = False) -> None:
    """What was learnt, the comparison, and where the replay is."""
    print_learnt(console, demo.learnt, explain)
    console.print()
    console.print(escape(demo.story), highlight=False)
    console.print(rollout_table(demo.rollouts, console.width))
    ways = [r for r in demo.rollouts.values() if r.way is not None]
    print_words(console, WAY_TERMS if ways else ROLLOUT_TERMS, explain)
    for name, controlled in demo.rollouts.items():
        if controlled.plan is not None:
            console.print(f"{escape(name)}: {escape(controlled.plan.sentence)}", highlight=False)
        if controlled.way is not None and controlled.way.stopped_by is not None:
            console.print(f"[yellow]{escape(name)}: stopped by {controlled.way.stopped_by}[/yellow]", highlight=False)
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


def print_warm_up(console: Console, warmed: Warmed) -> None:
    """What is compiled now."""
    words = (
        f"control steps are compiled ({warmed.seconds:.1f} s)"
        if warmed.compiled
        else ("nothing to compile: control steps run in Python, install the extra 'fast' to compile them")
    )
    console.print(words, highlight=False, markup=False)


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
    """One rollout: what was done in a sentence, the numbers, and what stood in the way."""
    way, r = controlled.way, controlled.rollout
    console.print(f"[bold]{escape(controlled.sentence)}[/bold]", highlight=False)
    if controlled.start:
        console.print(f"start: {escape(controlled.start)} (another: --start)", highlight=False)
    console.print(rollout_table({"rollout": controlled}, console.width))
    print_words(console, ROLLOUT_TERMS if way is None else WAY_TERMS, explain)
    if controlled.plan is not None:
        print_plan(console, controlled.plan)
    console.print(f"steps: {', '.join(f'{status} {n}' for status, n in r.status_counts.items())}", highlight=False)
    for sentence in _obstacles(controlled):
        console.print(f"[yellow]{escape(sentence)}[/yellow]", highlight=False)
    if controlled.out is not None:
        console.print(f"written: {escape(str(controlled.out))}", highlight=False, soft_wrap=True)


def print_plan(console: Console, plan: Plan) -> None:
    """What was planned, and why other postures were worse."""
    console.print(f"plan: {escape(plan.sentence)}", highlight=False)
    for other in plan.others[:MOST_OTHERS]:
        console.print(f"  instead, margin {other.margin:.0%}: {escape(other.why)}", highlight=False)
    console.print(f"  of {counted(plan.candidates, 'posture')} that take hold", highlight=False)
    for note in plan.notes:
        console.print(f"[yellow]{escape(note)}[/yellow]", highlight=False)


def _obstacles(controlled: Controlled) -> list[str]:
    """What kept a rollout from its goal, or should make one careful, in sentences."""
    way, aim, out = controlled.way, controlled.aim, []
    if way is not None and way.stopped_by is not None:
        out.append(f"stopped by {way.stopped_by}")
    if way is not None and way.strays:
        out.append(
            f"the hand strayed {1e3 * way.deviation:.1f} mm from what holds it, near a singularity or a limit: what is "
            "rigid pushes back; start in another posture"
        )
    if aim is not None and aim.crossed > controlled.tolerance:
        out.append(
            f"the hand moved {aim.crossed:.3g} along what the recordings show to be blocked, to come to the target: a "
            "hand that holds the thing needs a target on its way, or --along"
        )
    if controlled.hint:
        out.append(controlled.hint)
    if aim is not None and aim.ignored and not controlled.reached:
        out.append(f"--rows held leaves {', '.join(aim.ignored)} of the target free")
    if way is None and controlled.stalled:
        out.append(
            f"stalled with {controlled.final_error:.3g} left: limits or a singularity block the rest; the target may "
            "be out of reach, or try another --start"
        )
    elif way is None and controlled.final_error > controlled.tolerance:
        out.append(
            f"{controlled.final_error:.3g} left after {controlled.rollout.time[-1]:g} s, still moving: try a longer "
            "--duration"
        )
    return out


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
