"""Kinds of files that people have: each is read exactly, or refused in words that say what to type."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml
from recording_corpus import text
from recording_formats import rows_of

import manip_learn as ml

ROBOT = ml.load_robot("sawyer")
N = list(ROBOT.joint_names)
T = np.arange(150) * 0.02  # [s]
Q = 0.3 * np.sin(T[:, None] * np.linspace(0.5, 1.5, 7)) + np.linspace(-0.2, 0.2, 7)
OTHER = Q + 0.1  # of a command
STAMPS = 1.7e9 + 0.37 + T  # [s]
SEC, PART = np.floor(STAMPS), STAMPS % 1
NS = np.round(PART * 1e9)
GIVEN = {"joint_names": N}
NAMED = [[name] * len(T) for name in N]  # columns that hold the names of the joints

Write = Callable[[Path], Any]  # writes a file
# how it is written, words of the refusal ("" if it is read), options that the refusal advises, options
Kind = tuple[Write, str, dict[str, Any] | None, dict[str, Any]]


def kind(write: Write, refusal: str = "", advised: dict[str, Any] | None = None, **options: Any) -> Kind:
    """Return a row of the table."""
    return write, refusal, advised, options


def table(header: list[str], *columns: Any, before: str = "", mark: str = ",") -> Write:
    """Return how to write a table; columns of shape (T, n) are n of them."""
    return text(before + (mark.join(header) + "\n" if header else "") + rows_of(*columns, mark=mark))


def hdf5(**arrays: Any) -> Write:
    """Return how to write arrays, `__` between groups."""

    def write(path: Path) -> None:
        with h5py.File(path, "w") as file:
            for name, array in arrays.items():
                file[name.replace("__", "/")] = array

    return write


def npz(**arrays: Any) -> Write:
    """Return how to write an archive."""

    def write(path: Path) -> None:
        with path.open("wb") as file:
            np.savez(file, **arrays)

    return write


def state(k: int, named: bool = True, words: tuple[str, str] = ("sec", "nanosec")) -> dict[str, Any]:
    """Return a JointState."""
    stamp = dict(zip(words, (int(SEC[k]), int(NS[k])), strict=True))
    lists = {"name": N if named else [], "position": Q[k].tolist(), "velocity": [], "effort": []}
    return {"header": {"stamp": stamp, "frame_id": ""}} | lists


def echo(flow: bool | None = None, **options: Any) -> Write:
    """Return how `topic echo` writes."""
    return text("---\n".join(yaml.safe_dump(state(k, **options), default_flow_style=flow) for k in range(len(T))))


def each(prefix: str, n: int = 7) -> list[str]:
    """Return numbered names."""
    return [f"{prefix}{k}" for k in range(n)]


COLUMNS = {"timestamp": T.tolist(), "tcp_x": T.tolist()} | dict(zip(N, Q.T.tolist(), strict=True))
DURATIONS = ({"secs": int(t), "nsecs": round((t % 1) * 1e9)} for t in T.tolist())
POINTS = [{"positions": q, "velocities": [], "time_from_start": t} for t, q in zip(DURATIONS, Q.tolist(), strict=True)]
WIDE = 0.8 * np.sin(T[:, None] * np.linspace(1.0, 2.5, 7) + np.arange(7))
SECONDS = "sec,nanosec secs,nsecs seconds,nseconds tv_sec,tv_nsec header/stamp/sec,header/stamp/nanosec"
COMMANDS = "action control target master leader command desired next_obs goal".split()
POSES = {"transform_positions": 3, "tcp_pos": 3, "ee_pose": 7, "gripper_position": 1, "object_pos": 7}
COPIED = {f"{group}__robot_state__joint_positions": Q for group in ("observation", "action")}
COPIED |= {"action__joint_position": OTHER}
EULER = ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]
RTDE = ["timestamp", *each("actual_q_"), *each("target_q_"), *each("actual_TCP_pose_", 6)]
CHANGING = ["time", *each("name"), *each("position")]
ECHO_P = ["%time", "field.header.seq", *each("field.name"), *each("field.position")]
MOTORS = [[{"position": np.degrees(p), "velocity": 0.0} for p in q] for q in Q.tolist()]
ACTUATORS = [{"time": t, "actuators": motors} for t, motors in zip(T.tolist(), MOTORS, strict=True)]

KINDS: dict[str, Kind] = {
    **{f"stamps {s}": kind(table([*s.split(","), *N], SEC, NS, Q)) for s in SECONDS.split()},
    "seconds and microseconds": kind(table(["tv_sec", "tv_usec", *N], SEC, np.round(PART * 1e6), Q)),
    "times that contradict each other": kind(
        table(["time", "stamp", *N], T, 2 * T, Q),
        "span 2.98 and 5.96: leave the wrong one out, ignore_columns=['stamp']",
        {"ignore_columns": ["stamp"]},
    ),
    "stamps (T, 2) in HDF5": kind(hdf5(joint_positions=Q, timestamps=np.column_stack([SEC, NS])), **GIVEN),
    "two arrays of times": kind(npz(t=T, stamp=2 * T, q=Q), "could be the time; choose one with rename={'t'", **GIVEN),
    "a line of units": kind(table(["time", *N], ["s", *T], *(["rad", *q] for q in Q.T))),
    "units in names": kind(table(["time [s]", *(n + " [rad]" for n in N)], T, Q)),
    "a preamble of text": kind(table(["time", *N], T, Q, before="Log v1\nDate: today\n\n")),
    **{
        f"HDF5 with a group {group}": kind(
            hdf5(**{"obs__arm__joint_positions": Q, f"{group}__joint_position": OTHER, "obs__time": T}), **GIVEN
        )
        for group in COMMANDS
    },
    **{
        f"HDF5 with {name} of width {n}": kind(hdf5(s__joint_pos=Q, s__t=T, **{f"p__{name}": Q[:, :n]}), **GIVEN)
        for name, n in POSES.items()
    },
    "HDF5, two arms": kind(hdf5(left__joint_pos=Q, right__joint_pos=OTHER, time=T), "several arms", **GIVEN),
    "HDF5, two states": kind(
        hdf5(obs__arm__joint_pos=Q, obs__robot__joint_pos=OTHER, time=T),
        "of one recording; choose one with rename={'obs/arm/joint_pos': 'q'}",
        {"rename": {"obs/arm/joint_pos": "q"}},
        **GIVEN,
    ),
    "HDF5, names in the file": kind(hdf5(q=Q, t=T, joint_names=np.array(N, dtype="S"))),
    "HDF5, states copied among commands": kind(hdf5(**COPIED), **GIVEN, rate=50),
    "an archive of three dimensions": kind(npz(t=T, q=Q[None]), **GIVEN),
    "ros2 topic echo": kind(echo(False)),
    "ros2 topic echo --flow-style": kind(echo()),
    "topic echo without names": kind(echo(named=False), "joint_names=", GIVEN),
    "ros2 topic echo --csv": kind(table([], SEC.astype(int), NS.astype(int), ["base"] * 150, *NAMED, Q)),
    "... without names": kind(table([], SEC.astype(int), NS.astype(int), ["base"] * 150, Q), "joint_names=", GIVEN),
    "rostopic echo -p": kind(table(ECHO_P, np.round(STAMPS * 1e9), np.arange(150), *NAMED, Q)),
    "changing joints": kind(table(CHANGING, T, *np.array([N, N[::-1]] * 75).T.tolist(), Q), "change from row"),
    "PlotJuggler": kind(table(["__time", "/js/header/stamp", *(f"/js/{n}/position" for n in N)], STAMPS, STAMPS, Q)),
    "... in a message": kind(text("\n".join(json.dumps({"js": state(k)}) for k in range(150)))),
    "JSON, columns beside a pose": kind(text(json.dumps(COLUMNS))),
    "JSON, an object for each joint": kind(text(json.dumps(ACTUATORS)), **GIVEN, degrees=True),
    "YAML of a JointTrajectory": kind(text(yaml.safe_dump({"joint_trajectory": {"joint_names": N, "points": POINTS}}))),
    "a pose of angles": kind(table(["time", *EULER], T, Q), "coordinates of a pose"),
    "UR's RTDE": kind(
        table(RTDE, T, Q, OTHER, Q[:, :6], mark=" "), "columns='actual_q_{index}'", {"columns": "actual_q_{index}"}
    ),
}


@pytest.mark.parametrize("name", KINDS)
def test_kind(name: str, tmp_path: Path) -> None:
    """Positions and times to the last digits that were written, also as advised after a refusal; or one sentence that
    never names joints falsely.
    """
    write, refusal, advised, options = KINDS[name]
    write(path := tmp_path / "recording")
    if refusal:
        with pytest.raises(ml.ManipLearnError) as caught:
            ml.load_demonstrations(path, ROBOT, **options)
        assert refusal in str(caught.value) and "=right_j" not in str(caught.value)
        if advised is None:
            return
    (demo,) = ml.load_demonstrations(path, ROBOT, **options, **(advised or {}))
    np.testing.assert_allclose(demo.q, Q, rtol=0, atol=1e-6)
    np.testing.assert_allclose(demo.time - demo.time[0], T, rtol=0, atol=2e-6)


def test_a_recorded_tool_tells_an_order_of_joints(tmp_path: Path) -> None:
    """Where the tool was recorded, in any axes and units, a false order of the joints is said with the right one."""
    order = [1, 0, 2, 3, 4, 5, 6]
    path, right = tmp_path / "a.h5", [N[k] for k in order]
    at = np.array([ROBOT.pose(q, "right_hand") @ [0.0, 0.02, 0.1, 1.0] for q in WIDE])[:, :3]
    hdf5(time=T, joint_positions=WIDE[:, order], tcp_pose=np.hstack([1e3 * at[:, [1, 2, 0]], at]))(path)
    said = " ".join(ml.load_demonstrations(path, ROBOT, joint_names=N).notes)
    assert f"joint_names={right}" in said and " mm rms " in said
    demos = ml.load_demonstrations(path, ROBOT, joint_names=right)
    assert "mm rms" not in " ".join(demos.notes)
    np.testing.assert_allclose(demos[0].q, WIDE, atol=1e-12)


def test_a_robot_whose_joints_are_all_locked_is_refused(tmp_path: Path) -> None:
    """No joint moves: said before anything is learnt."""
    table(["time", *N], T, Q)(tmp_path / "a.csv")
    with pytest.raises(ml.ManipLearnError, match="no joint of robot 'sawyer' moves"):
        ml.load_demonstrations(tmp_path / "a.csv", ml.load_robot("sawyer", locked=N))
