"""MJCF -> links and joints like those of a URDF, so that gate, limits, mimics and locking are the same.

Pinocchio's own MJCF reader is not used: 4.1 reads `axisangle` and `eulerseq` wrongly, scales the range of sliding
joints like an angle, drops all but the first body of the world, and leaves couplings out.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

from manip_learn.robot.description.diagnostics import GateLog
from manip_learn.robot.description.kinematic_urdf import kinematic_urdf
from manip_learn.robot.description.mjcf_reader import couplings, read_bodies, unreadable
from manip_learn.robot.description.validation import Passed, pass_parts
from manip_learn.robot.description.xml_node import parse_xml


def check_mjcf(content: bytes, path: Path, locked: Collection[str] = ()) -> tuple[Passed, bytes]:
    """Read and check an MJCF file.

    Joints coupled by a linear `<equality><joint>` become mimic joints; sites become frames.

    Returns:
        What passed, and the same robot as a URDF with its shapes.

    Raises:
        RobotError: As for a URDF, and codes `mjcf-element`, `mjcf-class`, `mjcf-compiler`, `mjcf-orientation`,
            `mjcf-coupling`.
    """
    log = GateLog(path)
    root = parse_xml(content, path)
    unreadable(root, log)
    parts = read_bodies(root, log)
    follows = couplings(root, parts, log)
    joints = tuple(replace(j, mimic=follows.get(j.name)) for j in parts.joints)
    if any(j.nv == 1 for j in joints):
        log.warn(None, "an MJCF file has no velocity limits; they are taken as unlimited")
    if not parts.has_mass:
        log.warn(None, "no body states its mass; masses of shapes are not computed, so there is no centre of mass")
    name = root.attributes.get("model", "").strip() or path.stem
    passed = pass_parts(name, tuple(parts.links), joints, locked, log)
    return passed, kinematic_urdf(passed.urdf, parts.visuals, with_mimics=True).encode()
