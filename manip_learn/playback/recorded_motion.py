"""A rollout or a demonstration as what the page plays: key frames, tip path, curve and status."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
from jaxtyping import Float

from manip_learn.control.rollout import Rollout
from manip_learn.errors import RecordingError
from manip_learn.playback.furniture import Furniture, furniture_of
from manip_learn.playback.guidance import Guidance
from manip_learn.playback.kinematic_tree import TreeJoint, joint_tracks
from manip_learn.playback.motion_samples import MotionSamples, finite, motion_samples
from manip_learn.playback.phase_bands import LEADING, WAY, PhaseBand, own_bands
from manip_learn.playback.tracks import Curve, Track, broken_share, extremes, tracks_of
from manip_learn.recordings.preprocessing import evenly
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.frame import Frame
from manip_learn.robot.robot import Robot

KEY_FRAMES_PER_SECOND = 60.0
MAX_KEY_FRAMES = 18_000  # 30 a second in ten minutes
MAX_CURVE_POINTS = 2000
MAX_PATH_POINTS = 1500
UNGUIDED = Guidance()


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
        furniture: What a rollout opens; None for recordings, whose paths it would hide, and where nothing opens.
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
    measures: tuple[Track, ...] = ()
    samples: MotionSamples | None = None
    guidance: Guidance = UNGUIDED
    fit_share: float | None = None
    furniture: Furniture | None = None


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
    curve_times, curve = _curve(name, time, getattr(recording, "manipulability", None))
    own = _within(own_bands(name, getattr(recording, "phases", ())), first_time, float(time[-1]))
    bands = _within(phases, first_time, float(time[-1])) or own
    tracks = joint_tracks(robot, tree, q[keys])
    path_times, path = time[path_keys], np.array([robot.pose(x, tip)[:3, 3] for x in q[path_keys]])
    measures, furniture = tracks_of(robot, recording, samples, guidance, bands), None
    if isinstance(recording, Rollout):
        furniture = furniture_of(guidance.mechanism(0) or mechanism, path_times, path, _ways(own))
    if furniture is not None:
        measures = (Track("opening", (Curve("", path_times, furniture.opening),), furniture.unit), *measures)
    return RecordedMotion(
        name=name,
        key_times=time[keys],
        tracks=finite(name, "joint motion", tracks, 2),
        postures=q[keys],
        path_times=path_times,
        path=path,
        curve_times=curve_times,
        curve=curve,
        status=_status_changes(name, time, getattr(recording, "status", ())),
        duration=float(time[-1]),
        first_time=first_time,
        phases=bands,
        measures=measures,
        samples=samples,
        guidance=guidance,
        fit_share=broken_share(samples, guidance, bands) if isinstance(recording, Trajectory) else None,
        furniture=furniture,
    )


def _within(phases: tuple[PhaseBand, ...], first_time: float, duration: float) -> tuple[PhaseBand, ...]:
    """Bands with times from the first sample on; what lies outside the recording is cut off."""
    moved = (replace(b, start=max(b.start - first_time, 0.0), end=min(b.end - first_time, duration)) for b in phases)
    return tuple(band for band in moved if band.start < band.end)


def _ways(own: tuple[PhaseBand, ...]) -> list[tuple[float, float]] | None:
    """When the hand has hold of its mechanism, by a rollout's own phases; None if they do not tell."""
    if not any(band.name == WAY or band.name in LEADING for band in own):
        return None
    return [(band.start, band.end) for band in own if band.name == WAY]


def key_frames(time: Float[np.ndarray, " T"]) -> np.ndarray:
    """Indices of the samples that are key frames: at most 60 per second, fewer in long motions, first and last kept."""
    span = float(time[-1] - time[0])
    gap = max(1.0 / KEY_FRAMES_PER_SECOND, span / (MAX_KEY_FRAMES - 1))
    slots = np.floor((time - time[0]) / gap * (1.0 + 1e-12)).astype(np.int64)
    first_of_slot = np.flatnonzero(np.diff(slots, prepend=-1) > 0)
    return np.union1d(first_of_slot, [time.size - 1])


def _curve(name: str, time: np.ndarray, values: object) -> tuple[np.ndarray, np.ndarray]:
    """The manipulability, subsampled so that every minimum and maximum is kept."""
    if values is None:
        return np.zeros(0), np.zeros(0)
    curve = finite(name, "manipulability", values, 1)
    if curve.size != time.size:
        raise RecordingError(
            f"rollout {name!r} has {time.size} times and {curve.size} values of manipulability", code="shape"
        )
    chosen = extremes(curve, MAX_CURVE_POINTS)
    return time[chosen], curve[chosen]


def _status_changes(name: str, time: np.ndarray, words: object) -> tuple[tuple[float, str], ...]:
    status = [str(w) for w in words] if words is not None else []  # type: ignore[attr-defined]
    if not status:
        return ()
    if len(status) != time.size:
        raise RecordingError(f"rollout {name!r} has {time.size} times and {len(status)} status words", code="shape")
    changes = [i for i in range(len(status)) if i == 0 or status[i] != status[i - 1]]
    return tuple((float(time[i]), status[i]) for i in changes)
