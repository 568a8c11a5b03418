"""A rollout or a demonstration to show: what guided it, key frames, tip path, status, and tracks over time.

A track has few enough numbers for a page, every minimum and maximum among them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from manip_learn.constraint.constraint import Constraint
from manip_learn.constraint.mechanism import Mechanism
from manip_learn.control.command import Status
from manip_learn.control.rollout import Rollout
from manip_learn.errors import ConstraintMismatchError, RecordingError, TargetError, listed
from manip_learn.linalg import finite
from manip_learn.playback.appearance import joint_tracks
from manip_learn.playback.page_writer import packed
from manip_learn.playback.palette import WAY, PhaseBand, own_bands, own_kinds
from manip_learn.recordings.trajectory import Trajectory, evenly
from manip_learn.recordings.velocities import derive_velocities
from manip_learn.robot.joints import Frame
from manip_learn.robot.robot import Robot

MOST_OF_A_CURVE = 2000  # points
MAX_KEY_FRAMES = 18_000  # 30 a second in ten minutes
MAX_PATH_POINTS = 1500  # of a drawn path, about one a pixel
Curve = tuple[str, np.ndarray, np.ndarray]  # name, times from the first sample on [s], and values; NaN for a gap
Spans = list[tuple[float, float]]


@final
class GuidedMotion(NamedTuple):
    """A rollout or a recording, its samples and what guided it.

    Attributes:
        name: Name in the legend.
        recording: The rollout or the recording itself, on its own clock.
        samples: Its samples, joints in the robot's order, times from the first sample on [s].
        moving: The samples whose velocities are known: all, or fewer where they had to be derived; None without any.
        constraints: By the numbers of the phases, of a skill done again by its ways; a motion without phases has the
            first. Empty if none is known.
        target: Where the task was to arrive, as `Task.goal` says it; None if that is not known.
        phases: Bands of constraints within the motion, or a rollout's own.
    """

    name: str
    recording: Rollout | Trajectory
    samples: Trajectory
    moving: Trajectory | None
    constraints: tuple[Constraint, ...]
    target: Float[np.ndarray, "..."] | None
    phases: tuple[PhaseBand, ...] = ()

    @property
    def constraint(self) -> Constraint | None:
        """The first one."""
        return self.constraints[0] if self.constraints else None

    def mechanism(self, k: int) -> Mapping[str, Any] | None:
        """Return the mechanism that constraint k keeps; None if it keeps none."""
        kept = self.constraints[k].provenance.get("mechanism") if k < len(self.constraints) else None
        return kept if isinstance(kept, Mapping) else None

    def chosen(self, time: Float[np.ndarray, " T"]) -> Int[np.ndarray, " T"]:
        """Return the number of the constraint by which a velocity is measured: that of its phase, else the first.

        -1 where it is not known, and everywhere if the demonstrator drives the rows (b is not 0).

        Args:
            time: shape (T,), from the first sample on [s].
        """
        is_imposed = self.constraint is None or self.constraint.provenance.get("kind") == "self-imposed"
        chosen = np.full(time.size, -1 if is_imposed else 0)
        for band in [] if is_imposed else self.phases:
            if band.constraint is not None:
                chosen[band.covers(time)] = band.constraint
        return np.where(chosen < len(self.constraints), chosen, -1)


def guided_motion(
    robot: Robot,
    name: str,
    recording: Rollout | Trajectory,
    constraint: Constraint | Sequence[Constraint] | None = None,
    target: ArrayLike | None = None,
) -> GuidedMotion:
    """Check a motion, derive its velocities if it has none, and find what guided it.

    Args:
        robot: Whose joints move.
        name: Name in the legend.
        recording: A rollout or a recording.
        constraint: One, or one for each number of the phases; None for the rollout's own.
        target: As `Task.goal` says it; None for the rollout's own.

    Raises:
        ConstraintMismatchError: A constraint of another robot.
        RecordingError: No samples, shapes that do not fit, time that does not increase, NaN, another robot, or other
            joints locked.
        TargetError: A target that is not finite numbers.
    """
    given = (constraint,) if isinstance(constraint, Constraint) else tuple(constraint or ())
    checked = recording
    if isinstance(recording, Rollout):
        target = recording.target if target is None else target
        if recording.robot is not None:
            recording.robot.refuse_another(robot, f"rollout {name!r}")
        if constraint is None:
            given = _kept_constraints(robot, name, recording)
        # one that was made by hand is not checked: its times and postures as those of a trajectory are
        checked = Trajectory(recording.time, recording.q, recording.u, recording.joint_names, f"rollout {name!r}")
    for c in given:
        other = c.robot
        if c.nv != robot.nv or (other is not None and other.joint_names != robot.joint_names):
            whose = f"robot {other.name!r}" if other is not None else f"a system of {c.nv} velocities"
            shown = f"the robot shown is {robot.name!r} with {robot.nv}: give the constraint of that robot"
            raise ConstraintMismatchError(f"the constraint to show with {name!r} is of {whose}, {shown}")
    place = None if target is None else finite(target, *np.shape(np.array(target, dtype=object)))
    if target is not None and (place is None or place.ndim not in (1, 2)):
        raise TargetError(f"the target to show must be finite numbers, or a 4 x 4 pose, got {target!r:.80}")
    names, own = checked.joint_names or robot.joint_names, robot.joint_names
    if set(names) != set(own):
        parts = {"missing": [n for n in own if n not in names], "not its own": [n for n in names if n not in own]}
        what = "; ".join(f"{label} {', '.join(some[:6])}" for label, some in parts.items() if some)
        sentence = f"rollout {name!r} was not made with robot {robot.name!r}: joints {what}; load the robot that it was"
        raise RecordingError(f"{sentence} made with", code="joint-names")
    order, q = [names.index(n) for n in own], checked.q
    q = q[:, order] if q.shape[1] == robot.nv else q
    u = checked.u[:, order] if checked.u is not None and np.all(np.isfinite(checked.u)) else None
    samples = moving = Trajectory(checked.time - checked.time[0], q, u, own, name)
    if u is None:  # a derivative needs 5 samples
        moving = derive_velocities(samples, robot) if len(samples) >= 5 else None
    return GuidedMotion(name, recording, samples, moving, given, place)


def _kept_constraints(robot: Robot, name: str, rollout: Rollout) -> tuple[Constraint, ...]:
    """Return the constraints that a rollout keeps: one for each of its ways, or its only one."""
    kept = [way.get("constraint") for way in rollout.ways]
    kept = [rollout.constraint] if not kept or None in kept else kept
    return tuple(Constraint.from_dict(c, robot, source=f"the constraint of rollout {name!r}") for c in kept if c)


def _track(kind: str, curves: Sequence[Curve], unit: str = "", without: Sequence[str] = ()) -> dict[str, Any]:
    """Return curves that share an axis.

    Args:
        kind: `"singular"`, `"velocity"`, `"position"`, `"task-error"`, `"following-error"`, `"fit"`, `"opening"` of
            what slides, `"turning"` or `"effort"`.
        curves: Without any, or without a number in them, the track is not shown.
        unit: Of the values; `"limit"` for shares of a limit or of a range, empty for other shares.
        without: Joints that are not shown, because they have no limits.
    """
    return {"kind": kind, "unit": unit, "without": list(without), "curves": curves}


def tracks_of(robot: Robot, motion: GuidedMotion) -> list[dict[str, Any]]:
    """Return all that is known of a motion over time, but for the manipulability and the status.

    Args:
        robot: Whose joints move.
        motion: The motion.
    """
    fastest, low, high = robot.velocity_limit, robot.position_lower, robot.position_upper
    limited = np.isfinite(fastest) & (fastest > 0.0)
    bounded = np.isfinite(low) & np.isfinite(high) & (high > low)
    time, q, recording, moving = motion.samples.time, motion.samples.q, motion.recording, motion.moving
    names, tracks = robot.joint_names, list[dict[str, Any]]()
    # 0 at the lower limit of a joint, 1 at the upper one
    limits = [("position", time, (robot.unwrapped(q) - low) / np.where(bounded, high - low, 1.0), bounded)]
    if motion.constraint is not None:  # singular values of A(q), largest first
        A = motion.constraint.selection @ motion.constraint.features.batch(q)
        sigma = np.linalg.svd(A, compute_uv=False).T
        tracks.append(_track("singular", [(f"σ{k + 1}", time, s) for k, s in enumerate(sigma)]))
    if moving is not None:
        u = moving.arrays["u"]
        limits.insert(0, ("velocity", moving.time, u / np.where(limited, fastest, 1.0), limited))
        if isinstance(recording, Trajectory):
            speed = np.linalg.norm(u, axis=1)
            # below a tenth of its root mean square speed a motion says nothing of a constraint
            moves = speed > 0.1 * np.sqrt(np.mean(speed**2))
            shares = np.linalg.norm(_broken(motion, moving), axis=1) / np.where(moves, speed, np.nan)
            tracks.append(_track("fit", [("share", moving.time, shares)]))
    for kind, times, values, known in limits:
        curves = [(name, times, values[:, j]) for j, name in enumerate(names) if known[j]]
        without = [name for j, name in enumerate(names) if not known[j]]
        tracks.append(_track(kind, curves, "limit", without))
    if isinstance(recording, Rollout):
        features = None if motion.constraint is None else motion.constraint.features
        units = "" if features is None else " or ".join(sorted({u.removesuffix("/s") for u in features.row_units}))
        joints = " or ".join(sorted(set(robot.joint_units), reverse=True))
        errors = {"task-error": (recording.task_error, units), "following-error": (recording.following_error, joints)}
        for kind, (values, unit) in errors.items():
            if values is not None and values.shape == time.shape:
                tracks.append(_track(kind, [("", time, np.where(np.isfinite(values), values, np.nan))], unit))
    elif recording.effort is not None:  # each over its largest, since those at the base dwarf the others
        largest = np.max(np.abs(recording.effort), axis=0)
        shares = (recording.effort / np.where(largest > 0.0, largest, 1.0)).T
        joints = zip(recording.joint_names or names, shares, strict=True)
        tracks.append(_track("effort", [(name, time, share) for name, share in joints]))
    return tracks


def _broken(motion: GuidedMotion, moving: Trajectory) -> Float[np.ndarray, "U nv"]:
    """Return A^+ A u: the part of each velocity that A(q) u = 0 does not allow; NaN where no constraint is known.

    Args:
        motion: The motion.
        moving: Its samples whose velocities are known.
    """
    u, chosen = moving.arrays["u"], motion.chosen(moving.time)
    broken = np.full(u.shape, np.nan)
    for k in np.unique(chosen[chosen >= 0]):
        rows, constraint = chosen == k, motion.constraints[k]
        A = constraint.selection @ constraint.features.batch(moving.q[rows])
        broken[rows] = np.einsum("tij,tjk,tk->ti", np.linalg.pinv(A, rcond=1e-10), A, u[rows])
    return broken


def track_data(tracks: Sequence[Mapping[str, Any]], most: int) -> dict[str, Any]:
    """Return the tracks of one motion for the page.

    Curves that keep all of their samples share their times, in float64; those that do not have times of their own,
    as their extremes are at different samples. Values are float32.

    Args:
        tracks: Of one motion.
        most: About how many points a curve may have.
    """
    clocks = dict[str, int]()  # each with its number

    def curve_data(name: str, times: np.ndarray, values: np.ndarray) -> dict[str, Any]:
        kept = extremes(values, most)
        described: dict[str, Any] = {"name": name, "values": packed(values[kept], "<f4")}
        if kept.size < values.size:
            return described | {"times": packed(times[kept], "<f4")}
        return described | {"clock": clocks.setdefault(packed(times, "<f8"), len(clocks))}

    described = [{**track, "curves": [curve_data(*curve) for curve in track["curves"]]} for track in tracks]
    return {"clocks": list(clocks), "tracks": described}


def extremes(values: Float[np.ndarray, " T"], most: int) -> Int[np.ndarray, " K"]:
    """Return which samples to keep of a curve: first, last, and least and largest of each of `most / 2` spans.

    Args:
        values: The curve; NaN is a gap, and a span without any number keeps its first sample.
        most: About how many samples may be kept; a shorter curve is kept whole.
    """
    samples = np.arange(values.size)
    if values.size <= most:
        return samples
    spans = np.split(samples, np.linspace(0, values.size, max(most // 2, 2)).astype(int)[1:-1])
    low, high = (np.where(np.isnan(values), never, values) for never in (np.inf, -np.inf))
    kept = [(span[np.argmin(low[span])], span[np.argmax(high[span])]) for span in spans]
    return np.unique([0, values.size - 1, *np.ravel(kept)])


@final
class RecordedMotion(NamedTuple):
    """One motion, ready for the page. Times count from its first sample [s].

    Attributes:
        motion: Its samples, its phases and what guided it.
        postures: shape (K, n), the postures of the key frames.
        path_times: shape (P,).
        path: shape (P, 3), the tip in the base frame [m].
        measures: What is shown over time, see `tracks_of`.
        content: What else the page reads of it; of `handles`, for each fixture that a rollout moves, start and end of
            the times at which the hand has its handle [s].
    """

    motion: GuidedMotion
    postures: Float[np.ndarray, "K n"]
    path_times: Float[np.ndarray, " P"]
    path: Float[np.ndarray, "P 3"]
    measures: Sequence[Mapping[str, Any]]
    content: Mapping[str, Any]


def recorded_motion(
    robot: Robot,
    tip: Frame,
    motion: GuidedMotion,
    colour: str = "",
    phases: tuple[PhaseBand, ...] = (),
    mechanism: Mapping[str, Any] | None = None,
) -> RecordedMotion:
    """Subsample a motion for playback.

    Args:
        robot: Whose joints move.
        tip: Frame whose path is drawn.
        motion: What is played.
        colour: Its colour, hexadecimal.
        phases: Bands on the recording's own clock; empty for those that a rollout itself has.
        mechanism: Of a rollout whose constraint keeps none.

    Raises:
        RecordingError: A manipulability, a status or phases that do not fit.
        ConfigurationError: A posture of the wrong size.
    """
    recording, name, time, q = motion.recording, motion.name, motion.samples.time, motion.samples.q
    keys = key_frames(time)
    tracks = joint_tracks(robot, q[keys])  # first: it refuses postures of the wrong size
    path_keys = keys[evenly(keys.size, MAX_PATH_POINTS)]
    path_times, poses = time[path_keys], robot.frame_kinematics(tip).poses(q[path_keys])
    curve_times, curve, status, own, held, around = np.zeros(0), np.zeros(0), [], (), {}, ()
    if isinstance(recording, Rollout):
        if (curve := finite(recording.mu, time.size)) is None:
            sentence = f"the manipulability of its {time.size} times must be as many finite numbers"
            raise RecordingError(f"rollout {name!r}: {sentence}, got {recording.mu!r:.80}", code="not-finite")
        chosen = extremes(curve, MOST_OF_A_CURVE)
        curve_times, curve, around = time[chosen], curve[chosen], recording.around
        status = status_changes(name, time, recording.status)
        own = own_bands(name, recording.phases)
        if len(recording.ways) > 1:
            ways = {way.get("name"): k for k, way in reversed(list(enumerate(recording.ways)))}  # by the name of a step
            own = [band._replace(constraint=ways.get((band.name or "").rpartition(": ")[0])) for band in own]
        own = _within(own, motion)
        held = _held(recording, own, motion)
    motion = motion._replace(phases=_within(phases, motion) or own)
    opened: dict[str, list[Curve]] = {"m": [], "rad": []}
    for k, spans in list(held.items()):
        known = motion.mechanism(k) or mechanism or {}
        if not known.get("type"):
            del held[k]
        elif known["type"] in ("line", "hinge", "screw") and (learnt := Mechanism.from_dict(known)).axis is not None:
            way = _opened(learnt, path_times, poses, spans)
            opened["m" if learnt.type == "line" else "rad"].append(("", path_times, way))
    measures = [_track("opening", opened["m"], "m"), _track("turning", opened["rad"], "rad"), *tracks_of(robot, motion)]
    kinds = own_kinds(motion.phases, colour)
    numbers = {kind.label: k for k, kind in enumerate(kinds)}
    # angles in float64: one of many turns must still be right to a nanoradian
    exact = {"keyTimes": time[keys], "tracks": tracks, "curveTimes": curve_times, "curve": curve}
    content: dict[str, Any] = {
        "name": name,
        "colour": colour,
        "duration": float(time[-1]),
        **{key: packed(array, "<f8") for key, array in exact.items()},
        "pathTimes": packed(path_times, "<f4"),
        "path": packed(poses[:, :3, 3], "<f4"),
        "status": status,
        "handles": list(held.values()),
        # start, end, number of the kind; -1 for free motion
        "phases": [
            [b.start, b.end, numbers.get(b.name or "", -1 if b.constraint is None else b.constraint)]
            for b in motion.phases
        ],
    }
    more = {"phaseKinds": [vars(kind) for kind in kinds], "clear": keeps_clear(around)}
    content |= {key: value for key, value in more.items() if value}
    measures = [t for t in measures if any(np.any(np.isfinite(values)) for _, _, values in t["curves"])]
    return RecordedMotion(motion, q[keys], path_times, poses[:, :3, 3], measures, content)


def _within(phases: Iterable[PhaseBand], motion: GuidedMotion) -> tuple[PhaseBand, ...]:
    """Return bands with times from the first sample on; what lies outside the recording is cut off."""
    first, last = float(motion.recording.time[0]), motion.samples.duration
    moved = (b._replace(start=max(b.start - first, 0.0), end=min(b.end - first, last)) for b in phases)
    return tuple(band for band in moved if band.start < band.end)


def _held(recording: Rollout, bands: Sequence[PhaseBand], motion: GuidedMotion) -> dict[int, Spans]:
    """Return when the hand of a rollout has each fixture, by the number of its constraint [s]."""
    held: dict[int, Spans] = {}
    for band in bands:
        if band.part == WAY:
            held.setdefault(band.constraint or 0, []).append((band.start, band.end))
    first = float(recording.time[0])
    begins = recording.ways[0]["begins"] if recording.ways else first  # else in the hand all the time
    if not bands and begins is not None:
        held[0] = [(begins - first, motion.samples.duration)]
    return held


def _opened(
    mechanism: Mechanism, times: Float[np.ndarray, " T"], poses: Float[np.ndarray, "T 4 4"], spans: Spans
) -> Float[np.ndarray, " T"]:
    """Return how far a fixture of one free coordinate has moved [m or rad], most of it in the positive sense."""
    way, moved = np.zeros(len(times)), 0.0
    for start, end in spans:
        inside = np.flatnonzero((times >= start - 1e-9) & (times <= end + 1e-9))
        if inside.size and (mechanism.type == "line" or mechanism.point is not None):
            way[inside[0] :] = moved
            way[inside] += mechanism.at(poses[inside[0]], np.inf).coordinates(poses[inside])[:, 0]
            way[inside[-1] :] = moved = way[inside[-1]]
    return way * np.sign(way[np.argmax(np.abs(way))] or 1.0) + 0.0


def keeps_clear(around: Sequence[Mapping[str, Any]]) -> str:
    """Return what a plan keeps clear of in words, e.g. "table (0.30 m from link1) as stated"; empty if nothing.

    Args:
        around: As `Rollout.around`.
    """
    said: dict[str, dict[str, str]] = {"as stated": {}, "assumed: state what is there as a scene": {}}
    for thing in around:
        how = list(said)[bool(thing.get("assumed"))]
        near = f" ({thing['nearest']:.2f} m from {thing['link']})" if thing.get("nearest") is not None else ""
        said[how].setdefault(thing["name"], thing["name"] + near)
    return "; ".join(f"{listed(names.values())} {how}" for how, names in said.items() if names)


def key_frames(time: Float[np.ndarray, " T"]) -> np.ndarray:
    """Return the samples that are key frames: at most 60 a second, fewer in long motions, first and last kept."""
    gap = max(1.0 / 60.0, float(time[-1] - time[0]) / (MAX_KEY_FRAMES - 1))  # [s], as of most screens
    slots = np.floor((time - time[0]) / gap * (1.0 + 1e-12)).astype(np.int64)
    return np.union1d(np.flatnonzero(np.diff(slots, prepend=-1) > 0), [time.size - 1])


def status_changes(name: str, time: Float[np.ndarray, " T"], words: Iterable[object]) -> list[tuple[float, str, str]]:
    """Return time, word and effect of each status that differs from the one before it.

    Raises:
        RecordingError: There are not as many words as times.
    """
    status = [str(word) for word in words]
    if status and len(status) != time.size:
        raise RecordingError(f"rollout {name!r} has {time.size} times and {len(status)} status words", code="shape")
    effects = {str(status): status.effect for status in Status}  # of a controller of one's own there are others
    changes = [i for i, word in enumerate(status) if i == 0 or word != status[i - 1]]
    return [(float(time[i]), status[i], effects.get(status[i], "slowed")) for i in changes]
