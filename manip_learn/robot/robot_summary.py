"""Summary of a loaded robot as plain data, with an independent check of its forward kinematics by yourdfpy."""

from __future__ import annotations

import io
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from manip_learn.errors import RobotError
from manip_learn.robot.collision import describe_shapes
from manip_learn.robot.description.text import quoted
from manip_learn.robot.joints import JointKind, Mimic
from manip_learn.robot.robot import Robot
from manip_learn.robot.tips import likely_tips
from manip_learn.robot.visuals.visual_shapes import resolve_meshes, shape_faults


@final
@dataclass(frozen=True)
class JointSummary:
    """One degree of freedom.

    Attributes:
        name: Joint name; `base.x`, `base.rz`, ... for one coordinate of a floating or planar joint.
        kind: Type of the joint.
        unit: `"rad"` or `"m"`.
        lower: Lower limit in that unit, -inf without one.
        upper: Upper limit in that unit, inf without one.
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
class CrossCheck:
    """Difference between two readers of one URDF.

    Attributes:
        largest_difference: Largest difference of an entry of the 4x4 poses of links relative to their parents, over all
            links and postures [m, and no unit].
        link: Link with the largest difference.
        postures: Number of random postures.
        links: Number of links compared.
        left_out: Parts that were not compared, in a sentence; empty if everything was.
    """

    largest_difference: float
    link: str
    postures: int
    links: int
    left_out: str = ""

    @property
    def agrees(self) -> bool:
        """True if no entry differs by more than 1e-9."""
        return self.largest_difference <= 1e-9  # [m, and no unit] rounding along 100 joints stays below


@final
@dataclass(frozen=True)
class RobotSummary:
    """Facts about a robot that `inspect` prints.

    Attributes:
        name: Name of the robot.
        source: File it was read from, or None.
        nq: Size of a configuration.
        nv: Degrees of freedom.
        joints: One entry per degree of freedom.
        frames: Names of frames.
        mimics: Mimic joints.
        locked: Locked joint -> position [rad or m].
        tips: Likely tip frames, best first; with more than one, the user must choose.
        moving_tip: Joints that move the first of them.
        shapes: Sentence on the shapes that count for collisions.
        warnings: Ignored and repaired parts, and unusable meshes.
        cross_check: Independent check of forward kinematics; None if it failed, with the reason as the last warning.
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
    moving_tip: tuple[str, ...]
    shapes: str
    warnings: tuple[str, ...]
    cross_check: CrossCheck | None
    meshes_found: dict[str, Path]
    meshes_missing: dict[str, str]
    fingerprint: str


def inspect_robot(robot: Robot, seed: int = 0, postures: int = 10) -> RobotSummary:
    """Summarise a robot, with an independent check of its forward kinematics at random postures.

    Args:
        robot: A loaded robot.
        seed: Seed of the random postures.
        postures: Number of random postures.

    Returns:
        The summary; its warnings include a failed or impossible check.
    """
    files, missing = resolve_meshes(robot)
    missing |= resolve_meshes(robot, "collision")[1]
    warnings, check = [*robot.warnings, *shape_faults(robot, "collision", "visual")], None
    try:
        check = cross_check(robot, np.random.default_rng(seed), postures)
    except RobotError as error:
        warnings.append(f"no independent check of forward kinematics: {error}")
    if check is not None and not check.agrees:
        off = f"{check.largest_difference:.2g}"
        warnings.append(f"yourdfpy puts link {check.link!r} elsewhere (by {off}): do not trust this file")
    kinds = [block.kind for block in robot.blocks for _ in block.units]
    limits = (robot.position_lower.tolist(), robot.position_upper.tolist(), robot.velocity_limit.tolist())
    tips = likely_tips(robot)
    return RobotSummary(
        **{name: getattr(robot, name) for name in ("name", "source", "nq", "nv", "mimics", "fingerprint")},
        joints=tuple(map(JointSummary, robot.joint_names, kinds, robot.joint_units, *limits)),
        frames=robot.frame_names,
        locked=dict(robot.locked),
        tips=tips,
        moving_tip=tuple(j for j in robot.joint_names if tips and robot.moves(j, tips[0])),
        shapes=describe_shapes(robot),
        warnings=tuple(warnings),
        cross_check=check,
        meshes_found=files,
        meshes_missing=missing,
    )


def cross_check(robot: Robot, rng: np.random.Generator, n: int = 10) -> CrossCheck:
    """Compare the pose of every link at random postures with yourdfpy's pose from the same URDF.

    Args:
        robot: A loaded robot.
        rng: Source of the postures.
        n: Number of postures.

    Returns:
        The largest difference and its link.

    Raises:
        RobotError: The robot did not come from a URDF, or yourdfpy cannot read it; code `cross-check`.
    """
    if robot.description is None:
        raise RobotError(f"robot {robot.name!r} did not come from a URDF: nothing to compare with", code="cross-check")
    import yourdfpy
    from lxml import etree

    logger = logging.getLogger("yourdfpy.urdf")  # it warns of meshes and mimics, which validation has already handled
    before, logger.disabled = logger.disabled, True
    try:
        bare = {"build_scene_graph": False, "build_collision_scene_graph": False, "load_meshes": False}
        tree = etree.fromstring(robot.description, etree.XMLParser(recover=True))
        tree.set("name", tree.get("name", robot.name))
        parsed = yourdfpy.URDF.load(io.BytesIO(etree.tostring(tree)), **bare).robot
        for link in parsed.links:
            link.visuals, link.collisions = [], []
        joints = {j.name: j for j in parsed.joints}
        for j in parsed.joints:  # yourdfpy does not move these, but counts their coordinates as coordinates of leaders
            j.type = "fixed" if j.type in ("floating", "planar") else j.type
        for j in (j for j in parsed.joints if j.mimic is not None):
            if j.mimic.joint not in joints:  # its leader is locked: otherwise validation would have failed
                j.mimic = None
                continue
            # yourdfpy takes a mimic of a mimic for a mimic of a joint at rest: shorten the chains for it
            while (leader := joints[j.mimic.joint]).mimic is not None and leader.type != "fixed":
                j.mimic.offset += j.mimic.multiplier * leader.mimic.offset
                j.mimic.multiplier *= leader.mimic.multiplier
                j.mimic.joint = leader.mimic.joint
        return _compare(yourdfpy.URDF(robot=parsed, **(bare | {"build_scene_graph": True})), robot, rng, n)
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, yourdfpy.urdf.URDFError) as error:
        reason = f"({type(error).__name__}: {str(error)[:200]})"
        raise RobotError(f"yourdfpy cannot read robot {robot.name!r} {reason}", code="cross-check") from error
    finally:
        logger.disabled = before


def _compare(other: Any, robot: Robot, rng: np.random.Generator, n: int) -> CrossCheck:
    """Return the largest difference between a robot and yourdfpy's model of it at n random postures."""
    skipped = [b.name for b in robot.blocks if b.kind not in ("revolute", "prismatic", "continuous")]
    moves = np.array([b.name not in skipped for b in robot.blocks for _ in b.coordinate_names])
    largest, where = 0.0, other.base_link
    for _ in range(n):
        positions = np.where(moves, robot.positions(robot.random_configuration(rng)), 0.0)
        by_name = dict(zip(robot.joint_names, positions.tolist(), strict=True)) | robot.locked
        other.update_cfg({name: by_name.get(name, 0.0) for name in other.actuated_joint_names})
        poses = {link: robot.pose(positions, link) for link in other.link_map}
        for j in other.robot.joints:  # compare link by link: computing each pose in the base takes n^3
            ours = np.linalg.solve(poses[j.parent], poses[j.child])
            difference = float(np.abs(ours - other.get_transform(frame_to=j.child, frame_from=j.parent)).max())
            if not difference <= largest:
                largest, where = difference, j.child
    left_out = f"the motion of {quoted(skipped)}, which yourdfpy does not move" if skipped else ""
    return CrossCheck(largest, where, n, len(other.link_map), left_out)
