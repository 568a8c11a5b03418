"""Columns of a recording -> joints of the robot in its order; quaternions of objects become rotation vectors."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from manip_learn.errors import RecordingError, advice, counted
from manip_learn.recordings.readers.name_patterns import helpful_renaming
from manip_learn.recordings.readers.quantities import another_robot
from manip_learn.recordings.readers.read_request import ReadRequest, first_names, rename_words, unmoved_joint_names
from manip_learn.recordings.readers.recording import Recording
from manip_learn.recordings.velocities import continuous_rotation_vectors
from manip_learn.robot import Robot

QUATERNION, ROTATION_VECTOR = (".qx", ".qy", ".qz", ".qw"), (".rx", ".ry", ".rz")
_SHOWN = 12  # columns that a sentence says how to leave out
UNIT = 0.05  # by which the length of a recorded quaternion may differ from 1
_STILL = 0.02  # [rad or m] that a joint which does not move by itself may be recorded off its place: more is no noise


def object_coordinates(robot: Robot) -> Bool[np.ndarray, " nv"]:
    """True for the six coordinates of each object, False for those of the robot itself."""
    return np.array([block.name in robot.objects for block in robot.blocks for _ in block.units], dtype=bool)


def with_rotation_vectors(recording: Recording, objects: Sequence[str], *, in_degrees: bool) -> Recording:
    """The recording with columns `box.rx box.ry box.rz` in place of `box.qx box.qy box.qz box.qw`.

    Args:
        recording: As it stands in the file.
        objects: Names of the objects.
        in_degrees: Unit of the angles in the file, in which the rotation vectors are given too.

    Raises:
        RecordingError: Part of a quaternion, or one whose length is not 1.
    """
    for name in objects:
        names, wanted = recording.position_names, [name + s for s in QUATERNION]
        absent = [c for c in wanted if c not in names]
        if len(absent) == len(wanted):
            continue
        new = tuple(name + s for s in ROTATION_VECTOR)
        if absent:
            said = f"the orientation of object {name!r} is a quaternion without {absent[0]!r}: record all of"
            said += f" {', '.join(wanted)}, or the rotation vector {', '.join(new)}"
            raise recording.refusal("partial-quaternion", said, column=absent[0])
        quaternions = recording.positions[:, [names.index(c) for c in wanted]]
        length = np.linalg.norm(quaternions, axis=1)
        known = np.isfinite(length)  # of missing numbers: validation finds them
        bad = np.flatnonzero(known & (np.abs(length - 1.0) > UNIT))
        if bad.size:
            said = f"the quaternion of object {name!r} has length {length[bad[0]]:.4g}, 1 is needed"
            said += f" (order qx qy qz qw); so in {counted(bad.size, 'sample')}"
            raise recording.refusal("quaternion", said, sample=int(bad[0]), column=wanted[0])
        from scipy.spatial.transform import Rotation

        vectors = np.full((len(length), 3), np.nan)
        if np.any(known):
            vectors[known] = continuous_rotation_vectors(Rotation.from_quat(quaternions[known]).as_rotvec())
        kept = [i for i, n in enumerate(names) if n not in wanted]
        recording = replace(
            recording,
            position_names=(*(names[i] for i in kept), *new),
            positions=np.hstack([recording.positions[:, kept], np.degrees(vectors) if in_degrees else vectors]),
            notes=(*recording.notes, f"the quaternions of object {name!r} were converted to rotation vectors"),
        )
    return recording


def angular_coordinates(robot: Robot) -> Bool[np.ndarray, " nv"]:
    """True where a tangent coordinate is an angle, False where it is a length."""
    return np.array([unit == "rad" for unit in robot.joint_units], dtype=bool)


def match_joints(recording: Recording, request: ReadRequest) -> Recording:
    """The recording with the robot's joints as columns, in the robot's order; numbers are still those of the file.

    Raises:
        RecordingError: A joint without a column, a column without a joint.
    """
    robot = request.robot
    recording = recording.without(lambda name: not name or request.ignores(name))  # whatever the format
    for named in (recording.position_names, recording.velocity_names):
        repeated = next((n for n, count in Counter(named).items() if count > 1), None)
        if repeated is not None:
            raise recording.refusal("duplicate-column", f"the joint {repeated!r} occurs twice: keep one")
    recording = with_rotation_vectors(recording, robot.objects, in_degrees=request.units == "degrees")
    names = recording.position_names
    missing = [j for j in robot.joint_names if j not in names]
    moving = set(recording.velocity_names) & set(robot.joint_names)
    if len(missing) == robot.nv and moving:
        text = f"velocities of {counted(len(moving), 'joint')} are recorded in {counted(len(recording.time), 'sample')}"
        text += " and no positions, from which a posture is known: record positions too"
        raise recording.refusal("no-positions", text)
    if missing:
        raise _missing(recording, robot, missing)
    chosen = any("{" in name for name in request.new_names)  # by a pattern: what it leaves is not meant
    notes = _surplus_notes(recording, robot, recording.strict_columns and not chosen)
    velocities, said = _velocities(recording, robot)
    efforts, also = _efforts(recording, robot)
    q = recording.positions[:, [names.index(j) for j in robot.joint_names]]
    return replace(
        recording,
        position_names=robot.joint_names,
        positions=q,
        velocity_names=robot.joint_names,
        velocities=velocities,
        effort_names=robot.joint_names if efforts is not None else (),
        efforts=efforts,
        notes=(*recording.notes, *notes, *said, *also),
    )


def _missing(recording: Recording, robot: Robot, missing: list[str]) -> RecordingError:
    shown = ", ".join(map(repr, missing[:3])) + (f" and {len(missing) - 3} more" if len(missing) > 3 else "")
    known = {*robot.joint_names, *unmoved_joint_names(robot)}
    unknown = list(dict.fromkeys(n for n in recording.position_names if n not in known))
    seen = f", it has {first_names(unknown or recording.position_names, 10)}"
    thing = next((n for n in robot.objects if missing[0].startswith(f"{n}.")), None)
    if thing is not None:
        wanted = f"{thing}.x .y .z [m] and {thing}.rx .ry .rz (rotation vector [rad]) or {thing}.qx .qy .qz .qw"
        said = f"nothing is recorded for {shown}, the pose of object {thing!r}{seen}: record {wanted}; or leave it out"
        return recording.refusal("missing-object", said, column=missing[0])
    nothing, fixes = f"nothing is recorded for joint {shown} of robot {robot.name!r}{seen}", []
    helpful = helpful_renaming(unknown, missing, robot.joint_names)
    if not helpful and 2 * len(unknown) > len(recording.position_names):
        said = f"{another_robot(recording.position_names, robot)}; {nothing}"
        if len(unknown) == robot.nv:
            in_order = rename_words(dict(zip(unknown, robot.joint_names, strict=True)))
            said += advice("; if it is this one and they are in its order: {}", *in_order)
        return recording.refusal("missing-joint", said, column=missing[0])
    for rename, reads in helpful:
        words = ", ".join(f"{name} as {joint}" for name, joint in list(reads.items())[:2])
        ways = zip(rename_words(rename), _lock([j for j in missing if j not in reads.values()]), strict=True)
        python, flags = (mark.join(filter(None, way)) for mark, way in zip((" and ", " "), ways, strict=True))
        fixes.append(advice(f"{{}} reads {words}{', ...' if len(reads) > 2 else ''}", python, flags))
    if len(missing) < robot.nv:
        fixes.append(advice("{} if nothing of it moves", *_lock(missing)))
    fixes = [f for f in fixes if f] or ["name the robot that was recorded"]
    return recording.refusal("missing-joint", f"{nothing}: {'; or '.join(fixes)}", column=missing[0])


def _lock(joints: list[str]) -> tuple[str, str]:
    """How joints are locked in Python, and on the command line; nothing for none."""
    flags = " ".join(f"--lock {name}" for name in joints)
    return f"load_robot(..., locked=[{', '.join(map(repr, joints))}])" if joints else "", flags


def _surplus_notes(recording: Recording, robot: Robot, strict: bool) -> list[str]:
    unmoved = unmoved_joint_names(robot)
    known = {*robot.joint_names, *unmoved}
    unknown = [n for n in (*recording.position_names, *recording.velocity_names) if n not in known]
    unknown = list(dict.fromkeys(unknown))
    if unknown and strict:
        flags = " ".join(f"--ignore-column {shlex.quote(name)}" for name in unknown)
        ways = [advice("; or pass {}", f"ignore_columns={unknown}", flags)] if len(unknown) <= _SHOWN else []
        if recording.line_of is not None:  # patterns are for text tables
            others = "; {} reads the joints and leaves all else out"
            ways.append(advice(others, "columns='{joint}'", "--columns '{joint}'"))
        said = f"no joint of robot {robot.name!r} matches this column (it has {', '.join(robot.joint_names)})"
        raise recording.refusal("unknown-column", f"{said}: correct the name{''.join(ways)}", column=unknown[0])
    notes = [f"not joints of {robot.name!r}, not used: {', '.join(unknown)}"] if unknown else []
    at = {n: i for i, n in enumerate(recording.position_names)}
    for name in (n for n in recording.position_names if n in unmoved):
        values = recording.positions[:, at[name]]
        mimic = next((m for m in robot.mimics if m.joint == name), None)
        if mimic is None:
            note, though = f"joint {name!r} is locked or fixed in {robot.name!r}", "it moves by {} in the recording"
            off = values - np.min(values[np.isfinite(values)], initial=np.inf)
        else:
            note, though = f"mimic joint {name!r} follows {mimic.leader!r}", "it is up to {} away from its description"
            leader = recording.positions[:, at.get(mimic.leader, at[name])]
            off = values - mimic.multiplier * leader - mimic.offset if mimic.leader in at else 0.0 * values
        worst = float(np.max(np.abs(off[np.isfinite(off)]), initial=0.0))
        more = f", though {though.format(f'{worst:.3g}')}" if worst > _STILL else ""
        notes.append(f"{note}, its column is not used{more}")
    return notes


def _velocities(recording: Recording, robot: Robot) -> tuple[Float[np.ndarray, "T nv"] | None, list[str]]:
    names, recorded = recording.velocity_names, recording.velocities
    if recorded is None or not set(robot.joint_names) & set(names):
        return None, []
    if robot.objects and not recording.trusted:
        # a camera gives poses, and what a file calls their velocity may be in any frame
        return None, ["recorded velocities are not used: those of objects and joints are derived alike from positions"]
    known = np.column_stack([recorded, np.full(len(recorded), np.nan)])  # of those that are not recorded
    return known[:, [names.index(j) if j in names else -1 for j in robot.joint_names]], []


def _efforts(recording: Recording, robot: Robot) -> tuple[Float[np.ndarray, "T nv"] | None, list[str]]:
    """Efforts of all joints, or none: what the motion is learnt from does not need them, so nothing is refused."""
    efforts, names = recording.efforts, recording.effort_names
    there = [names.index(j) for j in robot.joint_names if j in names]
    if efforts is None or not there:
        return None, []
    if len(there) < robot.nv:
        return None, [f"efforts are recorded for {len(there)} of {robot.nv} joints, so they are not used"]
    if bad := int(np.count_nonzero(~np.all(np.isfinite(efforts[:, there]), axis=1))):
        return None, [f"efforts are not finite in {counted(bad, 'sample')}, so not used"]
    return efforts[:, there], []
