"""Cards that notebooks show of objects: a title, facts and tables. One look for all of the library.

Colours are those of the page around it, so that light and dark notebooks can both be read. It stands in the lowest room
that shows something, because every room above has objects to show.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape as escape_markup

from manip_learn.errors import printable

MOST_ROWS = 12  # of a table
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


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
