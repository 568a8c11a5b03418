"""Columns with the pose of an object: quaternions become rotation vectors, and these have no jumps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from manip_learn.errors import counted
from manip_learn.recordings.pose_velocities import continuous_rotation_vectors
from manip_learn.recordings.readers.recording import Recording
from manip_learn.robot import Robot

QUATERNION, ROTATION_VECTOR = (".qx", ".qy", ".qz", ".qw"), (".rx", ".ry", ".rz")
UNIT = 0.05  # by which the length of a recorded quaternion may differ from 1


def object_coordinates(robot: Robot) -> Bool[np.ndarray, " nv"]:
    """True for the six coordinates of each object, False for those of the robot itself."""
    out = np.zeros(robot.nv, dtype=bool)
    for block in robot.blocks:
        out[block.v] = block.name in robot.objects
    return out


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
        raise recording.refusal(
            "quaternion",
            f"the quaternion of object {name!r} has length {length[bad[0]]:.4g}, 1 is needed (order qx qy qz qw); "
            f"so in {counted(bad.size, 'sample')}",
            sample=int(bad[0]),
            column=columns[0],
        )
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
