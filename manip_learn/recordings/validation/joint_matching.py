"""Columns with the pose of an object: quaternions become rotation vectors, and these have no jumps."""

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
SHOWN = 12  # columns that a sentence says how to leave out
UNIT = 0.05  # by which the length of a recorded quaternion may differ from 1


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
        columns = [name + s for s in QUATERNION]
        there = [c for c in columns if c in recording.position_names]
        if not there:
            continue
        if len(there) < len(columns):
            absent = next(c for c in columns if c not in there)
            raise recording.refusal(
                "partial-quaternion",
                f"the orientation of object {name!r} is a quaternion without {absent!r}: record all of "
                f"{', '.join(columns)}, or the rotation vector {', '.join(name + s for s in ROTATION_VECTOR)}",
                column=absent,
            )
        recording = _converted(recording, name, columns, in_degrees)
    return recording


def _converted(recording: Recording, name: str, columns: list[str], in_degrees: bool) -> Recording:
    names = recording.position_names
    quaternions = recording.positions[:, [names.index(c) for c in columns]]
    length = np.linalg.norm(quaternions, axis=1)
    bad = np.flatnonzero(~(np.abs(length - 1.0) <= UNIT) & np.isfinite(length))
    if bad.size:
        text = (
            f"the quaternion of object {name!r} has length {length[bad[0]]:.4g}, 1 is needed (order qx qy qz qw); "
            f"so in {counted(bad.size, 'sample')}"
        )
        raise recording.refusal("quaternion", text, sample=int(bad[0]), column=columns[0])
    from scipy.spatial.transform import Rotation

    vectors = np.full((len(length), 3), np.nan)  # of missing numbers: validation finds them
    known = np.isfinite(length)
    vectors[known] = (
        continuous_rotation_vectors(Rotation.from_quat(quaternions[known]).as_rotvec()) if np.any(known) else 0.0
    )
    kept = [i for i, n in enumerate(names) if n not in columns]
    return replace(
        recording,
        position_names=(*(names[i] for i in kept), *(name + s for s in ROTATION_VECTOR)),
        positions=np.hstack([recording.positions[:, kept], np.degrees(vectors) if in_degrees else vectors]),
        notes=(*recording.notes, f"the quaternions of object {name!r} were converted to rotation vectors"),
    )


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
    if len(missing) == robot.nv and set(recording.velocity_names) & set(robot.joint_names):
        n = counted(len(set(recording.velocity_names) & set(robot.joint_names)), "joint")
        text = f"velocities of {n} are recorded and no positions, from which a posture is known: record positions too"
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
    helpful, fixes = helpful_renaming(unknown, missing, robot.joint_names), []
    for rename, reads in helpful:
        python, flags = rename_words(rename)
        locked, lock = _lock([j for j in missing if j not in reads.values()])
        words = ", ".join(f"{name} as {joint}" for name, joint in list(reads.items())[:2])
        more = ", ..." if len(reads) > 2 else ""
        python, flags = " and ".join(filter(None, (python, locked))), " ".join(filter(None, (flags, lock)))
        fixes.append(advice(f"{{}} reads {words}{more}", python, flags))
    nothing = f"nothing is recorded for joint {shown} of robot {robot.name!r}{seen}"
    if not helpful and 2 * len(unknown) > len(recording.position_names):
        said = f"{another_robot(recording.position_names, robot)}; {nothing}"
        if len(unknown) == robot.nv:
            in_order = rename_words(dict(zip(unknown, robot.joint_names, strict=True)))
            said += advice("; if it is this one and they are in its order: {}", *in_order)
        return recording.refusal("missing-joint", said, column=missing[0])
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
    if unknown and strict:
        raise _unknown(recording, robot, list(dict.fromkeys(unknown)))
    notes = []
    if unknown:
        notes.append(f"not joints of {robot.name!r}, not used: {', '.join(dict.fromkeys(unknown))}")
    for i, name in enumerate(recording.position_names):
        if name in unmoved:
            notes.append(_unmoved_note(recording, robot, name, recording.positions[:, i]))
    return notes


def _unknown(recording: Recording, robot: Robot, names: list[str]) -> RecordingError:
    flags = " ".join(f"--ignore-column {shlex.quote(name)}" for name in names[:SHOWN])
    leave = advice(", or pass {}", f"ignore_columns={names[:SHOWN]}", flags)
    only_joints = advice("; {} reads the joints and leaves all else out", "columns='{joint}'", "--columns '{joint}'")
    return recording.refusal(
        "unknown-column",
        f"no joint of robot {robot.name!r} matches this column (it has {', '.join(robot.joint_names)}): correct the "
        "name"
        + (leave if len(names) <= SHOWN else "")
        + (only_joints if recording.line_of is not None else ""),  # patterns are for text tables
        column=names[0],
    )


def _unmoved_note(recording: Recording, robot: Robot, name: str, values: np.ndarray) -> str:
    finite = values[np.isfinite(values)]
    mimic = next((m for m in robot.mimics if m.joint == name), None)
    if mimic is not None:
        note = f"mimic joint {name!r} follows {mimic.leader!r}, its column is not used"
        if mimic.leader in recording.position_names:
            leader = recording.positions[:, recording.position_names.index(mimic.leader)]
            off = np.abs(values - mimic.multiplier * leader - mimic.offset)
            worst = float(np.max(off[np.isfinite(off)], initial=0.0))
            if worst > 0.02:  # [rad or m], more than encoder noise
                note += f", though it is up to {worst:.3g} away from what the description says"
        return note
    note = f"joint {name!r} is locked or fixed in {robot.name!r}, its column is not used"
    span = float(np.ptp(finite)) if finite.size else 0.0
    if span > 0.02:  # [rad or m], likewise
        note += f", though it moves by {span:.3g} in the recording"
    return note


def _velocities(recording: Recording, robot: Robot) -> tuple[Float[np.ndarray, "T nv"] | None, list[str]]:
    if recording.velocities is None:
        return None, []
    names = recording.velocity_names
    there = [j for j in robot.joint_names if j in names]
    if not there:
        return None, []
    if robot.objects and not recording.trusted:
        # a camera gives poses, and what a file calls their velocity may be in any frame
        return None, ["recorded velocities are not used: those of objects and joints are derived alike from positions"]
    known = np.column_stack([recording.velocities, np.full(len(recording.velocities), np.nan)])  # of those not recorded
    return known[:, [names.index(j) if j in names else -1 for j in robot.joint_names]], []


def _efforts(recording: Recording, robot: Robot) -> tuple[Float[np.ndarray, "T nv"] | None, list[str]]:
    """Efforts of all joints, or none: what the motion is learnt from does not need them, so nothing is refused."""
    efforts, names = recording.efforts, recording.effort_names
    there = [j for j in robot.joint_names if j in names]
    if efforts is None or not there:
        return None, []
    if len(there) < robot.nv:
        return None, [f"efforts are recorded for {len(there)} of {robot.nv} joints, so they are not used"]
    values = efforts[:, [names.index(j) for j in robot.joint_names]]
    if bad := int(np.count_nonzero(~np.all(np.isfinite(values), axis=1))):
        return None, [f"efforts are not finite in {counted(bad, 'sample')}, so not used"]
    return values, []
