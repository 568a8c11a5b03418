"""Small JSON files beside recordings, and whether a path is a file at all."""

from __future__ import annotations

import json
import stat
from pathlib import Path

from manip_learn.errors import RecordingError
from manip_learn.recordings.readers.recording import reason


def check_regular(path: Path) -> None:
    """Refuse what is neither a file nor there.

    Raises:
        RecordingError: Missing, not readable, a pipe, a device.
    """
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            raise RecordingError(
                f"{path}: this is not a regular file; give a recording or a folder of recordings",
                code="not-a-file",
                path=path,
            )
        with path.open("rb"):
            pass
    except FileNotFoundError as error:
        raise RecordingError(
            f"{path}: there is no such file: check the path", code="missing-file", path=path
        ) from error
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path}: cannot be opened: {reason(error)}", code="unreadable", path=path) from error


def read_json(path: Path, most_bytes: int = 10_000_000) -> object:
    """A small JSON file.

    Raises:
        RecordingError: Too large or not JSON.
    """
    check_regular(path)
    if path.stat().st_size > most_bytes:
        raise RecordingError(
            f"{path}: larger than {most_bytes:,} bytes, which no such file should be", code="too-large", path=path
        )
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"{path}: not valid JSON: {reason(error)}", code="damaged", path=path) from error
