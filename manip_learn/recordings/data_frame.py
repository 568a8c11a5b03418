"""Demonstrations as one table of pandas, and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from manip_learn.errors import MissingExtraError, RecordingError
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.writers.csv_writer import VELOCITY_SUFFIX

if TYPE_CHECKING:
    import pandas

TRAJECTORY, TIME = "trajectory", "time"


def frame_of(trajectories: Sequence[Trajectory]) -> pandas.DataFrame:
    """See `Demonstrations.to_frame`."""
    try:
        import pandas as pd
    except ImportError as error:
        raise MissingExtraError("a data frame", "pandas") from error
    joints = trajectories[0].joint_names
    for t in trajectories:
        if t.q.shape[1] != len(joints):
            raise RecordingError(
                f"{t.name}: q has {t.q.shape[1]} columns and there are {len(joints)} joint names: a table needs one "
                "name per column; name the joints, or load the recording with load_demonstrations",
                code="joint-names",
            )
    table: dict[str, np.ndarray] = {
        TRAJECTORY: np.repeat([t.name for t in trajectories], [len(t) for t in trajectories]),
        TIME: np.concatenate([t.time for t in trajectories]),
    }
    q = np.concatenate([t.q for t in trajectories])
    table |= {name: q[:, j] for j, name in enumerate(joints)}
    if any(t.u is not None for t in trajectories):
        u = np.concatenate([np.full_like(t.q, np.nan) if t.u is None else t.u for t in trajectories])
        table |= {name + VELOCITY_SUFFIX: u[:, j] for j, name in enumerate(joints)}
    return pd.DataFrame(table)
