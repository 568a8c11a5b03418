"""The bytes of a robot description, read without trusting the path."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from manip_learn.errors import RobotError

MAX_BYTES = 10_000_000


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
