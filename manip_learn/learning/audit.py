"""Audit recordings with a learnt constraint: measure and rank each one, and decide which ones to leave out."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple, get_origin, get_type_hints

import numpy as np
from scipy.special import stdtrit

from manip_learn.constraint.constraint import Constraint
from manip_learn.errors import RecordingError, counted
from manip_learn.learning.table import REST_SPEED, map_parts
from manip_learn.recordings.given import Given, parts_of, recordings_given
from manip_learn.recordings.load import Progress, Reader
from manip_learn.recordings.options import Velocities, refuse_unmatched
from manip_learn.recordings.trajectory import Demonstrations, Trajectory
from manip_learn.recordings.velocities import jerk, positions_along, with_velocities

RULE = "left out where the robust z-score of a criterion, (value - median) / (1.4826 MAD), exceeds the threshold"


class EpisodeAudit(NamedTuple):
    """Measures of one recording, and the decision to keep it or leave it out.

    A measure is NaN if it is not defined (no limits, too few samples). A measure that is a criterion has an annotation
    with four entries: name of the criterion; direction of bad values (1 large, -1 small, 0 both); value below which
    differences do not matter (if it is not 0, logarithms are compared); text of the reason.

    Attributes:
        episode: Name of the trajectory.
        number: Position among the audited recordings, counted from 0.
        n_samples: Number of samples.
        duration: Time from the first to the last sample [s].
        rest_share: Share of the time in which no joint is faster than 0.02 rad/s or m/s.
        sigma_min: Smallest singular value of A(q) at any sample: the distance to the singularity of the task, in the
            unit of the rows.
        sigma_median: Median of the smallest singular values.
        manipulability_min: Smallest manipulability mu(q) = sqrt(det(A A^T)).
        residual: Share of the motion that violates A(q) u = 0, see `Constraint.residual`.
        displacement_mm: Extent of the motion along constrained linear rows [mm].
        displacement_deg: Extent of the motion along constrained angular rows [degrees].
        limit_margin: Smallest distance to a position limit, as a share of the joint's range; negative beyond it.
        limit_joint: Joint with the smallest distance, or an empty string.
        beyond_limits: Share of the samples beyond a position limit.
        peak_speed: Largest speed as a share of the velocity limit.
        peak_speed_joint: Joint with the largest share, or an empty string.
        too_fast: Share of the samples faster than a velocity limit.
        jerk_rms: Root mean square of the jerk [rad/s^3].
        jerk_peak: Largest jerk [rad/s^3].
        score: Root of the sum of squares of the positive z-scores, by which recordings are ranked.
        leave_out: True if the recording should be left out.
        reasons: Reasons to leave it out, in sentences; empty if it should stay.
    """

    episode: str
    number: int
    n_samples: int
    duration: Annotated[float, "duration", 0, 1e-3, "lasts {e.duration:.3g} s"]
    rest_share: Annotated[float, "rest", 1, 0.0, "is at rest {e.rest_share:.0%} of the time"]
    sigma_min: Annotated[float, "singularity", -1, 1e-6, "nears the task's singularity (sigma {e.sigma_min:.3g})"]
    sigma_median: float
    manipulability_min: float
    residual: Annotated[float, "violation", 1, 0.01, "violates the constraint with {e.residual:.1%} of its motion"]
    displacement_mm: Annotated[float, "displacement", 1, 1.0, "moves {e.displacement_mm:.3g} mm along held directions"]
    displacement_deg: Annotated[float, "rotation", 1, 0.2, "turns {e.displacement_deg:.3g} degrees about held axes"]
    limit_margin: Annotated[float, "limits", -1, 0.0, "leaves {e.limit_joint!r} only {e.limit_margin:.1%} of its range"]
    limit_joint: str
    beyond_limits: float
    peak_speed: Annotated[float, "speed", 1, 0.1, "moves {e.peak_speed_joint!r} at {e.peak_speed:.0%} of its top speed"]
    peak_speed_joint: str
    too_fast: float
    jerk_rms: Annotated[float, "jerk", 1, 1.0, "is jerky ({e.jerk_rms:.3g} rad/s3 rms)"]
    jerk_peak: float
    score: float = 0.0
    leave_out: bool = False
    reasons: tuple[str, ...] = ()


HINTS = get_type_hints(EpisodeAudit, include_extras=True)
CRITERIA = [(measure, *hint.__metadata__) for measure, hint in HINTS.items() if get_origin(hint) is Annotated]


class AuditReport(NamedTuple):
    """Audited recordings, the worst first.

    Attributes:
        episodes: Measures, score and reasons of each recording.
        criteria: Names of the criteria used.
        threshold: Robust z-score beyond which a recording is left out; infinite for fewer than five recordings.
        notes: Remarks of the readers, and limitations of this audit.
    """

    episodes: tuple[EpisodeAudit, ...]
    criteria: tuple[str, ...]
    threshold: float
    notes: tuple[str, ...] = ()

    @property
    def leave_out(self) -> tuple[EpisodeAudit, ...]:
        """Recordings to leave out, the worst first."""
        return tuple(e for e in self.episodes if e.leave_out)

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain dictionaries, lists and numbers; NaN and infinity are not replaced.

        Returns:
            `episodes` (all attributes of each), `leave_out` (name, number and reasons of each), `rule` (text, criteria,
            threshold), `n_episodes`, `n_samples` and `notes`.
        """
        odd = [{"episode": e.episode, "number": e.number, "reasons": e.reasons} for e in self.leave_out]
        rule = {"text": RULE, "criteria": self.criteria, "threshold": self.threshold}
        rows, sizes = [e._asdict() for e in self.episodes], [e.n_samples for e in self.episodes]
        totals = {"n_episodes": len(rows), "n_samples": sum(sizes), "notes": self.notes}
        return {"episodes": rows, "leave_out": odd, "rule": rule, **totals}


def audit_episodes(
    constraint: Constraint,
    demonstrations: Given,
    *,
    velocities: Velocities = "auto",
    false_alarms: float = 0.05,
    client: Any = None,
    progress: Progress | None = None,
) -> AuditReport:
    """Measure and rank recordings with a constraint, and name the ones to leave out of a data set.

    One recording is in memory at a time.

    Args:
        constraint: Constraint, learnt or written by hand. If it was learnt as self-imposed (the demonstrator drives the
            rows), motion along its rows is no violation.
        demonstrations: Recordings, in any form that `ConstraintLearner.fit` accepts.
        velocities: `"auto"` or `"derive"` to derive velocities from positions; `"recorded"` to use recorded velocities,
            and derive them for recordings without.
        false_alarms: Probability of leaving out at least one recording if all are equally good, between 0 and 1. With a
            larger value, more recordings are left out.
        client: A `dask.distributed.Client` whose workers measure the recordings; None to measure in this process.
        progress: Function that is called with the name of a stage and its completed share, 0 to 1; None for none.

    Returns:
        Measures and decisions for all recordings, the worst first. With fewer than five, none is left out.

    Raises:
        RecordingError: There are no demonstrations, they are of another robot, velocities cannot be derived, or
            `false_alarms` is not between 0 and 1.
        ManipLearnError: The workers of the client died.
        ConfigurationError: Recordings without joint names have another number of columns than the robot has joints.
    """
    if not 0.0 < false_alarms < 1.0:
        raise RecordingError(f"false_alarms must be a probability between 0 and 1, got {false_alarms!r}", code="option")
    parts = parts_of(recordings_given(demonstrations, constraint.robot, constraint.nv, velocities))
    results = list(map_parts(lambda part: _measure_part(constraint, velocities, part), parts, client, progress))
    notes = refuse_unmatched([note for _, remarks in results for note in remarks], len(parts))
    rows = [row for part, _ in results for row in part]
    if not rows:
        raise RecordingError("there are no demonstrations: give at least one trajectory", code="empty")
    criteria = [c for c in CRITERIA if np.any(np.isfinite([getattr(e, c[0]) for e in rows]))]
    if constraint.provenance.get("kind") == "self-imposed":
        notes.append("the demonstrator drives the constrained rows: motion along them does not count as a violation")
        criteria = [c for c in criteria if c[1] not in ("violation", "displacement", "rotation")]
    measures, names, signs, negligible, templates = zip(*criteria, strict=True)
    values, ratios = np.array([[getattr(e, m) for m in measures] for e in rows]), np.array(negligible) > 0.0
    values[:, ratios] = np.log(np.maximum(values, negligible)[:, ratios])
    values -= np.nanmedian(values, axis=0)
    # differences of 10 %, or of 5 points of a share, do not matter. Set by hand
    spread = np.maximum(1.4826 * np.nanmedian(np.abs(values), axis=0), np.where(ratios, 0.1, 0.05))
    z = np.nan_to_num(np.where(signs, np.multiply(signs, values), np.abs(values)) / spread)
    # All scores share the probability evenly (Bonferroni). A z-score by the median absolute deviation has the tails of
    # Student's t with 0.37 n degrees of freedom, its efficiency, and 0.25 by simulation of small n. The smallest
    # threshold is from Iglewicz and Hoaglin, How to Detect and Handle Outliers (1993). Fewer than 5 have no spread.
    threshold = max(3.5, -float(stdtrit(0.37 * len(z) + 0.25, false_alarms / z.size))) if len(z) >= 5 else np.inf
    if len(rows) < 5:
        notes.append(f"too few to judge: {counted(len(rows), 'episode')}, at least 5 are needed")
    for i, (e, scores) in enumerate(zip(rows, z, strict=True)):
        odd = [t.format(e=e) + f", robust z {s:.1f}" for t, s in zip(templates, scores, strict=True) if s > threshold]
        reasons, score = tuple(r.replace("%", " %") for r in odd), float(np.linalg.norm(np.maximum(scores, 0.0)))
        rows[i] = e._replace(number=i, score=score, leave_out=bool(odd), reasons=reasons)
    rows.sort(key=lambda e: (not e.leave_out, -e.score, e.number))
    return AuditReport(tuple(rows), names, threshold, tuple(dict.fromkeys(notes)))


def _measure_part(constraint: Constraint, velocities: Velocities, part: Reader) -> tuple[list[EpisodeAudit], list[str]]:
    """Return the measures of the recordings in a part, and remarks of its reader: the task of a dask worker."""
    notes: list[str] = []
    return [_measure(constraint, velocities, recorded) for recorded in part(notes)], notes


def _measure(constraint: Constraint, velocities: Velocities, recorded: Trajectory) -> EpisodeAudit:
    """Return the measures of one recording; its number and verdict depend on the others."""
    t, robot = with_velocities(Demonstrations([recorded]), constraint.robot, velocities)[0], constraint.robot
    u, weights = np.asarray(t.u), np.gradient(t.time) if len(t) > 1 else np.ones(1)  # [s] duration of each sample
    selection, features, limits = constraint.selection, constraint.features, []
    A = np.concatenate([selection @ features.batch(q) for q in np.array_split(t.q, 1 + len(t) // 4096)])  # fits memory
    _, sigma, Vt = np.linalg.svd(A, full_matrices=False)
    broken = np.einsum("nkv,nv->nk", Vt, u)[sigma > 1e-15 * sigma[:, :1]]
    residual = float(np.linalg.norm(broken) / np.linalg.norm(u)) if np.any(u) else np.nan
    path, units = np.cumsum(np.einsum("nsv,nv,n->ns", A, u, weights), axis=0) @ selection, np.array(features.row_units)
    path -= path[0]
    paths = 1e3 * path[:, units == "m/s"], np.degrees(path[:, units == "rad/s"])
    extents = [float(np.max(np.linalg.norm(p, axis=1))) if p.size else np.nan for p in paths]
    x, low, high, fastest, names = t.q, np.nan, np.nan, np.nan, t.joint_names
    if robot is not None:
        x = positions_along(t, robot)
        x = np.array([robot.positions(q) for q in t.q]) if x is None else x  # with a planar base
        low, high, fastest, names = robot.position_lower, robot.position_upper, robot.velocity_limit, robot.joint_names
    beyond = np.maximum(low - x, x - high) / np.where(np.isfinite(high - low), high - low, np.nan)
    for share, most, sign in ((beyond, 0.0, -1), (np.abs(u) / np.where(np.isfinite(fastest), fastest, np.nan), 1.0, 1)):
        joint = int(np.argmax(worst := np.nan_to_num(np.max(share, axis=0), nan=-np.inf)))
        name = names[joint] if np.isfinite(worst[joint]) else ""
        limits += [sign * float(np.max(share[:, joint])), name, float(np.mean(np.any(share > most + 1e-6, axis=1)))]
    rest = float(np.average(np.max(np.abs(u), axis=1) < REST_SPEED, weights=weights))
    near = float(sigma[:, -1].min()), float(np.median(sigma[:, -1])), float(sigma.prod(axis=1).min())
    return EpisodeAudit(*[t.name, 0, len(t), t.duration, rest, *near, residual, *extents, *limits, *jerk(t.time, x)])
