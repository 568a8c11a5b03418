"""What `make bench` found, in one table, beside what it found before: a ratio that has risen by a fifth fails.

`references.toml` holds a table per benchmark, name -> ratio. `BENCH_WRITE=1 make bench` writes what it measures.
"""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import NamedTuple

FILE = Path(__file__).with_name("references.toml")
ALLOWED = 1.2


class Ratio(NamedTuple):
    """A ratio, smaller is better: that of the best rounds, and the quarter marks of the rounds' own."""

    best: float
    lower: float | None = None
    upper: float | None = None


FOUND: dict[tuple[str, str], Ratio] = {}


def known() -> dict[str, dict[str, float]]:
    """Benchmark -> name -> ratio."""
    return tomllib.loads(FILE.read_text(encoding="utf-8")) if FILE.is_file() else {}


def check(benchmark: str, ratios: dict[str, Ratio] | dict[str, float]) -> None:
    """Compare ratios with those known, and keep them for the table at the end; new names are only printed.

    Raises:
        AssertionError: One has risen by more than a fifth, with its name and both figures.
    """
    found = {name: x if isinstance(x, Ratio) else Ratio(float(x)) for name, x in ratios.items()}
    FOUND.update({(benchmark, name): x for name, x in found.items()})
    before = known()
    if os.environ.get("BENCH_WRITE") == "1":
        before[benchmark] = {**before.get(benchmark, {}), **{name: round(x.best, 3) for name, x in found.items()}}
        lines = []
        for table, rows in sorted(before.items()):
            lines += [f'["{table}"]', *(f'"{name}" = {x:g}' for name, x in sorted(rows.items())), ""]
        FILE.write_text("\n".join(lines), encoding="utf-8")
        return
    mine = before.get(benchmark, {})
    slower = {n: (mine[n], round(x.best, 3)) for n, x in found.items() if n in mine and x.best > ALLOWED * mine[n]}
    assert not slower, f"{benchmark}: slower than (before, now), in ratios: {slower}"


def table() -> str:
    """Markdown: everything found in this run."""
    before = known()
    lines = ["| benchmark | what | ratio | quarter marks of the rounds | known |", "|---|---|---|---|---|"]
    for (benchmark, name), x in FOUND.items():
        spread = "" if x.lower is None else f"{x.lower:.3g} .. {x.upper:.3g}"
        was = before.get(benchmark, {}).get(name)
        lines.append(f"| {benchmark} | {name} | {x.best:.3g} | {spread} | {'' if was is None else f'{was:g}'} |")
    return "\n".join(lines)
