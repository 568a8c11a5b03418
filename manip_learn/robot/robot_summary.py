"""Summary of a loaded robot, as plain data for printing."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import final

import numpy as np

from manip_learn.errors import MissingExtraError, RobotError
from manip_learn.robot.cross_check import CrossCheck, cross_check
from manip_learn.robot.description.mimic import Mimic
from manip_learn.robot.joints import JointKind
from manip_learn.robot.robot import Robot
from manip_learn.robot.tips import likely_tips
from manip_learn.robot.visuals.visual_shapes import resolve_meshes

UNITS: dict[JointKind, str] = {"prismatic": "m"}


@final
@dataclass(frozen=True)
class JointSummary:
    """One degree of freedom.

    Attributes:
        name: Joint name; `base.x`, `base.rz`, ... for one coordinate of a floating or planar joint.
        kind: What moves.
        unit: `"rad"` or `"m"`.
        lower: Lower limit in that unit, -inf without one.
        upper: Upper limit, inf without one.
        velocity: Velocity limit in that unit per second, inf without one.
    """

    name: str
    kind: JointKind
    unit: str
    lower: float
    upper: float
    velocity: float


@final
@dataclass(frozen=True)
class RobotSummary:
    """What `inspect` prints.

    Attributes:
        name: Name of the robot.
        source: File it was read from, or None.
        nq: Size of a configuration.
        nv: Degrees of freedom.
        joints: One entry per degree of freedom.
        frames: Names of frames.
        mimics: Joints that follow others.
        locked: Joints held still -> position [rad or m].
        tips: Likely tip frames, best first; with more than one, the user must choose.
        warnings: What was ignored or repaired, and meshes that cannot be used.
        cross_check: Independent check of forward kinematics; None if there is none, and the last warning says why.
        meshes_found: Address in the URDF -> file.
        meshes_missing: Address in the URDF -> reason.
        fingerprint: Hash of the kinematics.
    """

    name: str
    source: Path | None
    nq: int
    nv: int
    joints: tuple[JointSummary, ...]
    frames: tuple[str, ...]
    mimics: tuple[Mimic, ...]
    locked: dict[str, float]
    tips: tuple[str, ...]
    warnings: tuple[str, ...]
    cross_check: CrossCheck | None
    meshes_found: dict[str, Path]
    meshes_missing: dict[str, str]
    fingerprint: str


def inspect_robot(robot: Robot, seed: int = 0, postures: int = 10) -> RobotSummary:
    """Summary of a robot, with an independent check of its forward kinematics at random postures."""
    return with_cross_check(summarise(robot), robot, seed, postures)


def with_cross_check(summary: RobotSummary, robot: Robot, seed: int = 0, postures: int = 10) -> RobotSummary:
    """The summary with an independent check of forward kinematics, whose library takes a second to load."""
    try:
        check = cross_check(robot, np.random.default_rng(seed), postures)
    except (RobotError, MissingExtraError) as error:
        said = f"no independent check of forward kinematics: {error}"
        return replace(summary, warnings=(*summary.warnings, said))
    if check.agrees:
        return replace(summary, cross_check=check)
    said = f"yourdfpy puts link {check.link!r} elsewhere (by {check.largest_difference:.2g}): do not trust this file"
    return replace(summary, cross_check=check, warnings=(*summary.warnings, said))


def summarise(robot: Robot) -> RobotSummary:
    """Summary of a robot without the check."""
    meshes = resolve_meshes(robot)
    return RobotSummary(
        name=robot.name,
        source=robot.source,
        nq=robot.nq,
        nv=robot.nv,
        joints=_joints(robot),
        frames=robot.frame_names,
        mimics=robot.mimics,
        locked=dict(robot.locked),
        tips=likely_tips(robot),
        warnings=(*robot.warnings, *meshes.warnings),
        cross_check=None,
        meshes_found=meshes.found,
        meshes_missing=meshes.missing,
        fingerprint=robot.fingerprint,
    )


def _joints(robot: Robot) -> tuple[JointSummary, ...]:
    summaries: list[JointSummary] = []
    for block in robot.blocks:
        for k, name in zip(range(block.v.start, block.v.stop), block.coordinate_names, strict=True):
            is_length = name.endswith((".x", ".y", ".z")) and block.kind in ("floating", "planar")
            summaries.append(
                JointSummary(
                    name=name,
                    kind=block.kind,
                    unit="m" if is_length else UNITS.get(block.kind, "rad"),
                    lower=float(robot.position_lower[k]),
                    upper=float(robot.position_upper[k]),
                    velocity=float(robot.velocity_limit[k]),
                )
            )
    return tuple(summaries)
