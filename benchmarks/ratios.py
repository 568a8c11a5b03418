"""The ratios that a run of the benchmarks has found, for the table at its end."""

from __future__ import annotations

from typing import NamedTuple


class Ratio(NamedTuple):
    """A ratio, smaller is better, and the quarter marks of the rounds' own."""

    value: float
    lower: float = float("nan")
    upper: float = float("nan")


FOUND: dict[tuple[str, str], Ratio] = {}


def keep(benchmark: str, ratios: dict[str, Ratio] | dict[str, float]) -> None:
    """Keep ratios for the table at the end."""
    FOUND.update({(benchmark, name): x if isinstance(x, Ratio) else Ratio(float(x)) for name, x in ratios.items()})


def table() -> str:
    """Markdown: everything found in this run."""
    lines = ["| benchmark | what | ratio | quarter marks of the rounds |", "|---|---|---|---|"]
    for (benchmark, name), x in FOUND.items():
        spread = "" if x.lower != x.lower else f"{x.lower:.3g} .. {x.upper:.3g}"
        lines.append(f"| {benchmark} | {name} | {x.value:.3g} | {spread} |")
    return "\n".join(lines)
