"""The page of the documentation whose table a benchmark makes."""

from __future__ import annotations

from pathlib import Path

BEGIN, END = "<!-- table -->\n", "<!-- end -->"


def put(table: str, page: Path | None) -> None:
    """Put a table into a page between its marks, or print it where there is no page."""
    if page is None:
        print(table)
        return
    head, _, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    _, _, tail = rest.partition(END)
    page.write_text(f"{head}{BEGIN}{table}\n{END}{tail}", encoding="utf-8")
