"""Which column of a text table holds the time stamps, by the names that common programs give it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

TIME = "time"
UNIT_WORDS = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
# the axis of PlotJuggler's tables [s]
FIRST = ("__time",)
# written by `rostopic echo -p`, and by converters of ROS 1 bags, in nanoseconds
NANOSECONDS = ("%time", "field.header.stamp", "rosbagtimestamp")
PLAIN = re.compile(
    r"(time|times|t|timestamps?|stamp|secs?|seconds|elapsed([_ ]time)?|relative[_ ]time|ros[_ ]?time|unix[_ ]?time"
    r"|epoch|recv_?time|receive[_ ]time|publish[_ ]time|(.*[./])?header[./]stamp)"
)
WITH_UNIT = re.compile(r"(?:elapsed[_ ]?)?(?:time|t|timestamp|stamp)[_ ]?[\[(]?(s|sec|secs|seconds|ms|us|ns)[\])]?")
# `header.stamp.secs` of ROS 1, `header.stamp.sec` of ROS 2, `header/stamp/sec` of paths
SECONDS = re.compile(r"(.*[./_])?stamp[./_]secs?")
NANO = re.compile(r"(.*[./_])?stamp[./_]n(ano)?secs?")


@final
@dataclass(frozen=True)
class TimeColumns:
    """Where the stamps are.

    Attributes:
        columns: One column; or two, whole seconds and nanoseconds.
        unit: Unit that the name says; None: that of any column `time`.
        note: What the caller should know; empty for a column `time`.
        others: Further columns of times, which are not used.
        choices: Names among which the caller must choose, if there are several; no column is chosen then.
    """

    columns: tuple[int, ...] = ()
    unit: str | None = None
    note: str = ""
    others: tuple[int, ...] = ()
    choices: tuple[str, ...] = ()


def find_time(names: Sequence[str | None]) -> TimeColumns:
    """The column `time`, or one that is known by another name: PlotJuggler's, a message's stamp, or the only one."""
    lowered = ["" if n is None else n.strip().lower() for n in names]
    known = [i for i, n in enumerate(lowered) if _is_time(n)]
    if TIME in names:
        return TimeColumns((names.index(TIME),), others=tuple(i for i in known if names[i] != TIME))
    seconds = [i for i in known if SECONDS.fullmatch(lowered[i])]
    if not any(n in FIRST for n in lowered) and len(seconds) == 1:
        nano = [i for i in known if NANO.fullmatch(lowered[i])]
        if len(nano) == 1:
            pair = (seconds[0], nano[0])
            note = f"time is read from {names[pair[0]]!r} [s] and {names[pair[1]]!r} [ns]"
            return TimeColumns(pair, "s", note, tuple(i for i in known if i not in pair))
    single = [i for i in known if not SECONDS.fullmatch(lowered[i]) and not NANO.fullmatch(lowered[i])]
    for wanted in (FIRST, ("field.header.stamp",), ("header.stamp", "header/stamp")):
        first = [i for i in single if lowered[i].endswith(wanted)]
        if len(first) == 1:
            return _single(names, lowered, first[0], known)
    if len(single) == 1:
        return _single(names, lowered, single[0], known)
    return TimeColumns(choices=tuple(str(names[i]) for i in single))


def _is_time(name: str) -> bool:
    patterns = (PLAIN, WITH_UNIT, SECONDS, NANO)
    return name in (*FIRST, *NANOSECONDS) or any(p.fullmatch(name) for p in patterns)


def _single(names: Sequence[str | None], lowered: list[str], i: int, known: list[int]) -> TimeColumns:
    unit = "ns" if lowered[i] in NANOSECONDS else None
    said = WITH_UNIT.fullmatch(lowered[i])
    if said is not None:
        unit = "s" if said.group(1).startswith("s") else said.group(1)
    note = f"time is read from column {names[i]!r}, in {UNIT_WORDS[unit or 's']}"
    return TimeColumns((i,), unit, note, tuple(k for k in known if k != i))
