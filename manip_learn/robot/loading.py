"""Load robots by name or from files."""

from __future__ import annotations

import hashlib
import math
import os
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import pinocchio as pin

from manip_learn.errors import RobotError, UnknownNameError
from manip_learn.robot.description import urdf as plain
from manip_learn.robot.description.catalogue import find_robot
from manip_learn.robot.description.mjcf import validate_mjcf
from manip_learn.robot.description.text import parse_xml, read_description
from manip_learn.robot.description.urdf import UrdfFile, UrdfJoint, UrdfLink, as_matrix, as_pose
from manip_learn.robot.description.xacro_expansion import expand_xacro
from manip_learn.robot.joints import COORDINATE_SUFFIXES
from manip_learn.robot.robot import Robot
from manip_learn.robot.visuals.meshes import find_package

Base = Literal["fixed", "floating", "planar"]
Locked = Sequence[str] | Mapping[str, float | None]
DESCRIPTION_SUFFIXES = (".urdf", ".xml", ".xacro", ".mjcf")
BASES = {"floating": pin.JointModelFreeFlyer, "planar": pin.JointModelPlanar}
# a number of a description, between quotes or spaces
DECIMAL = re.compile(r'(?<=["\s])-?\d+(\.\d+)?(e[+-]?\d+)?(?=["\s])')


def load_robot(
    name: str | os.PathLike[str],
    package_dirs: Sequence[str | os.PathLike[str]] = (),
    locked: Locked = (),
    *,
    base: Base = "fixed",
    xacro: bool | Mapping[str, str] = False,
    objects: Sequence[str] = (),
) -> Robot:
    """Load a robot by its name or from a file; `Robot.warnings` lists repaired and ignored parts.

    Args:
        name: `"planar3"`, `"sawyer"`, a robot of example-robot-data such as `"panda"`, or the path of a URDF or MJCF
            file. The name of an existing file, or a name that ends in .urdf, .xml, .mjcf or .xacro, is a path.
        package_dirs: Folders that contain the packages of `package://` meshes and of `$(find ...)` in xacro files. Not
            needed for the kinematics of a URDF.
        locked: Names of joints to lock, at zero or at the limit nearest to zero; or a mapping from joints to positions
            [rad or m], with None for that default.
        base: `"fixed"` fixes the root link; `"floating"` lets it move in space, `"planar"` in the plane.
        xacro: True, or a mapping with the file's arguments such as `{"ur_type": "ur5e"}`, to expand a .xacro file. Off
            by default, because the expansion evaluates expressions of the file's author.
        objects: Names of objects whose pose is recorded together with the joints, e.g. `("box",)`: each becomes a link
            on a floating joint, both of that name, attached to the root link, with six more degrees of freedom
            `box.x box.y box.z box.rx box.ry box.rz` (position [m] and rotation vector [rad] in the root link's frame)
            without limits. No motor moves them: a controller for such a robot commands their twist too.

    Returns:
        The robot.

    Raises:
        UnknownNameError: The robot or a locked joint does not exist; lists near matches.
        MissingExtraError: The robot or the file format needs a package that is not installed.
        RobotError: The description is invalid. The error has a `code`; the message names the file, the line, the joint
            or link, the actual value and the remedy.

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("sawyer")  # or "my_arm.urdf"
        >>> robot.nv, robot.joint_names[0]
        (7, 'right_j0')
    """
    if isinstance(name, str) and not name.strip():
        raise RobotError("no robot is named; pass a name such as 'panda' or the path of a URDF file", code="missing")
    package_folders = [package_dirs] if isinstance(package_dirs, str | os.PathLike) else package_dirs
    try:
        path, *folders = (Path(place).expanduser() for place in (name, *package_folders))
    except RuntimeError as error:  # ~user without a home directory here
        places = ", ".join(os.fspath(place) for place in (name, *package_folders))
        raise RobotError(f"{places}: {error}; write the path out", code="missing") from error
    if isinstance(name, str) and path.suffix not in DESCRIPTION_SUFFIXES and os.sep not in name:
        path = path if path.is_file() else find_robot(name)
    for folder in folders:
        if not folder.is_dir():
            raise RobotError(f"package folder {folder}: there is no such folder; check the path", code="package-dir")
    if base not in ("fixed", *BASES):
        raise RobotError(f"base is {base!r}; it must be one of 'fixed', 'floating', 'planar'", code="base")
    root_joint = BASES[base]() if base in BASES else None
    if isinstance(xacro, Mapping) and path.suffix != ".xacro":
        sentence = f"this is not a .xacro file, so it has no arguments: remove {', '.join(map(str, xacro))}"
        raise RobotError(f"{path}: {sentence}", code="xacro-arg", path=path)
    find = partial(find_package, urdf=path, package_dirs=folders)
    content = expand_xacro(path, xacro, folders, find) if path.suffix == ".xacro" else read_description(path)
    return robot_from_text(content, path, package_dirs=folders, locked=locked, root_joint=root_joint, objects=objects)


def robot_from_text(
    content: bytes,
    path: Path,
    *,
    package_dirs: Sequence[Path] = (),
    locked: Locked = (),
    root_joint: pin.JointModel | None = None,
    objects: Sequence[str] = (),
) -> Robot:
    """Build a robot from the text of a URDF (xacro expanded) or an MJCF file.

    Args:
        content: Text of the file. `Robot.description` is this text for a URDF, and the equivalent URDF for an MJCF
            file.
        path: File from which the text was read.
        package_dirs: Folders of mesh packages.
        locked: Names of joints to lock, or a mapping from names to positions [rad or m], see `load_robot`.
        root_joint: Joint between the world and the root link; None if it is fixed.
        objects: Names of objects whose pose is recorded, see `load_robot`.

    Returns:
        The robot.

    Raises:
        RobotError: The description is invalid, Pinocchio refuses it, a joint cannot be locked, or an object has the
            name of a link or joint.
        UnknownNameError: A locked joint does not exist.
    """
    joints = [locked] if isinstance(locked, str) else locked  # a single string counts as one name
    requested = {str(name): locked[name] if isinstance(locked, Mapping) else None for name in joints}
    root = parse_xml(content, path)
    is_mjcf = root.tag == "mujoco"
    urdf, content = validate_mjcf(root, requested) if is_mjcf else (plain.validate_urdf(root, requested), content)
    names = (objects,) if isinstance(objects, str) else tuple(objects)
    urdf = with_objects(urdf, names) if names else urdf
    if root_joint is not None and any(j.name == "root_joint" for j in urdf.joints):
        sentence = f"{path}: a joint is called 'root_joint', the name of the moving base; rename it"
        raise RobotError(sentence, code="name-reserved", path=path)
    still = locked_positions(urdf, requested) if requested or urdf.resting else {}
    text = plain.kinematic_urdf(with_fixed(urdf, still) if still else urdf)
    try:
        model = pin.buildModelFromXML(text) if root_joint is None else pin.buildModelFromXML(text, root_joint)
    except (ValueError, RuntimeError) as error:
        sentence = f"{path}: Pinocchio refuses the robot: {str(error)[:500]}"
        raise RobotError(sentence, code="pinocchio", path=path) from error
    for limit in ("lowerPositionLimit", "upperPositionLimit", "velocityLimit"):
        values = np.array(getattr(model, limit))
        values[np.abs(values) >= plain.HUGE] *= np.inf
        setattr(model, limit, values)
    return Robot(
        model,
        name=urdf.name,
        source=path.absolute(),  # meshes are looked up later, perhaps from another folder
        description=content,
        package_dirs=[d.absolute() for d in package_dirs],
        fingerprint=_fingerprint(urdf, still, root_joint),
        mimics=[m for m in urdf.followers if m.joint not in still],
        locked=still,
        objects=names,
        warnings=urdf.warnings,
    )


def _fingerprint(urdf: UrdfFile, still: dict[str, float], root_joint: pin.JointModel | None) -> str:
    """Return the hash of kinematics and masses.

    Comments, meshes, colours, the order of elements and the last digit, which differs between machines, do not count.
    """
    lines = sorted(plain.kinematic_urdf(urdf).splitlines())
    lines += sorted(f'locked {name} "{position!r}"' for name, position in still.items())
    lines += sorted(f'mimic {m.joint} {m.leader} "{m.multiplier!r} {m.offset!r}"' for m in urdf.followers)
    lines.append(f"base {'fixed' if root_joint is None else root_joint.shortname()}")
    text = DECIMAL.sub(lambda found: repr(round(float(found.group()), 12) + 0.0), "\n".join(lines))
    return hashlib.sha256(text.encode()).hexdigest()


def locked_positions(urdf: UrdfFile, asked: Mapping[str, float | None]) -> dict[str, float]:
    """Return the position of every joint that will not move: locked joints, and mimic joints of locked or fixed joints.

    Args:
        urdf: The robot description.
        asked: Positions by name of the joint to lock [rad or m]; None for zero, or for the limit nearest to zero.

    Returns:
        Joint name -> position [rad or m], in the order of the file. The result can be passed as `asked` again. Floating
        and planar joints can be locked only at 0.

    Raises:
        UnknownNameError: A name is not the name of a joint.
        RobotError: A joint cannot be locked there; codes `locked-follower`, `locked-position`.
    """
    by_name = {j.name: j for j in urdf.joints}
    leader_of = {m.joint: m.leader for m in urdf.followers}
    still = dict(urdf.resting)
    for name, value in asked.items():
        if name not in by_name:
            raise UnknownNameError("joint", name, by_name, f"robot {urdf.name!r}")
        if by_name[name].nv > 0 and name not in leader_of and name not in still:
            still[name] = _position(by_name[name], value)
    alone = next((name for name in asked if name in leader_of and leader_of[name] not in still), None)
    if alone is not None:
        sentence = f"joint {alone!r} cannot be locked alone: it follows {leader_of[alone]!r}; lock that joint"
        raise RobotError(sentence, code="locked-follower")
    still |= {m.joint: m.multiplier * still[m.leader] + m.offset for m in urdf.followers if m.leader in still}
    return {name: still[name] for name in by_name if name in still}


def _position(joint: UrdfJoint, value: float | None) -> float:
    """Return the position at which a joint is locked [rad or m], within its limits."""
    limit, lower, upper = joint.limit, -math.inf, math.inf
    if joint.type != "continuous" and limit.lower <= limit.upper:  # otherwise they are missing or contradictory
        lower, upper = limit.lower, limit.upper
    try:
        position = min(max(0.0, lower), upper) if value is None else float(value)
    except (TypeError, ValueError) as error:
        sentence = f"joint {joint.name!r}: locked at {value!r}, a number is expected"
        raise RobotError(sentence, code="locked-position") from error
    sentence = f"joint {joint.name!r}: locked at {position:g}, outside its limits {lower:g} ... {upper:g}"
    if joint.nv != 1 and position != 0.0:
        sentence = f"joint {joint.name!r} is {joint.type} and can be locked only at its zero: give no position"
    elif lower <= position <= upper:
        return position
    raise RobotError(sentence, code="locked-position")


def with_fixed(urdf: UrdfFile, still: Mapping[str, float]) -> UrdfFile:
    """Return a robot description with some joints replaced by fixed joints.

    Pinocchio's own function for this is not used, because it leaves frames whose parents form a circle.

    Args:
        urdf: The robot description.
        still: Joint to fix -> its position [rad or m].
    """
    joints = list(urdf.joints)
    for i, joint in enumerate(joints):
        if (position := still.get(joint.name)) is not None:
            moved = as_matrix(joint.pose) @ plain.motion_along(joint.type, joint.axis, position)
            pose = as_pose(moved) if position != 0.0 else joint.pose
            joints[i] = joint._replace(type="fixed", pose=pose, mimic=None)
    return urdf._replace(joints=tuple(joints))


def with_objects(urdf: UrdfFile, objects: Sequence[str]) -> UrdfFile:
    """Return a robot description with a link on a floating joint for each object, attached to the root link.

    Args:
        urdf: The robot description.
        objects: Names of the objects, which are the names of the new links and joints.

    Raises:
        RobotError: A name is empty, unprintable or repeated, or it is the name of a link, joint or coordinate of the
            robot; code `object-name`.
    """
    used = {link.name for link in urdf.links} | {joint.name for joint in urdf.joints}
    suffixes = ("", *COORDINATE_SUFFIXES["floating"])
    for i, name in enumerate(objects):
        usable = isinstance(name, str) and name.strip() == name and name.isprintable() and name not in plain.RESERVED
        clash = next((n for n in (f"{name}{suffix}" for suffix in suffixes) if n in used), None)
        sentence = f"object {name!r}: robot {urdf.name!r} has a link or joint {clash!r}; give the object another name"
        if not usable or not 0 < len(name) <= plain.LONGEST_NAME:
            sentence = f"objects: {name!r} cannot be the name of an object"
        elif name in objects[:i]:
            sentence = f"objects: {name!r} is named twice"
        elif clash is None:
            continue
        raise RobotError(sentence, code="object-name")
    node = urdf.links[0].node
    links = tuple(UrdfLink(name, node) for name in objects)
    joints = tuple(UrdfJoint(name, node, "floating", urdf.root, name) for name in objects)
    return urdf._replace(links=(*urdf.links, *links), joints=(*urdf.joints, *joints))
