"""Prepare a rollout or a demonstration for playback: constraints, key frames, tip path, status, curves over time.

A curve is thinned for a page, but keeps every minimum and maximum.
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
from manip_learn.playback.page_writer import to_base64
from manip_learn.playback.palette import WAY, PhaseBand, rollout_bands, rollout_kinds
from manip_learn.recordings.trajectory import Trajectory, evenly
from manip_learn.recordings.velocities import derive_velocities
from manip_learn.robot.joints import Frame
from manip_learn.robot.robot import Robot

MAX_CURVE_POINTS = 2000  # of one curve: more than a screen has pixels across
MAX_KEY_FRAMES = 18_000  # 30 per second in ten minutes
MAX_PATH_POINTS = 1500  # about one per pixel of a drawn path
Curve = tuple[str, np.ndarray, np.ndarray]  # name, times from the first sample [s], and values; NaN for a gap
Spans = list[tuple[float, float]]


@final
class GuidedMotion(NamedTuple):
    """A rollout or a recording, its samples and the constraints that guided it.

    Attributes:
        name: Name in the legend.
        recording: The rollout or the recording itself, on its own time axis.
        samples: Its samples, with joints in the robot's order and times from the first sample [s].
        moving: The samples with known velocities: all, or fewer if the velocities were derived; None if there are none.
        constraints: Constraints, by their index in the phases (for a reproduced skill, one per motion along a
            constraint). The first one applies to a motion without phases. Empty if none is known.
        target: Target of the task, as returned by `Task.goal`; None if it is not known.
        phases: Time spans of the constraints, or the phases that a rollout itself contains.
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
        """The first constraint; None if none is known."""
        return self.constraints[0] if self.constraints else None

    def mechanism(self, k: int) -> Mapping[str, Any] | None:
        """Return the mechanism stored with constraint k.

        Args:
            k: Index of the constraint.

        Returns:
            The dictionary of the mechanism; None if there is none.
        """
        stored = self.constraints[k].provenance.get("mechanism") if k < len(self.constraints) else None
        return stored if isinstance(stored, Mapping) else None

    def constraint_indices(self, time: Float[np.ndarray, " T"]) -> Int[np.ndarray, " T"]:
        """Return the index of the constraint that applies at each time.

        Args:
            time: Times (T,) from the first sample [s].

        Returns:
            Indices (T,) from the phases, 0 for a motion without phases. -1 if no constraint is known at that time, and
            everywhere if the demonstrator drives the rows (b is not 0).
        """
        is_imposed = self.constraint is None or self.constraint.provenance.get("kind") == "self-imposed"
        indices = np.full(time.size, -1 if is_imposed else 0)
        for band in [] if is_imposed else self.phases:
            if band.constraint is not None:
                indices[band.covers(time)] = band.constraint
        return np.where(indices < len(self.constraints), indices, -1)


def guided_motion(
    robot: Robot,
    name: str,
    recording: Rollout | Trajectory,
    constraint: Constraint | Sequence[Constraint] | None = None,
    target: ArrayLike | None = None,
) -> GuidedMotion:
    """Check a motion, derive its velocities if it has none, and find its constraints.

    Args:
        robot: Robot of the motion.
        name: Name in the legend.
        recording: A rollout or a recording.
        constraint: One constraint, or one for each index in the phases; None to use the rollout's own.
        target: Target of the task, as returned by `Task.goal`; None to use the rollout's own.

    Returns:
        The motion, with empty phases.

    Raises:
        ConstraintMismatchError: The constraint belongs to another robot.
        RecordingError: There are no samples, shapes do not fit, time does not increase, a number is NaN, the robot is
            another one, or it has other locked joints.
        TargetError: The target is not finite numbers.
    """
    constraints = (constraint,) if isinstance(constraint, Constraint) else tuple(constraint or ())
    checked = recording
    if isinstance(recording, Rollout):
        target = recording.target if target is None else target
        if recording.robot is not None:
            recording.robot.refuse_another(robot, f"rollout {name!r}")
        if constraint is None:
            constraints = _stored_constraints(robot, name, recording)
        # a rollout built by hand was not checked before; a trajectory checks times and postures
        checked = Trajectory(recording.time, recording.q, recording.u, recording.joint_names, f"rollout {name!r}")
    for c in constraints:
        other = c.robot
        if c.nv != robot.nv or (other is not None and other.joint_names != robot.joint_names):
            owner = f"robot {other.name!r}" if other is not None else f"a system of {c.nv} velocities"
            remedy = f"the robot shown is {robot.name!r} with {robot.nv}: pass a constraint of this robot"
            raise ConstraintMismatchError(f"the constraint to show with {name!r} belongs to {owner}, {remedy}")
    place = None if target is None else finite(target, *np.shape(np.array(target, dtype=object)))
    if target is not None and (place is None or place.ndim not in (1, 2)):
        raise TargetError(f"the target to show must be finite numbers, or a 4 x 4 pose, got {target!r:.80}")
    names, joints = checked.joint_names or robot.joint_names, robot.joint_names
    if set(names) != set(joints):
        parts = {"missing": [n for n in joints if n not in names], "not its own": [n for n in names if n not in joints]}
        what = "; ".join(f"{label} {', '.join(some[:6])}" for label, some in parts.items() if some)
        sentence = f"rollout {name!r} was not made with robot {robot.name!r}: joints {what}"
        raise RecordingError(f"{sentence}; load the robot of the rollout", code="joint-names")
    order, q = [names.index(n) for n in joints], checked.q
    q = q[:, order] if q.shape[1] == robot.nv else q
    u = checked.u[:, order] if checked.u is not None and np.all(np.isfinite(checked.u)) else None
    samples = moving = Trajectory(checked.time - checked.time[0], q, u, joints, name)
    if u is None:  # a derivative needs 5 samples
        moving = derive_velocities(samples, robot) if len(samples) >= 5 else None
    return GuidedMotion(name, recording, samples, moving, constraints, place)


def _stored_constraints(robot: Robot, name: str, rollout: Rollout) -> tuple[Constraint, ...]:
    """Return the constraints stored in a rollout: one for each of its ways, or its only one."""
    stored = [way.get("constraint") for way in rollout.ways]
    stored = [rollout.constraint] if not stored or None in stored else stored
    return tuple(Constraint.from_dict(c, robot, source=f"the constraint of rollout {name!r}") for c in stored if c)


def _track(kind: str, curves: Sequence[Curve], unit: str = "", without: Sequence[str] = ()) -> dict[str, Any]:
    """Return curves that share an axis.

    Args:
        kind: `"singular"`, `"velocity"`, `"position"`, `"task-error"`, `"following-error"`, `"fit"`, `"opening"` (of a
            sliding fixture), `"turning"` or `"effort"`.
        curves: The curves; the page leaves out a track without curves or without finite values.
        unit: Unit of the values; `"limit"` for shares of a limit or of a range, empty for other shares.
        without: Joints that are left out because they have no limits.
    """
    return {"kind": kind, "unit": unit, "without": list(without), "curves": curves}


def motion_tracks(robot: Robot, motion: GuidedMotion) -> list[dict[str, Any]]:
    """Return the quantities of a motion that the page plots over time, except manipulability and status.

    Args:
        robot: Robot of the motion.
        motion: The motion.

    Returns:
        One dictionary per quantity (track): its `kind`, `unit` and `curves`, and the joints that are left out.
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
            # below a tenth of its root mean square speed a motion is too slow to measure a constraint
            moves = speed > 0.1 * np.sqrt(np.mean(speed**2))
            shares = np.linalg.norm(_violation(motion, moving), axis=1) / np.where(moves, speed, np.nan)
            tracks.append(_track("fit", [("share", moving.time, shares)]))
    for kind, times, values, has_limit in limits:
        curves = [(name, times, values[:, j]) for j, name in enumerate(names) if has_limit[j]]
        without = [name for j, name in enumerate(names) if not has_limit[j]]
        tracks.append(_track(kind, curves, "limit", without))
    if isinstance(recording, Rollout):
        features = None if motion.constraint is None else motion.constraint.features
        units = "" if features is None else " or ".join(sorted({u.removesuffix("/s") for u in features.row_units}))
        joints = " or ".join(sorted(set(robot.joint_units), reverse=True))
        errors = {"task-error": (recording.task_error, units), "following-error": (recording.following_error, joints)}
        for kind, (values, unit) in errors.items():
            if values is not None and values.shape == time.shape:
                tracks.append(_track(kind, [("", time, np.where(np.isfinite(values), values, np.nan))], unit))
    elif recording.effort is not None:  # normalised per joint, because the efforts at the base dwarf the others
        largest = np.max(np.abs(recording.effort), axis=0)
        shares = (recording.effort / np.where(largest > 0.0, largest, 1.0)).T
        joints = zip(recording.joint_names or names, shares, strict=True)
        tracks.append(_track("effort", [(name, time, share) for name, share in joints]))
    return tracks


def _violation(motion: GuidedMotion, moving: Trajectory) -> Float[np.ndarray, "U nv"]:
    """Return A^+ A u, the part of each velocity that violates A(q) u = 0; NaN where no constraint is known.

    Args:
        motion: The motion.
        moving: Its samples with known velocities.
    """
    u, indices = moving.arrays["u"], motion.constraint_indices(moving.time)
    violation = np.full(u.shape, np.nan)
    for k in np.unique(indices[indices >= 0]):
        rows, constraint = indices == k, motion.constraints[k]
        A = constraint.selection @ constraint.features.batch(moving.q[rows])
        violation[rows] = np.einsum("tij,tjk,tk->ti", np.linalg.pinv(A, rcond=1e-10), A, u[rows])
    return violation


def track_data(tracks: Sequence[Mapping[str, Any]], most: int) -> dict[str, Any]:
    """Convert the plotted quantities of a motion to data for the page.

    Curves with all of their samples share their times, in float64; thinned curves have their own times, because their
    extremes are at different samples. Values are float32.

    Args:
        tracks: Quantities of one motion over time, see `motion_tracks`.
        most: Approximate largest number of points per curve.

    Returns:
        Dictionary of JSON values: shared times (`clocks`) and tracks.
    """
    clocks = dict[str, int]()  # times -> index

    def curve_data(name: str, times: np.ndarray, values: np.ndarray) -> dict[str, Any]:
        """Return one curve, thinned, with its own or a shared clock.

        Args:
            name: Name in the legend.
            times: Times (T,) [s].
            values: Values (T,); NaN for a gap.
        """
        samples = extremes(values, most)
        described: dict[str, Any] = {"name": name, "values": to_base64(values[samples], "<f4")}
        if samples.size < values.size:
            return described | {"times": to_base64(times[samples], "<f4")}
        return described | {"clock": clocks.setdefault(to_base64(times, "<f8"), len(clocks))}

    described = [{**track, "curves": [curve_data(*curve) for curve in track["curves"]]} for track in tracks]
    return {"clocks": list(clocks), "tracks": described}


def extremes(values: Float[np.ndarray, " T"], most: int) -> Int[np.ndarray, " K"]:
    """Select samples of a curve to plot: first, last, and minimum and maximum of each of about `most / 2` time spans.

    Args:
        values: The curve (T,); NaN is a gap, and a span without any number keeps its first sample.
        most: Approximate largest number of samples; a shorter curve is not thinned.

    Returns:
        Indices (K,), increasing.
    """
    samples = np.arange(values.size)
    if values.size <= most:
        return samples
    spans = np.split(samples, np.linspace(0, values.size, max(most // 2, 2)).astype(int)[1:-1])
    low, high = (np.where(np.isnan(values), never, values) for never in (np.inf, -np.inf))
    ends = [(span[np.argmin(low[span])], span[np.argmax(high[span])]) for span in spans]
    return np.unique([0, values.size - 1, *np.ravel(ends)])


@final
class RecordedMotion(NamedTuple):
    """Motion with all data that the page needs; times are counted from its first sample [s].

    Attributes:
        motion: Samples, phases and constraints of the motion.
        postures: shape (K, n), joint positions of the key frames [rad or m].
        path_times: shape (P,), times along the tip path [s].
        path: shape (P, 3), positions of the tip in the base frame [m].
        measures: Quantities to plot over time, see `motion_tracks`.
        content: Further data for the page. Its entry `handles` has, for each fixture that a rollout moves, the times at
            which the hand grasps and releases the handle [s].
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
    """Sample a motion for playback.

    Args:
        robot: Robot of the motion.
        tip: Frame whose path is drawn.
        motion: The motion.
        colour: Hexadecimal colour of the motion, e.g. `"#0072b2"`.
        phases: Phases on the recording's own time axis; empty to use the phases that a rollout contains.
        mechanism: Dictionary of the mechanism, for a rollout whose constraint stores none; None if it is not known.

    Returns:
        The motion with its data for the page.

    Raises:
        RecordingError: Manipulability, status or phases do not fit the motion.
        ConfigurationError: A configuration has the wrong size.
    """
    recording, name, time, q = motion.recording, motion.name, motion.samples.time, motion.samples.q
    keys = key_frames(time)
    tracks = joint_tracks(robot, q[keys])  # first, because it refuses postures of the wrong size
    path_keys = keys[evenly(keys.size, MAX_PATH_POINTS)]
    path_times, poses = time[path_keys], robot.frame_kinematics(tip).poses(q[path_keys])
    curve_times, curve, status, bands, grips, around = np.zeros(0), np.zeros(0), [], (), {}, ()
    if isinstance(recording, Rollout):
        if (curve := finite(recording.mu, time.size)) is None:
            sentence = f"the manipulability of its {time.size} times must be as many finite numbers"
            raise RecordingError(f"rollout {name!r}: {sentence}, got {recording.mu!r:.80}", code="not-finite")
        samples = extremes(curve, MAX_CURVE_POINTS)
        curve_times, curve, around = time[samples], curve[samples], recording.around
        status = status_changes(name, time, recording.status)
        bands = rollout_bands(name, recording.phases)
        if len(recording.ways) > 1:
            ways = {way.get("name"): k for k, way in reversed(list(enumerate(recording.ways)))}  # by the name of a step
            bands = [band._replace(constraint=ways.get((band.name or "").rpartition(": ")[0])) for band in bands]
        bands = _within(bands, motion)
        grips = _grip_spans(recording, bands, motion)
    motion = motion._replace(phases=_within(phases, motion) or bands)
    travels: dict[str, list[Curve]] = {"m": [], "rad": []}
    for k, spans in list(grips.items()):
        stored = motion.mechanism(k) or mechanism or {}
        if not stored.get("type"):
            del grips[k]
        elif stored["type"] in ("line", "hinge", "screw") and (fixture := Mechanism.from_dict(stored)).axis is not None:
            way = _fixture_travel(fixture, path_times, poses, spans)
            travels["m" if fixture.type == "line" else "rad"].append(("", path_times, way))
    opening, turning = _track("opening", travels["m"], "m"), _track("turning", travels["rad"], "rad")
    measures = [opening, turning, *motion_tracks(robot, motion)]
    kinds = rollout_kinds(motion.phases, colour)
    numbers = {kind.label: k for k, kind in enumerate(kinds)}
    # angles in float64: even after many turns they must be accurate to a nanoradian
    exact = {"keyTimes": time[keys], "tracks": tracks, "curveTimes": curve_times, "curve": curve}
    content: dict[str, Any] = {
        "name": name,
        "colour": colour,
        "duration": float(time[-1]),
        **{key: to_base64(array, "<f8") for key, array in exact.items()},
        "pathTimes": to_base64(path_times, "<f4"),
        "path": to_base64(poses[:, :3, 3], "<f4"),
        "status": status,
        "handles": list(grips.values()),
        # start, end, index of the kind; -1 for free motion
        "phases": [
            [b.start, b.end, numbers.get(b.name or "", -1 if b.constraint is None else b.constraint)]
            for b in motion.phases
        ],
    }
    more = {"phaseKinds": [vars(kind) for kind in kinds], "clear": clearance_in_words(around)}
    content |= {key: value for key, value in more.items() if value}
    measures = [t for t in measures if any(np.any(np.isfinite(values)) for _, _, values in t["curves"])]
    return RecordedMotion(motion, q[keys], path_times, poses[:, :3, 3], measures, content)


def _within(phases: Iterable[PhaseBand], motion: GuidedMotion) -> tuple[PhaseBand, ...]:
    """Return bands with times from the first sample, cut to the span of the recording."""
    first, last = float(motion.recording.time[0]), motion.samples.duration
    moved = (b._replace(start=max(b.start - first, 0.0), end=min(b.end - first, last)) for b in phases)
    return tuple(band for band in moved if band.start < band.end)


def _grip_spans(recording: Rollout, bands: Sequence[PhaseBand], motion: GuidedMotion) -> dict[int, Spans]:
    """Return the time spans in which a rollout's hand holds each fixture, by the index of its constraint [s]."""
    grips: dict[int, Spans] = {}
    for band in bands:
        if band.part == WAY:
            grips.setdefault(band.constraint or 0, []).append((band.start, band.end))
    first = float(recording.time[0])
    begins = recording.ways[0]["begins"] if recording.ways else first  # without ways, in the hand all the time
    if not bands and begins is not None:
        grips[0] = [(begins - first, motion.samples.duration)]
    return grips


def _fixture_travel(
    mechanism: Mechanism, times: Float[np.ndarray, " T"], poses: Float[np.ndarray, "T 4 4"], spans: Spans
) -> Float[np.ndarray, " T"]:
    """Return the travel of a fixture with one free coordinate [m or rad]; the largest travel is positive."""
    way, moved = np.zeros(len(times)), 0.0
    for start, end in spans:
        inside = np.flatnonzero((times >= start - 1e-9) & (times <= end + 1e-9))
        if inside.size and (mechanism.type == "line" or mechanism.point is not None):
            way[inside[0] :] = moved
            way[inside] += mechanism.at(poses[inside[0]], np.inf).coordinates(poses[inside])[:, 0]
            way[inside[-1] :] = moved = way[inside[-1]]
    return way * np.sign(way[np.argmax(np.abs(way))] or 1.0) + 0.0


def clearance_in_words(around: Sequence[Mapping[str, Any]]) -> str:
    """Return the obstacles of a plan as text, e.g. "table (0.30 m from link1) as stated".

    Args:
        around: One dictionary per obstacle, as in `Rollout.around`.

    Returns:
        The text; empty without obstacles.
    """
    groups: dict[str, dict[str, str]] = {"as stated": {}, "assumed: state what is there as a scene": {}}
    for obstacle in around:
        origin = list(groups)[bool(obstacle.get("assumed"))]
        near = f" ({obstacle['nearest']:.2f} m from {obstacle['link']})" if obstacle.get("nearest") is not None else ""
        groups[origin].setdefault(obstacle["name"], obstacle["name"] + near)
    return "; ".join(f"{listed(names.values())} {origin}" for origin, names in groups.items() if names)


def key_frames(time: Float[np.ndarray, " T"]) -> np.ndarray:
    """Select the samples that are key frames of the playback.

    There are at most 60 per second, and fewer in long motions; the first and the last sample are among them.

    Args:
        time: Times (T,) of the samples [s].

    Returns:
        Increasing indices of the samples.
    """
    gap = max(1.0 / 60.0, float(time[-1] - time[0]) / (MAX_KEY_FRAMES - 1))  # [s], frame period of most screens
    slots = np.floor((time - time[0]) / gap * (1.0 + 1e-12)).astype(np.int64)
    return np.union1d(np.flatnonzero(np.diff(slots, prepend=-1) > 0), [time.size - 1])


def status_changes(name: str, time: Float[np.ndarray, " T"], words: Iterable[object]) -> list[tuple[float, str, str]]:
    """Return the changes of the controller's status over time.

    Args:
        name: Name of the rollout, for error messages.
        time: Times (T,) [s].
        words: Status at each time; empty for no status.

    Returns:
        Tuple (time [s], status, effect of the status on the motion) for each change; the effect of an unknown status is
        `"slowed"`.

    Raises:
        RecordingError: The number of words differs from the number of times.
    """
    status = [str(word) for word in words]
    if status and len(status) != time.size:
        raise RecordingError(f"rollout {name!r} has {time.size} times and {len(status)} status words", code="shape")
    effects = {str(status): status.effect for status in Status}  # a user's own controller may have others
    changes = [i for i, word in enumerate(status) if i == 0 or word != status[i - 1]]
    return [(float(time[i]), status[i], effects.get(status[i], "slowed")) for i in changes]
