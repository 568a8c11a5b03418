"""Validation of a recording: faults are rejected with a located message, every change is reported in a note."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from manip_learn.errors import advice, counted, named
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.readers.read_request import ReadRequest
from manip_learn.recordings.readers.recording import Recording
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.validation.joint_matching import angular_coordinates, match_joints, object_coordinates
from manip_learn.recordings.validation.motion_checks import (
    Motion,
    bunched_note,
    check_motion,
    increasing,
    pieces,
    time_in_seconds,
)
from manip_learn.recordings.velocities import continuous_rotation_vectors
from manip_learn.robot import Robot

SHOWN = 5  # places in a sentence
# [rad]: a guided arm stays within a turn of its zeros and travels less than half a turn; in degrees that were nothing
RADIANS, TRAVEL = 2.0 * np.pi, np.pi
NO_MEASUREMENT = 1e50  # finite, but its square would overflow


def validate(recording: Recording, request: ReadRequest) -> Demonstrations:
    """Trajectories of a recording, in the robot's joints and in SI units; notes report what was noticed or done."""
    recording = match_joints(recording, request)
    q, u = recording.positions, recording.velocities
    robot, notes = request.robot, list(recording.notes)
    if recording.time.shape[0] >= 2:
        _refuse_not_finite(recording)
    time = time_in_seconds(recording, request)
    q, u, said = _in_radians(recording, request, q, u)
    notes += said
    keep, said = increasing(recording, time, q, u)
    notes += said
    if not np.all(keep):
        recording, time, q, u = _kept(recording, keep), time[keep], q[keep], None if u is None else u[keep]
        if time.shape[0] < 2:
            raise recording.refusal("too-short", "all stamps are the same: no motion is left")
    notes += bunched_note(time)
    q, said = _unwrapped(robot, q)
    notes += said
    notes += check_motion(Motion(recording, request, time, q, u))
    return _split(recording, robot, time, q, u, notes)


def _refuse_not_finite(recording: Recording) -> None:
    parts = [("", recording.time[:, None], ("time",)), ("", recording.positions, recording.position_names)]
    if recording.velocities is not None:
        parts.append((" velocity", recording.velocities, recording.velocity_names))
    bad = np.any([~np.all(np.abs(values) < NO_MEASUREMENT, axis=1) for _, values, _ in parts], axis=0)
    rows = np.flatnonzero(bad)
    if not rows.size:
        return
    places = ", ".join(recording.place(int(r)) for r in rows[:SHOWN]) + (", ..." if rows.size > SHOWN else "")
    row = int(rows[0])
    for word, values, columns in parts:
        wrong = np.flatnonzero(~(np.abs(values[row]) < NO_MEASUREMENT))
        if wrong.size:
            text = (
                f"{values[row, wrong[0]]}{word} where a finite number is needed, in {counted(rows.size, 'sample')}: "
                f"{places}; "
                "remove them (a gap of more than ten steps then splits the demonstration)"
            )
            raise recording.refusal("not-finite", text, sample=row, column=columns[wrong[0]])


def _refuse_radians(recording: Recording, request: ReadRequest, angles: Float[np.ndarray, "T k"]) -> None:
    """Refuse angles that were called degrees and look like radians."""
    if request.units_insisted or not angles.size:
        return
    largest, travel = float(np.abs(angles).max()), float(np.ptp(angles, axis=0).max())
    if largest > RADIANS or travel > TRAVEL:
        return
    python, flag = "units='degrees'", "--units degrees"
    leave_out = advice("leave {} out", "degrees=True", "--degrees") or "say radians"
    raise recording.refusal(
        "degrees",
        f"{leave_out} if these are radians, as they look: no joint gets beyond {largest:.3g} or travels more than "
        f"{travel:.3g}; {advice('if they are degrees, insist with {}', python, flag) or 'else convert the file'}",
    )


def _in_radians(
    recording: Recording, request: ReadRequest, q: Float[np.ndarray, "T nv"], u: Float[np.ndarray, "T nv"] | None
) -> tuple[Float[np.ndarray, "T nv"], Float[np.ndarray, "T nv"] | None, list[str]]:
    robot, angular = request.robot, angular_coordinates(request.robot)
    if recording.trusted and request.units not in (None, "radians"):
        python, flag = f"units={request.units!r}", f"--units {request.units}"
        raise recording.refusal(
            "units", f"a rollout of this library is in radians and metres{advice('; leave {} out', python, flag)}"
        )
    if request.units == "degrees":
        _refuse_radians(recording, request, q[:, angular & ~object_coordinates(robot)])
        factor = np.where(angular, np.pi / 180, 1.0)
        lengths = [n for n, a in zip(robot.joint_names, angular, strict=True) if not a]
        kept = f"; {', '.join(lengths)} taken as metres" if lengths else ""
        return q * factor, None if u is None else u * factor, [f"degrees converted to radians, as asked{kept}"]
    if request.units == "normalised":
        # the pose of an object is in metres and radians whatever the unit of the motors
        pose = object_coordinates(robot)
        lower, upper = np.where(pose, -100.0, robot.position_lower), np.where(pose, 100.0, robot.position_upper)
        unlimited = [n for n, a, b in zip(robot.joint_names, lower, upper, strict=True) if not np.isfinite(b - a)]
        if unlimited:
            text = f"joint {unlimited[0]!r} has no limits, so its normalised values have no meaning: convert the file"
            raise recording.refusal("units", text)
        if np.max(np.abs(q[:, ~pose]), initial=0.0) > 110.0:
            raise recording.refusal(
                "units", f"values reach {np.max(np.abs(q)):.4g}: normalised ones are -100 .. 100; state other units"
            )
        factor = (upper - lower) / 200.0
        note = "normalised values (-100 .. 100) spread over the joint limits, as asked"
        return 0.5 * (lower + upper) + q * factor, None if u is None else u * factor, [note]
    return q, u, []


def _kept(recording: Recording, keep: np.ndarray) -> Recording:
    """The recording seen through the kept samples, so that later messages still name the right line."""
    index = np.flatnonzero(keep)
    efforts, line_of = recording.efforts, recording.line_of
    return replace(
        recording,
        time=recording.time[keep],
        positions=recording.positions[keep],
        velocities=None,
        efforts=None if efforts is None else efforts[keep],
        line_of=None if line_of is None else lambda i: line_of(int(index[i])),
    )


def _unwrapped(robot: Robot, q: Float[np.ndarray, "T nv"]) -> tuple[Float[np.ndarray, "T nv"], list[str]]:
    """Rotation vectors of objects and angles of continuous joints without jumps, and notes."""
    columns = [b.v.start for b in robot.blocks if b.kind == "continuous"]
    wrapped = [i for i in columns if np.any(np.abs(np.diff(q[:, i])) > np.pi)]
    q, notes = q.copy(), []
    for block in robot.blocks:
        if block.name in robot.objects:
            part = slice(block.v.start + 3, block.v.stop)
            vectors = continuous_rotation_vectors(q[:, part])
            if not np.array_equal(vectors, q[:, part]):
                q[:, part] = vectors
                notes.append(f"object {block.name!r}: full turns added where its rotation vector wraps (same pose)")
    if wrapped:
        q[:, wrapped] = np.unwrap(q[:, wrapped], axis=0)
        names = [robot.joint_names[i] for i in wrapped]
        notes.append(f"full turns added where the angle wraps (the posture is the same): {named('joint', names)}")
    return q, notes


def _split(
    recording: Recording,
    robot: Robot,
    time: Float[np.ndarray, " T"],
    q: Float[np.ndarray, "T nv"],
    u: Float[np.ndarray, "T nv"] | None,
    notes: list[str],
) -> Demonstrations:
    parts, gaps = pieces(time)
    whole = Trajectory(time, q, u, robot.joint_names, recording.name, effort=recording.efforts)
    if not gaps.size:
        return Demonstrations((whole,), notes)
    long_parts = [p for p in parts if p.stop - p.start >= 2]
    shown = ", ".join(f"{time[g + 1] - time[g]:.3g} s after {recording.place(int(g))}" for g in gaps[:SHOWN])
    notes.append(
        f"split at {counted(gaps.size, 'gap')} longer than ten steps ({shown}{', ...' if gaps.size > SHOWN else ''})"
    )
    if len(long_parts) < len(parts):
        notes.append(f"left out between gaps: {counted(len(parts) - len(long_parts), 'lone sample')}")
    if not long_parts:
        raise recording.refusal("too-short", "the samples are so far apart that no two belong together")
    n = len(long_parts)
    trajectories = tuple(whole.part(p, f"{recording.name} part {k} of {n}") for k, p in enumerate(long_parts, 1))
    return Demonstrations(trajectories, notes)
