"""The bytes of a robot description, read without trusting the path."""

from __future__ import annotations

import errno
from pathlib import Path

from manip_learn.errors import RobotError
from manip_learn.robot.description.regular_file import read_regular_file

MAX_BYTES = 10_000_000


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
        raise RobotError(f"{str(path)!r}: no usable path ({error})", code="unreadable", path=path) from error


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
