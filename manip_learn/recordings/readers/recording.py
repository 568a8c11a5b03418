"""One recording as it stands in a file, before it is matched to a robot, and what every reader asks of a file."""

from __future__ import annotations

import json
import re
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.errors import RecordingError

LONGEST = 160
GAP_FACTOR = 10.0  # times the usual step: a break in a recording


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
        where = self.name if line is None else f"{self.name}:{line}"
        if sample is not None and line is None:
            where += f" sample {int(sample)}"
        if column is not None:
            where += f", column {column!r}"
        return RecordingError(f"{where}: {text}", code=code, path=self.path, line=line, column=column)


def reason(error: BaseException) -> str:
    """Its message without line breaks; the name of its class if it has none."""
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."


def float_array(values: np.ndarray) -> Float[np.ndarray, "..."]:
    """The values as native float64 in C order; what is not a number becomes NaN, which validation finds."""
    with np.errstate(invalid="ignore", over="ignore"):  # signalling NaN in damaged files
        return np.ascontiguousarray(values, dtype=np.float64)


def size_on_disk(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def natural_order(name: str) -> tuple[tuple[int, int, str], ...]:
    """Sort key that puts `demo_2` before `demo_10`."""
    parts = re.findall(r"\d+|\D+", name)
    # CPython refuses to convert thousands of digits
    return tuple((0, int(p), "") if p.isdecimal() and len(p) < 400 else (1, 0, p) for p in parts)


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
