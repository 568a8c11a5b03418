"""MJCF -> `Robot`, through Pinocchio's reader."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin

from manip_learn.errors import RobotError, UnknownNameError
from manip_learn.robot.c_stderr import captured_c_stderr
from manip_learn.robot.coupling import Mimic
from manip_learn.robot.gate_log import GateLog, quoted
from manip_learn.robot.locking import Locked, names_of
from manip_learn.robot.robot import Robot
from manip_learn.robot.urdf_tree import MAX_DEPTH, MAX_LINKS, MAX_NV
from manip_learn.robot.xml_node import XmlNode, parse_xml

DEGREES_OF_FREEDOM = {"hinge": 1, "slide": 1, "ball": 3, "free": 6}


def load_mjcf(
    content: bytes,
    path: Path,
    package_dirs: Sequence[Path],
    locked: Locked,
    root_joint: pin.JointModel | None,
) -> Robot:
    """Robot from an MJCF file.

    Joints coupled by a linear `<equality><joint>` become mimic joints; any other coupling is refused.

    Raises:
        RobotError: Codes `mjcf-include`, `mjcf-coupling`, `mjcf-joint`, `pinocchio`, `counts`, and those of size.
        UnknownNameError: A locked joint that does not exist.
    """
    log = GateLog(path)
    root = parse_xml(content, path)
    mimics = check_mjcf(root, log)
    warnings = list(log.warnings)
    try:
        with captured_c_stderr() as lines:
            model = (
                pin.buildModelFromMJCF(str(path))
                if root_joint is None
                else pin.buildModelFromMJCF(str(path), root_joint)
            )
    except (ValueError, RuntimeError, IndexError) as error:
        said = " ".join([*lines, str(error)])
        raise RobotError(f"{path}: Pinocchio refuses the robot: {said[:500]}", code="pinocchio", path=path) from error
    warnings += [f"Pinocchio: {line}" for line in lines]
    still = _still(model, mimics, locked)
    fingerprint = hashlib.sha256(content + repr((sorted(still.items()), root_joint is not None)).encode()).hexdigest()
    if still:
        q = pin.neutral(model)
        for name, position in still.items():
            joint = model.joints[model.getJointId(name)]
            if joint.nv == 1:
                x = (np.cos(position), np.sin(position)) if joint.nq == 2 else position
                q[joint.idx_q : joint.idx_q + joint.nq] = x
        model = pin.buildReducedModel(model, [model.getJointId(n) for n in still], q)
    return Robot(
        model,
        name=root.attributes.get("model") or path.stem,
        source=path,
        package_dirs=package_dirs,
        fingerprint=fingerprint,
        mimics=[m for m in mimics if m.joint not in still],
        locked=still,
        warnings=warnings,
    )


def check_mjcf(root: XmlNode, log: GateLog) -> list[Mimic]:
    """Size and shape of an MJCF tree; its linear joint couplings.

    Raises:
        RobotError: The file is too large, includes others, or couples joints in a way that cannot be kept.
    """
    bodies = joints = nv = 0
    for depth, node in _walk(root):
        if node.tag == "include":
            fix = "write one file without <include>"
            raise log.refusal(
                "mjcf-include", node.line, "the file", "it includes another file", "one file is read", fix
            )
        bodies += node.tag == "body"
        if node.tag in ("joint", "freejoint") and "site" not in node.attributes:
            joints += 1
            nv += 6 if node.tag == "freejoint" else DEGREES_OF_FREEDOM.get(node.attributes.get("type", "hinge"), 1)
        for key, value in node.attributes.items():
            if any(not math.isfinite(x) for x in _numbers(value)):
                seen = f'{node.tag} {key}="{value[:60]}"'
                fix = "write the true value"
                raise log.refusal("not-finite", node.line, "the file", seen, "finite numbers are wanted", fix)
        if depth > MAX_DEPTH:
            raise log.refusal(
                "too-deep", node.line, "the bodies", "they nest too deep", f"at most {MAX_DEPTH} work", "merge"
            )
    for what, number, most, code in (
        ("bodies", bodies, MAX_LINKS, "too-many-links"),
        ("degrees of freedom", nv, MAX_NV, "too-many-dof"),
    ):
        if number > most:
            fix = "leave out what the arm does not need"
            raise log.refusal(code, None, "the robot", f"it has {number} {what}", f"at most {most} work", fix)
    return _couplings(root, log)


def _walk(root: XmlNode) -> Iterator[tuple[int, XmlNode]]:
    pending = [(0, root)]
    while pending:
        depth, node = pending.pop()
        yield depth, node
        pending += [(depth + 1, c) for c in reversed(node.children)]


def _numbers(text: str) -> list[float]:
    out = []
    for word in text.split()[:1000]:
        try:
            out.append(float(word))
        except ValueError:
            return []
    return out


def _couplings(root: XmlNode, log: GateLog) -> list[Mimic]:
    mimics = []
    for node in (e for group in root.all("equality") for e in group.children):
        first, second = node.attributes.get("joint1"), node.attributes.get("joint2")
        if node.tag != "joint" or first is None:
            log.warn(node.line, f"<equality><{node.tag}> is ignored: it closes a chain, which kinematics here does not")
            continue
        coefficients = _numbers(node.attributes.get("polycoef", "0 1 0 0 0")) + [0.0] * 5
        if second is None or any(coefficients[2:5]):
            fix = "make it linear, or lock the joint"
            seen = "it couples joints by a polynomial" if second else "it holds a joint at a constant"
            raise log.refusal("mjcf-coupling", node.line, f"joint {first!r}", seen, "a line is wanted", fix)
        mimics.append(Mimic(first, second, coefficients[1], coefficients[0]))
    followers = [m.joint for m in mimics]
    if len(set(followers)) != len(followers) or any(m.leader in followers for m in mimics):
        seen = f"{quoted(followers)} follow each other"
        raise log.refusal("mjcf-coupling", None, "<equality>", seen, "one leader a joint is wanted", "simplify it")
    return mimics


def _still(model: pin.Model, mimics: list[Mimic], locked: Locked) -> dict[str, float]:
    names = list(model.names)[1:]
    still: dict[str, float] = {}
    for name in names_of(locked):
        if name not in names:
            raise UnknownNameError("joint", name, names, f"robot {model.name!r}")
        value = locked[name] if isinstance(locked, dict) else None
        joint = model.joints[model.getJointId(name)]
        lower, upper = (
            (float(limits[joint.idx_q]) for limits in (model.lowerPositionLimit, model.upperPositionLimit))
            if joint.nq == joint.nv == 1
            else (-math.inf, math.inf)
        )
        still[name] = min(max(0.0, lower), upper) if value is None else float(value)
    for m in mimics:
        if m.leader in still:
            still[m.joint] = m.multiplier * still[m.leader] + m.offset
        elif m.joint in still:
            raise RobotError(
                f"joint {m.joint!r} cannot be locked alone: it follows {m.leader!r}; lock that joint",
                code="locked-follower",
            )
    return still
