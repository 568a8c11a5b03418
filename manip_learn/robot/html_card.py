"""Cards that notebooks show of objects: a title, facts and tables. One look for all of the library.

Colours are those of the page around it, so that light and dark notebooks can both be read. It stands in the lowest room
that shows something, because every room above has objects to show.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape as escape_markup

from manip_learn.errors import printable

MOST_TABLE_ROWS = 12  # of a table
WIDTH, HEIGHT, LINE = 320, 64, 16  # [px] of a picture, of a curve in it, of a bar
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
    body = ""
    for row in rows[:MOST_TABLE_ROWS]:
        texts = (
            f"{value:.4g}" if isinstance(value, float) else f"{value:,}" if type(value) is int else str(value)
            for value in row
        )
        body += "<tr>" + "".join(f'<td style="{_CELL}">{escape(text)}</td>' for text in texts) + "</tr>"
    left = len(rows) - MOST_TABLE_ROWS
    more = f"<p style='margin:0;opacity:.75'>and {left} more</p>" if left > 0 else ""
    thead = f"<thead><tr>{head}</tr></thead>" if any(header) else ""
    style = "border-collapse:collapse;margin:4px 0;font-size:13px"
    return f'<table style="{style}">{thead}<tbody>{body}</tbody></table>{more}'


def facts(pairs: Iterable[tuple[str, object]]) -> str:
    """A table of names and values; None is left out."""
    return table(("", ""), [(name, value) for name, value in pairs if value is not None])


def curve(x: Sequence[float], y: Sequence[float], label: str) -> str:
    """A small curve above zero, in the colour of the text; values that are not finite are gaps."""
    high, first = max(filter(math.isfinite, y), default=0.0), min(x, default=0.0)
    span = max(max(x, default=0.0) - first, 1e-12)  # of a single moment, too
    if high <= 0.0:
        return ""
    step = max(1, len(x) // WIDTH)
    points = [
        f"{WIDTH * (a - first) / span:.1f},{HEIGHT * (1.0 - b / high):.1f}" if math.isfinite(b) else " "
        for a, b in zip(x[::step], y[::step], strict=True)
    ]
    parts = [f'<polyline points="{p}"/>' for p in " ".join(points).split("   ") if p.strip()]
    ground = f'<path opacity=".4" stroke-width="1" d="M0 {HEIGHT}h{WIDTH}"/>'
    return _picture(ground + "".join(parts), HEIGHT, label)


def bars(values: Sequence[tuple[str, float]], label: str) -> str:
    """A bar with its name for each positive value, on a scale by powers of ten that begins a tenth below the least."""
    known = [(name, math.log10(value)) for name, value in values if value > 0.0 and math.isfinite(value)]
    if not known:
        return ""
    low, high = min(v for _, v in known) - 1.0, max(v for _, v in known)
    lines = [
        f'<path stroke-width="8" d="M0 {LINE * (i + 0.5)}h{0.6 * WIDTH * (v - low) / (high - low):.1f}"/>'
        f'<text x="{0.6 * WIDTH * (v - low) / (high - low) + 6:.1f}" y="{LINE * (i + 0.5) + 4}" fill="currentColor"'
        f' stroke="none" font-size="11">{escape(name)}</text>'
        for i, (name, v) in enumerate(known)
    ]
    return _picture("".join(lines), LINE * len(known), label)


def _picture(inner: str, height: int, label: str) -> str:
    """Shapes as a picture with its title below, which is what a screen reader says."""
    return (
        f'<svg role="img" aria-label="{escape(label)}" width="{WIDTH}" height="{height + 4}" viewBox="0 -2 {WIDTH} '
        f'{height + 4}" fill="none" stroke="currentColor" stroke-width="1.5" style="display:block;margin-top:6px">'
        f"{inner}</svg>{sentence(label)}"
    )


def folded(summary: str, inner: str) -> str:
    """Parts that are shown when the reader asks for them."""
    return f"<details><summary>{escape(summary)}</summary>{inner}</details>" if inner else ""
