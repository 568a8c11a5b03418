"""The order in which people number files."""

from __future__ import annotations

import re


def natural_order(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key that puts `demo_2` before `demo_10`."""
    parts = re.findall(r"\d+|\D+", name)
    # CPython refuses to convert thousands of digits
    return tuple((0, int(p), "") if p.isdecimal() and len(p) < 400 else (1, 0, p) for p in parts)
