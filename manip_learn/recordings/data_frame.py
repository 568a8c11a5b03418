"""Demonstrations as one table of pandas, and back."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator, Sequence, Sized
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, runtime_checkable

import numpy as np

from manip_learn.errors import MissingExtraError, RecordingError
from manip_learn.recordings.format_words import EFFORT_SUFFIX, VELOCITY_SUFFIX
from manip_learn.recordings.trajectory import Trajectory

TRAJECTORY, TIME = "trajectory", "time"


@runtime_checkable
class DataFrame(Protocol):
    """What is needed of a table of pandas, which need not be installed."""

    @property
    def columns(self) -> Sized:
        """Names."""
        ...

    @property
    def index(self) -> Sized:
        """Row numbers, names or times."""
        ...

    @property
    def to_csv(self) -> object:  # the overloads of pandas-stubs fit no signature of our own
        """Write a text table."""
        ...


if TYPE_CHECKING:  # what comes back is a table of pandas; at run time pandas need not be there
    import pandas as pd

    PandasFrame: TypeAlias = pd.DataFrame
else:
    PandasFrame = DataFrame


def pandas_frame_of(trajectories: Sequence[Trajectory]) -> PandasFrame:
    """See `Demonstrations.to_frame`.

    Raises:
        RecordingError: Postures that are no joint positions (nq differs from nv) have no column names.
        MissingExtraError: pandas is not installed.
    """
    try:
        import pandas as pd
    except ImportError as error:
        raise MissingExtraError("a data frame", "pandas") from error
    joints = trajectories[0].joint_names
    for t in trajectories:
        if t.q.shape[1] != len(joints):
            text = f"{t.name}: q has {t.q.shape[1]} columns and there are {len(joints)} joint names: a table needs one "
            text += "name per column; name the joints, or load the recording with load_demonstrations"
            raise RecordingError(text, code="joint-names")
    table: dict[str, np.ndarray] = {
        TRAJECTORY: np.repeat([t.name for t in trajectories], [len(t) for t in trajectories]),
        TIME: np.concatenate([t.time for t in trajectories]),
    }
    for attribute, suffix in (("q", ""), ("u", VELOCITY_SUFFIX), ("effort", EFFORT_SUFFIX)):
        names = [name + suffix for name in joints]
        arrays = [getattr(t, attribute) for t in trajectories]
        if any(a is not None for a in arrays):
            missing = [np.full((len(t), len(names)), np.nan) for t in trajectories]
            filled = [m if a is None else a for m, a in zip(missing, arrays, strict=True)]
            table |= dict(zip(names, np.concatenate(filled).T, strict=True))
    return pd.DataFrame(table)


@contextmanager
def frames_as_files(given: Any, first: int = 1) -> Iterator[Any]:
    """Data frames as text tables while they are read, so that one reader says what columns mean; else what was given.

    A frame with a column `trajectory` is one table for each of its values. An index of times or durations, or an index
    called `time`, is a column `time`. Numbers are written so that they come back bit for bit.

    Args:
        given: A data frame, several of them, or paths.
        first: Number of the first frame in names.
    """
    frames = [given] if isinstance(given, DataFrame) else given
    if not (isinstance(frames, Sequence) and frames and all(isinstance(frame, DataFrame) for frame in frames)):
        yield given
        return
    with tempfile.TemporaryDirectory(prefix="manip_learn_") as folder:
        yield [path for number, frame in enumerate(frames, first) for path in _written(frame, Path(folder), number)]


def _written(frame: Any, folder: Path, number: int) -> Iterator[Path]:
    if not len(frame) or not len(frame.columns):
        raise RecordingError(f"data frame {number} has the shape {frame.shape}: there is nothing in it", code="empty")
    frame = _with_time(frame)
    if TRAJECTORY in frame.columns:
        groups = [(str(name), part) for name, part in frame.groupby(TRAJECTORY, sort=False)]
    else:
        groups = [(f"data frame {number}", frame)]
    for i, (name, part) in enumerate(groups):
        inner = folder / f"{number}_{i}"  # names may be equal once they are fit for a file
        inner.mkdir()
        path = inner / (re.sub(r"[^\w. -]", "_", name)[:100] or "data frame")
        part.drop(columns=TRAJECTORY, errors="ignore").dropna(axis=1, how="all").to_csv(path, index=False, na_rep="nan")
        yield path


def _with_time(frame: Any) -> Any:
    """The frame with its index as a column, where the index is of time."""
    index = frame.index
    if TIME in frame.columns:
        return frame
    if index.dtype.kind in "mM":  # durations, or dates
        durations = index - index[0] if index.dtype.kind == "M" else index
        return frame.assign(**{TIME: durations.total_seconds()})
    return frame.assign(**{TIME: index}) if index.name == TIME else frame
