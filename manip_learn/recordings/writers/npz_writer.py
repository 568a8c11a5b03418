"""A motion as a NumPy archive: every array bit for bit, and the header as one text."""

from __future__ import annotations

import io

import numpy as np

from manip_learn.recordings.saved_motion import PREFIX, SavedMotion


def npz_bytes(motion: SavedMotion) -> bytes:
    """The archive."""
    header = motion.header
    arrays: dict[str, np.ndarray | None] = {
        "format": np.array(PREFIX + header.kind),
        "header": np.array(header.to_json()),
        "time": motion.time,
        "q": motion.q,
        "u": motion.u,
        "effort": motion.effort,
        "joint_names": np.array(header.joint_names, dtype=str),
        "manipulability": motion.manipulability,
        "task_error": motion.task_error,
        "following_error": motion.following_error,
        "status": np.array(motion.status, dtype=str) if header.kind == "rollout" else None,
    }
    stream = io.BytesIO()
    np.savez_compressed(stream, **{name: array for name, array in arrays.items() if array is not None})  # type: ignore[arg-type]
    return stream.getvalue()
