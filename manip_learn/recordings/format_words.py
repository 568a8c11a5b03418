"""The words of the formats that are read and written: what names of columns, topics and arrays mean."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

MARK = "# manip_learn "  # how a text file of this library begins; its header follows
DATASET_HEADER = "meta/manip_learn.json"  # of a LeRobot data set that this library wrote, beside its own metadata
VELOCITY_SUFFIX, EFFORT_SUFFIX = "_velocity", "_effort"  # of columns, after the name of a joint
JOINT_STATE = "sensor_msgs/msg/JointState"
RATE = ("rate=<samples per second>", "--rate <samples per second>")  # how the option is written
# `d` as in libfranka's q_d and tau_J_d
COMMAND = {
    *("desired", "command", "commanded", "cmd", "target", "goal"),
    *("setpoint", "reference", "ref", "des", "action", "d"),
}
EFFORT = {"effort", "efforts", "torque", "torques", "tau", "moment"}


def effort_joint(name: str, joints: Sequence[str]) -> str | None:
    """`joint1` for `joint1_effort`, `effort_joint1`, `tau.joint1`, where that is a joint; None for all other names."""
    for word, mark in itertools.product(EFFORT, "._/"):
        for joint in (name.removesuffix(mark + word), name.removeprefix(word + mark)):
            if name not in joints and joint in joints:
                return joint
    return None
