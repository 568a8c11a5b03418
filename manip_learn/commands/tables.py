"""Tables and sentences printed by the commands, and the terms in them, explained."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Container, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markdown import Markdown
from rich.table import Table
from rich.text import Text

from manip_learn.errors import counted, few, listed, printable

if TYPE_CHECKING:
    from manip_learn.commands.audit import Audited
    from manip_learn.commands.control import Controlled
    from manip_learn.commands.demo import Demo
    from manip_learn.commands.export import Exported
    from manip_learn.commands.learn import LearntTask
    from manip_learn.commands.record import Recorded
    from manip_learn.commands.repeat import Repeated
    from manip_learn.commands.reproduce import Reproduction
    from manip_learn.commands.robots import Inspected, KnownRobots
    from manip_learn.commands.teach import Taught
    from manip_learn.learning.audit import EpisodeAudit
    from manip_learn.playback import ReplayResult

PLAIN = {"header_style": "bold", "box": SIMPLE_HEAD, "padding": (0, 1, 0, 0), "show_edge": False}  # of a table
WAY_TERMS = ("off", "fastest", "margin of a way", "least mu")
ROLLOUT_TERMS = ("error", "mu", "peak", "unhindered")
AUDIT_TERMS = ("score", "sigma", "broken", "mm, deg", "margin", "speed", "jerk", "rest")
# what an audit shows of an episode, in order -> which of them go first where there is no room for all, and its cell
MEASURES: dict[str, tuple[int, Callable[[EpisodeAudit], float], str]] = {
    "score": (0, lambda e: e.score, ".1f"),
    "sigma": (4, lambda e: e.sigma_min, ".3f"),
    "broken": (1, lambda e: e.residual, ".1%"),
    "mm": (3, lambda e: e.displacement_mm, ".1f"),
    "deg": (7, lambda e: e.displacement_deg, ".1f"),
    "margin": (2, lambda e: e.limit_margin, ".0%"),
    "speed": (5, lambda e: e.peak_speed, ".0%"),
    "jerk": (8, lambda e: e.jerk_rms, ".1f"),
    "rest": (6, lambda e: e.rest_share, ".0%"),
    "s": (9, lambda e: e.duration, ".1f"),
}
# what the tables say in a word, in the order in which it is explained
WORDS = {
    "row": "One combination of velocities that the task holds: a drawer holds two of x, y, z. The directions that are "
    "left are free.",
    "gap": "How much more the weakest free direction is used than the strongest held one; 10 and above is clear, below "
    "3 says nothing. Noise and softness make it smaller. With the joint estimator 1.5 says something.",
    "left out": "The constraint is learnt again without some of the recordings and asked about those: 0 % is best.",
    "uncertainty": "In 68 % of repetitions with other recordings the answer stays within it. The arm is taken to be "
    "off by as much as --zeros and --links say, as far as the recordings do not tell. It does not say whether they "
    "show the right task.",
    "strength": "How much more a row moves when joints are exchanged between recordings, so that nothing is held any "
    "more (recombination test); 1 or less: it is free. p is the chance of that.",
    "mu": "Manipulability of the task: the volume of velocities along the held rows that joint velocities of length 1 "
    "reach. At 0, its singularity, the arm cannot follow in some direction. Compare it between policies only.",
    "off": "How far the hand strayed from the line, plane or circle; a drawer pushes back.",
    "fastest": "The fastest joint, of its speed limit. At 100 % the hand had to wait for it.",
    "margin of a way": "The least share that the way leaves of the joints' ranges, of their speeds, and of the speed "
    "that the weakest direction could have. A plan chooses the posture in which the hand takes hold by it.",
    "least mu": "The smallest manipulability of what the task holds and drives; the smaller, the faster the joints "
    "must move.",
    "error": "Distance to the target at the end, along the rows driven [m or rad]. With --rows held the tip may end "
    "elsewhere along those that the constraint leaves free.",
    "peak": "The largest speed of any joint [rad/s or m/s].",
    "unhindered": "Share of the steps that no limit and no singularity changed (status ok); the replay shows where the "
    "others are.",
    "score": "How unusual the episode is: the root of the sum of squares of all z-scores that are worse than usual. "
    "Episodes are compared with the median of those given, so it says nothing if most of them are of another task.",
    "sigma": "Smallest singular value of the task at the worst posture; 0 at its singularity.",
    "broken": "Share of the motion along held rows: noise gives some tenths of a percent, another task much more.",
    "mm, deg": "How far the tip went along rows that are held.",
    "margin": "Room to the nearest joint limit: 50 % is the middle of the range; negative beyond the limit.",
    "speed": "The fastest joint, of its limit; above 100 % the recording is faster than the description allows.",
    "jerk": "Roughness [rad/s3]: root mean square of the third derivative, less what noise contributes.",
    "rest": "Share of the time in which no joint is faster than 0.02 rad/s.",
}


def text(words: object, style: str = "") -> Text:
    """Words for the terminal: nothing in them is markup, and none of their characters controls the terminal."""
    return Text(printable(words), style)


def say(console: Console, *sentences: str, style: str = "", whole: bool = False) -> None:
    """Print sentences, each on its own line; whole ones, that end in the name of a file, are not wrapped."""
    for sentence in sentences:
        console.print(text(sentence, style), highlight=False, soft_wrap=whole)


def say_end(
    console: Console, notes: Iterable[str] = (), out: Path | None = None, page: ReplayResult | None = None
) -> None:
    """Print what is to be noted, and where something was written, if it was."""
    say(console, *(f"note: {note}" for note in notes), style="dim")
    say(console, *([] if out is None else [f"written: {out}"]), whole=True)
    say(console, *([] if page is None else [f"replay: {page.html} ({page.bytes / 1e6:.1f} MB)"]), whole=True)


def table_of(
    header: Sequence[str], rows: Iterable[Sequence[str | Text]], left: Container[int] = (0,), **style: Any
) -> Table:
    """A table; columns that are not named are aligned to the right, and nothing in it is markup.

    Args:
        header: Names of the columns.
        rows: Cells.
        left: Columns that are aligned to the left.
        style: As rich's `Table` takes it.
    """
    table = Table(**style)
    for i, name in enumerate(header):
        table.add_column(name, justify="left" if i in left else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(cell if isinstance(cell, Text) else text(cell) for cell in row))
    return table


def print_words(console: Console, terms: Iterable[str], explain: bool) -> None:
    """Explain terms, once; or say how to have them explained."""
    if not explain:
        say(console, "--explain says what the words mean", style="dim")
    for term in terms if explain else ():
        console.print(Text.assemble((term, "bold"), f": {WORDS[term]}"), highlight=False)


def rollout_table(rollouts: dict[str, Controlled], width: int) -> Table:
    """Policies side by side: a line each, or on a narrow terminal, or of one alone, a column each."""
    measures = [_measures(controlled) for controlled in rollouts.values()]
    lines = [("policy", *measures[0]), *((n, *m.values()) for n, m in zip(rollouts, measures, strict=True))]
    if width < 76 or len(measures) == 1:  # columns that hold the policies below each other
        lines = list(zip(*lines, strict=True))
    if len(measures) == 1:  # no policy is compared
        return table_of(("", ""), lines[1:], box=SIMPLE_HEAD, padding=(0, 1), show_header=False)
    return table_of(list(map(str, lines[0])), lines[1:], header_style="bold", box=SIMPLE_HEAD, padding=(0, 1))


def _measures(controlled: Controlled) -> dict[str, str | Text]:
    """Name -> value of what is told of a rollout."""
    r, way = controlled.rollout, controlled.way
    if way is not None:
        unit, size, digits = ("m", 1.0, 3) if way.unit == "m" else ("deg", math.degrees(1.0), 1)
        return {
            controlled.verb: f"{abs(size * way.done):.{digits}f} {unit}",
            "time": "-" if way.seconds is None else f"{way.seconds:.1f} s",
            "off": Text(f"{1e3 * way.deviation:.1f} mm", "red" if way.strays else ""),
            "fastest": f"{100 * way.fastest[1]:.0f} %",
            "margin": "-" if controlled.margin is None else f"{100 * controlled.margin:.0f} %",
            "least mu": f"{way.least_manipulability:.3f}",
        }
    mu = r.manipulability[r.time >= min(0.1, r.time[-1])]  # [s]: a nearly singular start is not due to the policy
    return {
        "error": f"{controlled.final_error:.4f}",
        "min mu": f"{mu.min():.4f}",
        "mean mu": f"{r.manipulability.mean():.3f}",
        "peak": f"{abs(r.u).max():.2f}/s",
        "unhindered": f"{100 * r.status.count('ok') / len(r):.0f} %",
    }


def audit_table(episodes: Sequence[EpisodeAudit], width: int) -> tuple[Table, tuple[str, ...]]:
    """Episodes with as many measures as fit, and the names of those that do not."""
    values = {name: list(map(value, episodes)) for name, (_, value, _) in MEASURES.items()}
    cells = {  # "12.3 %", not "12.3%"
        name: [f"{x:{MEASURES[name][2]}}".replace("%", " %") if math.isfinite(x) else "-" for x in column]
        for name, column in values.items()
    }
    room = width - max([len("episode"), *(len(printable(e.episode)) for e in episodes)])
    shown = list[str]()
    for name in sorted(MEASURES, key=lambda n: MEASURES[n][0]):
        room -= 2 + max(len(name), *(len(c) for c in cells[name]), 0)
        if room < 0:
            break
        shown.append(name)
    fitting = shown
    shown, hidden = ([n for n in MEASURES if (n in fitting) is fits] for fits in (True, False))
    lines = zip([e.episode for e in episodes], *(cells[name] for name in shown), strict=True)
    rows = [[text(cell, "red" if e.leave_out else "") for cell in row] for e, row in zip(episodes, lines, strict=True)]
    return table_of(["episode", *shown], rows, **PLAIN), tuple(hidden)


def print_learnt(console: Console, learnt: LearntTask, explain: bool = False, more: Sequence[str] = ()) -> None:
    """The sentence, the evidence, the warnings; with `explain` its terms and more."""
    from manip_learn.learning.report import RecordingOverview
    from manip_learn.learning.table import CLEAR_GAP

    report = learnt.report
    say(console, *([learnt.headline] if learnt.headline else []), style="bold")
    say(console, *learnt.sentences, style="" if learnt.headline else "bold")
    rank = f"{CLEAR_GAP:g} is clear" if report.gap >= CLEAR_GAP else f"weak: {CLEAR_GAP:g} is clear"
    gap = f"{report.gap:,.0f}" if report.gap >= 10 else f"{report.gap:.2g}"
    held = [row for row in report.row_evidence if row.state == "held"]
    strengths = listed(f"{row.strength:.3g}" for row in held) if held else "none"
    p_value = f", p = {max(row.p_value for row in held):.2g}" if held else ""
    left_out = report.held_out_residual
    share = f"{100 * left_out:.2g} %" if left_out >= 1e-5 else "less than 0.001 %"
    rows = "held rows" if report.kind == "motion-constrained" else "steered rows"
    source = f"{counted(report.n_samples, 'sample')} of {counted(report.n_trajectories, 'recording')}"
    facts = [
        ("estimator", f"{report.estimator} ({report.kind})", ""),
        ("reference", report.reference, ""),
        ("policy model", report.policy_model, ""),
        (rows, learnt.constraint.rows_in_words(), "row"),
        ("number of rows", f"{report.n_constraints} of {len(report.row_names)}, gap {gap} ({rank})", "gap"),
        ("left out", f"{share} of the motion unexplained" if math.isfinite(left_out) else "", "left out"),
        ("uncertainty", report.known_to(), "uncertainty"),
        ("evidence", f"strength {strengths}{p_value} (recombination test)" if report.row_evidence else "", "strength"),
        ("mechanism", report.mechanism_in_words(), ""),
        ("learnt from", f"{source} in {report.seconds:.2g} s", ""),
    ]
    facts = [(called, said, term) for called, said, term in facts if said]  # what it is called, and what explains it
    grid = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for called, said, _ in facts:
        grid.add_row(called, text(said))
    console.print(grid)
    say(console, *(f"constraint {n}: {other.sentence}" for n, other in enumerate(learnt.reports[1:], start=2)))
    say(console, *RecordingOverview(report.phases).sentences())
    many = len(learnt.constraints) > 1
    shown = [
        (f"constraint {n}: " if many else "", c.shown or c.intention) for n, c in enumerate(learnt.constraints, start=1)
    ]
    say(console, *(where + what.sentence for where, what in shown if what is not None))
    say(console, *(f"warning: {warning}" for warning in report.warnings), style="yellow")
    say_end(console, (*learnt.notes, *report.notes), learnt.out, learnt.page)
    print_words(console, [term for *_, term in facts if term] + list(more), explain)
    if learnt.following is not None and not more:
        say(console, f"next: {learnt.following}", whole=True)


def print_demo(console: Console, demo: Demo, explain: bool = False) -> None:
    """What was learnt, the comparison, and where the replay is."""
    ways = any(r.way is not None for r in demo.rollouts.values())
    print_learnt(console, demo.learnt, explain, WAY_TERMS if ways else ROLLOUT_TERMS)
    say(console, "", demo.story)
    console.print(rollout_table(demo.rollouts, console.width))
    for name, controlled in demo.rollouts.items():
        if controlled.plan is not None:
            say(console, f"{name}: {controlled.plan.sentence}")
        if controlled.way is not None and controlled.way.stopped_by is not None:
            say(console, f"{name}: stopped by {controlled.way.stopped_by}", style="yellow")
    say_end(console, page=demo.page)


def print_repeated(console: Console, repeated: Repeated) -> None:
    """What became of each step, and where it was written."""
    from manip_learn.control.tasks.driven_motion import way_in_words

    done = repeated.repetition
    ways = counted(sum(step.kind == "way" for step in done.steps), "way")
    say(console, f"{ways} done as shown" if done.is_done else "not all of it was done", style="bold")
    if repeated.whence:
        say(console, f"start: {repeated.whence} (another: --start)")
    table = Table("step", "done", "of", "off", "fastest", "margin", box=SIMPLE_HEAD, pad_edge=False)
    for step in done.steps:
        far, wanted = (way_in_words(round(x, 4), step.unit) for x in (step.done, step.wanted))
        off = f"{1e3 * step.deviation:.1f} {'mm' if step.unit == 'm' else 'mm or mrad'}"
        margin = "" if step.margin is None else f"{100 * step.margin:.0f} %"
        table.add_row(text(step.name), far, wanted, off, f"{100 * step.fastest:.0f} %", margin)
    console.print(table)
    say(console, done.pace)
    for step in done.steps:
        off = "" if step.off is None else f", {1e3 * step.off:.1f} mm from where a contact began"
        if step.kind == "reach":
            say(console, f"{step.name}: at {_at(step.place.tolist())}{off}")
    stopped = (f"{step.name}: stopped by {step.stopped_by}" for step in done.steps if step.stopped_by)
    say(console, *stopped, style="yellow")
    say_end(console, done.notes, repeated.out, repeated.page)


# origin of a robot -> what is said of it, the extra that brings it, and arms of it
ORIGINS = (
    ("package", "with the package", "", ""),
    ("extra", "with the extra robots, without a net", "robots", "panda, xarm7, so101, ur5 and 60 more"),
    ("net", "with the extra descriptions, fetched from the net when first named", "descriptions", "xarm6 and more"),
)


def print_robots(console: Console, listed: KnownRobots) -> None:
    """Names and numbers of joints, by where the robots come from, and what brings more of them."""
    for origin, title, extra, arms in ORIGINS:
        robots = listed.of(origin)
        if not robots:
            say(console, f"more with: pip install 'manip_learn[{extra}]' ({arms})")
            continue
        said = [
            f"{r.name} ({'refused' if r.refused else len(r.joints)})" if origin != "net" else r.name for r in robots
        ]
        say(console, f"{title} (and how many joints they have):" if origin == "package" else f"{title}:", style="bold")
        say(console, ", ".join(said))


def print_robot(console: Console, inspected: Inspected) -> None:
    """Print what one must know before recording and learning, on one screen."""
    summary, joints, check = inspected.summary, inspected.summary.joints, inspected.summary.cross_check
    tip = summary.tips[0] if summary.tips else "NAME"
    still = [j.name for j in joints if summary.moving_tip and j.name not in summary.moving_tip]
    limits = [[f"{x:.4g}" if math.isfinite(x) else "none" for x in (j.lower, j.upper, j.velocity)] for j in joints]
    rows = [(j.name, j.kind, *row, j.unit) for j, row in zip(joints, limits, strict=True)]
    agreed = f"agrees with yourdfpy to {check.largest_difference:.1e}" if check and check.agrees else ""
    above = {
        "likely tips": f"{few(summary.tips)} (--frame {shlex.quote(tip)})",
        f"moving {tip}": f"{few(summary.moving_tip)}; not: {few(still)}" if still else "",
        "without position limits": few([j.name for j in joints if not math.isfinite(j.upper - j.lower)]),
    }
    below = {
        "mimic": few([f"{m.joint} = {m.multiplier:g} {m.leader} + {m.offset:g}" for m in summary.mimics], 3),
        "locked": few([f"{name} at {position:g}" for name, position in summary.locked.items()]),
        "frames, the last first": f"{few(summary.frames[::-1])} (all: --json)",
        "forward kinematics": agreed,
        "shapes": summary.shapes,
        "next": f"manip-learn learn {shlex.join(inspected.loaded)} RECORDINGS --frame {shlex.quote(tip)}",
    }
    console.print(Text.assemble(text(summary.name, "bold"), f": nq {summary.nq}, nv {summary.nv}"), highlight=False)
    say(console, *([] if summary.source is None else [str(summary.source)]), style="dim", whole=True)
    say(console, *(f"{what}: {words}" for what, words in above.items() if words not in ("", "none")))
    say(console, *(f"warning: {warning}" for warning in summary.warnings), style="yellow")
    header = ("joint, in the order of files", "kind", "lower", "upper", "velocity", "unit")
    console.print(table_of(header, rows, left=(0, 1, 5), **PLAIN))
    say(console, *(f"{what}: {words}" for what, words in below.items() if words not in ("", "none")))


def print_controlled(console: Console, controlled: Controlled, explain: bool = False) -> None:
    """One rollout: what was done in a sentence, the numbers, and what stood in the way."""
    say(console, controlled.sentence, style="bold")
    if controlled.start:
        say(console, f"start: {controlled.start} (another: --start)")
    if controlled.hold is not None:
        say(console, f"the hand took hold at {_at(controlled.hold)}")
    console.print(rollout_table({"rollout": controlled}, console.width))
    plan = controlled.plan
    if plan is not None:
        say(console, f"plan: {plan.sentence}")
        if plan.around.names:
            say(console, f"  clear of: {', '.join(plan.around.names)}")
        if explain:
            say(console, f"  of {counted(plan.candidates, 'posture')} that take hold")
        say(console, *plan.notes, style="yellow")
    counts = controlled.rollout.status_counts
    say(console, f"steps: {', '.join(f'{status} {n}' for status, n in counts.items())}")
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
    say(console, *out, style="yellow")
    print_words(console, ROLLOUT_TERMS if controlled.way is None else WAY_TERMS, explain)
    say_end(console, controlled.notes, controlled.out, controlled.page)


def _at(place: Sequence[float]) -> str:
    return f"({', '.join(f'{x:.3f}' for x in place)}) m"


def print_audit(console: Console, audited: Audited, explain: bool = False) -> None:
    """The worst episodes, and what to leave out and why."""
    report = audited.report
    most = 20  # rows on a terminal
    table, hidden = audit_table(report.episodes[:most], console.width)
    console.print(table)
    if hidden:
        say(console, f"not shown for want of width: {', '.join(hidden)} (--csv FILE has all)")
    if len(report.episodes) > most:
        say(console, f"and {len(report.episodes) - most} better episodes (--csv FILE lists all)")
    threshold = f"robust z above {report.threshold:.1f}" if math.isfinite(report.threshold) else "too few to tell"
    left_out = f"leave out {len(report.leave_out)} of {counted(len(report.episodes), 'episode')}"
    console.print(Text.assemble((left_out, "bold"), f" ({threshold})"), highlight=False)
    for e in report.leave_out:
        reasons = Text.assemble(text(e.episode, "red"), text(f": {'; '.join(e.reasons)}"))
        console.print(reasons, highlight=False, soft_wrap=True)
    print_words(console, [t for t in AUDIT_TERMS if t.split(",")[0] not in hidden], explain)
    say_end(console, report.notes, audited.out)


def print_replayed(console: Console, page: ReplayResult) -> None:
    """What was noticed, the file and its size."""
    say_end(console, page.notes, page=page)


def print_reproduction(console: Console, reproduction: Reproduction) -> None:
    """Each part's own page: our numbers next to those of the paper."""
    for part, page in reproduction.pages.items():
        console.rule(part)
        console.print(Markdown(page))
    say_end(console, out=reproduction.out)


def print_recorded(console: Console, answer: Recorded) -> None:
    """The files, whether samples were lost, and what the recordings show."""
    say(console, *(f"recorded: {file}" for file in answer.recorded.files), whole=True)
    say(console, answer.recorded.sentence)
    say_end(console, answer.recorded.notes)
    if answer.sentence:
        say(console, answer.sentence, style="bold")
    say(console, answer.advice, whole=True)


def print_taught(console: Console, answer: Taught) -> None:
    """The last answer, and the folder of all of it."""
    say_end(console, answer.notes)
    say(console, *([answer.sentence] if answer.sentence else []), style="bold")
    kept = f"{counted(len(answer.recordings), 'recording')} kept in: {answer.folder}"
    say(console, kept if answer.recordings else "nothing was recorded", whole=True)


def print_exported(console: Console, exported: Exported) -> None:
    """What was written, and what was noticed."""
    say(console, *(f"note: {note}" for note in exported.notes), whole=True)
    say(console, *(f"{exported.format}: {file}" for file in exported.files), whole=True)
    if exported.trajectories:
        say(console, f"{counted(exported.trajectories, 'trajectory')}, {counted(exported.samples, 'sample')}")
