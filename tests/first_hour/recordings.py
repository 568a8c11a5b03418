"""Motions of the arm along a line that its hand was held on, in the bags that ROS 2 writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import manip_learn as ml

FREE = np.array([0.8, 0.6, 0.0])  # the hand may move along this, and turn as it likes
EPOCH = 1_760_000_000.25  # recordings carry the time of day [s]
MIDDLE = np.array([0.3, 0.5, 1.2, 0.2, 0.8, 0.0])


def motions(robot: ml.Robot, count: int = 6) -> list[ml.Trajectory]:
    """Motions of 4 s at 100 Hz in which the tool's position keeps to a line, with 1e-4 rad of encoder noise."""
    rng = np.random.default_rng(4)
    held = ml.Constraint(np.linalg.svd(FREE[None])[2][1:], ml.FrameJacobian(robot, "tool0", "xyz"))
    found = []
    for number in range(1, count + 1):
        start = MIDDLE + rng.uniform(-0.4, 0.4, 6)
        rest = ml.JointAttractor(start + rng.uniform(-0.7, 0.7, 6), gain=0.8)
        rollout = ml.simulate(robot, ml.ResolvedRateController(held, null_policy=rest), start, duration=4.0, dt=0.01)
        q = rollout.q + 1e-4 * rng.standard_normal(rollout.q.shape)
        found.append(ml.Trajectory(rollout.time, q, None, robot.joint_names, f"motion {number}"))
    return found


def write_bag(path: Path, demo: ml.Trajectory) -> None:
    """ROS 2 bag (MCAP) of /joint_states, joints in another order than the robot's."""
    types = get_typestore(Stores.ROS2_JAZZY)
    kind = "sensor_msgs/msg/JointState"
    header, stamp = types.types["std_msgs/msg/Header"], types.types["builtin_interfaces/msg/Time"]
    names, none = list(demo.joint_names)[::-1], np.zeros(0)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/joint_states", kind, typestore=types)
        for t, q in zip(demo.time, demo.q, strict=True):
            nanoseconds = int((EPOCH + t) * 1e9)
            at = header(stamp=stamp(*divmod(nanoseconds, 10**9)), frame_id="base_link")
            message = types.types[kind](at, names, q[::-1].copy(), none, none)
            writer.write(connection, nanoseconds, types.serialize_cdr(message, kind))
