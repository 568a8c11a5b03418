"""Holes in recordings: times in which no new posture came, while the arm may have moved on."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from manip_learn.errors import RecordingError, counted
from manip_learn.recordings.clock import FEW_GAPS, FEWEST_STAMPS, pieces, usual_step
from manip_learn.recordings.trajectory import Trajectory
from manip_learn.robot.robot import Robot

# usual steps without a new posture that are a hole; above ten the recording is split there
SEVERAL = 4.0
MOVED = 0.02  # [rad or m]: more than encoders, belts and a held pose leave of a joint at rest
_BESIDE, FARTHER = 3, 3.0  # steps on either side, and times of the largest of them that an arm moves in a hole
_SHOWN = 5  # holes in a sentence


def stalled(time: Float[np.ndarray, " T"], q: Float[np.ndarray, "T n"]) -> Int[np.ndarray, " k"]:
    """Samples that repeat the posture before them to the last bit while the arm moved on, as its next step shows.

    An arm that rests begins with small steps; a driver that did not answer goes on where the arm has got to meanwhile.
    """
    new = np.append(True, np.any(q[1:] != q[:-1], axis=1))
    at = np.flatnonzero(new)
    if len(at) == len(time) or len(at) < FEWEST_STAMPS:
        return np.empty(0, dtype=int)
    steps, size = np.diff(time[at]), np.abs(np.diff(q[at], axis=0)).max(axis=1)
    long = np.flatnonzero((steps > SEVERAL * usual_step(steps)) & (size > MOVED))
    around = [np.delete(size[max(0, k - _BESIDE) : k + _BESIDE + 1], min(k, _BESIDE)).max() for k in long]
    long = long[size[long] > FARTHER * np.array(around)]
    if len(long) > max(FEW_GAPS, len(time) / 200.0):  # this is how the samples come
        return np.empty(0, dtype=int)
    return np.concatenate(
        [np.empty(0, dtype=int), *(np.arange(a + 1, b) for a, b in zip(at[long], at[long + 1], strict=True))]
    )


def split_at_holes(whole: Trajectory, robot: Robot | None) -> tuple[list[Trajectory], list[str]]:
    """The stretches between holes, none of which is a lone sample; and notes.

    Args:
        whole: A recording without samples that are `stalled`.
        robot: Whose joints they are, if that is known.

    Raises:
        RecordingError: All samples are alone.
    """
    if len(whole) < 2:
        return [whole], []
    time = whole.time
    parts, gaps = pieces(time)
    long_parts = [p for p in parts if p.stop - p.start >= 2]
    if not long_parts:
        raise RecordingError(
            f"{whole.name}: the samples are so far apart that no two belong together", code="too-short"
        )
    steps, far = np.diff(time), np.abs(np.diff(whole.q, axis=0))
    short = np.flatnonzero((steps > SEVERAL * usual_step(steps)) & (far.max(axis=1, initial=0.0) > MOVED))
    short = np.setdiff1d(short, gaps)
    if len(short) > max(FEW_GAPS, len(time) / 200.0):  # this is how the samples come
        short = short[:0]

    def in_words(holes: Int[np.ndarray, " k"]) -> str:
        words = []
        for g in holes[:_SHOWN].tolist():
            j = int(far[g].argmax())
            did = "the arm stood"
            if far[g, j] > MOVED:
                did = "the arm moved"
                if robot is not None and robot.nv == far.shape[1]:
                    did = f"{robot.joint_names[j]} moved by {far[g, j]:.2g} {robot.joint_units[j]}"
            words.append(f"for {steps[g]:.3g} s from {time[g] - time[0]:.3g} s on, while {did}")
        more = f", and {counted(len(holes) - _SHOWN, 'hole')} more" if len(holes) > _SHOWN else ""
        return f"no new posture came {'; '.join(words)}{more}"

    notes = []
    if len(gaps):
        notes.append(f"split where {in_words(gaps)}: what was done meanwhile is not learnt from")
    if len(short):
        notes.append(f"{in_words(short)}: the motion meanwhile is taken for smooth")
    if len(long_parts) < len(parts):
        notes.append(f"left out between gaps: {counted(len(parts) - len(long_parts), 'lone sample')}")
    if not len(gaps):
        return [whole], notes
    n = len(long_parts)
    return [whole.part(p, f"{whole.name} part {k} of {n}") for k, p in enumerate(long_parts, 1)], notes
