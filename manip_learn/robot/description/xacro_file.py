"""xacro -> URDF, only when asked for."""

from __future__ import annotations

from pathlib import Path
from xml.parsers.expat import ExpatError

from manip_learn.errors import MissingExtraError, RobotError
from manip_learn.robot.description.description_file import read_description


def expanded_xacro(path: Path, *, allowed: bool) -> bytes:
    """Text of the URDF that a xacro file stands for.

    Args:
        path: The .xacro file.
        allowed: Whether the caller opted in.

    Raises:
        RobotError: Codes `xacro` (not opted in), `xacro-failed`, and those of reading a file.
        MissingExtraError: xacrodoc is not installed.
    """
    content = read_description(path)
    if not allowed:
        raise RobotError(
            f"{path}: a xacro file is not expanded unless you ask, since it runs expressions and includes other files; "
            "if you trust it, load_robot(..., xacro=True)",
            code="xacro",
            path=path,
        )
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise RobotError(f"{path}: a <!DOCTYPE> is not read; delete it", code="doctype", path=path)
    try:
        from xacro import XacroException
        from xacrodoc import XacroDoc
    except ImportError as error:
        raise MissingExtraError(f"the xacro file {path}", "xacro") from error
    try:
        return XacroDoc.from_file(str(path)).to_urdf_string().encode()
    except (XacroException, ExpatError, OSError, ValueError, LookupError, RuntimeError) as error:
        said = " ".join(str(error).split())[:300]
        raise RobotError(
            f"{path}: xacro could not be expanded ({said}); correct it, or set ROS_PACKAGE_PATH for $(find ...)",
            code="xacro-failed",
            path=path,
        ) from error
