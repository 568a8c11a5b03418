"""Things whose pose is recorded beside the joints: a link each, joined to the root link by a floating joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from manip_learn.errors import RobotError
from manip_learn.robot.description.urdf_elements import Pose, UrdfFile, UrdfJoint, UrdfLink
from manip_learn.robot.description.urdf_reader import MAX_NAME, RESERVED

COORDINATES = ("x", "y", "z", "rx", "ry", "rz")


def object_names(objects: Sequence[str] | str) -> tuple[str, ...]:
    """The names in what a caller passed as `objects`; a single string counts as one name.

    Raises:
        RobotError: Code `object-name`: no name, an unprintable one, or the same twice.
    """
    names = (objects,) if isinstance(objects, str) else tuple(objects)
    for i, name in enumerate(names):
        usable = isinstance(name, str) and name.strip() == name and 0 < len(name) <= MAX_NAME and name.isprintable()
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
        clash = next((n for n in (name, *(f"{name}.{c}" for c in COORDINATES)) if n in taken), None)
        if clash is not None:
            raise RobotError(
                f"object {name!r}: robot {urdf.name!r} has a link or joint {clash!r}; give the object another name",
                code="object-name",
            )
    links = tuple(UrdfLink(name, 0, None) for name in objects)
    joints = tuple(
        UrdfJoint(name, 0, "floating", urdf.root, name, Pose(), (1.0, 0.0, 0.0), None, None) for name in objects
    )
    return replace(urdf, links=(*urdf.links, *links), joints=(*urdf.joints, *joints))
