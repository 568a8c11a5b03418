"""Motions of the arm along a line that its hand was held on, in the files that other programs write."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

import manip_learn as ml

FREE = np.array([0.8, 0.6, 0.0])  # the hand may move along this, and turn as it likes
EPOCH = 1_760_000_000.25  # recordings carry the time of day [s]


def motions(robot: ml.Robot, count: int = 6) -> list[ml.Trajectory]:
    """Motions of 4 s at 100 Hz in which the tool's position keeps to a line, with 1e-4 rad of encoder noise."""
    rng = np.random.default_rng(4)
    features = ml.FrameJacobian(robot, "tool0", "xyz")
    held = ml.Constraint(np.linalg.svd(FREE[None])[2][1:], features)
    found = []
    for number in range(1, count + 1):
        start = np.array([0.3, 0.5, 1.2, 0.2, 0.8, 0.0]) + rng.uniform(-0.4, 0.4, 6)
        rest = ml.JointAttractor(start + rng.uniform(-0.7, 0.7, 6), gain=0.8)
        rollout = ml.simulate(robot, ml.ResolvedRateController(held, null_policy=rest), start, duration=4.0, dt=0.01)
        q = rollout.q + 1e-4 * rng.standard_normal(rollout.q.shape)
        found.append(ml.Trajectory(rollout.time, q, None, robot.joint_names, f"motion {number}"))
    return found


def write_plotjuggler(folder: Path, demos: list[ml.Trajectory]) -> Path:
    """CSV exports of PlotJuggler: time of day, one column per field of the topic, velocities and efforts too."""
    folder.mkdir()
    for i, demo in enumerate(demos):
        u = np.gradient(demo.q, demo.time, axis=0)
        blocks = {"position": demo.q, "velocity": u, "effort": 0.1 * demo.q}
        header = ["__time", *(f"/joint_states/{n}/{field}" for field in blocks for n in demo.joint_names)]
        _write(folder / f"export_{i}.csv", header, np.column_stack([EPOCH + demo.time, *blocks.values()]))
    return folder


def write_numbered(folder: Path, demos: list[ml.Trajectory]) -> Path:
    """Logs of a controller of one's own: t, q[0] ..., dq[0] ..."""
    folder.mkdir()
    for i, demo in enumerate(demos):
        n = demo.q.shape[1]
        header = ["t", *(f"q[{j}]" for j in range(n)), *(f"dq[{j}]" for j in range(n))]
        _write(
            folder / f"log_{i}.csv",
            header,
            np.column_stack([demo.time, demo.q, np.gradient(demo.q, demo.time, axis=0)]),
        )
    return folder


def write_bags(folder: Path, demos: list[ml.Trajectory]) -> Path:
    """ROS 2 bags (MCAP) of /joint_states, joints in another order than the robot's."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_JAZZY)
    kind = "sensor_msgs/msg/JointState"
    header, stamp = types.types["std_msgs/msg/Header"], types.types["builtin_interfaces/msg/Time"]
    folder.mkdir()
    for i, demo in enumerate(demos):
        with Writer(folder / f"bag_{i}", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connection = writer.add_connection("/joint_states", kind, typestore=types)
            for t, q in zip(demo.time, demo.q, strict=True):
                nanoseconds = int((EPOCH + t) * 1e9)
                at = stamp(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
                names, values, none = list(demo.joint_names)[::-1], q[::-1].copy(), np.zeros(0)
                message = types.types[kind](header(stamp=at, frame_id="base_link"), names, values, none, none)
                writer.write(connection, nanoseconds, types.serialize_cdr(message, kind))
    return folder


def _write(path: Path, header: list[str], rows: object) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)  # type: ignore[arg-type]
