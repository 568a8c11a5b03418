"""Atomic writing of files: a file is written completely or not at all."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import glob
import os
import secrets
import stat
from pathlib import Path

from manip_learn.errors import OutputError


def write_atomically(path: str | os.PathLike[str], content: bytes | str) -> Path:
    """Write `content` to `path` completely or not at all: readers see the old content or the new content, never a mix.

    The content is written to a temporary file in the same folder and flushed to the disk; then that file replaces the
    old one in one step. Missing folders are created. Text is written as UTF-8 with unchanged line ends. Temporary files
    that killed programs left for the same path are removed.

    Args:
        path: File to write; `~` is expanded, and a symbolic link stays a link: its target is replaced.
        content: Bytes, or text.

    Returns:
        The absolute path of the file.

    Raises:
        OutputError: The path is a folder or a device, the old file is write-protected, or the folder cannot be written.
    """
    target = _check_target(path)
    data = content.encode("utf-8") if isinstance(content, str) else bytes(content)
    temporary = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        descriptor, temporary = _open_locked_temporary(target)
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
            if target.exists():
                temporary.chmod(stat.S_IMODE(target.stat().st_mode))
            os.replace(temporary, target)  # while it is locked
        with contextlib.suppress(OSError):
            descriptor = os.open(target.parent, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
    except OSError as error:
        remedy = (
            "make room, or choose another disk"
            if has_no_room(error)
            else "choose a file in a folder that you may write to"
        )
        raise OutputError(f"cannot write {target}: {error.strerror or error}; {remedy}") from error
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
    return target


def _open_locked_temporary(target: Path) -> tuple[int, Path]:
    """Open a new locked file in the target's folder, and remove the temporary files that no writer has locked."""
    start, random = f".{target.name[:20]}.", 6  # number of random bytes in the name
    for leftover in target.parent.glob(f"{glob.escape(start)}{2 * random * '[0-9a-f]'}.tmp"):
        with contextlib.suppress(OSError), leftover.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            leftover.unlink()
    while True:
        temporary = target.with_name(f"{start}{secrets.token_hex(random)}.tmp")
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        with contextlib.suppress(OSError):  # some network disks have no locks; leftovers on them are never removed
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        if os.fstat(descriptor).st_nlink:
            return descriptor, temporary
        os.close(descriptor)  # another writer removed the file as a leftover before it was locked


def has_no_room(error: OSError) -> bool:
    """Return True if an error means that the disk is full, the quota is used up or the file is too large.

    Args:
        error: Error of the operating system that was raised during writing.
    """
    return error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def check_folder(path: str | os.PathLike[str]) -> None:
    """Check that the folder of an output file exists and is writable, before the output is computed.

    Args:
        path: File that will be written later; `~` is expanded.

    Raises:
        OutputError: The folder does not exist or is write-protected; the message gives the command that creates it.
    """
    folder = Path(path).expanduser().absolute().parent
    if not folder.is_dir():
        raise OutputError(f"make the folder first, mkdir -p '{folder}': {path} cannot be written without it")
    if not os.access(folder, os.W_OK):
        raise OutputError(f"cannot write {path}: the folder {folder} is write-protected; choose another folder")


def _check_target(path: str | os.PathLike[str]) -> Path:
    """Return the absolute path of the file to write, with links resolved; refuse a path that cannot be written."""
    text = os.fspath(path)
    if not text:
        raise OutputError("cannot write to an empty path: give a file name")
    try:
        target = Path(text).expanduser().resolve()  # a link stays a link, its target is replaced
        mode = target.stat().st_mode if target.exists() else None
    except (OSError, RuntimeError, ValueError) as error:
        raise OutputError(f"cannot write {text!r}: {error}; choose another file name") from error
    if mode is None:
        if text.endswith(("/", os.sep)):
            raise OutputError(f"cannot write {text!r}: it names a folder; give a file name in it")
        return target
    if stat.S_ISDIR(mode):
        raise OutputError(f"cannot write {target}: it is a folder; give a file name in it")
    if not stat.S_ISREG(mode):
        raise OutputError(f"cannot write {target}: it is a device or a pipe; give an ordinary file name")
    if not os.access(target, os.W_OK):
        raise OutputError(f"cannot write {target}: the file is write-protected; choose another name or remove it")
    return target
