"""The bytes of a robot description, read without trusting the path; xacro is expanded only on request."""

from __future__ import annotations

import errno
import os
import stat
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.parsers.expat import ExpatError

from manip_learn.errors import MissingExtraError, RobotError, advice

MAX_BYTES = 10_000_000
_EXPANDING = threading.Lock()


def read_regular_file(path: Path, most: int) -> bytes:
    """Content of a regular file of at most `most` bytes.

    Raises:
        OSError: As from `open`; `ENXIO` if it is no regular file, `EFBIG` if it is larger.
        ValueError: The path holds a zero byte.
    """
    # O_NONBLOCK: opening a pipe would wait for its writer
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.ENXIO, "not a regular file")
        if status.st_size > most:
            raise OSError(errno.EFBIG, f"{status.st_size} bytes")
        with os.fdopen(descriptor, "rb", closefd=False) as file:
            content = file.read(most + 1)
    finally:
        os.close(descriptor)
    if len(content) > most:
        raise OSError(errno.EFBIG, f"more than {most} bytes")
    return content


def read_description(path: Path) -> bytes:
    """Content of a regular file of at most 10 MB.

    Raises:
        RobotError: Codes `missing`, `not-a-file`, `unreadable`, `file-too-large`.
    """
    try:
        return read_regular_file(path, MAX_BYTES)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise RobotError(f"{path}: there is no such file; check the path", code="missing", path=path) from error
    except OSError as error:
        raise _explained(error, path) from error
    except ValueError as error:
        raise RobotError(f"{str(path)!r}: not a usable path ({error})", code="unreadable", path=path) from error


def _explained(error: OSError, path: Path) -> RobotError:
    if error.errno in (errno.ENXIO, errno.EISDIR):
        return RobotError(f"{path}: not a regular file; {_hint(path)}", code="not-a-file", path=path)
    if error.errno == errno.EFBIG:
        return RobotError(
            f"{path}: the file has {error.strerror}, at most {MAX_BYTES} are read; is it a robot description?",
            code="file-too-large",
            path=path,
        )
    sentence = f"{path}: cannot be read ({error.strerror}); check the path and its permissions"
    return RobotError(sentence, code="unreadable", path=path)


def _hint(path: Path) -> str:
    if not path.is_dir():
        return "name a URDF file"
    inside = sorted(p.name for p in path.glob("*.urdf"))[:4]
    return f"it is a folder; name a file in it, e.g. {', '.join(inside)}" if inside else "it is a folder; name a file"


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
            + (
                advice("if you trust it: {}", "load_robot(..., xacro=True)", "--xacro")
                or "if you trust it: xacro robot.xacro > robot.urdf"
            ),
            code="xacro",
            path=path,
        )
    _refuse_doctype(content, path)
    try:
        from xacro import XacroException
        from xacrodoc import XacroDoc
    except ImportError as error:
        raise MissingExtraError(f"the xacro file {path}", "xacro") from error
    try:
        with _includes_from(path.parent):
            return XacroDoc.from_file(str(path)).to_urdf_string().encode()
    except (XacroException, ExpatError, OSError, ValueError, LookupError, RuntimeError) as error:
        said = " ".join(str(error).split())[:300]
        raise RobotError(
            f"{path}: xacro could not be expanded ({said}); correct it, or set ROS_PACKAGE_PATH for $(find ...)",
            code="xacro-failed",
            path=path,
        ) from error


def _refuse_doctype(content: bytes, path: Path) -> None:
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise RobotError(f"{path}: a <!DOCTYPE> is not read; delete it", code="doctype", path=path)


@contextmanager
def _includes_from(folder: Path) -> Iterator[None]:
    """Within it, xacro looks for relative includes in a folder, and refuses one with a DOCTYPE like the top file.

    xacro keeps the file at hand in a global variable, so that one thread at a time expands.
    """
    import xacro

    parse, root = xacro.parse, xacro.root_dir

    def checked(inp: Any, filename: str | None = None) -> Any:
        if inp is None and filename is not None:
            place = Path(xacro.root_dir) / filename
            if place.is_file():  # otherwise xacro says what is missing
                _refuse_doctype(read_description(place), place)
        return parse(inp, filename)

    with _EXPANDING:
        xacro.parse, xacro.root_dir = checked, str(folder)
        xacro.init_stacks(None)  # an expansion that failed leaves its files behind
        try:
            yield
        finally:
            xacro.parse, xacro.root_dir = parse, root
