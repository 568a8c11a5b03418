"""A motion as a `trajectory_msgs/msg/JointTrajectory`, in text that `ros2 topic pub` and ros2_control users send.

The text is JSON behind comment lines, which is YAML too: every number has a decimal point, as YAML 1.1 demands. Times
are whole nanoseconds from the first sample. Efforts are left out: what was measured is no command, and controllers of
ros2_control refuse points that have them.
"""

from __future__ import annotations

import json

from manip_learn.errors import OutputError
from manip_learn.recordings.saved_motion import SavedMotion
from manip_learn.recordings.writers.csv_writer import MARK
from manip_learn.recordings.writers.joint_state_messages import nanoseconds

TYPE = "trajectory_msgs/msg/JointTrajectory"


def joint_trajectory_bytes(motion: SavedMotion) -> bytes:
    """The text, UTF-8.

    Raises:
        OutputError: Numbers that are not finite, or times that whole nanoseconds cannot tell apart.
    """
    names = motion.header.joint_names
    if motion.q.shape[1] != len(names):
        raise OutputError("a JointTrajectory needs one position per joint, the motion has configurations")
    times = nanoseconds(motion.time, from_first=True).tolist()
    lines = [
        MARK + motion.header.to_json(),
        f'# ros2 topic pub --once <controller>/joint_trajectory {TYPE} "$(cat FILE)"',
        '{"header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},',
        f' "joint_names": {json.dumps(list(names))},',
        ' "points": [',
    ]
    velocities = None if motion.u is None else motion.u.tolist()
    for i, (time, q) in enumerate(zip(times, motion.q.tolist(), strict=True)):
        sec, nanosec = divmod(time, 1_000_000_000)
        moving = "" if velocities is None else f', "velocities": {_numbers(velocities[i])}'
        start = f'{{"sec": {sec}, "nanosec": {nanosec}}}'
        end = "," if i + 1 < len(times) else ""
        lines.append(f'  {{"positions": {_numbers(q)}{moving}, "time_from_start": {start}}}{end}')
    return "\n".join([*lines, " ]}", ""]).encode()


def _numbers(values: list[float]) -> str:
    return f"[{', '.join(map(_number, values))}]"


def _number(value: float) -> str:
    """Shortest text that is read as the same float64; 1e-05 alone would be a word in YAML 1.1."""
    text = repr(value)
    if "n" in text:  # nan, inf
        raise OutputError(f"a JointTrajectory cannot hold the number {text}")
    digits, mark, exponent = text.partition("e")
    return text if "." in digits else f"{digits}.0{mark}{exponent}"
