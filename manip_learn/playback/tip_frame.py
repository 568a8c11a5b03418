"""Which frame is the tip of an arm."""

from __future__ import annotations

import re

import pinocchio as pin

from manip_learn.robot.robot import Robot

TIP_NAMES = re.compile(r"(^|_)(tcp|tool\d*|tip|ee|eef|end_?effector|hand|gripper|flange)($|_|\d)", re.IGNORECASE)


def tip_frame(robot: Robot, name: str | None = None) -> str:
    """The frame of that name, or the last link of the arm: the one with the most joints above it, and among those that
    come close the one that is called like a tip.

    Raises:
        UnknownNameError: No such frame.
    """
    if name is not None:
        return robot.frame(name).name
    model = robot.pinocchio_model
    frames = [robot.frame(n) for n in robot.frame_names]
    links = [f for f in frames if model.frames[f.index].type == pin.FrameType.BODY] or frames
    if not links:
        return ""
    above = {f.name: len(model.supports[f.parent_joint]) for f in links}
    most = max(above.values())
    # the fingers of a hand have one joint more than the hand itself
    near = [f for f in links if above[f.name] >= max(most - 1, 2) and TIP_NAMES.search(f.name)]
    pool = [f for f in near if not re.search("finger", f.name, re.IGNORECASE)] or [
        f for f in links if above[f.name] == most
    ]
    return pool[-1].name
