"""Mimic joints: the chains of a URDF resolved, and all joints as an affine map of the independent ones."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.errors import RobotError, closest_names
from manip_learn.robot.description.diagnostics import Diagnostics, quoted
from manip_learn.robot.description.urdf_elements import UrdfJoint, UrdfMimic

LARGEST_MULTIPLIER = 1e6


@final
@dataclass(frozen=True)
class Mimic:
    """One mimic joint: position = multiplier * position of `leader` + offset."""

    joint: str
    leader: str
    multiplier: float
    offset: float


@final
@dataclass(frozen=True)
class Coupling:
    """Positions and velocities of all joints as an affine map of the independent ones.

    positions_all = lift @ positions + offset;  velocities_all = lift @ velocities.

    Attributes:
        lift: shape (nv_all, nv).
        offset: shape (nv_all,) [rad or m].
    """

    lift: Float[np.ndarray, "n_all nv"]
    offset: Float[np.ndarray, " n_all"]

    def __post_init__(self) -> None:
        self.lift.setflags(write=False)
        self.offset.setflags(write=False)

    def columns_of(self, rows: Int[np.ndarray, " j"]) -> Int[np.ndarray, " j"] | None:
        """Independent joint of each of these joints, given by their rows; None if one of them follows another."""
        lift = self.lift[rows]
        columns = np.argmax(lift, axis=1)
        alone = np.array_equal(lift, np.eye(lift.shape[1])[columns]) and len(set(columns.tolist())) == len(columns)
        return columns if alone and not np.any(self.offset[rows]) else None


@final
@dataclass(frozen=True)
class Mimics:
    """Where the mimic joints of a robot lead.

    Attributes:
        followers: Each with an independent, moving leader, however long the chain was.
        resting: Position of each mimic joint whose chain ends at a fixed joint [rad or m].
    """

    followers: tuple[Mimic, ...]
    resting: dict[str, float]


def resolve_mimics(joints: tuple[UrdfJoint, ...], alone: frozenset[str], log: Diagnostics) -> Mimics:
    """Follow every chain of mimics to its end, in whatever order the joints come.

    Args:
        joints: All joints.
        alone: Joints that are locked by name: what they follow does not matter.
        log: For warnings and refusals.

    Raises:
        RobotError: Codes `mimic-unknown`, `mimic-cycle`, `mimic-type`, `mimic-multiplier`.
    """
    by_name = {j.name: j for j in joints}
    followers: list[Mimic] = []
    resting: dict[str, float] = {}
    without_effect = [j.name for j in joints if j.mimic is not None and j.type == "fixed"]
    if without_effect:
        log.warn(None, f"<mimic> of the fixed joints {quoted(without_effect)} has no effect")
    for j in joints:
        if j.mimic is None or j.type == "fixed" or _is_alone(j, alone, by_name):
            continue
        leader, multiplier, offset = _end_of_chain(j, alone, by_name, log)
        if leader.type == "fixed":
            resting[j.name] = offset
            log.warn(j.mimic.line, f"joint {j.name!r} follows the fixed joint {leader.name!r}; it rests at {offset:g}")
            continue
        _warn_about_turns(j, leader, multiplier, log)
        followers.append(Mimic(j.name, leader.name, multiplier, offset))
    return Mimics(tuple(followers), resting)


def _is_alone(joint: UrdfJoint, alone: frozenset[str], by_name: dict[str, UrdfJoint]) -> bool:
    # a locked follower whose leader exists still belongs to its chain: locking it alone would break the coupling
    return joint.name in alone and joint.mimic is not None and joint.mimic.leader not in by_name


def _end_of_chain(
    start: UrdfJoint, alone: frozenset[str], by_name: dict[str, UrdfJoint], log: Diagnostics
) -> tuple[UrdfJoint, float, float]:
    multiplier, offset = 1.0, 0.0
    joint, seen = start, [start.name]
    while joint.mimic is not None and joint.type != "fixed" and not _is_alone(joint, alone, by_name):
        _check_type(joint, log)
        mimic = joint.mimic
        offset += multiplier * mimic.offset
        multiplier *= mimic.multiplier
        if mimic.leader not in by_name:
            raise _unknown_leader(joint, mimic, by_name, log)
        joint = by_name[mimic.leader]
        if joint.name in seen:
            where, fix = f"joint {start.name!r}", "let one of them move by itself"
            path = " -> ".join(repr(n) for n in [*seen, joint.name][:6])
            raise log.refusal(
                "mimic-cycle",
                mimic.line,
                where,
                f"joints follow each other in a loop: {path}",
                "a leader is expected",
                fix,
            )
        seen.append(joint.name)
    _check_type(joint, log)
    if not (abs(multiplier) <= LARGEST_MULTIPLIER and math.isfinite(offset)):
        line = None if start.mimic is None else start.mimic.line
        seen_text = f"it follows {joint.name!r} by the factor {multiplier:g}"
        fix = "correct the multiplier"
        raise log.refusal(
            "mimic-multiplier", line, f"joint {start.name!r}", seen_text, f"at most {LARGEST_MULTIPLIER:g} works", fix
        )
    return joint, multiplier, offset


def _check_type(joint: UrdfJoint, log: Diagnostics) -> None:
    if joint.type in ("floating", "planar"):
        seen = f"it is {joint.type}, with {joint.nv} degrees of freedom, and takes part in a <mimic>"
        fix = "delete the <mimic>"
        raise log.refusal("mimic-type", joint.line, f"joint {joint.name!r}", seen, "one degree is expected", fix)


def _unknown_leader(joint: UrdfJoint, mimic: UrdfMimic, by_name: dict[str, UrdfJoint], log: Diagnostics) -> RobotError:
    near = closest_names(mimic.leader, by_name)
    fix = f"did you mean {quoted(near)}?" if near else "correct the name, or lock the joint"
    seen = f"it follows the joint {mimic.leader!r}, which does not exist"
    where, expected = f"joint {joint.name!r}", "a joint of this file is expected"
    return log.refusal("mimic-unknown", mimic.line, where, seen, expected, fix)


def _warn_about_turns(joint: UrdfJoint, leader: UrdfJoint, multiplier: float, log: Diagnostics) -> None:
    line = None if joint.mimic is None else joint.mimic.line
    if multiplier == 0.0:
        log.warn(line, f"joint {joint.name!r} follows {leader.name!r} by the factor 0: it never moves")
    elif leader.type == "continuous" and multiplier != round(multiplier):
        log.warn(
            line,
            f"joint {joint.name!r} follows the continuous joint {leader.name!r} by the factor {multiplier:g}: "
            "it jumps where the leader passes half a turn, unless postures are given as joint positions",
        )
