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
    """Facts about one degree of freedom.

    Attributes:
        name: Joint name; `base.x`, `base.rz`, ... for one coordinate of a floating or planar joint.
        kind: Type of the joint.
        unit: `"rad"` or `"m"`.
        lower: Lower position limit [`unit`], -inf without one.
        upper: Upper position limit [`unit`], inf without one.
        velocity: Velocity limit [`unit` per second], inf without one.
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
    """Comparison of the forward kinematics from two independent readers of one URDF.

    Attributes:
        largest_difference: Largest difference of an entry of a link's pose (4, 4) relative to its parent link, over all
            links and configurations (positions in m, rotations without a unit).
        link: Link with the largest difference.
        postures: Number of random configurations.
        links: Number of compared links.
        left_out: Sentence about parts that were not compared; empty if all were.
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
    """Facts about a robot, as printed by `manip-learn inspect`.

    Attributes:
        name: Name of the robot.
        source: File from which it was read; None if it was not read from a file.
        nq: Size of a configuration.
        nv: Degrees of freedom.
        joints: One entry per degree of freedom.
        frames: Names of frames.
        mimics: Mimic joints.
        locked: Locked joint -> position [rad or m].
        tips: Frames that are likely to be the tip, the most likely first; if there are several, the user must choose.
        moving_tip: Names of the joints that move the first of these frames.
        shapes: Sentence about the shapes used for collision checks.
        warnings: Sentences about ignored and repaired parts of the description, and unusable meshes.
        cross_check: Independent check of forward kinematics; None if it was not possible, with the reason as the last
            warning.
        meshes_found: Address of a mesh in the URDF -> file.
        meshes_missing: Address of a mesh in the URDF -> reason why it was not found.
        fingerprint: `Robot.fingerprint`.
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
    """Summarise a robot, and check its forward kinematics with a second reader at random configurations.

    Args:
        robot: A loaded robot.
        seed: Seed of the random configurations.
        postures: Number of random configurations.

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
    """Compare the pose of every link at random configurations with the pose that yourdfpy computes from the same URDF.

    Args:
        robot: A loaded robot.
        rng: Source of random numbers.
        n: Number of configurations.

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
