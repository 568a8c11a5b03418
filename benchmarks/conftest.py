"""The table at the end of `make bench`."""

from __future__ import annotations

from typing import Any

import timing


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Everything that this run has measured, in one table of ratios."""
    if timing.FOUND:
        terminalreporter.write_line("")
        terminalreporter.write_line(timing.table())
