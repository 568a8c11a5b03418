"""HTML cards that represent objects in notebooks: a title, facts and tables, with one style for the whole library.

Cards use the colours of the surrounding page, so that they are readable in light and dark notebooks. This module is in
the lowest layer of the library that displays objects, because all layers above use it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape as escape_markup

from manip_learn.errors import printable

WIDTH = 320  # [px] of a picture


def escape(text: str) -> str:
    """Escape a text for HTML, and remove characters that affect the text around it.

    Args:
        text: Plain text.
    """
    return escape_markup(printable(text, layout=True))


def card(title: str, *parts: str) -> str:
    """Return a block of HTML with a title.

    Args:
        title: Title, as plain text.
        *parts: Contents, as HTML; empty parts are left out.
    """
    inner = "".join(part for part in parts if part)
    return f'<div style="font-size:13px;line-height:1.45"><b>{escape(title)}</b>{inner}</div>'


def sentence(text: str) -> str:
    """Return a paragraph of HTML; empty for an empty text.

    Args:
        text: Plain text.
    """
    return f'<p style="margin:2px 0;max-width:60em">{escape(text)}</p>' if text else ""


def warnings(texts: Iterable[str]) -> str:
    """Return a list of warnings as HTML, one item per sentence; empty without any.

    Args:
        texts: Plain texts.
    """
    items = "".join(f"<li>{escape(text)}</li>" for text in texts)
    return f'<ul style="margin:2px 0;padding-left:1.2em"><b>Warnings</b>{items}</ul>' if items else ""


def table(header: Sequence[str], rows: Sequence[Sequence[object]], most: int = 12) -> str:
    """Return a table as HTML; the last row of a table that was cut gives the number of rows left out.

    Args:
        header: Names of the columns; all empty for no header.
        rows: Values of each row; floats are shown with 4 digits, integers with commas.
        most: Largest number of rows.
    """
    if not rows:
        return ""
    cell = "text-align:left;padding:1px 12px 1px 0;border:0;background:none"
    head = "".join(f'<th scope="col" style="{cell};opacity:.75">{escape(name)}</th>' for name in header)
    body = ""
    for row in rows[:most]:
        texts = (
            f"{value:.4g}" if isinstance(value, float) else f"{value:,}" if type(value) is int else str(value)
            for value in row
        )
        body += "<tr>" + "".join(f'<td style="{cell}">{escape(text)}</td>' for text in texts) + "</tr>"
    omitted = len(rows) - most
    more = f"<p style='margin:0;opacity:.75'>and {omitted} more</p>" if omitted > 0 else ""
    thead = f"<thead><tr>{head}</tr></thead>" if any(header) else ""
    style = "border-collapse:collapse;margin:4px 0;font-size:13px"
    return f'<table style="{style}">{thead}<tbody>{body}</tbody></table>{more}'


def facts(pairs: Iterable[tuple[str, object]]) -> str:
    """Return a table of names and values as HTML.

    Args:
        pairs: Pairs (name, value); pairs whose value is None are left out.
    """
    return table(("", ""), [(name, value) for name, value in pairs if value is not None])


def curve(x: Sequence[float], y: Sequence[float], label: str) -> str:
    """Return a small plot of a curve above zero as an SVG picture; empty if no value is positive.

    Args:
        x: Horizontal coordinates, ascending.
        y: Values; values that are not finite are gaps.
        label: Plain text below the picture, which screen readers read out.
    """
    height = 64  # [px] of the curve
    high, first = max(filter(math.isfinite, y), default=0.0), min(x, default=0.0)
    span = max(max(x, default=0.0) - first, 1e-12)  # positive for a single sample, too
    if high <= 0.0:
        return ""
    step = max(1, len(x) // WIDTH)
    points = [
        f"{WIDTH * (a - first) / span:.1f},{height * (1.0 - b / high):.1f}" if math.isfinite(b) else " "
        for a, b in zip(x[::step], y[::step], strict=True)
    ]
    parts = [f'<polyline points="{p}"/>' for p in " ".join(points).split("   ") if p.strip()]
    ground = f'<path opacity=".4" stroke-width="1" d="M0 {height}h{WIDTH}"/>'
    return _picture(ground + "".join(parts), height, label)


def bars(values: Sequence[tuple[str, float]], label: str) -> str:
    """Return a bar chart as an SVG picture, on a logarithmic scale that begins at a tenth of the smallest value.

    Args:
        values: Name and value of each bar; values that are not positive and finite are left out.
        label: Plain text below the picture, which screen readers read out.

    Returns:
        HTML; empty if there are no bars.
    """
    line = 16  # [px] height of a bar
    levels = [(name, math.log10(value)) for name, value in values if value > 0.0 and math.isfinite(value)]
    if not levels:
        return ""
    low, high = min(v for _, v in levels) - 1.0, max(v for _, v in levels)
    lines = [
        f'<path stroke-width="8" d="M0 {line * (i + 0.5)}h{0.6 * WIDTH * (v - low) / (high - low):.1f}"/>'
        f'<text x="{0.6 * WIDTH * (v - low) / (high - low) + 6:.1f}" y="{line * (i + 0.5) + 4}" fill="currentColor"'
        f' stroke="none" font-size="11">{escape(name)}</text>'
        for i, (name, v) in enumerate(levels)
    ]
    return _picture("".join(lines), line * len(levels), label)


def _picture(inner: str, height: int, label: str) -> str:
    """Return shapes as a picture with its label below."""
    return (
        f'<svg role="img" aria-label="{escape(label)}" width="{WIDTH}" height="{height + 4}" viewBox="0 -2 {WIDTH} '
        f'{height + 4}" fill="none" stroke="currentColor" stroke-width="1.5" style="display:block;margin-top:6px">'
        f"{inner}</svg>{sentence(label)}"
    )


def folded(summary: str, inner: str) -> str:
    """Return parts that are hidden until the reader unfolds them; empty without parts.

    Args:
        summary: Plain text that is always visible.
        inner: Hidden contents, as HTML.
    """
    return f"<details><summary>{escape(summary)}</summary>{inner}</details>" if inner else ""
