"""An hour of joint states at 100 Hz from any bag, and a table of a million rows, over plain ways to read the same file.

Promises: a bag takes at most one and a half times a loop that deserialises its messages with rosbags (measured: 1.06 to
1.36 for MCAP, ROS 1 and SQLite), a table at most three times NumPy's own `loadtxt`; both of these check nothing.
"""

from __future__ import annotations

import struct
import time
from pathlib import Path

import numpy as np
import pytest
from timing import keep

from manip_learn.recordings import load_demonstrations
from manip_learn.robot import load_robot

SAMPLES = 360_000
NAMES = {"table": "table.csv", "ros1": "hour.bag", "sqlite": "sqlite", "mcap": "mcap"}  # ROS 2: a folder
PROMISED = {"ros1": 1.5, "sqlite": 1.5, "mcap": 1.5, "table": 3.0}  # times the plain way
START = 1_700_000_000 * 10**9
JOINTS = ("joint1", "joint2", "joint3")
JOINT_STATE = "sensor_msgs/msg/JointState"


def motion(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities of a slow swing."""
    t = 0.01 * np.arange(n)[:, None]
    return np.sin(0.3 * t + np.arange(3)), 0.3 * np.cos(0.3 * t + np.arange(3))


def write_bag(path: Path, kind: str, samples: int) -> Path:
    """One publisher at 100 Hz; one message is serialised by the library, the others differ in stamp and numbers."""
    pytest.importorskip("rosbags", reason="the extra 'ros' is not installed")
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    ros1 = kind == "ros1"
    types = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
    stamp = types.types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    extra = {"seq": 0} if ros1 else {}
    header = types.types["std_msgs/msg/Header"](stamp=stamp, frame_id="base", **extra)
    marks = np.array([-1.25e300, -1.5e300, -1.75e300])
    message = types.types[JOINT_STATE](header, list(JOINTS), marks, -marks, np.zeros(3))
    raw = bytearray(types.serialize_ros1(message, JOINT_STATE) if ros1 else types.serialize_cdr(message, JOINT_STATE))
    q_at, u_at = raw.index(marks.tobytes()), raw.index((-marks).tobytes())
    q, u = motion(samples)
    plugin = StoragePlugin.SQLITE3 if kind == "sqlite" else StoragePlugin.MCAP
    with Writer1(path) if ros1 else Writer2(path, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/joint_states", JOINT_STATE, typestore=types)
        for i in range(samples):
            at = START + i * 10_000_000
            struct.pack_into("<II", raw, 4, at // 10**9, at % 10**9)
            raw[q_at : q_at + 24], raw[u_at : u_at + 24] = q[i].tobytes(), u[i].tobytes()
            writer.write(connection, at, bytes(raw))
    return path


def write_table(path: Path, kind: str, samples: int) -> Path:
    """Rows of text."""
    table = np.column_stack([0.01 * np.arange(samples), motion(samples)[0]])
    np.savetxt(path, table, fmt="%.7g", delimiter=",", header=",".join(("time", *JOINTS)), comments="")
    return path


def plain_bag(path: Path) -> int:
    """Every message deserialised, as the rosbags documentation shows it."""
    from rosbags.highlevel import AnyReader

    count = 0
    with AnyReader([path]) as reader:
        for connection, _, raw in reader.messages():
            count += len(reader.deserialize(raw, connection.msgtype).position) == len(JOINTS)
    return count


def plain_table(path: Path) -> int:
    """NumPy's own reader."""
    return len(np.loadtxt(path, delimiter=",", skiprows=1))


@pytest.mark.bench
@pytest.mark.timeout(900)
@pytest.mark.parametrize("kind", ["ros1", "sqlite", "mcap", "table"])
def test_recordings_over_plain_means(kind: str, tmp_path: Path) -> None:
    """360,000 messages, or a million rows, are read, checked and right, over the plain way."""
    robot = load_robot("planar3")
    writer, samples = (write_table, 1_000_000) if kind == "table" else (write_bag, SAMPLES)
    path = writer(tmp_path / NAMES[kind], kind, samples)
    seconds = {"plain": [], "ours": []}
    for _ in range(3):
        begin = time.process_time()
        assert (plain_table if kind == "table" else plain_bag)(path) >= SAMPLES
        seconds["plain"].append(time.process_time() - begin)
        begin = time.process_time()
        demos = load_demonstrations(path, robot)
        seconds["ours"].append(time.process_time() - begin)
    np.testing.assert_allclose(demos[0].q, motion(demos.n_samples)[0], rtol=0, atol=1e-6)
    ratio = min(seconds["ours"]) / min(seconds["plain"])
    print(f"{kind}: {demos.n_samples:,} samples in {ratio:.2f} of the plain way's time")
    assert ratio <= PROMISED[kind]
    keep("recordings", {kind: ratio})
