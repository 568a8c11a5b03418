"""Build a skill from learnt constraints: their order in the recordings, the grasps and the final position."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.features.feature_map import FeatureMap
from manip_learn.constraint.shown import Take, demonstrated_motion
from manip_learn.constraint.skill import MAX_TAKES, Skill, Step
from manip_learn.errors import counted
from manip_learn.learning.answer import Answers
from manip_learn.learning.table import Table
from manip_learn.recordings.trajectory import Trajectory, evenly


class _Contact(NamedTuple):
    """Contact in a recording: number of its constraint, and samples."""

    constraint: int
    piece: Trajectory


def build_skill(constraints: Sequence[Constraint], result: Answers, table: Table) -> Skill:
    """Build the skill from learnt constraints, in the order in which most recordings show them.

    Args:
        constraints: Constraint of each answer, with all its rows.
        result: Answers of the learner, with their stretches.
        table: Samples of all recordings.

    Returns:
        Skill, each step with its demonstrated motion; without steps if the answers have no stretches.
    """
    retreat = 0.02  # [m] smallest motion after the last contact that is a retreat, not only a release
    numbered = [(number, stretch) for number, answer in enumerate(result.answers) for stretch in answer.stretches]
    order: dict[int, list[_Contact]] = {stretch.recording: [] for _, stretch in numbered}
    for number, stretch in sorted(numbered, key=lambda one: one[1].start):
        piece, before = table.moved[stretch.recording][stretch.start : stretch.end], order[stretch.recording]
        if before and before[-1].constraint == number:  # keep the longest of successive contacts with one constraint
            before[-1] = max(before[-1], _Contact(number, piece), key=lambda c: c.piece.duration)
        else:
            before.append(_Contact(number, piece))
    sequences = Counter(tuple(c.constraint for c in contacts) for contacts in order.values())
    if not sequences:
        return Skill(tuple(constraints), ())
    usual, times = sequences.most_common(1)[0]
    usual_ones = {i: contacts for i, contacts in order.items() if tuple(c.constraint for c in contacts) == usual}
    note = f"{times} of {counted(len(order), 'recording')} show the steps in this order; the others differ"
    steps: list[Step] = []
    opening: dict[str, Any] = {}  # of the gripper that closed in the step before
    for place, number in enumerate(usual):
        constraint, pieces = constraints[number], [contacts[place].piece for contacts in usual_ones.values()]
        demonstrated = constraint.shown
        if usual.count(number) > 1:
            demonstrated = demonstrated_motion(constraint.features, constraint.selection, constraint.mechanism, pieces)
        takes = list[Take]()  # joint motions to the contact, along it and away from it
        few = [*usual_ones.items()] if constraint.robot is not None else []
        for recording, contacts in (few[i] for i in evenly(len(few), MAX_TAKES)):
            ends = [float(x) for contact in contacts for x in contact.piece.time[[0, -1]]]
            between = [-np.inf, *ends, np.inf][2 * place : 2 * place + 4]
            takes.append(Take.of(constraint.robot, table.moved[recording], *between))
        reach = Step("reach", constraint, **opening)
        closing, opening = _grip_motion(constraint.features, table, usual_ones, place)
        steps += [reach, Step("way", constraint, demonstrated, takes=tuple(takes), **closing)]
    ends = [(contacts[-1].piece.q[-1], table.moved[recording].q[-1]) for recording, contacts in usual_ones.items()]
    twist = constraints[usual[-1]].features.twist
    if twist is not None:
        poses = twist.poses(np.concatenate(ends).reshape(2 * len(ends), -1))
        last, end = poses[0::2, :3, 3], poses[1::2, :3, 3]
        if np.median(np.linalg.norm(end - last, axis=1)) > retreat:
            steps.append(Step("reach", None, place=np.median(end, axis=0), **opening))
    return Skill(tuple(constraints), tuple(steps), (note,) if times < len(order) else ())


def _grip_motion(features: FeatureMap, table: Table, demos: dict[int, list[_Contact]], k: int) -> list[dict[str, Any]]:
    """Return the arguments of `Step` that close a gripper as contact begins, and the arguments that open it again.

    Both are empty unless in most recordings joints that do not move the hand move or press as contact begins.
    """
    # smallest motion of a finger in a grasp, as a share of its range; smallest rise of its effort, as a share of its
    # largest
    least_move, least_rise = 0.1, 0.5
    robot, frame = getattr(features, "robot", None), getattr(features, "frame", None)
    if robot is None or frame is None or robot.nq != robot.nv:
        return [{}, {}]
    ranges = robot.position_upper - robot.position_lower
    idle = [not robot.moves(name, frame.name) for name in robot.joint_names]
    fingers = np.flatnonzero(idle & np.isfinite(ranges))
    if not len(fingers):
        return [{}, {}]
    grips: list[tuple[np.ndarray, np.ndarray]] = []
    for recording, contacts in demos.items():
        piece, whole = contacts[k].piece, table.moved[recording]
        since = contacts[k - 1].piece.time[-1] if k else -np.inf
        before = (since < whole.time) & (whole.time < piece.time[0])
        in_contact = (piece.time[0] <= whole.time) & (whole.time <= piece.time[-1])
        if not before.any():
            continue
        reach, closed = whole.q[before][:, fingers], np.median(whole.q[in_contact][:, fingers], axis=0)
        opened = reach[np.argmax(np.max(np.abs(reach - closed) / ranges[fingers], axis=1))]
        moves = np.abs(closed - opened) > least_move * ranges[fingers]
        if whole.effort is not None:
            efforts = np.abs(whole.effort[:, fingers])
            rise = np.median(efforts[in_contact], axis=0) - np.median(efforts[before], axis=0)
            moves |= rise > least_rise * np.max(efforts, axis=0)
        if moves.any():
            grips.append((closed, opened))
    if len(grips) <= 0.5 * len(demos):
        return [{}, {}]
    names = [robot.joint_names[i] for i in fingers]
    closed, opened = (dict(zip(names, map(float, q), strict=True)) for q in np.median(grips, axis=0))
    return [{"gripper": "close", "fingers": closed}, {"gripper": "open", "fingers": opened}]
