"""One recording as it stands in a file, before it is matched to a robot, and what every reader asks of a file: what it
claims to hold is checked before it is read, with the same numbers for every format.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.errors import DAMAGE, RecordingError
from manip_learn.robot.description.text import DEEPEST, UNREADABLE, open_regular_file, read_regular_file, unreadable

_LONGEST = 160  # characters of a foreign text: two lines of a terminal
POINTER = b"version https://git-lfs"  # how the text begins that Git LFS leaves in place of a file
# bytes that are never too many, and times that what is in a file may be larger than it: motions pack 1 to 20 times
ALWAYS_FINE, BOMB_RATIO = 50_000_000, 200
LARGEST_ARRAYS = 16_000_000_000  # bytes of all arrays of one recording, which are in memory together
FEWEST_SAMPLE_BYTES = 16  # of a sample: a stamp and a few joints
_MOST_COLUMNS = 10_000  # of a table, an array or a message: a hundred robots
LONGEST_TEXT = 1_000_000  # characters of a line of a table, or of one text in an archive
LARGEST_METADATA = 10_000_000  # bytes of a JSON or YAML file, which lists features or topics but no samples
MOST_NAME_LISTS = 200  # lists of joints in one topic of a bag; drivers that alternate have two or three


@final
@dataclass(frozen=True, eq=False)
class Recording:
    """Numbers and names of one demonstration, unit and order still those of the file.

    Attributes:
        path: File.
        name: Name used in messages, e.g. `demo_01.csv` or `demo.hdf5 demo_3`.
        time: shape (T,), stamps as in the file.
        position_names: One name per column of `positions`.
        positions: shape (T, m).
        velocity_names: One joint name per column of `velocities`.
        velocities: shape (T, k), or None.
        strict_columns: True where names are written by hand (a surplus name is a mistake), False where a program writes
            them.
        in_seconds: True if the format itself says that `time` is in seconds.
        trusted: True for our own rollouts: their units are not questioned.
        line_of: Sample -> line in the file, where there are lines.
        notes: What the reader noticed or did.
        effort_names: One joint name per column of `efforts`.
        efforts: shape (T, e) [N m or N], or None.
        sha256: Of the file; empty for a folder.
        lag: By how far the positions were at most from where they were commanded to be [rad or m]; of trusted ones.
    """

    path: Path
    name: str
    time: Float[np.ndarray, " T"]
    position_names: tuple[str, ...]
    positions: Float[np.ndarray, "T m"]
    velocity_names: tuple[str, ...] = ()
    velocities: Float[np.ndarray, "T k"] | None = None
    strict_columns: bool = True
    in_seconds: bool = False
    trusted: bool = False
    line_of: Callable[[int], int] | None = None
    notes: tuple[str, ...] = ()
    effort_names: tuple[str, ...] = ()
    efforts: Float[np.ndarray, "T e"] | None = None
    sha256: str = ""
    lag: float = 0.0

    @staticmethod
    def of(
        path: Path,
        name: str,
        time: np.ndarray,
        names: tuple[str, ...],
        q: np.ndarray,
        u: np.ndarray | None,
        effort: np.ndarray | None,
        **others: Any,
    ) -> Recording:
        """A recording whose velocities and efforts, where there are some, are those of the joints of its positions."""
        u_names, e_names = (() if x is None else names for x in (u, effort))
        return Recording(path, name, time, names, q, u_names, u, effort_names=e_names, efforts=effort, **others)

    def without(self, unwanted: Callable[[str], bool]) -> Recording:
        """The recording without the columns whose names are not wanted."""
        changed: dict[str, Any] = {}
        for values, names in (("positions", "position"), ("velocities", "velocity"), ("efforts", "effort")):
            called, array = getattr(self, f"{names}_names"), getattr(self, values)
            wanted = [i for i, n in enumerate(called) if not unwanted(n)]
            if len(wanted) == len(called):  # a million samples are not copied for nothing
                continue
            changed[f"{names}_names"] = tuple(called[i] for i in wanted)
            changed[values] = None if array is None else array[:, wanted]
        return replace(self, **changed)

    def line(self, sample: int) -> int | None:
        """Line of the sample in the file, counted from 1, or None."""
        return None if self.line_of is None else self.line_of(int(sample))

    def place(self, sample: int) -> str:
        """`line 12`, or `sample 10` where there are no lines."""
        line = self.line(sample)
        return f"sample {int(sample)}" if line is None else f"line {line}"

    def refusal(self, code: str, text: str, *, sample: int | None = None, column: str | None = None) -> RecordingError:
        """The error that refuses this recording, with its place."""
        line = None if sample is None else self.line(sample)
        where = self.name + ("" if sample is None else f" sample {int(sample)}" if line is None else f":{line}")
        if column is not None:
            where += f", column {column!r}"
        return RecordingError(f"{where}: {text}", code=code, path=self.path, line=line, column=column)


def refusal(
    path: Path, code: str, text: str, *, line: int | None = None, column: str | None = None, in_full: bool = False
) -> RecordingError:
    """The error that refuses a file.

    Args:
        path: The file, which is called by its name.
        code: Short name of the reason.
        text: What is wrong, and what to do.
        line: Where, counted from 1.
        column: Name of the column.
        in_full: Call it by its whole path.
    """
    where = f"{path if in_full else path.name}{'' if line is None else f':{line}'}"
    where += "" if column is None else f", column {column!r}"
    return RecordingError(f"{where}: {text}", code=code, path=path, line=line, column=column)


@contextmanager
def refusing_damage(path: Path, *more: type[Exception]) -> Iterator[None]:
    """Within it, what libraries raise for broken files, and `more`, is the refusal of a file."""
    try:
        yield
    except (*more, *DAMAGE) as error:
        code, said = "damaged", f"the file is damaged ({reason_of(error)}): download, copy or save it again"
        if isinstance(error, MemoryError):
            code, said = "too-large", f"there is too little memory for it ({reason_of(error)}): divide the recording"
        elif isinstance(error, OSError) and error.errno in UNREADABLE:
            code, said = unreadable(error)
        codes = {"missing": "missing-file", "file-too-large": "too-large"}
        raise refusal(path, codes.get(code, code), said, in_full=code != "damaged") from error


def reason_of(error: BaseException) -> str:
    """Its message without line breaks; the name of its class if it has none."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "..."


def float_array(values: np.ndarray) -> Float[np.ndarray, "..."]:
    """The values as native float64 in C order; what is not a number becomes NaN, which validation finds."""
    with np.errstate(invalid="ignore", over="ignore"):  # signalling NaN in damaged files
        return np.ascontiguousarray(values, dtype=np.float64)


def natural_order(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key that puts `demo_2` before `demo_10`."""
    parts = re.findall(r"\d+|\D+", name)
    # CPython refuses to convert thousands of digits
    return tuple((0, int(p), "") if p.isdecimal() and len(p) < 400 else (1, 0, p) for p in parts)


def check_regular(path: Path) -> bytes:
    """Return how a file begins, 4 kB at most; refuse what is neither a file nor there, and what only stands for one.

    Raises:
        RecordingError: Missing, not readable, a pipe, a device, a pointer of Git LFS.
    """
    with refusing_damage(path), open_regular_file(path) as file:
        head = file.read(4096)
    if head.startswith(POINTER):
        raise refusal(path, "git-lfs", "this is a Git LFS pointer, not the recording itself: run `git lfs pull`")
    return head


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
    if n > _MOST_COLUMNS:
        raise refusal(path, "too-large", f"{what} has {n:,} columns, at most {_MOST_COLUMNS:,} are read")


def metadata_text(path: Path) -> str:
    """The text of a file of JSON or YAML.

    Raises:
        RecordingError: Not a regular file, too large, brackets too deep within each other, or no UTF-8.
    """
    check_regular(path)
    with refusing_damage(path):
        text = read_regular_file(path, LARGEST_METADATA).decode()
    depths = itertools.accumulate(1 if mark in "[{" else -1 for mark in re.findall(r"[][{}]", text))
    if any(depth > DEEPEST for depth in depths):
        raise refusal(path, "damaged", f"more than {DEEPEST} brackets are open within each other", in_full=True)
    return text
