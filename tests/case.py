"""Names the case of a loop in which a test fails, gives each case an empty folder, and reads tables of cases."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

DATA = Path(__file__).with_name("data")


@contextmanager
def case(*values: object) -> Iterator[Path]:
    """Within it, a failure says which case it was.

    Yields:
        An empty folder, which goes with the case.
    """
    try:
        with TemporaryDirectory(prefix="case_") as folder:
            yield Path(folder)
    except BaseException as error:
        error.add_note(f"case: {', '.join(map(repr, values))}")
        raise


def rows_in(name: str) -> list[list[str]]:
    """Cells of each row of a table in tests/data: columns between bars, below a header; # begins a remark. Cells that
    are left out at the end of a row are empty.
    """
    lines = [line for line in (DATA / name).read_text(encoding="utf-8").split("\n") if line and line[0] != "#"]
    header, *rows = [[cell.strip() for cell in line.split("|")] for line in lines]
    assert all(len(row) <= len(header) for row in rows), name
    return [row + [""] * (len(header) - len(row)) for row in rows]
