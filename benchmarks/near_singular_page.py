"""The page docs/figures_law.md, made of the runs of `near_singular_ways.py`."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

TITLES = {"none": "no null-space motion", "learnt": "ascent of μ", "ascent": "`task.ascent()`"}
HEAD = """# The law at its limits

What becomes of ways that begin near a singularity, of firm grips, and of what no arm can reach? Each figure stands
behind the figure of the law before ([formulas](method.md#the-controller)), which scaled the task and its null-space
motion by one factor each and damped held rows as driven ones. This page is made by a program; nothing in it is written
by hand.

```bash
python benchmarks/near_singular_ways.py --page docs/figures_law.md --workers 2
```

Each line of {download}`the table <figures/law.csv>` is one start with one policy; of the law before there is
{download}`the same <figures/law_before.csv>`.

## Ways that begin near a singularity

The starts are those of [When it helps](figures_when_it_helps.md) with a held orientation near a singularity, two for
each arm and task: 60 ways and 12 points to reach. A way is done if the hand goes all of it and is never 2 mm off what
holds it. The law was tuned on the starts of seed 41000; of seed 87000 one firm grip, of a UR5, led to a rule as well.
"""
FIRM = """
## Firm grips

The hand turns with a door or a screw: five rows of its pose, in its own axes, are held. There are 30 such ways.
"""
SMALLEST = """
## The smallest case

An xArm7 goes half a metre along a rail, and a spare joint comes to its limit on the way.
"""
BEYOND = """
## Out of reach, and exactly at a singularity

Points are 0.3 m out of reach of four arms, ways more than twice as long as six arms reach; exactly singular starts of
ten arms are those of `closed_loops.py`. An arm turns to and fro if, in the last second, a joint changes the sign of
its velocity (above 1 mrad/s) from one period to the next.
"""


class Run(NamedTuple):
    """What became of one start with one policy.

    `good` is a way that was done, a target out of reach without chatter, or a singularity that was left; `off` is how
    far the hand was off what holds it [mm], and `why` what stopped it.
    """

    part: str
    seed: int
    arm: str
    task: str
    number: int
    policy: str
    good: bool
    off: float
    why: str


def read(path: Path) -> list[Run]:
    """The runs of a table."""
    with path.open(encoding="utf-8", newline="") as file:
        return [
            Run(*row[:1], int(row[1]), *row[2:4], int(row[4]), row[5], row[6] == "True", float(row[7]), row[8])
            for row in list(csv.reader(file))[1:]
        ]


def table(head: Sequence[str], lines: Iterable[Sequence[object]]) -> str:
    """A Markdown table."""
    rows = [head, ["---"] * len(head), *lines]
    return "\n" + "".join("| " + " | ".join(map(str, row)) + " |\n" for row in rows)


def short(run: Run, stray: float) -> str:
    """What stopped a run, in a few words."""
    joint = re.match(r"joint '(.*)' at its (\w+) limit", run.why)
    words = f"{joint[1]} at its {joint[2]} limit" if joint else run.why
    off = f"{run.off:.1f} mm off"
    return f"{words}, {off}" if run.off > 1e3 * stray and off not in words else words


def sums(before: list[Run], now: list[Run], policies: list[str], stray: float) -> str:
    """How many ways are done and stray, the law before beside this one."""

    def both(count: Callable[[list[Run]], object], seed: int, policy: str) -> str:
        then, here = ([run for run in runs if (run.seed, run.policy) == (seed, policy)] for runs in (before, now))
        return f"{count(then) if then else '?'} → {count(here)}"

    def reaches(wanted: bool, runs: list[Run]) -> str:
        some = [run.good for run in runs if (run.task == "reach") == wanted]
        return f"{sum(some)} of {len(some)}" if some else "-"

    lines = [
        [
            seed,
            TITLES[policy],
            both(lambda runs: reaches(wanted=False, runs=runs), seed, policy),
            both(lambda runs: reaches(wanted=True, runs=runs), seed, policy),
            both(lambda runs: sum(run.off > 1e3 * stray for run in runs), seed, policy),
            both(lambda runs: f"{max(run.off for run in runs):.1f}", seed, policy),
        ]
        for seed in dict.fromkeys(run.seed for run in now)
        for policy in policies
        if any((run.seed, run.policy) == (seed, policy) for run in now)
    ]
    head = ["starts", "policy", "ways done", "points reached", "farther than 2 mm off", "farthest [mm]"]
    if not any(run.task == "reach" for run in now):
        head, lines = head[:3] + head[4:], [line[:3] + line[4:] for line in lines]
    return table(head, lines)


def lost(before: list[Run], now: list[Run], policies: list[str], stray: float) -> str:
    """The starts that are not done, what stops them, and whether the law before did them."""
    old = {run[:6]: run for run in before}
    starts: dict[tuple[object, ...], dict[str, Run]] = {}
    for run in now:
        starts.setdefault(run[1:5], {})[run.policy] = run

    def cell(run: Run | None) -> str:
        if run is None:
            return "not run"
        if run.good:
            return "done"
        then = old.get(run[:6])
        did = then is not None and then.good
        return short(run, stray) + (" (**done before**)" if did else "")

    lines = [
        [*start, *(cell(runs.get(policy)) for policy in policies)]
        for start, runs in starts.items()
        if not all(runs[policy].good for policy in policies if policy in runs)
    ]
    again = sum("done before" in str(word) for line in lines for word in line)
    text = f"\nNot done, and what stops them (the law before did {again} of these runs):\n"
    return text + table(["seed", "arm", "task", "start", *(TITLES[policy] for policy in policies)], lines)


def counted(before: list[Run], now: list[Run]) -> str:
    """How many of the others are good, and which are not."""
    parts = [part for part in dict.fromkeys(run.part for run in now) if part.split()[0] in ("point", "way", "singular")]
    lines, bad = [], []
    for part in (part for part in parts if part != "way"):
        for policy in dict.fromkeys(run.policy for run in now if run.part == part):
            then, here = ([r.good for r in runs if (r.part, r.policy) == (part, policy)] for runs in (before, now))
            word = "left within 1 s" if part.startswith("singular") else "without turning to and fro"
            lines.append([part, TITLES[policy], word, f"{sum(then)} → {sum(here)} of {len(here)}"])
        bad += [
            [run.part, run.arm, run.task, run.number, TITLES[run.policy], run.why or "not left"]
            for run in now
            if run.part == part and not run.good
        ]
    return (
        table(["", "policy", "counted", "before → now"], lines)
        + "\nThe others:\n"
        + table(["", "arm", "rows", "start", "policy", "what happens"], bad)
    )


def page_of(before: list[Run], now: list[Run], stray: float, law: str) -> str:
    """The whole page."""
    ascent = [run._replace(policy="learnt") for run in now if run.policy == "ascent"]
    same = set(ascent) <= set(now)
    policies = ["none", "learnt"] if same else ["none", "learnt", "ascent"]
    text = HEAD + (f"It was measured with {law}.\n" if law else "")
    if same:
        text += "`task.ascent()` is the ascent of μ of the rows held and driven.\n"
    for part, head in (("way", ""), ("firm grip", FIRM)):
        then, here = ([run for run in runs if run.part == part] for runs in (before, now))
        text += head + sums(then, here, policies, stray) + lost(then, here, policies, stray)
    small = [
        [TITLES[run.policy], *(f"{r.off:.1f} mm off, {short(r, 1.0) or 'done'}" for r in (old, run))]
        for run in now
        if run.part == "smallest case" and run.policy in policies
        for old in before
        if old[:6] == run[:6]
    ]
    text += SMALLEST + table(["policy", "before", "now"], small)
    return text + BEYOND + counted(before, now)
