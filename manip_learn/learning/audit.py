"""Recordings judged by a learnt constraint: every episode measured, ranked, and those named that should be left out."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import NormalDist
from typing import Any, Literal, NamedTuple, final

import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit

from manip_learn.atomic_write import write_atomically
from manip_learn.constraint.constraint import Constraint
from manip_learn.errors import RecordingError, counted
from manip_learn.learning.checks import REST_SPEED
from manip_learn.learning.thinning import each_part
from manip_learn.linalg import one_thread
from manip_learn.recordings.given import Given, parts_of, recordings_given
from manip_learn.recordings.load import Progress, Reader
from manip_learn.recordings.options import Velocities, refuse_unmatched
from manip_learn.recordings.trajectory import Demonstrations, Trajectory
from manip_learn.recordings.velocities import jerk, with_velocities
from manip_learn.robot.robot import Robot

# chance that an audit of equally good episodes leaves any of them out. Convention
FALSE_ALARMS = 0.05
# z-score: Iglewicz and Hoaglin, How to Detect and Handle Outliers (1993)
SMALLEST_THRESHOLD = 3.5
# episodes, below which no spread can be told. Set by hand
FEWEST_EPISODES = 5
# spread below which differences do not matter: 10 %, and 5 points of a share. Set by hand
LOG_SPREAD, SHARE_SPREAD = 0.1, 0.05
# values below which differences do not matter: the smallest singular value that is told from zero; a share of the
# motion, [mm], [deg], a share of the velocity limit, [rad/s^3], [s]. Set by hand
_NEGLIGIBLE = {
    "singularity": 1e-6,
    "violation": 0.01,
    "displacement": 1.0,
    "rotation": 0.2,
    "speed": 0.1,
    "jerk": 1.0,
    "duration": 1e-3,
}

_CHUNK = 4096  # samples whose Phi are held at a time
NOTABLE = 1e-6  # [rad or m, and of a speed limit] beyond a limit

# a z-score by the median absolute deviation has the tails of a Student's t with 0.37 n + 0.25 degrees of freedom: 0.37
# is its efficiency beside the standard deviation, 0.25 what a simulation of small n adds
MAD_EFFICIENCY, MAD_SMALL = 0.37, 0.25
MAD_TO_SIGMA = 1.0 / NormalDist().inv_cdf(0.75)
RULE = (
    "z = (value - median) / max(1.4826 MAD, least spread) per criterion, the worse the larger (logarithms of "
    "sigma_min, residual, displacements, peak speed, jerk and duration); score = sqrt(sum of squares of the positive "
    "z); left out where a z exceeds the threshold, Student's t with 0.37 n + 0.25 degrees of freedom at a "
    "chance of 5 % or the one asked for, for all episodes and criteria together, at least 3.5"
)


@final
@dataclass(frozen=True)
class EpisodeAudit:
    """What the audit says of one episode. NaN where something is not defined (no limits, too few samples).

    Attributes:
        episode: Name of the trajectory.
        number: Its place among those audited, counted from 0.
        n_samples: Number of samples.
        duration: From the first to the last [s].
        rest_share: Share of the time in which no joint is faster than 0.02 rad/s or m/s.
        sigma_min: Smallest of the smallest singular values of A(q): the distance to the task's singularity, in the
            unit of the rows.
        sigma_median: Their median.
        manipulability_min: Smallest manipulability mu(q) = sqrt(det(A A^T)).
        residual: Share of the motion that breaks A(q) u = 0, sqrt(sum |A^+ A u|^2 / sum |u|^2).
        displacement_mm: Extent of the motion along the constrained rows, those in m [mm].
        displacement_deg: The same, rows in rad [degrees].
        limit_margin: Smallest distance to a position limit, as a share of the joint's range; negative beyond it.
        limit_joint: The joint that comes so close, or an empty string.
        beyond_limits: Share of the samples beyond a position limit.
        peak_speed: Largest speed as a share of the velocity limit.
        peak_speed_joint: The joint that is so fast, or an empty string.
        too_fast: Share of the samples faster than a velocity limit.
        jerk_rms: Root mean square of the jerk [rad/s^3].
        jerk_peak: Largest jerk [rad/s^3].
        score: Root of the sum of squares of the positive robust z-scores; the ranking's key.
        reasons: Why it should be left out, one sentence each; empty if it should stay.
    """

    episode: str
    number: int
    n_samples: int
    duration: float
    rest_share: float
    sigma_min: float
    sigma_median: float
    manipulability_min: float
    residual: float
    displacement_mm: float
    displacement_deg: float
    limit_margin: float
    limit_joint: str
    beyond_limits: float
    peak_speed: float
    peak_speed_joint: str
    too_fast: float
    jerk_rms: float
    jerk_peak: float
    score: float = 0.0
    reasons: tuple[str, ...] = ()

    @property
    def leave_out(self) -> bool:
        """Whether the audit says to leave it out."""
        return bool(self.reasons)


def measure(
    constraint: Constraint, trajectory: Trajectory, number: int, velocities: Velocities = "auto"
) -> EpisodeAudit:
    """The measures of one episode, without its score, which depends on the others.

    Raises:
        RecordingError: Velocities are missing and cannot be derived.
        ConfigurationError: Postures of another robot.
    """
    robot: Robot | None = getattr(constraint.features, "robot", None)
    moving = trajectory if robot is None else with_velocities(Demonstrations([trajectory]), robot, velocities)[0]
    u = np.zeros((len(moving), constraint.nv)) if moving.u is None else moving.u
    sigma, mu, broken, held = _along(constraint, moving.q, u)
    total = float(np.sum(u * u))
    x, columns = _joint_positions(trajectory, robot)
    (excess, limit_joint, beyond), (peak, fastest, too_fast) = _limits(robot, x, u[:, columns], columns)
    rms, jerk_peak = jerk(trajectory.time, x)
    rests = np.max(np.abs(u[:, columns]), axis=1, initial=0.0) < REST_SPEED
    weights = np.gradient(moving.time) if len(moving) > 1 else np.ones(1)  # [s] that each sample stands for
    units = np.array(constraint.features.row_units)
    return EpisodeAudit(
        episode=trajectory.name,
        number=number,
        n_samples=len(trajectory),
        duration=trajectory.duration,
        rest_share=float(np.sum(weights[rests]) / np.sum(weights)) if len(moving) > 1 else float("nan"),
        sigma_min=float(sigma.min()),
        sigma_median=float(np.median(sigma)),
        manipulability_min=float(mu.min()),
        residual=float(np.sqrt(np.sum(broken) / total)) if total > 0.0 else float("nan"),
        displacement_mm=1000.0 * _extent(moving.time, held[:, units == "m/s"]),
        displacement_deg=float(np.degrees(_extent(moving.time, held[:, units == "rad/s"]))),
        limit_margin=-excess,
        limit_joint=limit_joint,
        beyond_limits=beyond,
        peak_speed=peak,
        peak_speed_joint=fastest,
        too_fast=too_fast,
        jerk_rms=rms,
        jerk_peak=jerk_peak,
    )


def _along(
    constraint: Constraint, q: Float[np.ndarray, "T n"], u: Float[np.ndarray, "T nv"]
) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, " T"], Float[np.ndarray, " T"], Float[np.ndarray, "T p"]]:
    """Of each sample: the smallest singular value of A, mu, |A^+ A u|^2, and the constrained part of Phi u."""
    selection = constraint.selection
    sigma, mu, broken = (np.empty(len(q)) for _ in range(3))
    held = np.empty((len(q), selection.shape[1]))
    for start in range(0, len(q), _CHUNK):
        part = slice(start, start + _CHUNK)
        A = np.einsum("sp,npv->nsv", selection, constraint.features.batch(q[part]), optimize=True)
        _, singular, Vt = np.linalg.svd(A, full_matrices=False)
        sigma[part], mu[part] = singular[:, -1], np.prod(singular, axis=1)
        if A.shape[1] > A.shape[2]:  # more rows than joints: singular everywhere
            sigma[part] = mu[part] = 0.0
        used = singular > 1e-15 * singular[:, :1]  # as np.linalg.pinv
        broken[part] = np.sum((np.einsum("nkv,nv->nk", Vt, u[part]) * used) ** 2, axis=1)
        held[part] = np.einsum("nsv,nv->ns", A, u[part]) @ selection
    return sigma, mu, broken, held


def _extent(time: Float[np.ndarray, " T"], rate: Float[np.ndarray, "T k"]) -> float:
    """Length of the integrated rates along the direction in which they spread most; NaN without rows."""
    if rate.shape[1] == 0:
        return float("nan")
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(time)[:, None]
    way = np.vstack([np.zeros(rate.shape[1]), np.cumsum(steps, axis=0)])
    _, directions = np.linalg.eigh(np.cov(way, rowvar=False, bias=True).reshape(rate.shape[1], -1))
    return float(np.ptp(way @ directions[:, -1]))


def _joint_positions(trajectory: Trajectory, robot: Robot | None) -> tuple[np.ndarray, np.ndarray]:
    """Positions of the joints with one coordinate, continuous ones without jumps, and their tangent coordinates."""
    if robot is None:
        return trajectory.q, np.arange(len(trajectory.joint_names))
    blocks = [b for b in robot.blocks if b.v.stop - b.v.start == 1]
    columns = np.array([b.v.start for b in blocks], dtype=int)
    q = trajectory.q
    x = q if q.shape[1] == robot.nv else np.array([robot.positions(row) for row in q])
    x = x[:, columns].copy()
    for i, b in enumerate(blocks):
        if b.kind == "continuous":
            x[:, i] = np.unwrap(x[:, i])
    return x, columns


def _limits(
    robot: Robot | None, x: Float[np.ndarray, "T k"], u: Float[np.ndarray, "t k"], columns: np.ndarray
) -> tuple[tuple[float, str, float], tuple[float, str, float]]:
    """Of positions, as a share of the range beyond a limit (negative within), and of speeds, as a share of the limit:
    the largest, its joint, and the share of samples beyond a limit.
    """
    if robot is None:
        return (float("nan"), "", 0.0), (float("nan"), "", 0.0)
    lower, upper, fastest = (a[columns] for a in (robot.position_lower, robot.position_upper, robot.velocity_limit))
    beyond, names = np.maximum(lower - x, x - upper), [robot.joint_names[i] for i in columns]
    with np.errstate(invalid="ignore"):
        shares = np.where(np.isfinite(upper - lower), beyond / (upper - lower), -np.inf)
    speeds = np.where(np.isfinite(fastest), np.abs(u) / fastest, -np.inf)
    out = []
    for values, too_far in ((shares, beyond > NOTABLE), (speeds, speeds > 1.0 + NOTABLE)):
        of_joint = np.max(values, axis=0)
        worst = int(np.argmax(of_joint)) if np.any(np.isfinite(of_joint)) else None
        said = (float("nan"), "") if worst is None else (float(of_joint[worst]), names[worst])
        out.append((*said, 0.0 if worst is None else float(np.mean(np.any(too_far, axis=1)))))
    return out[0], out[1]


class Criterion(NamedTuple):
    """One way in which an episode can be worse than the others; its z-score is one-sided.

    Attributes:
        name: Key in the JSON document; measures named in `_NEGLIGIBLE` are compared by their logarithms.
        measure: Attribute of `EpisodeAudit`.
        words: What is wrong, with the measure and the joint to be filled in.
        factor: Of the measure in words.
        is_bad: `"high"` or `"low"`; `"both"` where too little is as bad as too much.
        joint: Attribute with the joint's name.
        needs_rest: Whether it says something only of rows that the world holds still (b = 0).
    """

    name: str
    measure: str
    words: str
    factor: float = 1.0
    is_bad: Literal["high", "low", "both"] = "high"
    joint: str = ""
    needs_rest: bool = False

    def badness(self, episode: EpisodeAudit) -> float:
        """A number that grows as the episode gets worse; differences below what is negligible do not matter."""
        value = getattr(episode, self.measure)
        if self.name in _NEGLIGIBLE:
            value = math.log(max(value, _NEGLIGIBLE[self.name])) if not math.isnan(value) else math.nan
        return -value if self.is_bad == "low" else value

    def sentence(self, episode: EpisodeAudit) -> str:
        """What is wrong with an episode, in words."""
        joint = getattr(episode, self.joint) if self.joint else ""
        return self.words.format(self.factor * getattr(episode, self.measure), joint=joint)


_NEAR = "comes close to the task's singularity (smallest singular value {:.3g})"
LIMIT = "joint {joint!r} gets within {:.2g} % of its range to a limit"
FAST = "joint {joint!r} reaches {:.3g} % of its velocity limit"
CRITERIA = (
    Criterion("singularity", "sigma_min", _NEAR, is_bad="low"),
    Criterion("violation", "residual", "violates the constraint with {:.2g} % of its motion", 100.0, needs_rest=True),
    Criterion("displacement", "displacement_mm", "moves {:.3g} mm along directions that are held", needs_rest=True),
    Criterion("rotation", "displacement_deg", "turns {:.3g} degrees about axes that are held", needs_rest=True),
    Criterion("limits", "limit_margin", LIMIT, 100.0, "low", "limit_joint"),
    Criterion("speed", "peak_speed", FAST, 100.0, joint="peak_speed_joint"),
    Criterion("jerk", "jerk_rms", "is jerky ({:.3g} rad/s3 rms)"),
    Criterion("rest", "rest_share", "is at rest {:.2g} % of the time", 100.0),
    Criterion("duration", "duration", "lasts {:.3g} s", is_bad="both"),
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
    demonstrations: Given,
    *,
    velocities: Velocities = "auto",
    false_alarms: float = FALSE_ALARMS,
    client: Any = None,
    progress: Progress | None = None,
) -> AuditReport:
    """Measure, rank and judge episodes by a constraint; one trajectory in memory at a time.

    Args:
        constraint: Learnt, or written by hand. If it was learnt as self-imposed (rows moved on purpose), motion along
            its rows is no violation and does not count.
        demonstrations: As for `ConstraintLearner.fit`.
        velocities: Which recorded ones are used and how others are derived, as of `ConstraintLearner`.
        false_alarms: Chance that of equally good episodes any is left out; a larger one leaves out more.
        client: A `dask.distributed.Client` whose workers measure the episodes.
        progress: Called with what is being done and the share of it that is done.

    Raises:
        RecordingError: No demonstrations, another robot's joints, velocities that cannot be derived, or no chance.
        ManipLearnError: Workers of the client die again and again, or their scheduler does.
    """
    if not 0.0 < false_alarms < 1.0:
        raise RecordingError(f"false_alarms must be a chance between 0 and 1, got {false_alarms!r}", code="option")
    robot = getattr(constraint.features, "robot", None)
    parts = parts_of(recordings_given(demonstrations, robot, constraint.nv, velocities))
    rows: list[EpisodeAudit] = []
    notes: list[str] = []
    for part, said in each_part(partial(measured, constraint, velocities), parts, client, progress):
        rows += [dataclasses.replace(row, number=len(rows) + i) for i, row in enumerate(part)]
        notes += said
    notes = refuse_unmatched(notes, len(parts))
    if not rows:
        raise RecordingError("there are no demonstrations: give at least one trajectory", code="empty")
    imposed = constraint.provenance.get("kind") == "self-imposed"
    if imposed:
        notes.append("the constrained rows were moved on purpose: motion along them is no violation and does not count")
    if len(rows) < FEWEST_EPISODES:
        few, needed = counted(len(rows), "episode"), FEWEST_EPISODES
        notes.append(f"too few to say which are odd: {few}, at least {needed} are needed")
    criteria = [c for c in CRITERIA if not (imposed and c.needs_rest)]
    values = np.array([[c.badness(row) for c in criteria] for row in rows])
    defined = np.any(np.isfinite(values), axis=0)
    criteria = [c for c, there in zip(criteria, defined, strict=True) if there]
    z = robust_z(
        values[:, defined], np.array([LOG_SPREAD if c.name in _NEGLIGIBLE else SHARE_SPREAD for c in criteria])
    )
    z = np.where([c.is_bad == "both" for c in criteria], np.abs(z), z)
    threshold = outlier_threshold(len(z), z.shape[1], false_alarms)
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
    return AuditReport(tuple(judged), tuple(c.name for c in criteria), threshold, tuple(dict.fromkeys(notes)))


def measured(constraint: Constraint, velocities: Velocities, part: Reader) -> tuple[list[EpisodeAudit], list[str]]:
    """The episodes of a part, and notes of its reader: what a worker does.

    Raises:
        RecordingError: Another robot's joints, or velocities that cannot be derived.
    """
    notes: list[str] = []
    with one_thread():
        return [measure(constraint, episode, i, velocities) for i, episode in enumerate(part(notes))], notes


def robust_z(values: Float[np.ndarray, "n k"], least_spread: Float[np.ndarray, " k"]) -> Float[np.ndarray, "n k"]:
    """(value - median) / max(1.4826 MAD, least spread), column by column; 0 where a value is not defined."""
    centre = np.nanmedian(values, axis=0)
    spread = np.maximum(MAD_TO_SIGMA * np.nanmedian(np.abs(values - centre), axis=0), least_spread)
    return np.nan_to_num((values - centre) / spread, nan=0.0)


def outlier_threshold(n: int, k: int, false_alarms: float = FALSE_ALARMS) -> float:
    """Robust z-score that n equally good episodes exceed anywhere in k criteria with a chance of at most this.

    For normal values; the chance is shared evenly among all n k scores (Bonferroni).
    """
    if n < FEWEST_EPISODES:
        return math.inf
    return max(SMALLEST_THRESHOLD, -float(stdtrit(MAD_EFFICIENCY * n + MAD_SMALL, false_alarms / (n * max(k, 1)))))
