"""Skill from constraints: their order in the recordings, the grasps and the end."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.shown import poses_of, shown_by
from manip_learn.constraint.skill import Skill, Step
from manip_learn.errors import counted
from manip_learn.learning.answer import Answer, Found
from manip_learn.learning.table import Table
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.robot import Robot

LEAVES = 0.02  # [m] that a hand goes after its last contact if it was taken away from there, and not only let go
GRIPS = 0.1  # share of its range that a gripper's joint moves when it closes or opens
PRESSES = 0.5  # share of its largest effort by which that of a gripper's joint rises when it closes on something


class _Contact(NamedTuple):
    """Contact in a recording: number of its constraint, start [s], and samples."""

    constraint: int
    start: float
    piece: Trajectory


def skill_of(constraints: Sequence[Constraint], found: Found, table: Table) -> Skill:
    """Return the constraints in the order in which most recordings show them, each with the motion shown there."""
    answers = found.answers
    order = _contacts_in_order(answers, table)
    sequences = Counter(tuple(c.constraint for c in contacts) for contacts in order.values())
    if not sequences:
        return Skill(tuple(constraints), ())
    usual, times = sequences.most_common(1)[0]
    chosen = {i: contacts for i, contacts in order.items() if tuple(c.constraint for c in contacts) == usual}
    notes = ()
    if times < len(order):
        notes = (f"{times} of {counted(len(order), 'recording')} show the steps in this order; the others differ",)
    steps: list[Step] = []
    grips: _Grip | None = None  # of the way before
    for place, number in enumerate(usual):
        constraint, pieces = constraints[number], [contacts[place].piece for contacts in chosen.values()]
        shown = constraint.shown
        if usual.count(number) > 1:
            shown = shown_by(constraint.features, constraint.selection, constraint.mechanism, pieces)
        grip = _gripping(constraints, table, chosen, place)
        steps.append(_reach(constraint, grips))
        way = Step("way", constraint, shown)
        steps.append(way if grip is None else replace(way, gripper="close", fingers=grip.closed))
        grips = grip
    end = _end_of(constraints[usual[-1]], table, chosen)
    if end is not None:
        steps.append(replace(_reach(None, grips), place=end))
    return Skill(tuple(constraints), tuple(steps), notes)


def _contacts_in_order(answers: Sequence[Answer], table: Table) -> dict[int, list[_Contact]]:
    """Return the contacts of each recording in order; of successive contacts with one constraint, the longest."""
    found: dict[int, list[_Contact]] = {}
    for number, answer in enumerate(answers):
        for stretch in answer.stretches:
            contact = _Contact(number, stretch.start, table.piece(stretch))
            found.setdefault(stretch.recording, []).append(contact)
    out: dict[int, list[_Contact]] = {}
    for recording, contacts in found.items():
        kept: list[_Contact] = []
        for contact in sorted(contacts, key=lambda c: c.start):
            if kept and kept[-1].constraint == contact.constraint:
                kept[-1] = max(kept[-1], contact, key=lambda c: c.piece.duration)
            else:
                kept.append(contact)
        out[recording] = kept
    return out


class _Grip(NamedTuple):
    """Positions of the joints of a gripper during a grasp, and before [rad or m]."""

    closed: dict[str, float]
    opened: dict[str, float]


def _reach(constraint: Constraint | None, grip: _Grip | None) -> Step:
    """Return the step to a constraint; a closed gripper is opened first."""
    return Step("reach", constraint) if grip is None else Step("reach", constraint, None, "open", None, grip.opened)


def _gripping(
    constraints: Sequence[Constraint], table: Table, chosen: dict[int, list[_Contact]], place: int
) -> _Grip | None:
    """Return the gripper, if in most recordings joints that do not move the hand move or press as contact begins."""
    features = constraints[next(iter(chosen.values()))[place].constraint].features
    robot: Robot | None = getattr(features, "robot", None)
    frame = getattr(features, "frame", None)
    if robot is None or frame is None or robot.nq != robot.nv:
        return None
    ranges = robot.position_upper - robot.position_lower
    idle = [not robot.moves(name, frame.name) for name in robot.joint_names]
    fingers = np.flatnonzero(idle & np.isfinite(ranges))
    if not len(fingers):
        return None
    grips: list[tuple[np.ndarray, np.ndarray]] = []
    for recording, contacts in chosen.items():
        piece, whole = contacts[place].piece, table.moved[recording]
        since = contacts[place - 1].piece.time[-1] if place else -np.inf
        before = (since < whole.time) & (whole.time < piece.time[0])
        held = (piece.time[0] <= whole.time) & (whole.time <= piece.time[-1])
        if not before.any():
            continue
        reach, closed = whole.q[before][:, fingers], np.median(whole.q[held][:, fingers], axis=0)
        opened = reach[np.argmax(np.max(np.abs(reach - closed) / ranges[fingers], axis=1))]
        moves = np.abs(closed - opened) > GRIPS * ranges[fingers]
        if whole.effort is not None:
            efforts = np.abs(whole.effort[:, fingers])
            rise = np.median(efforts[held], axis=0) - np.median(efforts[before], axis=0)
            moves |= rise > PRESSES * np.max(efforts, axis=0)
        if moves.any():
            grips.append((closed, opened))
    if len(grips) <= 0.5 * len(chosen):
        return None
    closed, opened = np.median(grips, axis=0)
    names = [robot.joint_names[i] for i in fingers]
    return _Grip(*(dict(zip(names, map(float, values), strict=True)) for values in (closed, opened)))


def _end_of(constraint: Constraint, table: Table, chosen: dict[int, list[_Contact]]) -> Float[np.ndarray, " 3"] | None:
    """Return the position of the hand at the end of the recordings, if it left the last contact [m]."""
    ends, away = [], []
    for recording, contacts in chosen.items():
        both = np.stack([contacts[-1].piece.q[-1], table.moved[recording].q[-1]])
        poses = poses_of(constraint.features, both)
        if poses is None:
            return None
        ends.append(poses[1, :3, 3])
        away.append(float(np.linalg.norm(poses[1, :3, 3] - poses[0, :3, 3])))
    return np.median(ends, axis=0) if np.median(away) > LEAVES else None
