"""The words of the formats that are read and written: what names of columns, topics and arrays mean."""

from __future__ import annotations

MARK = "# manip_learn "  # how a text file of this library begins; its header follows
DATASET_HEADER = "meta/manip_learn.json"  # of a LeRobot data set that this library wrote, beside its own metadata
VELOCITY_SUFFIX, EFFORT_SUFFIX = "_velocity", "_effort"  # of columns, after the name of a joint
# of names that are about a joint, after its name
ENDS = (VELOCITY_SUFFIX, EFFORT_SUFFIX, "_torque", "_acceleration", ".pos", ".vel", ".torque", ".effort")
JOINT_STATE = "sensor_msgs/msg/JointState"
