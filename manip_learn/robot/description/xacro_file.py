"""Xacro files: expanded only on request, since that runs their author's expressions."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.parsers.expat import ExpatError

from manip_learn.errors import MissingExtraError, RobotError, advice, closest_names
from manip_learn.robot.description.description_file import read_description

DECLARED = re.compile(rb"<xacro:arg\b[^>]*\bname\s*=\s*[\"']([^\"']+)[\"']")
_EXPANDING = threading.Lock()


def expanded_xacro(path: Path, asked: bool | Mapping[str, str], package_dirs: Sequence[Path] = ()) -> bytes:
    """Text of the URDF that a xacro file stands for.

    Args:
        path: The .xacro file.
        asked: Whether the caller opted in: True, or the values of its arguments (`<xacro:arg>`) by name.
        package_dirs: Folders that contain the packages of `$(find ...)`; the folders above the file are searched too.

    Raises:
        RobotError: Codes `xacro` (not opted in), `xacro-arg` (no such argument), `xacro-failed`, and those of reading a
            file.
        MissingExtraError: xacrodoc is not installed.
    """
    content = read_description(path)
    if asked is False:
        raise RobotError(
            f"{path}: a xacro file is not expanded unless you ask, since it runs expressions and includes other files; "
            + (
                advice("if you trust it: {}", "load_robot(..., xacro=True)", "--xacro")
                or "if you trust it: xacro robot.xacro > robot.urdf"
            ),
            code="xacro",
            path=path,
        )
    values = _checked_values(asked, path)
    _refuse_doctype(content, path)
    try:
        from xacro import XacroException
        from xacrodoc import XacroDoc
        from xacrodoc.packages import PackageNotFoundError
    except ImportError as error:
        raise MissingExtraError(f"the xacro file {path}", "xacro") from error
    try:
        with _includes_from(path.parent, package_dirs) as included:
            text = XacroDoc.from_file(str(path), subargs=values).to_urdf_string().encode()
    except (XacroException, PackageNotFoundError, ExpatError, OSError, ValueError, LookupError, RuntimeError) as error:
        said = " ".join(str(error).split())[:300]
        folders = advice(
            ", or name the folder that contains the package with {}", "package_dirs=[...]", "--package-dir FOLDER"
        )
        where = f"correct it{folders or ', or set ROS_PACKAGE_PATH'} for $(find ...)"
        raise RobotError(
            f"{path}: xacro could not be expanded ({said}); {where}", code="xacro-failed", path=path
        ) from error
    _refuse_undeclared(values, [content, *included], path)
    return text


def _checked_values(asked: object, path: Path) -> dict[str, str]:
    if asked is True:
        return {}
    if not isinstance(asked, Mapping) or not all(isinstance(name, str) for name in asked):
        raise RobotError(
            f"{path}: xacro is {asked!r:.80}; True, or a mapping {{argument: value}}, is needed", code="xacro-arg"
        )
    return {name: str(value) for name, value in asked.items()}


def _refuse_undeclared(values: Mapping[str, str], contents: Sequence[bytes], path: Path) -> None:
    """Refuse values for arguments that no file declares: xacro itself would ignore them."""
    declared = {name.decode(errors="replace") for content in contents for name in DECLARED.findall(content)}
    unknown = sorted(set(values) - declared)
    if unknown:
        shown = ", ".join(map(repr, closest_names(unknown[0], declared) or sorted(declared))) or "none"
        raise RobotError(
            f"{path}: the xacro file has no argument {unknown[0]!r}; it has {shown}", code="xacro-arg", path=path
        )


def _refuse_doctype(content: bytes, path: Path) -> None:
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise RobotError(f"{path}: a <!DOCTYPE> is not read; delete it", code="doctype", path=path)


@contextmanager
def _includes_from(folder: Path, package_dirs: Sequence[Path]) -> Iterator[list[bytes]]:
    """Within it, xacro looks for relative includes in a folder, and refuses one with a DOCTYPE like the top file.

    xacro keeps the file at hand, and xacrodoc the packages, in global variables, so that one thread at a time expands.

    Yields:
        The content of each file that is included, in time.
    """
    import xacro
    from xacrodoc import packages

    parse, root = xacro.parse, xacro.root_dir
    included: list[bytes] = []

    def checked(inp: Any, filename: str | None = None) -> Any:
        if inp is None and filename is not None:
            place = Path(xacro.root_dir) / filename
            if place.is_file():  # otherwise xacro says what is missing
                content = read_description(place)
                _refuse_doctype(content, place)
                included.append(content)
        return parse(inp, filename)

    with _EXPANDING:
        xacro.parse, xacro.root_dir = checked, str(folder)
        xacro.init_stacks(None)  # an expansion that failed leaves its files behind
        packages.reset()
        packages.update_package_cache({p.name: p for d in package_dirs for p in d.iterdir() if p.is_dir()})
        try:
            yield included
        finally:
            xacro.parse, xacro.root_dir = parse, root
            packages.reset()
