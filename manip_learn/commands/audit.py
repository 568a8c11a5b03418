"""`manip-learn audit`: every recorded episode judged by a constraint."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from manip_learn.atomic_write import write_atomically
from manip_learn.commands.loading import robot_of_constraint
from manip_learn.commands.options import AuditOptions
from manip_learn.constraint.constraint import Constraint
from manip_learn.learning.audit import AuditReport, EpisodeAudit, audit_episodes
from manip_learn.learning.table import dask_client
from manip_learn.recordings.load import Progress, RecordingSource


@final
@dataclass(frozen=True)
class Audited:
    """Report, and the file of its table or None."""

    report: AuditReport
    out: Path | None

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON answer."""
        return {**self.report.to_dict(), "csv": None if self.out is None else str(self.out)}


def audit(options: AuditOptions, progress: Progress | None = None) -> Audited:
    """Measure and rank the episodes in some recordings; write them as CSV if a file is named."""
    robot = robot_of_constraint(options.robot, options.constraint, options.loading)
    constraint = Constraint.load(options.constraint, robot)
    source = RecordingSource(options.recordings, robot, progress=progress, **options.reading.keywords())
    with dask_client(options.dask) as client:
        report = audit_episodes(constraint, source, client=client, progress=progress)
    return Audited(report, None if options.csv is None else write_table(report, options.csv))


def write_table(report: AuditReport, path: Path) -> Path:
    """Write one line per recording as CSV, the worst first; a measure that is not defined is an empty cell.

    Args:
        report: Audited recordings.
        path: File to write.

    Returns:
        The file.

    Raises:
        OutputError: It cannot be written.
    """
    writer = csv.writer(text := io.StringIO(), lineterminator="\n")
    writer.writerow(EpisodeAudit._fields)
    rows = ([*e[:-2], int(e.leave_out), "; ".join(e.reasons)] for e in report.episodes)
    writer.writerows([cell if cell == cell else "" for cell in row] for row in rows)  # NaN differs from itself
    return write_atomically(path, text.getvalue())
