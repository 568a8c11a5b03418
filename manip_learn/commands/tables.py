"""What people see of an answer, and the words in it, explained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import final

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markdown import Markdown
from rich.table import Table
from rich.text import Text

from manip_learn.commands.command_line import described
from manip_learn.commands.output import Answer
from manip_learn.errors import printable


@final
class Glossary:
    """Words in the tables of all commands, in the order in which they are explained.

    Attributes:
        rows: Combinations of velocities that the task holds: a drawer holds two of x, y, z. The directions that are
            left are free.
        gap: How much more the weakest free direction is used than the strongest held one; 10 and above is clear, below
            3 says nothing. Noise and softness make it smaller. With the joint estimator 1.5 says something.
        left out: The constraint is learnt again without some of the recordings and asked about those: 0 % is best.
        uncertainty: In 68 % of repetitions with other recordings the answer stays within it. The arm is taken to be off
            by as much as --zeros and --links say, as far as the recordings do not tell. It does not say whether they
            show the right task.
        strength: How much more a row moves when joints are exchanged between recordings, so that nothing is held any
            more (recombination test); 1 or less: it is free. p is the chance of that.
        off: How far the hand strayed from the line, plane or circle; a drawer pushes back.
        fastest: The fastest joint, of its speed limit. At 100 % the hand had to wait for it.
        margin: The least share that the way leaves of the joints' ranges, of their speeds, and of the speed that the
            weakest direction could have. A plan chooses the posture in which the hand takes hold by it.
        error: Distance to the target at the end, along the rows driven [m or rad]. With --rows held the tip may end
            elsewhere along those that the constraint leaves free.
        mu: Manipulability of the task: the volume of velocities along the held rows that joint velocities of length 1
            reach. The smaller, the faster the joints must move; at 0, its singularity, the arm cannot follow in some
            direction. Compare it between policies only.
        peak: The largest speed of any joint [rad/s or m/s].
        unhindered: Share of the steps that no limit and no singularity changed (status ok); the replay shows where the
            others are.
        score: How unusual the episode is: the root of the sum of squares of all z-scores that are worse than usual.
            Episodes are compared with the median of those given, so it says nothing if most of them are of another
            task.
        broken: Share of the motion along held rows: noise gives some tenths of a percent, another task much more.
        room: To the nearest joint limit: 50 % is the middle of the range; negative beyond the limit.
        mm: How far the tip went along rows that are held; deg: how far it turned about them.
        sigma: Smallest singular value of the task at the worst posture; 0 at its singularity.
        speed: The fastest joint, of its limit; above 100 % the recording is faster than the description allows.
        rest: Share of the time in which no joint is faster than 0.02 rad/s.
        jerk: Roughness [rad/s3]: root mean square of the third derivative, less what noise contributes.
    """


def show(console: Console, answer: Answer, explain: bool | None = None) -> None:
    """Print an answer for people, and explain the words in its tables, or if `explain` is false say how."""
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
    for term, words in described(Glossary).items() if explain else ():
        if f" {term} " in f" {' '.join(headings)} ":
            console.print(Text.assemble((term, "bold"), f": {words}"), highlight=False)
    say(console, [f"note: {note}" for note in answer.notes], "dim")
    for heading, page in answer.pages.items():
        console.rule(heading)
        console.print(Markdown(page))
    say(console, answer.written, whole=True)
    if answer.page is not None:
        say(console, [f"replay: {answer.page.html} ({answer.page.bytes / 1e6:.1f} MB)"], whole=True)
    say(console, ["--explain says what the words mean" if explain is False else ""], "dim")
    say(console, [f"next: {answer.following}" if answer.following else ""], whole=True)


def text(words: object, style: str = "") -> Text:
    """Return words for the terminal: no markup is read in them, and none of their characters controls the terminal."""
    return Text(printable(words), style)


def say(console: Console, sentences: Sequence[str], style: str = "", whole: bool = False) -> None:
    """Print sentences, each on its own line; whole ones, that end in the name of a file, are not wrapped."""
    for sentence in filter(None, sentences):
        console.print(text(sentence, style), highlight=False, soft_wrap=whole)


def table_of(rows: Sequence[Mapping[str, str]], width: int) -> tuple[Table, list[str]]:
    """Return a table of the first columns, as many as fit, and the headings of the others.

    Args:
        rows: Lines, heading -> words; the first column may be wrapped, and takes at most half of the width.
        width: Of the terminal, in characters.
    """
    table = Table(box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0), header_style="bold")
    shown, room = list[str](), width
    for heading in rows[0]:
        longest = max(len(printable(words)) for words in (heading, *(row[heading] for row in rows)))
        room -= 2 + (longest if shown else min(longest, width // 2))
        if room < 0:
            break
        table.add_column(heading, justify="right" if shown else "left", no_wrap=bool(shown))
        shown.append(heading)
    for row in rows:
        table.add_row(*(text(row[heading]) for heading in shown))
    return table, list(rows[0])[len(shown) :]
