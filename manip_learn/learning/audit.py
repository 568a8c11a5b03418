"""Recordings judged by a learnt constraint: every episode measured, ranked, and those named that should be left out."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit

from manip_learn.atomic_write import write_atomically
from manip_learn.constraint.constraint import Constraint
from manip_learn.errors import RecordingError, counted
from manip_learn.learning.data_summary import check_joints
from manip_learn.learning.episode_measures import EpisodeAudit, measure
from manip_learn.linalg import one_thread
from manip_learn.recordings.given_motions import Motion
from manip_learn.recordings.readers.option_uses import refuse_unmatched
from manip_learn.recordings.trajectory_source import Progress, TrajectorySource, source_of
from manip_learn.recordings.velocities import VelocityMethod

FALSE_ALARMS = 0.05  # chance that an audit of equally good episodes leaves any of them out
SMALLEST_THRESHOLD = 3.5  # Iglewicz and Hoaglin, How to Detect and Handle Outliers (1993)
# a z-score by the median absolute deviation has the tails of a Student's t with 0.37 n + 0.25 degrees of freedom: 0.37
# is its efficiency beside the standard deviation, 0.25 what a simulation of small n adds
MAD_EFFICIENCY, MAD_SMALL = 0.37, 0.25
MAD_TO_SIGMA = 1.4826
FEWEST = 5  # episodes, below which no spread can be told
LOG_SPREAD, SHARE_SPREAD = 0.1, 0.05  # spread below which differences do not matter: 10 %, and 5 points of a share


@final
@dataclass(frozen=True)
class Criterion:
    """One way in which an episode can be worse than the others.

    Attributes:
        name: Key in the JSON document.
        badness: Measure -> a number that grows as the episode gets worse; its z-score is one-sided.
        least_spread: Smallest standard deviation that is believed.
        sentence: Measure -> what is wrong, in words.
        two_sided: Whether too little is as bad as too much.
        needs_rest: Whether it says something only of rows that the world holds still (b = 0).
    """

    name: str
    badness: Callable[[EpisodeAudit], float]
    least_spread: float
    sentence: Callable[[EpisodeAudit], str]
    two_sided: bool = False
    needs_rest: bool = False


def _log(value: float, least: float) -> float:
    """Logarithm; below `least` differences do not matter."""
    return math.log(max(value, least)) if not math.isnan(value) else math.nan


CRITERIA = (
    Criterion(
        "singularity",
        lambda e: -_log(e.sigma_min, 1e-6),
        LOG_SPREAD,
        lambda e: f"comes close to the task's singularity (smallest singular value {e.sigma_min:.3g})",
    ),
    Criterion(
        "violation",
        lambda e: _log(e.residual, 0.01),
        LOG_SPREAD,
        lambda e: f"violates the constraint with {100 * e.residual:.2g} % of its motion",
        needs_rest=True,
    ),
    Criterion(
        "displacement",
        lambda e: _log(e.displacement_mm, 1.0),
        LOG_SPREAD,
        lambda e: f"moves {e.displacement_mm:.3g} mm along directions that are held",
        needs_rest=True,
    ),
    Criterion(
        "rotation",
        lambda e: _log(e.displacement_deg, 0.2),
        LOG_SPREAD,
        lambda e: f"turns {e.displacement_deg:.3g} degrees about axes that are held",
        needs_rest=True,
    ),
    Criterion(
        "limits",
        lambda e: -e.limit_margin,
        SHARE_SPREAD,
        lambda e: f"joint {e.limit_joint!r} gets within {100 * e.limit_margin:.2g} % of its range to a limit",
    ),
    Criterion(
        "speed",
        lambda e: _log(e.peak_speed, 0.1),
        LOG_SPREAD,
        lambda e: f"joint {e.peak_speed_joint!r} reaches {100 * e.peak_speed:.3g} % of its velocity limit",
    ),
    Criterion("jerk", lambda e: _log(e.jerk_rms, 1.0), LOG_SPREAD, lambda e: f"is jerky ({e.jerk_rms:.3g} rad/s3 rms)"),
    Criterion(
        "rest", lambda e: e.rest_share, SHARE_SPREAD, lambda e: f"is at rest {100 * e.rest_share:.2g} % of the time"
    ),
    Criterion(
        "duration", lambda e: _log(e.duration, 1e-3), LOG_SPREAD, lambda e: f"lasts {e.duration:.3g} s", two_sided=True
    ),
)
RULE = (
    "z = (value - median) / max(1.4826 MAD, least spread) per criterion, the worse the larger (logarithms of "
    "sigma_min, residual, displacements, peak speed, jerk and duration); score = sqrt(sum of squares of the positive "
    "z); left out where a z exceeds the threshold, Student's t with 0.37 n + 0.25 degrees of freedom at 5 % for "
    "all episodes and criteria together, at least 3.5"
)


@final
@dataclass(frozen=True)
class AuditReport:
    """Episodes, the worst first.

    Attributes:
        episodes: Measures, score and reasons of each.
        criteria: Names of the criteria used.
        threshold: Robust z-score beyond which an episode is left out; infinite for fewer than five.
        notes: What was done to the recordings, and what the audit cannot tell.
    """

    episodes: tuple[EpisodeAudit, ...]
    criteria: tuple[str, ...]
    threshold: float
    notes: tuple[str, ...] = ()

    @property
    def leave_out(self) -> tuple[EpisodeAudit, ...]:
        """Those to leave out, the worst first."""
        return tuple(e for e in self.episodes if e.leave_out)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON; NaN and infinity are for the writer to handle."""
        return {
            "episodes": [{**dataclasses.asdict(e), "leave_out": e.leave_out} for e in self.episodes],
            "leave_out": [{"episode": e.episode, "number": e.number, "reasons": e.reasons} for e in self.leave_out],
            "rule": {"text": RULE, "criteria": self.criteria, "threshold": self.threshold},
            "n_episodes": len(self.episodes),
            "n_samples": sum(e.n_samples for e in self.episodes),
            "notes": self.notes,
        }

    def save_csv(self, path: str | Path) -> Path:
        """Write one line per episode, the worst first; a measure that is not defined is an empty cell.

        Raises:
            OutputError: It cannot be written.
        """
        text = io.StringIO()
        names = [f.name for f in dataclasses.fields(EpisodeAudit) if f.name != "reasons"]
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([*names, "leave_out", "reasons"])
        for e in self.episodes:
            values = [getattr(e, name) for name in names]
            cells = ["" if isinstance(v, float) and not math.isfinite(v) else v for v in values]
            writer.writerow([*cells, int(e.leave_out), "; ".join(e.reasons)])
        return write_atomically(path, text.getvalue())


def audit_episodes(
    constraint: Constraint,
    demonstrations: TrajectorySource | Motion | Iterable[Motion],
    *,
    velocities: VelocityMethod = "auto",
    client: Any = None,
    progress: Progress | None = None,
) -> AuditReport:
    """Measure, rank and judge episodes by a constraint; one trajectory in memory at a time.

    Args:
        constraint: Learnt, or written by hand. If it was learnt as self-imposed (rows moved on purpose), motion along
            its rows is no violation and does not count.
        demonstrations: As for `ConstraintLearner.fit`.
        velocities: How missing velocities are derived, see `derive_velocities`.
        client: A `dask.distributed.Client` whose workers measure the episodes.
        progress: Called with what is being done and the share of it that is done.

    Raises:
        RecordingError: No demonstrations, another robot's joints, or velocities that cannot be derived.
        MissingExtraError: A client without the extra `dask`.
    """
    source = source_of(demonstrations)
    rows: list[EpisodeAudit] = []
    notes: list[str] = []
    for part, said in _measured_parts(constraint, source, velocities, client, progress):
        rows += [dataclasses.replace(row, number=len(rows) + i) for i, row in enumerate(part)]
        notes += said
    notes = refuse_unmatched(notes, source.n_parts)
    if not rows:
        raise RecordingError("there are no demonstrations: give at least one trajectory", code="empty")
    imposed = constraint.provenance.get("kind") == "self-imposed"
    if imposed:
        notes.append("the constrained rows were moved on purpose: motion along them is no violation and does not count")
    if len(rows) < FEWEST:
        notes.append(f"too few to say which are odd: {counted(len(rows), 'episode')}, at least {FEWEST} are needed")
    return _judged(rows, imposed, tuple(dict.fromkeys(notes)))


def _measured_parts(
    constraint: Constraint, source: TrajectorySource, velocities: VelocityMethod, client: Any, progress: Progress | None
) -> Iterator[tuple[list[EpisodeAudit], list[str]]]:
    if client is not None:
        from manip_learn.learning.streaming.dask_executor import map_parts

        yield from map_parts(client, measured, source, (constraint, velocities), progress, "auditing")
        return
    for part in range(source.n_parts):
        yield measured(source.alone(part), constraint, velocities)
        if progress is not None:
            progress("auditing", (part + 1) / source.n_parts)


def measured(
    source: TrajectorySource, constraint: Constraint, velocities: VelocityMethod
) -> tuple[list[EpisodeAudit], list[str]]:
    """The episodes of a source of one part, and notes of its reader: what a worker does.

    Raises:
        RecordingError: Another robot's joints, or velocities that cannot be derived.
    """
    notes: list[str] = []
    rows: list[EpisodeAudit] = []
    robot = getattr(constraint.features, "robot", None)
    with one_thread():
        for number, trajectory in enumerate(source.part(0, notes)):
            check_joints(trajectory.joint_names, robot)
            rows.append(measure(constraint, trajectory, number, velocities))
    return rows, notes


def _judged(rows: list[EpisodeAudit], imposed: bool, notes: tuple[str, ...]) -> AuditReport:
    criteria = [c for c in CRITERIA if not (imposed and c.needs_rest)]
    values = np.array([[c.badness(row) for c in criteria] for row in rows])
    defined = np.any(np.isfinite(values), axis=0)
    criteria = [c for c, there in zip(criteria, defined, strict=True) if there]
    z = robust_z(values[:, defined], np.array([c.least_spread for c in criteria]))
    z = np.where([c.two_sided for c in criteria], np.abs(z), z)
    threshold = outlier_threshold(*z.shape)
    judged = []
    for row, scores in zip(rows, z, strict=True):
        reasons = tuple(
            f"{c.sentence(row)}, robust z {score:.1f}"
            for c, score in zip(criteria, scores, strict=True)
            if score > threshold
        )
        score = float(np.sqrt(np.sum(np.maximum(scores, 0.0) ** 2)))
        judged.append(dataclasses.replace(row, score=score, reasons=reasons))
    judged.sort(key=lambda row: (not row.leave_out, -row.score, row.number))
    return AuditReport(tuple(judged), tuple(c.name for c in criteria), threshold, notes)


def robust_z(values: Float[np.ndarray, "n k"], least_spread: Float[np.ndarray, " k"]) -> Float[np.ndarray, "n k"]:
    """(value - median) / max(1.4826 MAD, least spread), column by column; 0 where a value is not defined."""
    centre = np.nanmedian(values, axis=0)
    spread = np.maximum(MAD_TO_SIGMA * np.nanmedian(np.abs(values - centre), axis=0), least_spread)
    return np.nan_to_num((values - centre) / spread, nan=0.0)


def outlier_threshold(n: int, k: int) -> float:
    """Robust z-score that n equally good episodes exceed anywhere in k criteria with a chance of at most 5 %.

    For normal values; the chance is shared evenly among all n k scores (Bonferroni).
    """
    if n < FEWEST:
        return math.inf
    return max(SMALLEST_THRESHOLD, -float(stdtrit(MAD_EFFICIENCY * n + MAD_SMALL, FALSE_ALARMS / (n * max(k, 1)))))
