"""Validation of a recording: faults are rejected with a located message, every change is reported in a note."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from manip_learn.errors import advice, counted, named
from manip_learn.recordings.clock import evenly_spread, senders_in_order, spread_repeats
from manip_learn.recordings.demonstrations import Demonstrations
from manip_learn.recordings.earned_velocities import NO_MEASUREMENT
from manip_learn.recordings.holes import split_at_holes, stalled
from manip_learn.recordings.readers.read_request import RATE, ReadRequest
from manip_learn.recordings.readers.recording import Recording
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.recordings.validation.joint_matching import angular_coordinates, match_joints, object_coordinates
from manip_learn.recordings.validation.motion_checks import (
    MotionInFile,
    check_motion,
    failed_reads,
    refuse_degrees_beside,
    time_in_seconds,
)
from manip_learn.recordings.velocities import continuous_rotation_vectors
from manip_learn.robot import Robot

_SHOWN = 5  # places in a sentence
# [rad]: a guided arm stays within a turn of its zeros and travels less than half a turn; in degrees that were nothing
RADIANS, TRAVEL = 2.0 * np.pi, np.pi


def validate(recording: Recording, request: ReadRequest) -> Demonstrations:
    """Trajectories of a recording, in the robot's joints and in SI units; notes report what was noticed or done."""
    recording = match_joints(recording, request)
    notes = list(recording.notes)
    if recording.time.shape[0] < 2:
        rows = "1 row" if recording.time.shape[0] == 1 else "no row"
        raise recording.refusal("too-short", f"there is {rows} of numbers, at least 2 are needed")
    _refuse_not_finite(recording)
    q, u, said = _in_radians(recording, request, recording.positions, recording.velocities)
    notes += said
    time, said = time_in_seconds(recording, request, q, u)
    notes += said
    runs, said = senders_in_order(time, q)
    notes += said
    if not runs:
        i = int(np.argmax(np.diff(time) < 0.0))
        text = f"time goes back in {np.count_nonzero(np.diff(time) < 0.0)} of {counted(len(time) - 1, 'step')}, first "
        text += f"from {recording.time[i]:.9g} to {recording.time[i + 1]:.9g}: sort the rows"
        text += advice(", or pass {} if they were taken evenly", *RATE)
        raise recording.refusal("time-order", text, sample=i + 1, column="time")
    trajectories: list[Trajectory] = []
    for number, run in enumerate(runs, 1):
        of_one = replace(recording, name=f"{recording.name} sender {number}") if len(runs) > 1 else recording
        own = None if u is None else u[run.samples]
        found, said = _of_one_sender(_kept(of_one, run.samples), request, run.time, q[run.samples], own)
        trajectories += found
        notes += [note for note in said if note not in notes]
    return Demonstrations(trajectories, notes)


def _of_one_sender(
    recording: Recording,
    request: ReadRequest,
    time: Float[np.ndarray, " T"],
    q: Float[np.ndarray, "T nv"],
    u: Float[np.ndarray, "T nv"] | None,
) -> tuple[list[Trajectory], list[str]]:
    """Trajectories of samples whose stamps do not lead back, and notes."""
    robot, notes = request.robot, list[str]()
    if time[-1] <= time[0]:
        text = "all stamps are the same: no motion is left"
        text += advice("; pass {}", *RATE)
        raise recording.refusal("too-short", text)
    repeated = np.flatnonzero(np.diff(time) == 0.0)
    same = np.all(q[repeated] == q[repeated + 1], axis=1)
    if u is not None:
        same &= np.all(u[repeated] == u[repeated + 1], axis=1)
    left_out = {"repeated sample": repeated + 1} if repeated.size and np.all(same) else {}
    failed = np.empty(0, dtype=int) if recording.trusted else failed_reads(q)
    left_out |= {"failed read": failed} if failed.size else {}
    for what, samples in left_out.items():
        posture = f"; the joints jump to {', '.join(f'{x:.3g}' for x in q[failed[0]])}" if samples is failed else ""
        where = recording.place(int(samples[0]))
        notes.append(f"{counted(samples.size, what)} left out (first: {where}{posture})")
    stalls = stalled(time, q)  # which the note on holes names
    if left_out or stalls.size:
        keep = np.delete(np.arange(len(time)), np.concatenate([*left_out.values(), stalls]))
        recording, time, q, u = _kept(recording, keep), time[keep], q[keep], None if u is None else u[keep]
    q, said = _unwrapped(robot, q)
    notes += said
    time, note = evenly_spread(time, q)
    notes += [note] if note else []
    if np.any(np.diff(time) <= 0.0):
        n = np.count_nonzero(np.diff(time) <= 0.0)
        time = spread_repeats(time)
        notes.append(f"{counted(n, 'stamp')} repeated with other positions: spread up to the next stamp")
    motion = MotionInFile(recording, request, time, q)
    notes += check_motion(motion, None if request.velocities == "derive" else u)
    if u is not None and not recording.trusted:
        refuse_degrees_beside(motion, u)
    whole = Trajectory(
        time,
        q,
        u,
        robot.joint_names,
        recording.name,
        effort=recording.efforts,
        judged=recording.trusted,
        sha256=recording.sha256,
    )
    parts, said = split_at_holes(whole, robot)
    return parts, [*notes, *said]


def _refuse_not_finite(recording: Recording) -> None:
    values, columns = np.column_stack([recording.time, recording.positions]), ("time", *recording.position_names)
    bad = ~(np.abs(values) < NO_MEASUREMENT)
    rows = np.flatnonzero(np.any(bad, axis=1))
    if rows.size:
        places = ", ".join(recording.place(int(r)) for r in rows[:_SHOWN]) + (", ..." if rows.size > _SHOWN else "")
        row, column = int(rows[0]), int(np.argmax(bad[rows[0]]))
        text = f"{values[row, column]} where a finite number is needed, in {counted(rows.size, 'sample')}: {places}; "
        text += "remove them (a gap of more than ten steps then splits the demonstration)"
        raise recording.refusal("not-finite", text, sample=row, column=columns[column])


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


def _kept(recording: Recording, index: Int[np.ndarray, " k"] | slice) -> Recording:
    """The recording seen through some samples, so that later messages still name the right line."""
    if isinstance(index, slice):
        return recording
    efforts, line_of = recording.efforts, recording.line_of
    return replace(
        recording,
        time=recording.time[index],
        positions=recording.positions[index],
        velocities=None,
        efforts=None if efforts is None else efforts[index],
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
