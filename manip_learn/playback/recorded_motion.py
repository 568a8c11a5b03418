"""A rollout or a demonstration as the page plays it: key frames, tip path, status, and tracks over time.

A track has few enough numbers for a page, every minimum and maximum among them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
from jaxtyping import Float, Int

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.mechanism import Mechanism
from manip_learn.control.rollout import Rollout
from manip_learn.errors import RecordingError
from manip_learn.linalg import finite
from manip_learn.playback.guided_motion import Guidance, MotionSamples, motion_samples
from manip_learn.playback.kinematic_tree import TreeJoint, joint_tracks
from manip_learn.playback.page_writer import packed
from manip_learn.playback.phase_bands import WAY, PhaseBand, own_bands
from manip_learn.recordings.trajectory import Trajectory, evenly
from manip_learn.robot.joints import Frame
from manip_learn.robot.robot import Robot

_AT_REST = 0.1  # share of the root mean square speed of a motion below which it says nothing of a constraint
_MOST_POINTS = 100_000  # of all curves of a page, 8 bytes each
MOST_OF_A_CURVE, LEAST_OF_A_CURVE = 2000, 60
_NEGLIGIBLE = 1e-10  # singular values relative to the largest
KEY_FRAMES_PER_SECOND = 60.0  # as most screens
MAX_KEY_FRAMES = 18_000  # 30 a second in ten minutes
MAX_CURVE_POINTS = 2000
MAX_PATH_POINTS = 1500  # of a drawn path, about one a pixel
UNGUIDED = Guidance()


@final
@dataclass(frozen=True, eq=False)
class _Curve:
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
class _Track:
    """Curves that share an axis.

    Attributes:
        kind: `"singular"`, `"velocity"`, `"position"`, `"task-error"`, `"following-error"`, `"fit"`, `"opening"` of
            what slides, `"turning"` or `"effort"`.
        curves: At least one.
        unit: Of the values; `"limit"` for shares of a limit or of a range, empty for other shares.
        without: Joints that are not shown, because they have no limits.
    """

    kind: str
    curves: tuple[_Curve, ...]
    unit: str = ""
    without: tuple[str, ...] = ()


def tracks_of(
    robot: Robot,
    recording: Rollout | Trajectory,
    samples: MotionSamples,
    guidance: Guidance,
    phases: Sequence[PhaseBand] = (),
) -> tuple[_Track, ...]:
    """All that is known of a motion over time, but for the manipulability and the status.

    Args:
        robot: Whose joints move.
        recording: The motion.
        samples: Its samples.
        guidance: Its constraint.
        phases: Its phases, times counted from the first sample.
    """
    fastest, low, high = robot.velocity_limit, robot.position_lower, robot.position_upper
    limited = np.isfinite(fastest) & (fastest > 0.0)
    bounded = np.isfinite(low) & np.isfinite(high) & (high > low)
    shares = samples.u / np.where(limited, fastest, 1.0)
    # 0 at the lower limit of a joint, 1 at the upper one
    places = (robot.unwrapped(samples.q) - low) / np.where(bounded, high - low, 1.0)
    tracks: list[_Track | None] = []
    if guidance.constraint is not None:  # singular values of A(q), largest first
        A = guidance.constraint.selection @ guidance.constraint.features.batch(samples.q)
        sigma = np.linalg.svd(A, compute_uv=False).T
        tracks.append(_Track("singular", tuple(_Curve(f"σ{k + 1}", samples.time, s) for k, s in enumerate(sigma))))
    tracks += [
        _fit(samples, guidance, phases) if isinstance(recording, Trajectory) else None,
        _of_limits(robot, "velocity", samples.velocity_time, shares, limited),
        _of_limits(robot, "position", samples.time, places, bounded),
    ]
    if isinstance(recording, Trajectory):
        if recording.effort is not None:  # each over its largest, since those at the base dwarf the others
            largest, joints = np.max(np.abs(recording.effort), axis=0), recording.joint_names or robot.joint_names
            shares = zip(joints, (recording.effort / np.where(largest > 0.0, largest, 1.0)).T, strict=True)
            tracks.append(_Track("effort", tuple(_Curve(name, samples.time, share) for name, share in shares)))
    if isinstance(recording, Rollout):
        features = None if guidance.constraint is None else guidance.constraint.features
        units = "" if features is None else " or ".join(sorted({u.removesuffix("/s") for u in features.row_units}))
        tracks.append(_error("task-error", samples, recording.task_error, units))
        joint_unit = " or ".join(sorted(set(robot.joint_units), reverse=True))
        tracks.append(_error("following-error", samples, recording.following_error, joint_unit))
    return tuple(t for t in tracks if t is not None and t.curves)


def _fit(samples: MotionSamples, guidance: Guidance, phases: Sequence[PhaseBand]) -> _Track | None:
    """|A^+ A u| / |u|: the share of the motion that breaks the constraint; a gap where the arm is at rest."""
    if not guidance.holds or not samples.u.size:
        return None
    shares = np.full(samples.velocity_time.size, np.nan)
    speed = np.linalg.norm(samples.u, axis=1)
    moving = speed > _AT_REST * np.sqrt(np.mean(speed**2))
    for rows, broken in _broken(samples, guidance, np.where(moving, guidance.at(samples.velocity_time, phases), -1)):
        shares[rows] = np.linalg.norm(broken, axis=1) / speed[rows]
    return _Track("fit", (_Curve("share", samples.velocity_time, shares),))


def broken_share(samples: MotionSamples, guidance: Guidance, phases: Sequence[PhaseBand]) -> float | None:
    """sqrt(sum |A^+ A u|^2 / sum |u|^2) over the phases in which a constraint holds, or over all of a motion without.

    None if no constraint is known, it is not held by the world, or nothing moves.
    """
    if not guidance.holds or not samples.u.size:
        return None
    time, chosen = samples.velocity_time, guidance.at(samples.velocity_time, phases)
    if phases:
        held = [(time >= b.start) & (time <= b.end) for b in phases if b.constraint is not None]
        chosen = np.where(np.any(held, axis=0) if held else False, chosen, -1)
    each = list(_broken(samples, guidance, chosen))
    total = float(sum(np.sum(samples.u[rows] ** 2) for rows, _ in each))
    return float(np.sqrt(sum(np.sum(broken**2) for _, broken in each) / total)) if total > 0.0 else None


def _broken(
    samples: MotionSamples, guidance: Guidance, chosen: Int[np.ndarray, " U"]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Of each constraint the samples that it is chosen for, and the part of their velocities that breaks it."""
    for k in np.unique(chosen[chosen >= 0]):
        rows = chosen == k
        yield rows, broken_motion(guidance.constraints[k], samples.velocity_q[rows], samples.u[rows])


def broken_motion(
    constraint: Constraint, q: Float[np.ndarray, "T n"], u: Float[np.ndarray, "T nv"]
) -> Float[np.ndarray, "T nv"]:
    """A^+ A u of each sample: the part of its velocity that A(q) u = 0 does not allow."""
    A = constraint.selection @ constraint.features.batch(q)
    _, sigma, V = np.linalg.svd(A, full_matrices=False)
    V = V * (sigma > _NEGLIGIBLE * np.maximum(sigma[:, :1], 1e-300))[:, :, None]
    return np.einsum("tkj,tk->tj", V, np.einsum("tkj,tj->tk", V, u))


def _of_limits(
    robot: Robot, kind: str, times: Float[np.ndarray, " T"], values: Float[np.ndarray, "T nv"], known: np.ndarray
) -> _Track:
    """Of each joint whose limits are known a curve of its share of them."""
    joints = list(zip(robot.joint_names, known, values.T, strict=True)) if len(values) else []
    curves = tuple(_Curve(name, times, column) for name, is_known, column in joints if is_known)
    return _Track(kind, curves, "limit", tuple(name for name, is_known, _ in joints if not is_known))


def _error(kind: str, samples: MotionSamples, values: Float[np.ndarray, " T"] | None, unit: str) -> _Track | None:
    if values is None or values.shape != samples.time.shape or not np.any(np.isfinite(values)):
        return None
    return _Track(kind, (_Curve("", samples.time, np.where(np.isfinite(values), values, np.nan)),), unit)


def points_per_curve(tracks: Sequence[Sequence[_Track]]) -> int:
    """How many points each curve of a page may have.

    Args:
        tracks: Those of each motion.
    """
    n = sum(len(track.curves) for some in tracks for track in some)
    return int(np.clip(_MOST_POINTS // max(n, 1), LEAST_OF_A_CURVE, MOST_OF_A_CURVE))


def track_data(tracks: Sequence[_Track], most: int) -> dict[str, Any]:
    """The tracks of one motion.

    Curves that keep all of their samples share their times, in float64; those that do not have times of their own,
    as their extremes are at different samples. Values are float32.

    Args:
        tracks: Of one motion.
        most: See `points_per_curve`.
    """
    clocks: list[np.ndarray] = []

    def curve_data(curve: _Curve) -> dict[str, Any]:
        kept = extremes(curve.values, most)
        described: dict[str, Any] = {"name": curve.name, "values": packed(curve.values[kept], "<f4")}
        if kept.size < curve.values.size:
            return described | {"times": packed(curve.times[kept], "<f4")}
        number = next((i for i, clock in enumerate(clocks) if clock is curve.times), len(clocks))
        if number == len(clocks):
            clocks.append(curve.times)
        return described | {"clock": number}

    described = [
        {"kind": t.kind, "unit": t.unit, "without": t.without, "curves": [curve_data(c) for c in t.curves]}
        for t in tracks
    ]
    return {"clocks": [packed(clock, "<f8") for clock in clocks], "tracks": described}


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


@final
@dataclass(frozen=True, eq=False)
class RecordedMotion:
    """One motion, ready for the page. Times count from its first sample [s].

    Attributes:
        name: Name in the legend.
        key_times: shape (K,).
        tracks: shape (K, w), see `joint_tracks`.
        postures: shape (K, n), the postures of the key frames.
        path_times: shape (P,).
        path: shape (P, 3), the tip in the base frame [m].
        curve_times: shape (C,), empty if the manipulability is not known.
        curve: shape (C,).
        status: (time, word) wherever the status changes; empty if it is not known.
        duration: [s].
        first_time: Of the first sample, on the recording's own clock [s].
        phases: Bands within the recording, their times counted from its first sample; a rollout without any from
            constraints has its own.
        measures: What else is shown over time.
        samples: All samples; None for a motion that is not recorded.
        guidance: Constraint and target.
        fit_share: Share of a recording's motion that breaks its constraint, see `broken_share`; None if not known.
        handles: For each fixture that a rollout moves, when the hand has its handle: start and end [s].
        around: What a rollout's plan kept clear of, as the rollout has it.
    """

    name: str
    key_times: Float[np.ndarray, " K"]
    tracks: Float[np.ndarray, "K w"]
    postures: Float[np.ndarray, "K n"]
    path_times: Float[np.ndarray, " P"]
    path: Float[np.ndarray, "P 3"]
    curve_times: Float[np.ndarray, " C"]
    curve: Float[np.ndarray, " C"]
    status: tuple[tuple[float, str], ...]
    duration: float
    first_time: float = 0.0
    phases: tuple[PhaseBand, ...] = ()
    measures: tuple[_Track, ...] = ()
    samples: MotionSamples | None = None
    guidance: Guidance = UNGUIDED
    fit_share: float | None = None
    handles: tuple[tuple[tuple[float, float], ...], ...] = ()
    around: tuple[Mapping[str, Any], ...] = ()


def recorded_motion(
    robot: Robot,
    tree: tuple[TreeJoint, ...],
    tip: Frame,
    name: str,
    recording: Rollout | Trajectory,
    phases: tuple[PhaseBand, ...] = (),
    guidance: Guidance = UNGUIDED,
    mechanism: Mapping[str, Any] | None = None,
) -> RecordedMotion:
    """Check a recording and subsample it for playback.

    Args:
        robot: Whose joints move.
        tree: Its joints as the page moves them.
        tip: Frame whose path is drawn.
        name: Name in the legend.
        recording: What is played.
        phases: Bands on the recording's own clock; empty for those that a rollout itself has.
        guidance: Its constraint and its target.
        mechanism: Of a rollout whose constraint keeps none.

    Raises:
        RecordingError: No samples, shapes that do not fit, time that does not increase, NaN, another robot, or other
            joints locked.
        ConfigurationError: A posture of the wrong size.
    """
    samples = motion_samples(robot, name, recording)
    time, q, first_time = samples.time, samples.q, samples.first_time
    keys = key_frames(time)
    path_keys = keys[evenly(keys.size, MAX_PATH_POINTS)]
    mu, curve_times, curve = getattr(recording, "manipulability", None), np.zeros(0), np.zeros(0)
    if mu is not None:
        if (curve := finite(mu, time.size)) is None:
            sentence = f"the manipulability of its {time.size} times must be as many finite numbers, got {mu!r:.80}"
            raise RecordingError(f"rollout {name!r}: {sentence}", code="not-finite")
        chosen = extremes(curve, MAX_CURVE_POINTS)
        curve_times, curve = time[chosen], curve[chosen]
    own = own_bands(name, getattr(recording, "phases", ()))
    if isinstance(recording, Rollout) and len(recording.ways) > 1:
        ways = {way.get("name"): k for k, way in reversed(list(enumerate(recording.ways)))}  # by the name of a step
        own = tuple(replace(band, constraint=ways.get((band.name or "").rpartition(": ")[0])) for band in own)
    own = _within(own, first_time, float(time[-1]))
    bands = _within(phases, first_time, float(time[-1])) or own
    tracks = joint_tracks(robot, tree, q[keys])  # first: it refuses postures of the wrong size
    path_times, poses = time[path_keys], robot.frame_kinematics(tip).poses(q[path_keys])
    measures = tracks_of(robot, recording, samples, guidance, bands)
    held = _held(recording, own, first_time) if isinstance(recording, Rollout) else {}
    known = {k: guidance.mechanism(k) or mechanism or {} for k in held}
    held = {k: spans for k, spans in held.items() if known[k].get("type")}
    ways = [way for k, spans in held.items() if (way := _way(known[k], path_times, poses, spans)) is not None]
    for kind, unit in (("turning", "rad"), ("opening", "m")):
        moved = tuple(curve for measured, curve in ways if measured == unit)
        measures = (_Track(kind, moved, unit), *measures) if moved else measures
    return RecordedMotion(
        name=name,
        key_times=time[keys],
        tracks=tracks,
        postures=q[keys],
        path_times=path_times,
        path=poses[:, :3, 3],
        curve_times=curve_times,
        curve=curve,
        status=status_changes(name, time, getattr(recording, "status", ())),
        duration=float(time[-1]),
        first_time=first_time,
        phases=bands,
        measures=measures,
        samples=samples,
        guidance=guidance,
        fit_share=broken_share(samples, guidance, bands) if isinstance(recording, Trajectory) else None,
        handles=tuple(map(tuple, held.values())),
        around=recording.around if isinstance(recording, Rollout) else (),
    )


def _held(recording: Rollout, bands: Sequence[PhaseBand], first_time: float) -> dict[int, list[tuple[float, float]]]:
    """Return when the hand of a rollout has each fixture, by the number of its constraint [s]."""
    held: dict[int, list[tuple[float, float]]] = {}
    for band in bands:
        if band.part == WAY:
            held.setdefault(band.constraint or 0, []).append((band.start, band.end))
    begins = recording.ways[0]["begins"] if recording.ways else first_time  # else in the hand all the time
    if not bands and begins is not None:
        held[0] = [(begins - first_time, float(recording.time[-1]) - first_time)]
    return held


def _way(
    mechanism: Mapping[str, Any],
    times: Float[np.ndarray, " T"],
    poses: Float[np.ndarray, "T 4 4"],
    spans: Sequence[tuple[float, float]],
) -> tuple[str, _Curve] | None:
    """Return the unit, and how far a fixture of one free coordinate has moved [m or rad]; None of others."""
    kind = str(mechanism.get("type"))
    if kind not in ("line", "hinge", "screw") or (learnt := Mechanism.from_dict(mechanism)).axis is None:
        return None
    way, moved = np.zeros(len(times)), 0.0
    for start, end in spans:
        inside = np.flatnonzero((times >= start - 1e-9) & (times <= end + 1e-9))
        if inside.size and (kind == "line" or learnt.point is not None):
            coordinates = learnt.at(poses[inside[0]], np.inf).coordinates(poses[inside])[:, 0]
            way[inside[0] :] = moved
            way[inside] += coordinates
            way[inside[-1] :] = moved = way[inside[-1]]
    sign = np.sign(way[np.argmax(np.abs(way))] or 1.0)
    return "m" if kind == "line" else "rad", _Curve("", times, way * sign + 0.0)


def _within(phases: tuple[PhaseBand, ...], first_time: float, duration: float) -> tuple[PhaseBand, ...]:
    """Bands with times from the first sample on; what lies outside the recording is cut off."""
    moved = (replace(b, start=max(b.start - first_time, 0.0), end=min(b.end - first_time, duration)) for b in phases)
    return tuple(band for band in moved if band.start < band.end)


def key_frames(time: Float[np.ndarray, " T"]) -> np.ndarray:
    """Indices of the samples that are key frames: at most 60 per second, fewer in long motions, first and last kept."""
    span = float(time[-1] - time[0])
    gap = max(1.0 / KEY_FRAMES_PER_SECOND, span / (MAX_KEY_FRAMES - 1))
    slots = np.floor((time - time[0]) / gap * (1.0 + 1e-12)).astype(np.int64)
    first_of_slot = np.flatnonzero(np.diff(slots, prepend=-1) > 0)
    return np.union1d(first_of_slot, [time.size - 1])


def status_changes(name: str, time: Float[np.ndarray, " T"], words: Iterable[object]) -> tuple[tuple[float, str], ...]:
    """Return time and word of each status that differs from the one before it.

    Raises:
        RecordingError: There are not as many words as times.
    """
    status = [str(word) for word in words]
    if status and len(status) != time.size:
        raise RecordingError(f"rollout {name!r} has {time.size} times and {len(status)} status words", code="shape")
    return tuple((float(time[i]), word) for i, word in enumerate(status) if i == 0 or word != status[i - 1])
