"""Constraints that are parts of one mechanism: a short piece of an arc is a line, and found as one beside the arc."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence

import numpy as np

from manip_learn.constraint.mechanism import Mechanism
from manip_learn.learning.answer import Answer
from manip_learn.learning.division import Part
from manip_learn.learning.phases.result import Stretch
from manip_learn.recordings.demonstrations import Demonstrations

# axes and places of one mechanism, learnt from different parts of it, differ by less: standard deviations, and at
# least [deg] and [m]
DEVIATIONS, ANGLE, DISTANCE = 5.0, 1.0, 0.01
# between two parts of one contact no more than this is lost to the search for its boundaries [s]
NEAR = 0.6


def same_mechanism(one: Answer, other: Answer) -> bool:
    """Whether two answers are about one hinge, within what is known of its axis."""
    first, second = _mechanism(one), _mechanism(other)
    if first is None or second is None or first.type != "hinge" or second.type != "hinge":
        return False
    if first.axis is None or second.axis is None or first.point is None or second.point is None:
        return False
    sine = float(np.linalg.norm(np.cross(first.axis, second.axis)))
    apart = second.point - first.point
    apart = apart - (apart @ first.axis) * first.axis
    return bool(
        np.degrees(np.arcsin(min(sine, 1.0))) < max(ANGLE, _tolerance(first, second, "axis"))
        and np.linalg.norm(apart) < max(DISTANCE, _tolerance(first, second, "point"))
    )


def joined(parts: Sequence[Part], demonstrations: Demonstrations, without: Collection[int] = ()) -> Part:
    """One part from several: stretches of a recording that follow each other closely are one contact.

    Args:
        parts: What one constraint is learnt from each.
        demonstrations: The recordings as they are.
        without: Numbers of trajectories that do not belong.
    """
    stretches: list[Stretch] = []
    every = [s for part in parts for s in part.stretches if s.trajectory not in without]
    for s in sorted(every, key=lambda s: (s.trajectory, s.start)):
        last = stretches[-1] if stretches else None
        if last is not None and last.trajectory == s.trajectory and s.start - last.end <= NEAR:
            stretches[-1] = Stretch(s.trajectory, last.start, max(last.end, s.end))
        else:
            stretches.append(s)
    cut = [demonstrations[s.trajectory][s.start : s.end] for s in stretches]
    counts = [part.n_constraints for part in parts if part.n_constraints is not None]
    members = Demonstrations(cut, demonstrations.notes)
    return dataclasses.replace(
        parts[0], demonstrations=members, stretches=tuple(stretches), n_constraints=min(counts, default=None)
    )


def _mechanism(answer: Answer) -> Mechanism | None:
    return None if answer.mechanism is None else answer.mechanism.mechanism


def _tolerance(first: Mechanism, second: Mechanism, name: str) -> float:
    return DEVIATIONS * float(np.hypot(first.uncertainty.get(name, 0.0), second.uncertainty.get(name, 0.0)))
