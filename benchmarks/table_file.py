"""The table that a benchmark makes: printed, or written as CSV for docs/figures."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path


def put(header: Sequence[str], rows: Sequence[Sequence[object]], out: Path | None) -> None:
    """Write a table as CSV into a file, or print it where there is none."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *rows])
    if out is None:
        print(text.getvalue(), end="")
    else:
        out.write_text(text.getvalue(), encoding="utf-8")
