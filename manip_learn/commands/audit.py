"""`manip-learn audit`: every recorded episode judged by a constraint."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from manip_learn.commands.loading import robot_of_constraint
from manip_learn.commands.options import AuditOptions
from manip_learn.constraint.constraint import Constraint
from manip_learn.learning.audit import AuditReport, audit_episodes
from manip_learn.learning.thinning import dask_client
from manip_learn.recordings.load import Progress, RecordingSource


@final
@dataclass(frozen=True)
class Audited:
    """A report, and where its table was written."""

    report: AuditReport
    out: Path | None

    def to_dict(self) -> dict[str, Any]:
        """The JSON answer."""
        return {**self.report.to_dict(), "csv": None if self.out is None else str(self.out)}


def audit(options: AuditOptions, progress: Progress | None = None) -> Audited:
    """Measure and rank the episodes in some recordings; write them as CSV if a file is named."""
    robot = robot_of_constraint(options.robot, options.constraint, options.loading)
    constraint = Constraint.load(options.constraint, robot)
    source = RecordingSource(options.recordings, robot, progress=progress, **options.reading.keywords())
    with dask_client(options.dask) as client:
        report = audit_episodes(constraint, source, client=client, progress=progress)
    return Audited(report, None if options.csv is None else report.save_csv(options.csv))
