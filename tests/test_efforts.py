"""Efforts of the joints: kept by trajectories, by every cut, by readers and writers."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from case import case

from manip_learn.errors import RecordingError
from manip_learn.recordings import load_demonstrations
from manip_learn.recordings.saved_motion import motion_of_trajectory
from manip_learn.recordings.trajectory import Demonstrations, Trajectory, subsample
from manip_learn.recordings.velocities import derive_velocities
from manip_learn.recordings.writers.write_motion import csv_bytes, joint_trajectory_bytes, mcap_bytes, npz_bytes
from manip_learn.robot import load_robot

T, ROBOT = 80, load_robot("planar3")
TIME = 0.01 * np.arange(T)
Q = np.column_stack([np.sin(TIME), np.cos(TIME), 0.3 * TIME])
EFFORT = np.column_stack([np.exp(TIME), -3.0 * TIME, 1.0 / 3.0 + TIME])
NAMES = ROBOT.joint_names


def trajectory(u: np.ndarray | None = None) -> Trajectory:
    return Trajectory(TIME, Q, u, NAMES, "demo", effort=EFFORT)


def test_efforts_are_checked_as_velocities_are():
    """Wrong shapes and NaN are refused; the array is frozen; a pickle keeps it."""
    with pytest.raises(RecordingError, match="effort must have shape") as caught:
        Trajectory(TIME, Q, None, NAMES, effort=EFFORT[:, :2])
    assert caught.value.code == "shape"
    with pytest.raises(RecordingError, match="effort of sample 3, joint 'joint2' is nan"):
        Trajectory(TIME, Q, None, NAMES, effort=np.where(np.arange(T * 3).reshape(T, 3) == 10, np.nan, EFFORT))
    with pytest.raises(ValueError, match="read-only"):
        trajectory().effort[0] = 1.0
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(trajectory())).effort, EFFORT)
    assert "efforts" in repr(trajectory()) and Trajectory(TIME, Q).effort is None


def test_cuts_keep_them():
    """A span of time, chosen samples, velocities derived: the efforts of the samples that are left; of an even choice
    both ends, and all where they are few.
    """
    t = trajectory(np.gradient(Q, TIME, axis=0))
    np.testing.assert_array_equal(t[0.2:0.4].effort, EFFORT[20:41])
    np.testing.assert_array_equal(t.part(np.array([3, 5])).effort, EFFORT[[3, 5]])
    np.testing.assert_array_equal(t.with_joint_names(("a", "b", "c")).effort, EFFORT)
    few = subsample(t, 9)
    assert (len(few), few.time[0], few.time[-1]) == (9, TIME[0], TIME[-1])
    assert subsample(t, 1000) is t and len(subsample(t, 1)) == 1
    with pytest.raises(RecordingError, match="positive"):
        subsample(t, 0)
    for cut in (few, derive_velocities(trajectory(), ROBOT)):
        places = np.searchsorted(TIME, cut.time - 1e-6)
        np.testing.assert_array_equal(cut.effort, EFFORT[places])


def test_own_formats_keep_them_exactly():
    """Written and read again, bit for bit, beside velocities and without."""
    for ending in [".npz", ".csv", ".mcap", ""]:
        for with_velocities in [True, False]:
            with case(ending, with_velocities) as tmp_path:
                pytest.importorskip({".mcap": "rosbags", "": "pyarrow"}.get(ending, "numpy"))
                u = np.column_stack([np.cos(TIME), -np.sin(TIME), 0.3 + 0.0 * TIME]) if with_velocities else None
                motion, path = motion_of_trajectory(trajectory(u), ROBOT), tmp_path / f"out{ending}"
                if ending == "":
                    from manip_learn.recordings.writers.lerobot_writer import write_lerobot

                    write_lerobot(path, [motion])
                else:
                    content = {".npz": npz_bytes, ".csv": csv_bytes, ".mcap": mcap_bytes}
                    path.write_bytes(content[ending](motion))
                (again,) = load_demonstrations(path, ROBOT)
                assert again.effort is not None and again.effort.tobytes() == EFFORT.tobytes()
                assert (again.u is not None) == with_velocities


def test_a_trajectory_for_a_controller_has_none():
    """What was measured in contact is no command."""
    assert b"effort" not in joint_trajectory_bytes(motion_of_trajectory(trajectory(), ROBOT))


def test_tables_say_it_in_several_ways():
    """By name, in whatever order the columns stand, also of programs that record a command, which was not measured."""
    for pattern in ["{}_effort", "effort_{}", "effort.{}", "tau_{}", "{}_torque", "tau/{}"]:
        with case(pattern) as tmp_path:
            names = [*NAMES, *(pattern.format(j) for j in NAMES[::-1])]
            write_table(tmp_path / "demo.csv", names, np.hstack([Q, EFFORT[:, ::-1]]))
            (t,) = load_demonstrations(tmp_path / "demo.csv", ROBOT)
            np.testing.assert_array_equal(t.effort, EFFORT)
    with case("position, desired effort and effort") as tmp_path:
        names = [f"/joint_states/{j}/{kind}" for kind in ("position", "desired_effort", "effort") for j in NAMES]
        write_table(tmp_path / "demo.csv", names, np.hstack([Q, 0.0 * Q, EFFORT]))
        np.testing.assert_array_equal(load_demonstrations(tmp_path / "demo.csv", ROBOT)[0].effort, EFFORT)


def test_locked_joints_are_dropped_and_half_a_set_is_not_used(tmp_path: Path):
    """The efforts of the joints that move; where one lacks its own, or is not finite, none, and a note says so."""
    write_table(tmp_path / "a.csv", [*NAMES, *(f"{j}_effort" for j in NAMES)], np.hstack([Q, EFFORT]))
    locked = load_robot("planar3", locked={NAMES[1]: 1.0})
    (t,) = load_demonstrations(tmp_path / "a.csv", locked)
    np.testing.assert_array_equal(t.effort, EFFORT[:, [0, 2]])
    write_table(tmp_path / "b.csv", [*NAMES, *(f"{j}_effort" for j in NAMES[:2])], np.hstack([Q, EFFORT[:, :2]]))
    half = load_demonstrations(tmp_path / "b.csv", ROBOT)
    assert half[0].effort is None and any("efforts are recorded for 2 of 3 joints" in n for n in half.notes)
    np.savez(tmp_path / "c.npz", time=TIME, q=Q, effort=np.where(EFFORT > 2.0, np.nan, EFFORT), joint_names=NAMES)
    broken = load_demonstrations(tmp_path / "c.npz", ROBOT)
    assert broken[0].effort is None and any("efforts are not finite" in n for n in broken.notes)


def test_archives_and_frames(tmp_path: Path):
    """An array `effort`; a table of pandas, there and back."""
    np.savez(tmp_path / "demo.npz", time=TIME, q=Q, effort=EFFORT, joint_names=NAMES)
    np.testing.assert_array_equal(load_demonstrations(tmp_path / "demo.npz", ROBOT)[0].effort, EFFORT)
    pytest.importorskip("pandas")
    frame = Demonstrations([trajectory()]).to_frame()
    np.testing.assert_array_equal(load_demonstrations(frame, ROBOT)[0].effort, EFFORT)


def test_a_gap_and_a_repeated_stamp_cut_them_as_well(tmp_path: Path):
    """Samples that are left out, and parts between gaps, keep their own efforts."""
    time = TIME + np.where(np.arange(T) >= 40, 5.0, 0.0)
    time[10], q = time[9], np.where(np.arange(T)[:, None] == 10, Q[9], Q)
    write_table(tmp_path / "demo.csv", [*NAMES, *(f"{j}_effort" for j in NAMES)], np.hstack([q, EFFORT]), time)
    parts = load_demonstrations(tmp_path / "demo.csv", ROBOT)
    assert len(parts) == 2
    for part in parts:
        places = [int(np.flatnonzero((q == row).all(axis=1))[0]) for row in part.q]
        left = [i for i in range(len(places)) if places[i] != 9]  # either of the two may be kept
        np.testing.assert_array_equal(part.effort[left], EFFORT[places][left])


def write_table(path: Path, names: list[str], values: np.ndarray, time: np.ndarray = TIME) -> None:
    rows = [",".join(map(repr, row)) for row in np.column_stack([time, values]).tolist()]
    path.write_text(",".join(["time", *names]) + "\n" + "\n".join(rows) + "\n", encoding="utf-8")
