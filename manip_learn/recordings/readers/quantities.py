"""What the names in a file mean: which quantity, of which joint, is in a column, an entry of a vector or an array.

A name that contains the name of a joint is made by a template, such as `{joint}_velocity` or `position.{joint}`; one
that does not may still have an end of a joint's columns. The words around `{joint}` say the quantity.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import final

from manip_learn.errors import advice, closest_names
from manip_learn.recordings.readers.name_patterns import (
    INDEX,
    JOINT,
    PatternError,
    numbered_families,
    pattern_columns,
    split_end,
    templates,
)
from manip_learn.recordings.readers.read_request import (
    RATE,
    UNIT_WORDS,
    ReadRequest,
    first_names,
    rename_words,
    unmoved_joint_names,
)
from manip_learn.robot import Robot, load_robot
from manip_learn.robot.description.catalogue import SHIPPED

# quantity -> words that say it; the first that has one of its words is meant
_WORDS: dict[str, set[str]] = {
    "other": {
        *("ext", "external"),  # an estimate of what the world exerts, without gravity and friction
        *("current", "acceleration", "acc", "accel", "qdd", "ddq"),
        *("temperature", "temp", "voltage", "force", "error", "errors", "limit", "jerk", "name"),
    },
    # `d` as in libfranka's q_d and tau_J_d
    "command": {
        *("desired", "command", "commanded", "cmd", "target", "goal"),
        *("setpoint", "reference", "ref", "des", "action", "d"),
    },
    "effort": {"effort", "efforts", "torque", "torques", "tau", "moment"},
    "velocity": {"velocity", "velocities", "vel", "qd", "dq", "qdot", "qvel", "speed"},
    "position": {"position", "positions", "pos", "q", "qpos", "angle", "angles", "theta", "rad"},
}
PLOTJUGGLER = "__time"  # the axis of its tables [s]
_PLAIN = re.compile(
    r"(time|times|t|timestamps?|stamp|secs?|seconds|elapsed([_ ]time)?|relative[_ ]time|ros[_ ]?time|unix[_ ]?time"
    r"|epoch|date[_ /]?time|recv_?time|receive[_ ]time|publish[_ ]time|(.*[./])?header[./]stamp)"
)
WITH_UNIT = re.compile(r"(?:elapsed[_ ]?)?(?:time|t|timestamp|stamp)[_ ]?[\[(]?(s|sec|secs|seconds|ms|us|ns)[\])]?")
# what belongs to a message or a data frame, not to the motion
BOOKKEEPING = re.compile(r"(.*[./])?(header[./](seq|frame_id)|seq|frame_id)|unnamed: 0", re.IGNORECASE)
# names of arrays of joint positions: joint_position (DROID), joint_pos, joint_positions, qpos
POSITIONS = re.compile(r"(joint_?pos(ition)?s?|qpos)$", re.IGNORECASE)
# of arrays of a hand, a gripper or a thing, whose positions are not those of the arm's joints
POSES = re.compile(r"eef|(^|_)ee(_|$)|tcp|cart|gripper|finger|hand|object|camera|cos|sin|quat", re.IGNORECASE)
ROLES = {"time": "time", "q": "position", "u": "velocity", "effort": "effort", "joint_names": "names"}  # of arrays
MESSAGES = "this is a table of the messages in a ROS bag (rostopic echo -p, bagpy): give the bag itself, it is read"
_SHOWN = 6  # names in a sentence


def kind_of(name: str) -> str:
    """`position`, `velocity`, `effort`, `command`, `other`, or nothing where the words of a name do not say."""
    if re.search(r"(rad|deg)/s", name.lower()):
        return "velocity"
    words = set(re.findall(r"[a-z]+", re.sub(r"\{\w+\}", " ", name.lower())))
    kinds = [kind for kind, known in _WORDS.items() if words & known]
    return "other" if {"command", "effort"} <= set(kinds) else next(iter(kinds), "")  # such efforts are not measured


@final
@dataclass(frozen=True)
class Columns:
    """Columns of a table.

    Attributes:
        positions: Column -> joint.
        velocities: Column -> joint.
        efforts: Column -> joint.
        strict: Whether columns are called as the joints, by hand: a name that is no joint's is a mistake.
        time: Column of the stamps; None where they are counted at the rate that the caller gives.
        unit: Unit of the stamps where their name says it.
        notes: What the caller should know.
    """

    positions: dict[int, str]
    velocities: dict[int, str]
    efforts: dict[int, str]
    strict: bool = False
    time: int | None = None
    unit: str | None = None
    notes: tuple[str, ...] = ()

    @property
    def used(self) -> list[int]:
        """Columns that are read."""
        stamps = () if self.time is None else (self.time,)
        return sorted({*stamps, *self.positions, *self.velocities, *self.efforts})


def table_columns(header: Sequence[str], first_row: Sequence[str], request: ReadRequest) -> Columns:
    """The columns of a table, by the names in its header.

    Args:
        header: Names; empty for a column without a name.
        first_row: Fields below them.
        request: How it is read.

    Raises:
        RecordingError: No time, a choice that only the caller can make, or a table of messages.
    """
    robot = request.robot
    moving, still = robot.joint_names, unmoved_joint_names(robot)
    names: list[str | None] = []
    for raw, name in zip(header, request.renamed(*header), strict=True):
        is_unread = not name and request.joint_names is not None  # the caller's '-'
        names.append(None if is_unread or request.ignores(raw, name) else name)
    stamps, times = find_time(names)
    time = stamps[0] if len(stamps) == 1 else None
    if time is None and request.rate is None:
        choices = [str(names[i]) for i in stamps]
        near = choices or closest_names("time", [n for n in names if n])[:1] or [n for n in names[:1] if n == ""]
        flags = [advice("{}", f"rename={{{n!r}: 'time'}}", f"--rename {n}=time") for n in near]
        hint = ""
        if choices and all(flags):
            hint = f"; several could be it, choose one: {' or '.join(flags)}"
        elif near and all(flags):
            hint = f"; if {near[0] or 'the first column, which has no name,'!r} is meant, pass {flags[0]} or rename it"
        hint += advice("; without time stamps, pass {}", *RATE)
        raise PatternError(f"there is no column 'time' among {first_names(header, 8)}{hint}", "no-time")
    for pattern, columns in numbered_families(names).items():
        if "name" in pattern.lower() and {first_row[i] for i in columns if i < len(first_row)} & {*moving, *still}:
            raise PatternError(MESSAGES, "messages")
    left_out = {i for i in times if request.columns or names[i] not in moving} | {time}
    joints = [None if i in left_out or BOOKKEEPING.fullmatch(n or "") else n or None for i, n in enumerate(names)]
    found = _asked(joints, request) if request.columns else _by_joint_names(joints, robot, still)
    notes, unit = list(found.notes), None
    if time is not None and (name := str(names[time])) != "time":
        stated = WITH_UNIT.fullmatch(name.strip().lower())
        unit = None if stated is None else "s" if stated.group(1).startswith("s") else stated.group(1)
        notes.insert(0, f"time is read from column {name!r}, in {UNIT_WORDS[unit or 's']}")
    found = replace(found, time=time, unit=unit)
    used = found.used
    for i in used:
        if names[i] in [names[k] for k in used if k < i]:
            raise PatternError(f"two columns are called {names[i]!r}: keep one", "duplicate-column")
    rest = [i for i, n in enumerate(names) if n is not None and i not in used]
    words = [header[i] or f"column {i + 1} (without a name)" for i in rest[:_SHOWN]]
    more = f" and {len(rest) - _SHOWN} more" if len(rest) > _SHOWN else ""
    notes += [f"columns not used: {', '.join(words)}{more}"] if rest else []
    return replace(found, notes=tuple(notes))


def _asked(names: Sequence[str | None], request: ReadRequest) -> Columns:
    """Columns that the caller's patterns name: those of positions, then those of velocities."""
    request.uses.use("columns")
    patterns, moving, still = request.columns, request.robot.joint_names, unmoved_joint_names(request.robot)
    q, *u = (pattern_columns(p, names, moving, still, "columns") for p in patterns)
    if INDEX in patterns[0]:
        numbered = numbered_families(names).items()
        alike = {p: dict(zip(c, q.values(), strict=True)) for p, c in numbered if len(c) == len(q)}
        order = ", ".join(f"{names[i]} as {joint}" for i, joint in q.items())
        notes = (f"columns read in the robot's order, as asked: {order}",)
    else:
        alike, notes = _whole(templates(names, (*moving, *still)), moving) if patterns[0] == JOINT else {}, ()
        u = u or [alike.get(_only_one("velocity", alike, moving), {})]
    return Columns(q, u[0] if u else {}, alike.get(_only_one("effort", alike, moving), {}), notes=notes)


def _whole(made: Mapping[str, dict[int, str]], moving: Iterable[str]) -> dict[str, dict[int, str]]:
    """The templates that have a column for each joint."""
    return {p: c for p, c in made.items() if set(c.values()) >= set(moving)}


def _only_one(kind: str, made: Mapping[str, dict[int, str]], moving: Iterable[str]) -> str:
    """The only template of a quantity, or the only whole one; nothing where there is a choice."""
    fitting = [p for p in _whole(made, moving) if kind_of(p) == kind] or [p for p in made if kind_of(p) == kind]
    return fitting[0] if len(fitting) == 1 else ""


def _by_joint_names(names: Sequence[str | None], robot: Robot, still: Sequence[str]) -> Columns:
    """Columns that are called as joints, or contain their names, where that leaves no choice.

    Columns of positions must be made alike, e.g. `/joint_states/{joint}/position`. Words such as `velocity` say that
    others are meant; those of commands (`target`, `desired`) are never taken for what was measured.

    Raises:
        RecordingError: Several templates fit: says which, and what to type.
    """
    moving, known = robot.joint_names, {*robot.joint_names, *still}
    made = templates(names, (*moving, *still))
    own = {p: c for p, c in made.items() if set(c.values()) & set(moving)}
    measured = [p for p in own if kind_of(p) == "position"] or [p for p in own if not kind_of(p)]
    if JOINT not in own and len(measured) != 1:
        if choices := measured or [p for p in own if kind_of(p) == "command"]:
            flags = " or ".join(advice("{}", f"columns={p!r}", f"--columns '{p}'") or p for p in choices)
            raise PatternError(f"several columns name each joint, or only those of a command do: say which: {flags}")
        if what := "" if own else _numbered_advice(names, moving):
            text = f"{another_robot(names, robot)}; if it is this one, {what}"
            raise PatternError(text, "numbered-columns")
    strict = JOINT in own or not measured
    pool = made if strict else _whole(own, moving)
    u, effort = (_only_one(kind, pool, moving) for kind in ("velocity", "effort"))
    efforts = {i: j for i, j in pool.get(effort, {}).items() if j in known}
    if strict:  # what is called as no joint and as no other quantity is a mistake, which is found later
        q = {i: str(names[i]) for i in sorted(i for p, c in made.items() if kind_of(p) in ("", "position") for i in c)}
        return Columns(q, pool.get(u, {}), efforts, strict=True)
    alike = " and ".join(repr(p) for p in (measured[0], u, effort) if p)
    note = f"columns are read as {alike}, the only ones that name the joints"
    return Columns(own[measured[0]], pool.get(u, {}), efforts, notes=(note,))


def entry_columns(names: Sequence[str], request: ReadRequest) -> Columns:
    """The entries of a vector that a program named after joints, with ends such as `.pos` and `.vel`."""
    columns: dict[str, dict[int, str]] = {kind: {} for kind in ("position", "velocity", "effort")}
    for i, name in enumerate(request.renamed(*names)):
        base, end = split_end(name)
        is_whole = name in request.robot.joint_names or kind_of(end) not in columns
        columns["position" if is_whole else kind_of(end)][i] = name if is_whole else base
    for kind, entries in columns.items():
        columns[kind] = dict(zip(entries, request.renamed(*entries.values()), strict=True))
    return Columns(columns["position"], columns["velocity"], columns["effort"])


def _numbered_advice(names: Sequence[str | None], moving: Sequence[str]) -> str:
    """What to type for numbered columns, with the joints that their numbers would stand for; empty without any."""
    n = len(moving)  # a few numbered columns, as of one wrist, are not the joints of an arm
    families = {p: c for p, c in numbered_families(names).items() if n < 2 * len(c) <= 2 * n}
    positions = [p for p in families if kind_of(p) == "position"] or [p for p in families if not kind_of(p)]
    speeds = [p for p in families if kind_of(p) == "velocity"]
    said = []
    for pattern in positions:
        patterns = [pattern, *(speeds if len(speeds) == 1 == len(positions) else [])]
        order = ", ".join(f"{names[i]} as {j}" for i, j in zip(families[pattern], moving, strict=False))
        python = f"columns={patterns if len(patterns) > 1 else pattern!r}"
        said.append(advice(f"{{}} reads {order}", python, " ".join(f"--columns '{p}'" for p in patterns)))
    return "; or ".join(filter(None, said))


def another_robot(names: Iterable[str | None], robot: Robot) -> str:
    """What to do about a recording whose columns are not joints of the robot; names the shipped one that they fit."""
    recorded = {n.removesuffix("_velocity") for n in names if n and n != "time"}
    fitting = [name for name in SHIPPED if recorded == set(load_robot(name).joint_names)]
    if fitting:
        which = " or ".join(map(repr, fitting))  # arms of one series have joints of the same names
        return f"it was recorded with {which}, not {robot.name!r}: name that robot"
    return f"was it recorded with another robot than {robot.name!r}? Then name that one"


def array_roles(names: Sequence[str]) -> dict[str, str]:
    """What the arrays of a group are (see `ROLES`) -> their names: by a name of its own, else by the words in it.

    Raises:
        RecordingError: Several arrays could be joint positions.
    """
    roles = {role: role for role in ROLES if role in names}
    free = [n for n in names if n not in ROLES]
    stamps, _ = find_time(free)
    if len(stamps) == 1:
        roles.setdefault("time", free[stamps[0]])
    for role, kind in ROLES.items():
        there = [] if role in roles else arrays_of(kind, free)
        if len(there) > 1 and role == "q":
            flags = " or ".join(advice("{}", *rename_words({n: "q"})) or n for n in there[:_SHOWN])
            raise PatternError(f"several arrays could be joint positions: say which: {flags}", "missing-array")
        roles |= {role: there[0]} if len(there) == 1 else {}
    return roles


def arrays_of(kind: str, names: Iterable[str]) -> list[str]:
    """Arrays of joint positions, velocities or efforts, by the words in their names."""
    there = [n for n in names if not POSES.search(n) and (kind_of(n) or POSITIONS.search(n))]
    there = [n for n in there if (kind_of(n) or "position") == kind]
    return [n for n in there if POSITIONS.search(n)] or there


def find_time(names: Sequence[str | None]) -> tuple[list[int], list[int]]:
    """Columns of times: the only one that could be it, or all that could; and those that are known by other names.

    A column `time` is it, or PlotJuggler's, or a message's stamp.
    """
    lowered = ["" if n is None else n.strip().lower() for n in names]
    known = [i for i, n in enumerate(lowered) if n == PLOTJUGGLER or _PLAIN.fullmatch(n) or WITH_UNIT.fullmatch(n)]
    if "time" in names:
        return [names.index("time")], [i for i in known if names[i] != "time"]
    for ends in (PLOTJUGGLER, ("header.stamp", "header/stamp")):
        found = [i for i in known if lowered[i].endswith(ends)]
        if len(found) == 1:
            return found, known
    return known, known
