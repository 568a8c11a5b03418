"""A motion -> a file, in the format that its name asks for."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path

from manip_learn.atomic_write import write_atomically
from manip_learn.errors import OutputError
from manip_learn.recordings.saved_motion import SavedMotion
from manip_learn.recordings.writers.csv_writer import csv_bytes
from manip_learn.recordings.writers.jsonl_writer import jsonl_bytes
from manip_learn.recordings.writers.mcap_writer import mcap_bytes
from manip_learn.recordings.writers.npz_writer import npz_bytes

WRITERS: Mapping[str, Callable[[SavedMotion], bytes]] = {
    ".npz": npz_bytes,
    ".csv": csv_bytes,
    ".mcap": mcap_bytes,
    ".jsonl": jsonl_bytes,
}


def write_motion(path: str | os.PathLike[str], motion: SavedMotion) -> Path:
    """Write a motion, whole or not at all.

    Returns:
        The absolute path that was written.

    Raises:
        OutputError: No format of that name, it cannot be written, or the format cannot hold the motion.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".rrd":
        raise OutputError(
            f"cannot write {os.fspath(path)!r}: a Rerun recording shows the robot too; use "
            "manip_learn.playback.write_rerun(robot, rollouts, path), or `manip-learn export ROBOT FILE... --out x.rrd`"
        )
    if suffix not in WRITERS:
        raise OutputError(
            f"cannot write {os.fspath(path)!r}: the ending says the format, and it is {suffix or 'missing'!r}; use "
            f"one of {', '.join(WRITERS)}"
        )
    try:
        content = WRITERS[suffix](motion)
    except UnicodeEncodeError as error:
        raise OutputError(f"cannot write {os.fspath(path)!r}: a name in it is no text ({error})") from error
    return write_atomically(path, content)
