"""`manip-learn audit`: rank recorded episodes by their deviation from a constraint."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

from manip_learn.atomic_write import write_atomically
from manip_learn.commands.loading import load_constraint
from manip_learn.commands.options import AuditOptions
from manip_learn.commands.output import Answer, Progress, cells
from manip_learn.errors import counted
from manip_learn.learning.audit import AuditReport, EpisodeAudit, audit_episodes
from manip_learn.learning.table import dask_client
from manip_learn.recordings.load import RecordingSource

# measures of an episode, the most important first
_MEASURES = (
    "score: {score:.1f}; broken: {residual:.1%}; room: {limit_margin:.0%}; mm: {displacement_mm:.1f}; "
    "sigma: {sigma_min:.3f}; speed: {peak_speed:.0%}; rest: {rest_share:.0%}; deg: {displacement_deg:.1f}; "
    "jerk: {jerk_rms:.1f}; s: {duration:.1f}"
)


def audit(options: AuditOptions, progress: Progress) -> Answer:
    """Measure and rank the episodes of recordings; write the ranking as CSV if a file is named.

    Args:
        options: Options of the command.
        progress: Function that is called with the name of a stage and its completed fraction, 0 to 1.

    Returns:
        Answer with the ranking.
    """
    constraint, robot = load_constraint(options.robot, options.constraint, options)
    source = RecordingSource(options.recordings, robot, progress=progress, **options.keywords())
    with dask_client(options.dask) as client:
        report = audit_episodes(constraint, source, client=client, progress=progress)
    return audit_answer(report, None if options.csv is None else write_table(report, options.csv))


def audit_answer(report: AuditReport, file: Path | None = None) -> Answer:
    """Return an audit as an answer: the episodes to leave out with the reasons, and the worst episodes.

    Args:
        report: Result of the audit.
        file: CSV table of the audit; None if it was not written.
    """
    most = 20  # number of episodes on a terminal
    n = len(report.episodes)
    threshold = f"robust z above {report.threshold:.1f}" if math.isfinite(report.threshold) else "too few to tell"
    return Answer(
        {**report.to_dict(), "csv": file},
        title=f"leave out {len(report.leave_out)} of {counted(n, 'episode')} ({threshold})",
        sentences=[f"{e.episode}: {'; '.join(e.reasons)}" for e in report.leave_out],
        remarks=[f"the {most} worst (--csv FILE lists all):" if n > most else ""],
        rows=[{"episode": e.episode} | cells(e._asdict(), _MEASURES) for e in report.episodes[:most]],
        notes=report.notes,
        written=[f"written: {file}" if file else ""],
    )


def write_table(report: AuditReport, path: Path) -> Path:
    """Write one line per recording as CSV, the worst first; cells of undefined measures are empty.

    Args:
        report: Audited recordings.
        path: File to write.

    Returns:
        Path of the file.

    Raises:
        OutputError: The file cannot be written.
    """
    writer = csv.writer(text := io.StringIO(), lineterminator="\n")
    writer.writerow(EpisodeAudit._fields)
    rows = ([*e[:-2], int(e.leave_out), "; ".join(e.reasons)] for e in report.episodes)
    writer.writerows([cell if cell == cell else "" for cell in row] for row in rows)  # NaN differs from itself
    return write_atomically(path, text.getvalue())
