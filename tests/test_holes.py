"""Holes in recordings: how long nothing came is said, and what was done meanwhile is not taken for a motion."""

from __future__ import annotations

import re

import numpy as np
import pytest

import manip_learn as ml
from manip_learn.recordings.given import recordings_given

TIME = np.arange(0.0, 8.0, 0.01)


def motion(time: np.ndarray = TIME) -> np.ndarray:
    """Rest for a second, and a motion of six seconds of all joints."""
    s = np.clip((time - 1.0) / 6.0, 0.0, 1.0)
    return np.outer(s - np.sin(2.0 * np.pi * s) / (2.0 * np.pi), [-1.2, 0.9, 0.7]) + 0.3


def recording(kind: str, seconds: float) -> ml.Trajectory:
    """A driver that gave nothing from 3 s on, or went on giving the same."""
    lost = (TIME > 3.0) & (TIME < 3.0 + seconds - 0.005)
    q = motion()
    if kind == "gap":
        return ml.Trajectory(TIME[~lost], q[~lost], joint_names=("q1", "q2", "q3"), name="shown")
    q[lost] = q[np.flatnonzero(lost)[0] - 1]
    return ml.Trajectory(TIME, q, joint_names=("q1", "q2", "q3"), name="shown")


def notes_of(given: ml.Trajectory, planar3: ml.Robot) -> tuple[list[str], list[ml.Trajectory]]:
    """What is said of a recording, and its parts."""
    read = recordings_given(given.with_joint_names(planar3.joint_names), planar3, planar3.nv)
    assert isinstance(read, ml.Demonstrations)
    return list(read.notes), list(read)


@pytest.mark.parametrize("kind", ["gap", "stall"])
@pytest.mark.parametrize("seconds", [0.08, 0.5, 3.0])
def test_a_hole_is_said_as_long_as_it_was(kind: str, seconds: float, planar3: ml.Robot) -> None:
    """One sentence names recording, time, length and effect, and no speed is learnt that the arm never had."""
    notes, read = notes_of(recording(kind, seconds), planar3)
    (note,) = [n for n in notes if "no new posture" in n]
    said = re.search(r"for ([\d.]+) s from ([\d.]+) s on, while (\S+) moved by ([\d.]+) rad", note)
    assert note.startswith("shown") and said is not None, note
    assert float(said[1]) == pytest.approx(seconds, rel=0.2) and float(said[2]) == pytest.approx(3.0, abs=0.05)
    far = abs(motion(np.array([3.0 + seconds]))[0, 0] - motion(np.array([3.0]))[0, 0])
    assert said[3] == planar3.joint_names[0] and float(said[4]) == pytest.approx(far, rel=0.2)
    assert len(read) == (2 if seconds > 0.1 else 1)
    fastest = max(float(np.abs(np.diff(t.q, axis=0) / np.diff(t.time)[:, None]).max()) for t in read)
    assert fastest < 1.1 * np.abs(np.diff(motion(), axis=0)).max() / 0.01


def test_what_is_no_hole_is_not_named(planar3: ml.Robot) -> None:
    """A rest, samples that come twice from a slower encoder, and uneven samples are how arms are recorded."""
    rest = motion(np.where(TIME > 4.0, np.maximum(TIME - 2.0, 4.0), TIME))
    rng = np.random.default_rng(1)
    uneven = np.cumsum(0.01 * rng.choice([1.0, 6.0], p=[0.8, 0.2], size=400))
    slower, seldom = motion(TIME // 0.05 * 0.05), slice(None, None, 10)
    rounded = np.round(rest, 3)
    for time, q in ((TIME, rounded), (TIME[seldom], rest[seldom]), (TIME, slower), (uneven, motion(uneven))):
        notes, read = notes_of(ml.Trajectory(time, q, joint_names=("q1", "q2", "q3")), planar3)
        assert not any("no new posture" in n for n in notes), notes
        assert len(read) == 1 and len(read[0]) == len(time)


def test_many_holes_are_counted(planar3: ml.Robot) -> None:
    """Five are told, the others counted."""
    kept = np.ones(len(TIME), dtype=bool)
    for begin in np.arange(1.0, 7.0, 0.8):
        kept &= (TIME <= begin) | (TIME >= begin + 0.495)
    (note,) = notes_of(ml.Trajectory(TIME[kept], motion()[kept], joint_names=("q1", "q2", "q3")), planar3)[0]
    assert note.count(" s from ") == 5 and ", and 3 holes more:" in note, note
