"""How large what a file claims to hold may be: checked before it is read, with the same numbers for every format."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np

from manip_learn.errors import RecordingError
from manip_learn.recordings.readers.recording import check_regular, reason, refusal

# bytes that are never too many, and times that what is in a file may be larger than it: motions pack 1 to 20 times
ALWAYS_FINE, BOMB_RATIO = 50_000_000, 200
LARGEST_ARRAYS = 16_000_000_000  # bytes of all arrays of one recording, which are in memory together
FEWEST_SAMPLE_BYTES = 16  # of a sample: a stamp and a few joints
MOST_COLUMNS = 10_000  # of a table, an array or a message: a hundred robots
LONGEST_TEXT = 1_000_000  # characters of a line of a table, or of one text in an archive
LARGEST_METADATA = 10_000_000  # bytes of a JSON or YAML file, which lists features or topics but no samples
DEEPEST = 100  # brackets within each other in such a file; beyond, parsers take quadratic time or run out of stack
MOST_NAME_LISTS = 200  # lists of joints in one topic of a bag; drivers that alternate have two or three


def most_bytes(packed: int) -> int:
    """Bytes that so many packed ones may unpack to."""
    return max(ALWAYS_FINE, BOMB_RATIO * packed)


def bomb(path: Path, evidence: str) -> RecordingError:
    """The refusal of a file that unpacks to far too much."""
    return refusal(
        path, "bomb", f"{evidence}: no recorded motion packs so well; if it is real, unpack it yourself first"
    )


def refuse_lost(path: Path, found: int, what: str, where: str, name: str, stated: object, way_out: str = "") -> None:
    """Refuse a file in which another number of something was found than `name` states.

    Raises:
        RecordingError: Code `lost-samples`.
    """
    if isinstance(stated, int | np.integer) and not isinstance(stated, bool) and int(stated) != found:
        text = f"{found} {what} are there, {where} states {name} = {int(stated)}: some are missing or were changed"
        raise refusal(path, "lost-samples", f"{text}; download it again{way_out}")


def check_columns(path: Path, what: str, n: int) -> None:
    """Refuse more columns than any robot has joints.

    Raises:
        RecordingError: Code `too-large`.
    """
    if n > MOST_COLUMNS:
        raise refusal(path, "too-large", f"{what} has {n:,} columns, at most {MOST_COLUMNS:,} are read")


def metadata_text(path: Path) -> str:
    """The text of a file of JSON or YAML.

    Raises:
        RecordingError: Not a regular file, too large, brackets too deep within each other, or no UTF-8.
    """
    check_regular(path)
    if path.stat().st_size > LARGEST_METADATA:
        text = f"larger than {LARGEST_METADATA:,} bytes, which no such file should be"
        raise refusal(path, "too-large", text, in_full=True)
    try:
        text = path.read_text(encoding="utf-8")
    except (ValueError, OSError) as error:
        raise refusal(path, "damaged", f"it cannot be read as text: {reason(error)}", in_full=True) from error
    depths = itertools.accumulate(1 if mark in "[{" else -1 for mark in re.findall(r"[][{}]", text))
    if any(depth > DEEPEST for depth in depths):
        raise refusal(path, "damaged", f"more than {DEEPEST} brackets are open within each other", in_full=True)
    return text
