"""Names the case of a loop in which a test fails, and gives each case an empty folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory


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
