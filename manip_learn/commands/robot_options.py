"""Options of the command line that say how a robot is loaded: one set, shared by all commands that load one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, final

import typer

from manip_learn.errors import ManipLearnError

if TYPE_CHECKING:  # so that `--help` stays quick
    from manip_learn.robot import Robot


@final
@dataclass(frozen=True)
class RobotOptions:
    """What is said beside the robot's name.

    Attributes:
        locked: Joints to hold still.
        package_dirs: Folders that contain mesh packages, and the packages of `$(find ...)` in xacro files.
        objects: Objects whose pose is recorded.
        xacro: Whether a xacro file may be expanded; or the values of its arguments.
    """

    locked: tuple[str, ...] = ()
    package_dirs: tuple[str, ...] = ()
    objects: tuple[str, ...] = ()
    xacro: bool | Mapping[str, str] = field(default=False)

    def load(
        self,
        name: str,
        locked: Sequence[str] | Mapping[str, float | None] | None = None,
        objects: Sequence[str] | None = None,
    ) -> Robot:
        """The robot, with other joints locked or other objects if they are named.

        Raises:
            ManipLearnError: Any of the errors of `load_robot`.
        """
        from manip_learn.robot import load_robot

        return load_robot(
            name,
            self.package_dirs,
            self.locked if locked is None else locked,
            xacro=self.xacro,
            objects=self.objects if objects is None else objects,
        )


def robot_options(
    lock: Annotated[list[str] | None, typer.Option(help="Joint to hold still; repeatable.")] = None,
    package_dir: Annotated[list[str] | None, typer.Option(help="Folder that contains mesh packages.")] = None,
    objects: Annotated[
        list[str] | None,
        typer.Option("--object", help="Object whose pose is recorded (NAME.x ... NAME.rz); repeatable."),
    ] = None,
    xacro: Annotated[bool, typer.Option("--xacro", help="Expand the robot's xacro file, which runs its code.")] = False,
    xacro_arg: Annotated[
        list[str] | None, typer.Option(help="NAME=VALUE of an argument of the xacro file; implies --xacro.")
    ] = None,
) -> RobotOptions:
    """What the flags say.

    Raises:
        ManipLearnError: An argument that is not NAME=VALUE.
    """
    values = dict(pair("--xacro-arg", "NAME=VALUE", text, may_be_empty=True) for text in xacro_arg or ())
    return RobotOptions(tuple(lock or ()), tuple(package_dir or ()), tuple(objects or ()), values or xacro)


def pair(flag: str, form: str, text: str, *, may_be_empty: bool = False, unnamed: bool = False) -> tuple[str, str]:
    """Both sides of the first equals sign.

    Raises:
        ManipLearnError: There is none, nothing before it, or nothing behind it where there must be something.
    """
    name, equals, value = text.partition("=")
    if not (name or unnamed) or not equals or not (value or may_be_empty):
        raise ManipLearnError(f"{flag} must be {form}, got {text!r}", code="option")
    return name, value
