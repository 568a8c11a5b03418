"""The words of the formats that are read and written: what names of columns, topics and arrays mean."""

from __future__ import annotations

import json
import re

MARK = "# manip_learn "  # how a text file of this library begins; its header follows
DATASET_HEADER = "meta/manip_learn.json"  # of a LeRobot data set that this library wrote, beside its own metadata
VELOCITY_SUFFIX, EFFORT_SUFFIX = "_velocity", "_effort"  # of columns, after the name of a joint
# of names that are about a joint, after its name
ENDS = (VELOCITY_SUFFIX, EFFORT_SUFFIX, "_torque", "_acceleration", ".pos", ".vel", ".torque", ".effort")
JOINT_STATE = "sensor_msgs/msg/JointState"


def yaml_text(content: object, indent: int | None = None) -> str:
    """JSON that YAML 1.1 reads as the same numbers and words: there 1e-05 alone would be a word.

    Raises:
        ValueError: A number that is not finite.
    """
    text = json.dumps(content, indent=indent, allow_nan=False)
    # words are passed over whole: a link may be called "arm_2end"
    return re.sub(r'"(?:[^"\\]|\\.)*"|(?<![\d.])(\d+)(?=e)', lambda m: f"{m[1]}.0" if m[1] else m[0], text)
