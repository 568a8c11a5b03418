"""Printing of answers as text, with a glossary of the terms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import final

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markdown import Markdown
from rich.table import Table
from rich.text import Text

from manip_learn.commands.command_line import attribute_texts
from manip_learn.commands.output import Answer
from manip_learn.errors import printable


@final
class Glossary:
    """Terms in the tables of all commands, in the order in which they are explained.

    Attributes:
        rows: Combinations of velocities that the task constrains: a drawer constrains two of x, y, z. The other
            directions are free.
        gap: Ratio of the motion along the weakest free direction to the motion along the strongest held one; 10 and
            above is clear, below 3 is no evidence. Noise and compliance reduce it. With the joint estimator, 1.5 is
            evidence.
        left out: Unexplained motion of recordings that were left out of the fit: 0 % is best.
        uncertainty: In 68 % of repetitions with other recordings the answer stays within it. The arm is assumed to have
            the calibration errors of --zeros and --links, unless the recordings show them. It does not cover
            recordings of the wrong task.
        strength: Growth of the motion along a row when joints are exchanged between recordings, so that nothing is
            constrained any more (recombination test); 1 or less: the row is free. p is the probability by chance.
        off: Deviation of the hand from the line, plane or circle; a drawer pushes back.
        fastest: Speed of the fastest joint as a share of its limit. At 100 % the hand had to wait for it.
        margin: Smallest remaining share of the joint ranges, of the joint speeds, and of the speed in the weakest
            direction. A plan chooses the grasp configuration with the largest margin.
        error: Distance to the target at the end, along the driven rows [m or rad]. With --rows held the tip may end
            elsewhere along the free directions.
        mu: Manipulability of the task: the volume of velocities along the held rows that joint velocities of length 1
            reach. The smaller, the faster the joints must move; at 0, its singularity, the arm cannot follow in some
            direction. Compare it between policies only.
        peak: Largest speed of any joint [rad/s or m/s].
        unhindered: Share of the steps that no limit and no singularity changed (status ok); the replay shows the
            others.
        score: Deviation of the episode: the root of the sum of squares of all z-scores that are worse than usual.
            Episodes are compared with their median, so it is meaningless if most of them show another task.
        broken: Share of the motion along held rows: noise gives some tenths of a percent, another task much more.
        room: Distance to the nearest joint limit: 50 % is the middle of the range; negative beyond the limit.
        mm: Motion of the tip along held rows; deg: rotation about them.
        sigma: Smallest singular value of the task at the worst posture; 0 at its singularity.
        speed: Speed of the fastest joint as a share of its limit; above 100 % the recording is faster than the limit.
        rest: Share of the time in which no joint is faster than 0.02 rad/s.
        jerk: Roughness [rad/s3]: root mean square of the third derivative, without the contribution of noise.
    """


def show(console: Console, answer: Answer, explain: bool | None = None) -> None:
    """Print an answer as text, with a glossary of the terms in its tables.

    Args:
        console: Console to print on.
        answer: Answer of a command.
        explain: True to print the glossary, False to print a hint that it exists, None for neither.
    """
    say(console, [answer.title], "bold")
    say(console, answer.sentences)
    facts, headings = Table.grid(padding=(0, 2, 0, 0)), [*answer.facts, *(answer.rows[0] if answer.rows else ())]
    for name, words in answer.facts.items():
        facts.add_row(text(name), text(words))
    if answer.facts:
        console.print(facts)
    say(console, answer.remarks)
    if answer.rows:
        table, hidden = table_of(answer.rows, console.width)
        console.print(table)
        say(console, [f"not shown for want of width: {', '.join(hidden)} (--json has all)" if hidden else ""])
    say(console, answer.warnings, "yellow")
    for term, words in attribute_texts(Glossary).items() if explain else ():
        if f" {term} " in f" {' '.join(headings)} ":
            console.print(Text.assemble((term, "bold"), f": {words}"), highlight=False)
    say(console, [f"note: {note}" for note in answer.notes], "dim")
    for heading, page in answer.pages.items():
        console.rule(heading)
        console.print(Markdown(page))
    say(console, answer.written, whole=True)
    if answer.page is not None:
        say(console, [f"replay: {answer.page.html} ({answer.page.bytes / 1e6:.1f} MB)"], whole=True)
    say(console, ["--explain defines the terms" if explain is False else ""], "dim")
    say(console, [f"next: {answer.following}" if answer.following else ""], whole=True)


def text(words: object, style: str = "") -> Text:
    """Return text for the terminal; markup is not interpreted, and control characters are escaped.

    Args:
        words: Text to print.
        style: Style of the library `rich`, e.g. `"bold"`.
    """
    return Text(printable(words), style)


def say(console: Console, sentences: Sequence[str], style: str = "", whole: bool = False) -> None:
    """Print sentences, each on its own line.

    Args:
        console: Console to print on.
        sentences: Sentences; empty ones are skipped.
        style: Style of the library `rich`, e.g. `"bold"`.
        whole: True to print each sentence without line breaks, e.g. one that ends in the name of a file.
    """
    for sentence in filter(None, sentences):
        console.print(text(sentence, style), highlight=False, soft_wrap=whole)


def table_of(rows: Sequence[Mapping[str, str]], width: int) -> tuple[Table, list[str]]:
    """Return a table with as many of the first columns as fit, and the headings of the columns left out.

    Args:
        rows: Lines: for each heading the text of its cell. The first column may be wrapped, and takes at most half of
            the width.
        width: Width of the terminal, in characters.
    """
    table = Table(box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0), header_style="bold")
    headings, room = list[str](), width
    for heading in rows[0]:
        longest = max(len(printable(words)) for words in (heading, *(row[heading] for row in rows)))
        room -= 2 + (longest if headings else min(longest, width // 2))
        if room < 0:
            break
        table.add_column(heading, justify="right" if headings else "left", no_wrap=bool(headings))
        headings.append(heading)
    for row in rows:
        table.add_row(*(text(row[heading]) for heading in headings))
    return table, list(rows[0])[len(headings) :]
