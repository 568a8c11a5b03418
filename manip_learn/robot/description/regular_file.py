"""Bytes of a file, if it is one: no pipe that hangs, no device without an end, no surprise in size."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path


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
