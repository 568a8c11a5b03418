"""Cards that notebooks show of objects: a title, facts, tables and a small curve. One look for all of the library.

Colours are those of the page around it, so that light and dark notebooks can both be read. It stands in the lowest room
that shows something, because every room above has objects to show.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape as escape_markup

import numpy as np

from manip_learn.errors import printable

MOST_ROWS = 12  # of a table
WIDTH, HEIGHT = 320, 56  # of a curve [px]
# points of a curve: two per pixel, the least and the largest of what falls on it
MOST_POINTS = 2 * WIDTH
_CELL = "text-align:left;padding:1px 12px 1px 0;border:0;background:none"


def escape(text: str) -> str:
    """A text as HTML, in which no character is markup or moves what is around it."""
    return escape_markup(printable(text, layout=True))


def card(title: str, *parts: str) -> str:
    """A titled block of parts that are HTML already; parts without content are left out."""
    inner = "".join(part for part in parts if part)
    return f'<div style="font-size:13px;line-height:1.45"><b>{escape(title)}</b>{inner}</div>'


def sentence(text: str) -> str:
    """A paragraph of plain text."""
    return f'<p style="margin:2px 0;max-width:60em">{escape(text)}</p>' if text else ""


def warnings(texts: Iterable[str]) -> str:
    """A list of warnings, one item per sentence."""
    items = "".join(f"<li>{escape(text)}</li>" for text in texts)
    return f'<ul style="margin:2px 0;padding-left:1.2em"><b>Warnings</b>{items}</ul>' if items else ""


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table; of long ones the first rows, and how many there are more."""
    if not rows:
        return ""
    head = "".join(f'<th scope="col" style="{_CELL};opacity:.75">{escape(name)}</th>' for name in header)
    cells = [[f'<td style="{_CELL}">{escape(_text(value))}</td>' for value in row] for row in rows[:MOST_ROWS]]
    body = "".join(f"<tr>{''.join(row)}</tr>" for row in cells)
    more = f"<p style='margin:0;opacity:.75'>and {len(rows) - MOST_ROWS} more</p>" if len(rows) > MOST_ROWS else ""
    thead = f"<thead><tr>{head}</tr></thead>" if any(header) else ""
    style = "border-collapse:collapse;margin:4px 0;font-size:13px"
    return f'<table style="{style}">{thead}<tbody>{body}</tbody></table>{more}'


def facts(pairs: Iterable[tuple[str, object]]) -> str:
    """A table of names and values; None is left out."""
    return table(("", ""), [(name, value) for name, value in pairs if value is not None])


def folded(summary: str, inner: str) -> str:
    """Parts that are shown when the reader asks for them."""
    return f"<details><summary>{escape(summary)}</summary>{inner}</details>" if inner else ""


def curve(x: np.ndarray, y: np.ndarray, label: str) -> str:
    """A small curve over its range, with its words for screen readers; empty without two finite points."""
    finite = np.isfinite(y)
    x, y = x[finite], y[finite]
    if len(x) < 2 or x[-1] <= x[0]:
        return ""
    x, y = _extremes(x, y)
    low, high = float(y.min()), float(y.max())
    across = (x - x[0]) / (x[-1] - x[0]) * WIDTH
    down = HEIGHT - 2 - (y - low) / ((high - low) or 1.0) * (HEIGHT - 4)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across, down, strict=True))
    words = escape(f"{label}: {low:.3g} to {high:.3g}")
    return (
        f'<svg role="img" aria-label="{words}" width="{WIDTH}" height="{HEIGHT}" style="display:block;margin:4px 0">'
        f'<polyline points="{points}" fill="none" stroke="currentColor" stroke-width="1.5"/></svg>'
        f'<p style="margin:0;opacity:.75">{words}</p>'
    )


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)


def _extremes(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest of every run of samples, in order of time: no peak is lost."""
    if len(x) <= MOST_POINTS:
        return x, y
    kept = {0, len(x) - 1}
    for run in np.array_split(np.arange(len(x)), MOST_POINTS // 2):
        kept |= {int(run[np.argmin(y[run])]), int(run[np.argmax(y[run])])}
    chosen = sorted(kept)
    return x[chosen], y[chosen]
