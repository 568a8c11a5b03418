"""What a page shows of a motion over time, one track below the other: singular values, joints, errors, fit.

A track has few enough numbers for a page, every minimum and maximum among them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.constraint.constraint import Constraint
from manip_learn.control.rollout import Rollout
from manip_learn.playback.guidance import Guidance
from manip_learn.playback.motion_samples import MotionSamples
from manip_learn.playback.packing import packed
from manip_learn.playback.phase_bands import PhaseBand
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.batch.postures import positions_of
from manip_learn.robot.robot import Robot

AT_REST = 0.1  # share of the root mean square speed of a motion below which it says nothing of a constraint
MOST_POINTS = 100_000  # of all curves of a page, 8 bytes each
MOST_OF_A_CURVE, LEAST_OF_A_CURVE = 2000, 60
NEGLIGIBLE = 1e-10  # singular values relative to the largest


@final
@dataclass(frozen=True, eq=False)
class Curve:
    """One curve of a track.

    Attributes:
        name: E.g. that of a joint.
        times: shape (T,), from the motion's first sample on [s].
        values: shape (T,); NaN where there is no value.
    """

    name: str
    times: Float[np.ndarray, " T"]
    values: Float[np.ndarray, " T"]


@final
@dataclass(frozen=True, eq=False)
class Track:
    """Curves that share an axis.

    Attributes:
        kind: `"singular"`, `"velocity"`, `"position"`, `"task-error"`, `"following-error"`, `"fit"` or `"opening"`.
        curves: At least one.
        unit: Of the values; `"limit"` for shares of a limit or of a range, empty where there is none.
        without: Joints that are not shown, because they have no limits.
    """

    kind: str
    curves: tuple[Curve, ...]
    unit: str = ""
    without: tuple[str, ...] = ()


def tracks_of(
    robot: Robot,
    recording: Rollout | Trajectory,
    samples: MotionSamples,
    guidance: Guidance,
    phases: Sequence[PhaseBand] = (),
) -> tuple[Track, ...]:
    """All that is known of a motion over time, but for the manipulability and the status.

    Args:
        robot: Whose joints move.
        recording: The motion.
        samples: Its samples.
        guidance: Its constraint.
        phases: Its phases, times counted from the first sample.
    """
    tracks = [
        _singular_values(samples, guidance.constraint),
        _fit(samples, guidance, phases) if isinstance(recording, Trajectory) else None,
        _shares_of_limits(robot, samples),
        _places_in_ranges(robot, samples),
    ]
    if isinstance(recording, Rollout):
        features = None if guidance.constraint is None else guidance.constraint.features
        units = "" if features is None else " or ".join(sorted({u.removesuffix("/s") for u in features.row_units}))
        tracks.append(_error("task-error", samples, recording.task_error, units))
        tracks.append(_error("following-error", samples, recording.following_error, _joint_unit(robot)))
    return tuple(t for t in tracks if t is not None and t.curves)


def _singular_values(samples: MotionSamples, constraint: Constraint | None) -> Track | None:
    """Of A(q), largest first."""
    if constraint is None:
        return None
    A = constraint.selection @ constraint.features.batch(samples.q)
    sigma = np.linalg.svd(A, compute_uv=False)
    names = [f"σ{k + 1}" for k in range(sigma.shape[1])]
    return Track("singular", tuple(Curve(n, samples.time, sigma[:, k]) for k, n in enumerate(names)))


def _fit(samples: MotionSamples, guidance: Guidance, phases: Sequence[PhaseBand]) -> Track | None:
    """|A^+ A u| / |u|: the share of the motion that breaks the constraint; a gap where the arm is at rest."""
    if not guidance.holds or not samples.u.size:
        return None
    shares = np.full(samples.velocity_time.size, np.nan)
    speed = np.linalg.norm(samples.u, axis=1)
    moving = speed > AT_REST * np.sqrt(np.mean(speed**2))
    chosen = guidance.at(samples.velocity_time, phases)
    for k in np.unique(chosen[chosen >= 0]):
        rows = (chosen == k) & moving
        broken = broken_motion(guidance.constraints[k], samples.velocity_q[rows], samples.u[rows])
        shares[rows] = np.linalg.norm(broken, axis=1) / speed[rows]
    return Track("fit", (Curve("share", samples.velocity_time, shares),))


def broken_share(samples: MotionSamples, guidance: Guidance, phases: Sequence[PhaseBand]) -> float | None:
    """sqrt(sum |A^+ A u|^2 / sum |u|^2) over the phases in which a constraint holds, or over all of a motion without.

    None if no constraint is known, it is not held by the world, or nothing moves.
    """
    if not guidance.holds or not samples.u.size:
        return None
    chosen = guidance.at(samples.velocity_time, phases)
    if phases:
        held = [b for b in phases if b.constraint is not None]
        inside = [(samples.velocity_time >= b.start) & (samples.velocity_time <= b.end) for b in held]
        chosen = np.where(np.any(inside, axis=0) if inside else False, chosen, -1)
    broken = total = 0.0
    for k in np.unique(chosen[chosen >= 0]):
        rows = chosen == k
        broken += float(np.sum(broken_motion(guidance.constraints[k], samples.velocity_q[rows], samples.u[rows]) ** 2))
        total += float(np.sum(samples.u[rows] ** 2))
    return float(np.sqrt(broken / total)) if total > 0.0 else None


def broken_motion(
    constraint: Constraint, q: Float[np.ndarray, "T n"], u: Float[np.ndarray, "T nv"]
) -> Float[np.ndarray, "T nv"]:
    """A^+ A u of each sample: the part of its velocity that A(q) u = 0 does not allow."""
    A = constraint.selection @ constraint.features.batch(q)
    _, sigma, V = np.linalg.svd(A, full_matrices=False)
    V = V * (sigma > NEGLIGIBLE * np.maximum(sigma[:, :1], 1e-300))[:, :, None]
    return np.einsum("tkj,tk->tj", V, np.einsum("tkj,tj->tk", V, u))


def _shares_of_limits(robot: Robot, samples: MotionSamples) -> Track | None:
    """Joint velocities over their limits, -1 to 1 within them."""
    limit = robot.velocity_limit
    limited = np.isfinite(limit) & (limit > 0.0)
    if not samples.u.size:
        return None
    curves = [
        Curve(n, samples.velocity_time, samples.u[:, i] / limit[i])
        for i, n in enumerate(robot.joint_names)
        if limited[i]
    ]
    without = [n for n, known in zip(robot.joint_names, limited, strict=True) if not known]
    return Track("velocity", tuple(curves), "limit", tuple(without))


def _places_in_ranges(robot: Robot, samples: MotionSamples) -> Track:
    """Joint positions between their limits, 0 at the lower and 1 at the upper one."""
    low, high = robot.position_lower, robot.position_upper
    limited = np.isfinite(low) & np.isfinite(high) & (high > low)
    positions = positions_of(robot, samples.q)
    curves = [
        Curve(n, samples.time, (positions[:, i] - low[i]) / (high[i] - low[i]))
        for i, n in enumerate(robot.joint_names)
        if limited[i]
    ]
    without = [n for n, known in zip(robot.joint_names, limited, strict=True) if not known]
    return Track("position", tuple(curves), "limit", tuple(without))


def _error(kind: str, samples: MotionSamples, values: Float[np.ndarray, " T"] | None, unit: str) -> Track | None:
    if values is None or values.shape != samples.time.shape or not np.any(np.isfinite(values)):
        return None
    return Track(kind, (Curve("", samples.time, np.where(np.isfinite(values), values, np.nan)),), unit)


def _joint_unit(robot: Robot) -> str:
    """Of joint positions: rad, m, or either."""
    units = {"m" if block.kind == "prismatic" else "rad" for block in robot.blocks}
    return " or ".join(sorted(units, reverse=True))


def points_per_curve(tracks: Sequence[Sequence[Track]]) -> int:
    """How many points each curve of a page may have.

    Args:
        tracks: Those of each motion.
    """
    n = sum(len(track.curves) for some in tracks for track in some)
    return int(np.clip(MOST_POINTS // max(n, 1), LEAST_OF_A_CURVE, MOST_OF_A_CURVE))


def track_data(tracks: Sequence[Track], most: int) -> dict[str, Any]:
    """The tracks of one motion.

    Curves that keep all of their samples share their times, in float64; those that do not have times of their own,
    as their extremes are at different samples. Values are float32.

    Args:
        tracks: Of one motion.
        most: See `points_per_curve`.
    """
    clocks: list[np.ndarray] = []
    described = [
        {
            "kind": t.kind,
            "unit": t.unit,
            "without": list(t.without),
            "curves": [_curve(c, most, clocks) for c in t.curves],
        }
        for t in tracks
    ]
    return {"clocks": [packed(clock, "<f8") for clock in clocks], "tracks": described}


def _curve(curve: Curve, most: int, clocks: list[np.ndarray]) -> dict[str, Any]:
    kept = extremes(curve.values, most)
    described: dict[str, Any] = {"name": curve.name, "values": packed(curve.values[kept], "<f4")}
    if kept.size < curve.values.size:
        return described | {"times": packed(curve.times[kept], "<f4")}
    number = next((i for i, clock in enumerate(clocks) if clock is curve.times), len(clocks))
    if number == len(clocks):
        clocks.append(curve.times)
    return described | {"clock": number}


def extremes(values: Float[np.ndarray, " T"], most: int) -> Int[np.ndarray, " K"]:
    """Which samples to keep of a curve: first, last, and the least and the largest of each of `most / 2` spans.

    Args:
        values: The curve; NaN is a gap, and a span without any number keeps its first sample.
        most: About how many samples may be kept; a shorter curve is kept whole.
    """
    if values.size <= most:
        return np.arange(values.size)
    edges = np.linspace(0, values.size, max(most // 2, 2)).astype(int)
    missing = np.isnan(values)
    low, high = np.where(missing, np.inf, values), np.where(missing, -np.inf, values)
    keep = {0, values.size - 1}
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        keep |= {a + int(np.argmin(low[a:b])), a + int(np.argmax(high[a:b]))}
    return np.array(sorted(keep))
