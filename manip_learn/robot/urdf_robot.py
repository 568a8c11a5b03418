"""A checked URDF -> `Robot`."""

from __future__ import annotations

import hashlib
import os
import re
import sys
import tempfile
import threading
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pinocchio as pin

from manip_learn.errors import RobotError
from manip_learn.robot.description.kinematic_urdf import LARGE, kinematic_urdf
from manip_learn.robot.description.locking import Locked, locked_positions, names_of, with_fixed
from manip_learn.robot.description.mimic import Mimic
from manip_learn.robot.description.objects import with_objects
from manip_learn.robot.description.urdf_elements import UrdfFile
from manip_learn.robot.description.validation import ValidatedRobot, validate_urdf
from manip_learn.robot.robot import Robot

DECIMAL = re.compile(r'(?<=["\s])-?\d+(\.\d+)?(e[+-]?\d+)?(?=["\s])')
_one_at_a_time = threading.Lock()


def robot_from_urdf(
    content: bytes,
    path: Path,
    *,
    package_dirs: Sequence[Path] = (),
    locked: Locked = (),
    root_joint: pin.JointModel | None = None,
    objects: Sequence[str] = (),
) -> Robot:
    """Robot from the text of a URDF.

    Args:
        content: The URDF, xacro expanded.
        path: Where it came from.
        package_dirs: Folders of mesh packages.
        locked: Joints to hold still; names, or names -> positions [rad or m].
        root_joint: Joint between the world and the root link; None if it is fixed.
        objects: Names of things whose pose is recorded, see `load_robot`.

    Raises:
        RobotError: The description is invalid, or Pinocchio refuses it.
        UnknownNameError: A locked joint that does not exist.
    """
    validated = validate_urdf(content, path, names_of(locked))
    return robot_from_validated(
        validated,
        content,
        path,
        package_dirs=package_dirs,
        locked=locked,
        root_joint=root_joint,
        objects=objects,
    )


def robot_from_validated(
    validated: ValidatedRobot,
    content: bytes,
    path: Path,
    *,
    package_dirs: Sequence[Path] = (),
    locked: Locked = (),
    root_joint: pin.JointModel | None = None,
    objects: Sequence[str] = (),
) -> Robot:
    """Robot from a validated description; `content` is kept as its description. See `robot_from_urdf`.

    Raises:
        RobotError: Pinocchio refuses it, a joint cannot be locked, or an object has the name of a link or joint.
        UnknownNameError: A locked joint that does not exist.
    """
    urdf, warnings = with_objects(validated.urdf, objects), list(validated.warnings)
    if root_joint is not None and urdf.joint("root_joint") is not None:
        raise RobotError(
            f"{path}: a joint is called 'root_joint', the name of the moving base; rename it",
            code="name-reserved",
            path=path,
        )
    still = locked_positions(urdf, validated.mimics, locked)
    model = _built(kinematic_urdf(with_fixed(urdf, still)), root_joint, path, warnings)
    _check_counts(model, urdf, still, root_joint, path)
    _set_unlimited(model)
    return Robot(
        model,
        name=urdf.name,
        source=path.absolute(),  # meshes are looked up later, perhaps from another folder
        description=content,
        package_dirs=[d.absolute() for d in package_dirs],
        fingerprint=_fingerprint(urdf, still, validated.mimics.followers, root_joint),
        mimics=[m for m in validated.mimics.followers if m.joint not in still],
        locked=still,
        objects=objects,
        warnings=warnings,
    )


def _built(text: str, root_joint: pin.JointModel | None, path: Path, warnings: list[str]) -> pin.Model:
    lines: list[str] = []
    try:
        with captured_c_stderr() as lines:
            model = pin.buildModelFromXML(text) if root_joint is None else pin.buildModelFromXML(text, root_joint)
    except (ValueError, RuntimeError) as error:
        said = " ".join([*lines, str(error)])
        raise RobotError(f"{path}: Pinocchio refuses the robot: {said[:500]}", code="pinocchio", path=path) from error
    warnings += [f"Pinocchio: {line}" for line in lines]
    return model


def _check_counts(
    model: pin.Model, urdf: UrdfFile, still: Collection[str], root_joint: pin.JointModel | None, path: Path
) -> None:
    """Everything in the file must be in the model, and nothing else."""
    extra = 0 if root_joint is None else 1
    kinds = [f.type for f in model.frames][1:]  # the first is the universe
    seen = {
        "links": kinds.count(pin.FrameType.BODY),
        "joints": kinds.count(pin.FrameType.JOINT) + kinds.count(pin.FrameType.FIXED_JOINT) - extra,
        "degrees of freedom": model.nv - (0 if root_joint is None else root_joint.nv),
    }
    wanted = {
        "links": len(urdf.links),
        "joints": len(urdf.joints),
        "degrees of freedom": sum(j.nv for j in urdf.joints if j.name not in still),
    }
    for what, number in wanted.items():
        if seen[what] != number:
            raise RobotError(
                f"{path}: the file has {number} {what}, the loaded model {seen[what]}; please report this file",
                code="counts",
                path=path,
            )


def _set_unlimited(model: pin.Model) -> None:
    lower, upper = np.array(model.lowerPositionLimit), np.array(model.upperPositionLimit)
    velocity = np.array(model.velocityLimit)
    lower[lower <= -LARGE], upper[upper >= LARGE], velocity[velocity >= LARGE] = -np.inf, np.inf, np.inf
    model.lowerPositionLimit, model.upperPositionLimit, model.velocityLimit = lower, upper, velocity


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


@contextmanager
def captured_c_stderr() -> Iterator[list[str]]:
    """Collect the lines written to file descriptor 2; the list is filled when the block ends, also by an error.

    The descriptor belongs to the whole process: what other threads print meanwhile is collected too.
    """
    lines: list[str] = []
    with _one_at_a_time:
        if sys.stderr is not None:
            sys.stderr.flush()
        try:
            saved = os.dup(2)
        except OSError:  # no stderr, as in a service: nothing visible is lost
            yield lines
            return
        with tempfile.TemporaryFile() as sink:
            os.dup2(sink.fileno(), 2)
            try:
                yield lines
            finally:
                if sys.stderr is not None:
                    sys.stderr.flush()
                os.dup2(saved, 2)
                os.close(saved)
                sink.seek(0)
                text = sink.read(1_000_000).decode("utf-8", "replace")
                lines += [line.strip() for line in text.splitlines() if line.strip()]
