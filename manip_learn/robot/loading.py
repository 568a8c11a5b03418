"""Names and files -> `Robot`."""

from __future__ import annotations

import hashlib
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pinocchio as pin

from manip_learn.errors import RobotError, UnknownNameError
from manip_learn.robot.description.catalogue import find_robot
from manip_learn.robot.description.mjcf import validate_mjcf
from manip_learn.robot.description.text import read_description
from manip_learn.robot.description.urdf import (
    HUGE,
    LONGEST_NAME,
    RESERVED,
    Pose,
    UrdfFile,
    UrdfJoint,
    UrdfLink,
    X,
    as_matrix,
    as_pose,
    kinematic_urdf,
)
from manip_learn.robot.description.validation import ValidatedRobot, validate_urdf
from manip_learn.robot.description.xacro_expansion import expanded_xacro
from manip_learn.robot.joints import COORDINATE_SUFFIXES, Mimic
from manip_learn.robot.robot import Robot

Base = Literal["fixed", "floating", "planar"]
Locked = Sequence[str] | Mapping[str, float | None]
DESCRIPTION_SUFFIXES = (".urdf", ".xml", ".xacro", ".mjcf")
BASES = {"floating": pin.JointModelFreeFlyer, "planar": pin.JointModelPlanar}
# numbers of a description, between quotes or spaces
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
    """Load a robot by its name or from a file; what is repaired or ignored is listed in `Robot.warnings`.

    Args:
        name: `"planar3"`, `"sawyer"`, a robot of example-robot-data such as `"panda"`, or the path of a URDF or MJCF
            file. What exists as a file, or ends in .urdf, .xml, .mjcf or .xacro, is a path.
        package_dirs: Folders that contain the packages of `package://` meshes and of `$(find ...)` in xacro files.
            Kinematics of a URDF needs none.
        locked: Joints to hold still, at zero or the limit nearest to it; or a mapping joint -> position [rad or m],
            None for that same place.
        base: Whether the root link is `"fixed"`, or free to move in space (`"floating"`) or in the plane (`"planar"`).
        xacro: Whether a .xacro file may be expanded: True, or the values of its arguments, e.g. `{"ur_type": "ur5e"}`.
            Off by default, since expanding runs its author's expressions.
        objects: Names of things whose pose is recorded beside the joints, e.g. `("box",)`: each becomes a link of that
            name on a floating joint of that name, which hangs on the root link, six more degrees of freedom
            `box.x box.y box.z box.rx box.ry box.rz` (position [m] and rotation vector [rad] in the root link's frame)
            without limits. No motor moves them: a controller that is given such a robot commands their twist too.

    Raises:
        UnknownNameError: No such robot, or a locked joint that does not exist; lists near matches.
        MissingExtraError: The robot or the file format needs a package that is not installed.
        RobotError: The description is refused: `code`, file, line, joint or link, the value seen and the fix.

    Example:
        >>> import manip_learn as ml
        >>> robot = ml.load_robot("sawyer")  # or "my_arm.urdf"
        >>> robot.nv, robot.joint_names[0]
        (7, 'right_j0')
    """
    if isinstance(name, str) and not name.strip():
        raise RobotError("no robot is named; give a name such as 'panda' or the path of a URDF file", code="missing")
    path = _expanded(name)
    if isinstance(name, str) and path.suffix not in DESCRIPTION_SUFFIXES and os.sep not in name:
        path = path if "\0" not in name and path.is_file() else find_robot(name)
    given = [package_dirs] if isinstance(package_dirs, str | os.PathLike) else package_dirs
    folders = tuple(_expanded(d) for d in given)
    for folder in folders:
        if not folder.is_dir():
            raise RobotError(f"package folder {folder}: there is no such folder; check the path", code="package-dir")
    if base not in ("fixed", *BASES):
        raise RobotError(f"base is {base!r}; it must be one of 'fixed', 'floating', 'planar'", code="base")
    root_joint = BASES[base]() if base in BASES else None
    names = object_names(objects)
    if isinstance(xacro, Mapping) and path.suffix != ".xacro":
        raise RobotError(
            f"{path}: this is no .xacro file, so it has no arguments: leave {', '.join(map(str, xacro))} out",
            code="xacro-arg",
            path=path,
        )
    content = expanded_xacro(path, xacro, folders) if path.suffix == ".xacro" else read_description(path)
    return robot_from_text(content, path, package_dirs=folders, locked=locked, root_joint=root_joint, objects=names)


def robot_from_text(
    content: bytes,
    path: Path,
    *,
    package_dirs: Sequence[Path] = (),
    locked: Locked = (),
    root_joint: pin.JointModel | None = None,
    objects: Sequence[str] = (),
) -> Robot:
    """Robot from the text of a URDF (xacro expanded) or an MJCF file.

    Args:
        content: The text; of a URDF it is kept as the robot's description, of an MJCF file the URDF that it stands for.
        path: Where it came from.
        package_dirs: Folders of mesh packages.
        locked: Joints to hold still; names, or names -> positions [rad or m].
        root_joint: Joint between the world and the root link; None if it is fixed.
        objects: Names of things whose pose is recorded, see `load_robot`.

    Raises:
        RobotError: The description is invalid, Pinocchio refuses it, a joint cannot be locked, or an object has the
            name of a link or joint.
        UnknownNameError: A locked joint that does not exist.
    """
    rest = content.lstrip(b"\xef\xbb\xbf \t\r\n")  # up to the first element
    for begin, end in ((b"<?", b"?>"), *((b"<!--", b"-->"),) * 100):
        if rest.startswith(begin):
            rest = rest.partition(end)[2].lstrip()
    if rest.startswith(b"<mujoco"):
        validated, content = validate_mjcf(content, path, locked_names(locked))
    else:
        validated = validate_urdf(content, path, locked_names(locked))
    urdf = with_objects(validated.urdf, objects)
    if root_joint is not None and any(j.name == "root_joint" for j in urdf.joints):
        sentence = f"{path}: a joint is called 'root_joint', the name of the moving base; rename it"
        raise RobotError(sentence, code="name-reserved", path=path)
    still = locked_positions(validated, urdf, locked)
    text = kinematic_urdf(with_fixed(urdf, still))
    try:
        model = pin.buildModelFromXML(text) if root_joint is None else pin.buildModelFromXML(text, root_joint)
    except (ValueError, RuntimeError) as error:
        said = str(error)[:500]
        raise RobotError(f"{path}: Pinocchio refuses the robot: {said}", code="pinocchio", path=path) from error
    for limit, beyond in (
        ("lowerPositionLimit", -HUGE),
        ("upperPositionLimit", HUGE),
        ("velocityLimit", HUGE),
    ):
        values = np.array(getattr(model, limit))
        setattr(model, limit, np.where(np.abs(values) >= HUGE, math.copysign(math.inf, beyond), values))
    return Robot(
        model,
        name=urdf.name,
        source=path.absolute(),  # meshes are looked up later, perhaps from another folder
        description=content,
        package_dirs=[d.absolute() for d in package_dirs],
        fingerprint=_fingerprint(urdf, still, validated.followers, root_joint),
        mimics=[m for m in validated.followers if m.joint not in still],
        locked=still,
        objects=objects,
        warnings=validated.warnings,
    )


def _expanded(name: str | os.PathLike[str]) -> Path:
    try:
        return Path(name).expanduser()
    except RuntimeError as error:  # ~user without a home directory here
        raise RobotError(f"{os.fspath(name)}: {error}; write the path out", code="missing", path=Path(name)) from error


def _fingerprint(
    urdf: UrdfFile, still: dict[str, float], followers: Sequence[Mimic], root_joint: pin.JointModel | None
) -> str:
    """Hash of kinematics and masses: comments, meshes, colours, the order of elements and the last digit, which
    differs between machines, do not count.
    """
    lines = sorted(kinematic_urdf(urdf).splitlines())
    lines += sorted(f'locked {name} "{position!r}"' for name, position in still.items())
    lines += sorted(f'mimic {m.joint} {m.leader} "{m.multiplier!r} {m.offset!r}"' for m in followers)
    lines.append(f"base {'fixed' if root_joint is None else root_joint.shortname()}")
    text = DECIMAL.sub(lambda found: repr(round(float(found.group()), 12) + 0.0), "\n".join(lines))
    return hashlib.sha256(text.encode()).hexdigest()


def locked_names(locked: Locked) -> tuple[str, ...]:
    """The names in what a caller passed as `locked`; a single string counts as one name."""
    return (locked,) if isinstance(locked, str) else tuple(str(n) for n in locked)


def locked_positions(validated: ValidatedRobot, urdf: UrdfFile, locked: Locked) -> dict[str, float]:
    """Position of every joint that stands still: locked ones, their followers, and followers of fixed joints.

    A joint locked by name alone stands at zero, or at the limit nearest to zero.

    Returns:
        Joint name -> position [rad or m], in file order; 0 for floating and planar joints, which is accepted again.

    Raises:
        UnknownNameError: A name that is no joint.
        RobotError: Codes `locked-follower`, `locked-position`.
    """
    asked = {name: (locked.get(name) if isinstance(locked, Mapping) else None) for name in locked_names(locked)}
    by_name = {j.name: j for j in urdf.joints}
    leader_of = {m.joint: m.leader for m in validated.followers}
    still = dict(validated.resting)
    for name, value in asked.items():
        if name not in by_name:
            raise UnknownNameError("joint", name, by_name, f"robot {urdf.name!r}")
        if by_name[name].nv > 0 and name not in leader_of and name not in still:
            still[name] = _position(by_name[name], value)
    alone = next((name for name in asked if name in leader_of and leader_of[name] not in still), None)
    if alone is not None:
        sentence = f"joint {alone!r} cannot be locked alone: it follows {leader_of[alone]!r}; lock that joint"
        raise RobotError(sentence, code="locked-follower")
    for m in validated.followers:
        if m.leader in still:
            still[m.joint] = m.multiplier * still[m.leader] + m.offset
    return {j.name: still[j.name] for j in urdf.joints if j.name in still}


def _position(joint: UrdfJoint, value: float | None) -> float:
    limit, lower, upper = joint.limit, -math.inf, math.inf
    if limit is not None and limit.lower is not None and limit.upper is not None and joint.type != "continuous":
        # limits that contradict each other say nothing
        lower, upper = (limit.lower, limit.upper) if limit.lower <= limit.upper else (lower, upper)
    if value is None:
        return min(max(0.0, lower), upper)
    try:
        position = float(value)
    except (TypeError, ValueError) as error:
        sentence = f"joint {joint.name!r}: locked at {value!r}, a number is expected"
        raise RobotError(sentence, code="locked-position") from error
    sentence = None
    if joint.nv != 1 and position != 0.0:
        sentence = f"joint {joint.name!r} is {joint.type} and can be locked only where it is: give no position"
    elif not lower <= position <= upper:
        sentence = f"joint {joint.name!r}: locked at {position:g}, outside its limits {lower:g} ... {upper:g}"
    if sentence is not None:
        raise RobotError(sentence, code="locked-position")
    return position


def with_fixed(urdf: UrdfFile, still: Mapping[str, float]) -> UrdfFile:
    """That robot with some joints fixed where they stand.

    Pinocchio's own reduction of a model leaves frames with parents that lead in a circle.
    """

    def fixed(joint: UrdfJoint, position: float) -> UrdfJoint:
        pose, motion, axis = joint.pose, np.eye(4), np.array(joint.axis)
        if joint.type == "prismatic":
            motion[:3, 3] = position * axis
        else:
            motion[:3, :3] = pin.exp3(position * axis)
        if position != 0.0:
            pose = as_pose(as_matrix(joint.pose) @ motion)
        return replace(joint, type="fixed", pose=pose, limit=None, mimic=None)

    return replace(urdf, joints=tuple(fixed(j, still[j.name]) if j.name in still else j for j in urdf.joints))


def object_names(objects: Sequence[str] | str) -> tuple[str, ...]:
    """The names in what a caller passed as `objects`; a single string counts as one name.

    Raises:
        RobotError: Code `object-name`: no name, an unprintable one, or the same twice.
    """
    names = (objects,) if isinstance(objects, str) else tuple(objects)
    for i, name in enumerate(names):
        usable = isinstance(name, str) and name.strip() == name and 0 < len(name) <= LONGEST_NAME and name.isprintable()
        if not usable or name in RESERVED:
            raise RobotError(f"objects: {name!r} cannot be the name of an object", code="object-name")
        if name in names[:i]:
            raise RobotError(f"objects: {name!r} is named twice", code="object-name")
    return names


def with_objects(urdf: UrdfFile, objects: Sequence[str]) -> UrdfFile:
    """The robot with a link on a floating joint of the same name for each object, its pose in the root link's frame.

    Raises:
        RobotError: Code `object-name`: a link, joint or coordinate of the robot has the name.
    """
    taken = {link.name for link in urdf.links} | {joint.name for joint in urdf.joints}
    for name in objects:
        made = (name, *(name + suffix for suffix in COORDINATE_SUFFIXES["floating"]))
        clash = next((n for n in made if n in taken), None)
        if clash is not None:
            sentence = (
                f"object {name!r}: robot {urdf.name!r} has a link or joint {clash!r}; give the object another name"
            )
            raise RobotError(sentence, code="object-name")
    links = tuple(UrdfLink(name, 0, None) for name in objects)
    joints = tuple(UrdfJoint(name, 0, "floating", urdf.root, name, Pose(), X, None, None) for name in objects)
    return replace(urdf, links=(*urdf.links, *links), joints=(*urdf.joints, *joints))
