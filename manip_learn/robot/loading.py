"""Names and files -> `Robot`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import pinocchio as pin

from manip_learn.errors import RobotError
from manip_learn.robot.description.catalogue import find_robot
from manip_learn.robot.description.description_file import read_description
from manip_learn.robot.description.locking import Locked, names_of
from manip_learn.robot.description.mjcf_reader import validate_mjcf
from manip_learn.robot.description.objects import object_names
from manip_learn.robot.description.xacro_file import expanded_xacro
from manip_learn.robot.robot import Robot
from manip_learn.robot.urdf_robot import robot_from_urdf, robot_from_validated

Base = Literal["fixed", "floating", "planar"]
SUFFIXES = (".urdf", ".xml", ".xacro", ".mjcf")
BASES = {"floating": pin.JointModelFreeFlyer, "planar": pin.JointModelPlanar}


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
    path = _path(name)
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
            f"{path}: this is no .xacro file, so it has no arguments: leave {', '.join(xacro)} out",
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
    """Robot from the text of a URDF or an MJCF file; `path` is where it came from. See `load_robot`.

    Raises:
        RobotError: The description is refused.
        UnknownNameError: A locked joint that does not exist.
    """
    if not _is_mjcf(content):
        return robot_from_urdf(
            content, path, package_dirs=package_dirs, locked=locked, root_joint=root_joint, objects=objects
        )
    validated, urdf = validate_mjcf(content, path, names_of(locked))
    return robot_from_validated(
        validated, urdf, path, package_dirs=package_dirs, locked=locked, root_joint=root_joint, objects=objects
    )


def _path(name: str | os.PathLike[str]) -> Path:
    if isinstance(name, str) and not name.strip():
        raise RobotError("no robot is named; give a name such as 'panda' or the path of a URDF file", code="missing")
    path = _expanded(name)
    if not isinstance(name, str) or path.suffix in SUFFIXES or os.sep in name:
        return path
    try:
        is_file = path.is_file()
    except ValueError:
        is_file = False
    return path if is_file else find_robot(name)


def _expanded(name: str | os.PathLike[str]) -> Path:
    try:
        return Path(name).expanduser()
    except RuntimeError as error:  # ~user without a home directory here
        raise RobotError(f"{os.fspath(name)}: {error}; write the path out", code="missing", path=Path(name)) from error


def _is_mjcf(content: bytes) -> bool:
    """Whether the first element is <mujoco>."""
    rest = content.lstrip(b"\xef\xbb\xbf \t\r\n")
    for begin, end in ((b"<?", b"?>"), *((b"<!--", b"-->"),) * 100):
        if rest.startswith(begin):
            rest = rest.partition(end)[2].lstrip()
    return rest.startswith(b"<mujoco")
