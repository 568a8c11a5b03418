"""The bytes of a robot description, read without trusting the path."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from manip_learn.errors import RobotError

MAX_BYTES = 10_000_000


def read_description(path: Path) -> bytes:
    """Content of a regular file of at most 10 MB. A pipe or a device is refused before it can hang the program.

    Raises:
        RobotError: Codes `missing`, `not-a-file`, `unreadable`, `file-too-large`.
    """
    try:
        # O_NONBLOCK: opening a FIFO would wait for its writer
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except (OSError, ValueError) as error:
        raise _explained(error, path) from error
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise _not_a_file(path)
        if status.st_size > MAX_BYTES:
            raise _too_large(path, status.st_size)
        try:
            content = file.read(MAX_BYTES + 1)
        except OSError as error:
            raise _explained(error, path) from error
    if len(content) > MAX_BYTES:
        raise _too_large(path, len(content))
    return content


def _explained(error: OSError | ValueError, path: Path) -> RobotError:
    if isinstance(error, FileNotFoundError | NotADirectoryError):
        return RobotError(f"{path}: there is no such file; check the path", code="missing", path=path)
    if isinstance(error, IsADirectoryError) or (
        isinstance(error, OSError) and error.errno in (errno.ENXIO, errno.EISDIR)
    ):
        return _not_a_file(path)
    reason = error.strerror if isinstance(error, OSError) else str(error)
    return RobotError(
        f"{path!s}: cannot be read ({reason}); check the path and its permissions", code="unreadable", path=path
    )


def _not_a_file(path: Path) -> RobotError:
    hint = "name a URDF file"
    if path.is_dir():
        inside = sorted(p.name for p in path.glob("*.urdf"))[:4]
        hint = (
            f"it is a folder; name a file in it, e.g. {', '.join(inside)}" if inside else "it is a folder; name a file"
        )
    return RobotError(f"{path}: not a regular file; {hint}", code="not-a-file", path=path)


def _too_large(path: Path, size: int) -> RobotError:
    return RobotError(
        f"{path}: the file has {size} bytes, at most {MAX_BYTES} are read; is it a robot description?",
        code="file-too-large",
        path=path,
    )
