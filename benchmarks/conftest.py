"""The table at the end of `make bench`."""

from __future__ import annotations

from typing import Any

import ratios


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Everything that this run has measured, in one table of ratios."""
    if ratios.FOUND:
        terminalreporter.write_line("")
        terminalreporter.write_line(ratios.table())
