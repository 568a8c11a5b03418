"""Names of columns: stamps, and patterns such as `position.{joint}` and `q[{index}]`, given or found in a header."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import final

from manip_learn.errors import advice
from manip_learn.recordings.format_words import COMMAND, EFFORT
from manip_learn.recordings.readers.name_patterns import (
    INDEX,
    JOINT,
    PatternError,
    numbered_families,
    pattern_columns,
    templates,
)
from manip_learn.recordings.readers.read_request import UNIT_WORDS
from manip_learn.robot import Robot, load_robot
from manip_learn.robot.description.catalogue import SHIPPED

POSITION = {"position", "positions", "pos", "q", "qpos", "angle", "angles", "theta", "rad"}
VELOCITY = {"velocity", "velocities", "vel", "qd", "dq", "qdot", "qvel", "speed"}
OTHER = {
    *("ext", "external"),  # an estimate of what the world exerts, from which gravity and friction have been taken off
    *("current", "acceleration", "acc", "accel", "qdd", "ddq"),
    *("temperature", "temp", "voltage", "force", "error", "errors", "limit", "jerk", "name"),
}
PLOTJUGGLER = "__time"  # the axis of its tables [s]
PLAIN = re.compile(
    r"(time|times|t|timestamps?|stamp|secs?|seconds|elapsed([_ ]time)?|relative[_ ]time|ros[_ ]?time|unix[_ ]?time"
    r"|epoch|date[_ /]?time|recv_?time|receive[_ ]time|publish[_ ]time|(.*[./])?header[./]stamp)"
)
WITH_UNIT = re.compile(r"(?:elapsed[_ ]?)?(?:time|t|timestamp|stamp)[_ ]?[\[(]?(s|sec|secs|seconds|ms|us|ns)[\])]?")


@final
@dataclass(frozen=True)
class Found:
    """Columns of the joints: of positions, and of velocities and efforts where there are some.

    Attributes:
        positions: Column -> joint.
        velocities: Column -> joint.
        note: How they were found.
        efforts: Column -> joint.
    """

    positions: dict[int, str]
    velocities: dict[int, str]
    note: str
    efforts: dict[int, str] = field(default_factory=dict)


def kind_of(pattern: str) -> str:
    """`position`, `velocity`, `effort`, `command`, `other`, or nothing where its words do not say."""
    if re.search(r"(rad|deg)/s", pattern.lower()):
        return "velocity"
    words = set(re.findall(r"[a-z]+", pattern.replace(JOINT, " ").replace(INDEX, " ").lower()))
    if words & EFFORT and words & COMMAND:  # not what was measured
        return "other"
    kinds = {"other": OTHER, "command": COMMAND, "effort": EFFORT, "velocity": VELOCITY, "position": POSITION}
    for kind, known in kinds.items():
        if words & known:
            return kind
    return ""


def by_patterns(
    patterns: Sequence[str], names: Sequence[str | None], moving: Sequence[str], still: Iterable[str]
) -> Found:
    """Columns that the caller's patterns name: those of positions, then those of velocities.

    Args:
        patterns: One or two.
        names: Of the columns.
        moving: Joints of the robot in its order, which an index counts.
        still: Joints that do not move, which may be recorded too.
    """
    parts = [pattern_columns(p, names, moving, still, "columns") for p in patterns]
    if len(parts) == 1 and JOINT in patterns[0]:
        usual = {i: j for j in moving for i, n in enumerate(names) if n == f"{j}_velocity"}
        parts.append(usual if set(usual.values()) == set(moving) else {})
    note = ""
    if any(INDEX in p for p in patterns):
        listed = ", ".join(f"{names[i]} as {joint}" for i, joint in parts[0].items())
        note = f"columns read in the robot's order, as asked: {listed}"
    efforts = [c for p, c in numbered_families(names).items() if kind_of(p) == "effort" and len(c) == len(parts[0])]
    own = dict(zip(efforts[0], parts[0].values(), strict=True)) if INDEX in patterns[0] and len(efforts) == 1 else {}
    return Found(parts[0], parts[1] if len(parts) > 1 else {}, note, own)


def by_joint_names(names: Sequence[str | None], moving: Sequence[str], still: Sequence[str]) -> Found | None:
    """Columns that contain the names of joints, where they leave no choice; None if there are none.

    All columns of positions must be made alike, e.g. `/joint_states/{joint}/position`. Words such as `velocity` or
    `effort` say that others are meant; those of commands (`target`, `desired`) are never taken for what was measured.

    Raises:
        RecordingError: Several patterns fit: says which, and what to type.
    """
    made = templates(names, (*moving, *still))
    own = {p: c for p, c in made.items() if set(c) & set(moving)}
    if not own:
        return None
    kinds: dict[str, list[str]] = {}
    for pattern in own:
        kinds.setdefault(kind_of(pattern), []).append(pattern)
    candidates = kinds.get("position") or kinds.get("") or []
    velocity, effort = ([p for p in kinds.get(k, []) if set(own[p]) >= set(moving)] for k in ("velocity", "effort"))
    if len(candidates) != 1:
        choices = [*candidates, *([] if candidates else kinds.get("command", []))]
        if not choices:
            return None
        flags = " or ".join(advice("{}", f"columns={p!r}", f"--columns '{p}'") or p for p in choices)
        raise PatternError(f"several columns name each joint, or only those of a command do: say which: {flags}")
    chosen = candidates[0]
    positions = {i: j for j, i in own[chosen].items()}
    speeds = {i: j for j, i in own[velocity[0]].items()} if len(velocity) == 1 else {}
    efforts = {i: j for j, i in own[effort[0]].items()} if len(effort) == 1 else {}
    alike = (f" and {velocity[0]!r}" if speeds else "") + (f" and {effort[0]!r}" if efforts else "")
    note = f"columns are read as {chosen!r}{alike}, the only ones that name the joints"
    return Found(positions, speeds, note, efforts)


def numbered_advice(names: Sequence[str | None], moving: Sequence[str]) -> str:
    """What to type for numbered columns, with the joints that their numbers would stand for; empty without any."""
    n = len(moving)  # a few numbered columns, as of one wrist, are not the joints of an arm
    families = {p: c for p, c in numbered_families(names).items() if n < 2 * len(c) <= 2 * n}
    kinds = {p: kind_of(p) for p in families}
    positions = [p for p in families if kinds[p] == "position"] or [p for p in families if kinds[p] == ""]
    speeds = [p for p in families if kinds[p] == "velocity"]
    said = []
    for pattern in positions:
        patterns = [pattern, *(speeds if len(speeds) == 1 and len(positions) == 1 else [])]
        python = f"columns={patterns if len(patterns) > 1 else pattern!r}"
        order = ", ".join(f"{names[i]} as {j}" for i, j in zip(families[pattern], moving, strict=False))
        said.append(advice(f"{{}} reads {order}", python, " ".join(f"--columns '{p}'" for p in patterns)))
    return "; or ".join(s for s in said if s)


def another_robot(names: Iterable[str | None], robot: Robot) -> str:
    """What to do about a recording whose columns are not joints of the robot; names the shipped one that they fit."""
    recorded = {n.removesuffix("_velocity") for n in names if n and n != "time"}
    fitting = [name for name in SHIPPED if recorded == set(load_robot(name).joint_names)]
    if fitting:
        which = " or ".join(map(repr, fitting))  # arms of one series have joints of the same names
        return f"it was recorded with {which}, not {robot.name!r}: name that robot"
    return f"was it recorded with another robot than {robot.name!r}? Then name that one"


def names_joints(names: Sequence[str | None], values: Sequence[str], joints: Iterable[str]) -> bool:
    """Whether numbered columns of text name the joints, as in tables of the messages in a bag."""
    families, known = numbered_families(names), set(joints)
    return any("name" in p.lower() and known & {values[i] for i in columns} for p, columns in families.items())


@final
@dataclass(frozen=True)
class TimeColumn:
    """Where the stamps are.

    Attributes:
        column: Its number; None if there is none, or several among which the caller must choose.
        unit: Unit that the name says; None: that of any column `time`.
        note: What the caller should know; empty for a column `time`.
        others: Further columns of times, which are not used.
        choices: Names among which the caller must choose.
    """

    column: int | None = None
    unit: str | None = None
    note: str = ""
    others: tuple[int, ...] = ()
    choices: tuple[str, ...] = ()


def find_time(names: Sequence[str | None]) -> TimeColumn:
    """The column `time`, or one that is known by another name: PlotJuggler's, a message's stamp, or the only one."""
    lowered = ["" if n is None else n.strip().lower() for n in names]
    known = [i for i, n in enumerate(lowered) if n == PLOTJUGGLER or PLAIN.fullmatch(n) or WITH_UNIT.fullmatch(n)]
    if "time" in names:
        return TimeColumn(names.index("time"), others=tuple(i for i in known if names[i] != "time"))
    for ends in (PLOTJUGGLER, ("header.stamp", "header/stamp"), ""):
        found = [i for i in known if lowered[i].endswith(ends)]
        if len(found) == 1:
            break
    else:
        return TimeColumn(choices=tuple(str(names[i]) for i in known))
    (column,) = found
    said = WITH_UNIT.fullmatch(lowered[column])
    unit = None if said is None else "s" if said.group(1).startswith("s") else said.group(1)
    note = f"time is read from column {names[column]!r}, in {UNIT_WORDS[unit or 's']}"
    return TimeColumn(column, unit, note, tuple(i for i in known if i != column))
