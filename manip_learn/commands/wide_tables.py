"""Tables with many columns, for wide terminals and for narrow ones."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

if TYPE_CHECKING:
    from manip_learn.commands.control import Controlled
    from manip_learn.learning.audit import EpisodeAudit

UNDER_WAY = 0.1  # the nearly singular start is not due to the policy: evaluated from here on [s]
WIDE = 76  # columns of a terminal that hold the policies below each other
GAP = 2  # blanks between columns
# what an audit shows of an episode; on a narrow terminal the last ones are left out
MEASURES = ("score", "broken", "margin", "mm", "sigma", "speed", "rest", "deg", "jerk", "s")
SHOWN_ORDER = ("score", "sigma", "broken", "mm", "deg", "margin", "speed", "jerk", "rest", "s")


def rollout_table(rollouts: dict[str, Controlled], width: int) -> Table:
    """Policies side by side: a line each, or on a narrow terminal, or of one alone, a column each."""
    measures = [_measures(controlled) for controlled in rollouts.values()]
    header = ("policy", *measures[0])
    rows = [(escape(name), *values.values()) for name, values in zip(rollouts, measures, strict=True)]
    if width < WIDE or len(rows) == 1:
        header, *rows = zip(header, *rows, strict=True)
    if len(measures) == 1:  # no policy is compared
        header, *rows = rows
    table = Table(header_style="bold" if len(measures) > 1 else "", box=SIMPLE_HEAD, padding=(0, 1))
    table.show_header = len(measures) > 1
    for i, name in enumerate(header):
        table.add_column(str(name), justify="left" if i == 0 else "right", no_wrap=True)
    for row in rows if len(measures) > 1 else [header, *rows]:
        table.add_row(*row)
    return table


def _measures(controlled: Controlled) -> dict[str, str]:
    """Name -> value of what is told of a rollout."""
    r, way = controlled.rollout, controlled.way
    if way is not None:
        off = f"{1e3 * way.deviation:.1f} mm"
        unit, size, digits = ("m", 1.0, 3) if way.unit == "m" else ("deg", math.degrees(1.0), 1)
        return {
            controlled.verb: f"{abs(size * way.done):.{digits}f} {unit}",
            "time": "-" if way.seconds is None else f"{way.seconds:.1f} s",
            "off": f"[red]{off}[/red]" if way.strays else off,
            "fastest": f"{100 * way.fastest[1]:.0f} %",
            "least mu": f"{way.least_manipulability:.3f}",
        }
    mu = r.manipulability[r.time >= min(UNDER_WAY, r.time[-1])]
    return {
        "error": f"{controlled.final_error:.4f}",
        "min mu": f"{mu.min():.4f}",
        "mean mu": f"{r.manipulability.mean():.3f}",
        "peak": f"{abs(r.u).max():.2f}/s",
        "unhindered": f"{100 * r.status.count('ok') / len(r):.0f} %",
    }


def audit_table(episodes: Sequence[EpisodeAudit], width: int) -> tuple[Table, tuple[str, ...]]:
    """Episodes with as many measures as fit, and the names of those that do not."""
    cells = {name: [_measure(name, e) for e in episodes] for name in SHOWN_ORDER}
    room = width - max([len("episode"), *(len(e.episode) for e in episodes)])
    fitting: list[str] = []
    for name in MEASURES:
        room -= GAP + max(len(name), *(len(c) for c in cells[name]), 0)
        if room < 0:
            break
        fitting.append(name)
    shown = [name for name in SHOWN_ORDER if name in fitting]
    table = Table(header_style="bold", box=SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
    table.add_column("episode", no_wrap=True)
    for name in shown:
        table.add_column(name, justify="right", no_wrap=True)
    for i, e in enumerate(episodes):
        table.add_row(escape(e.episode), *(cells[name][i] for name in shown), style="red" if e.leave_out else None)
    return table, tuple(name for name in SHOWN_ORDER if name not in fitting)


def _measure(name: str, e: EpisodeAudit) -> str:
    value, form, unit = {
        "score": (e.score, ".1f", ""),
        "sigma": (e.sigma_min, ".3f", ""),
        "broken": (100 * e.residual, ".1f", " %"),
        "mm": (e.displacement_mm, ".1f", ""),
        "deg": (e.displacement_deg, ".1f", ""),
        "margin": (100 * e.limit_margin, ".0f", " %"),
        "speed": (100 * e.peak_speed, ".0f", " %"),
        "jerk": (e.jerk_rms, ".1f", ""),
        "rest": (100 * e.rest_share, ".0f", " %"),
        "s": (e.duration, ".1f", ""),
    }[name]
    return f"{value:{form}}{unit}" if math.isfinite(value) else "-"
