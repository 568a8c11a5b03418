"""Joints of a robot that are recorded now and then, but do not move on their own."""

from __future__ import annotations

import functools

from manip_learn.robot import Robot


@functools.lru_cache(maxsize=8)
def unmoved_joint_names(robot: Robot) -> tuple[str, ...]:
    """Joints of the description that are no degrees of freedom: locked, fixed and mimic joints."""
    frames = robot.pinocchio_model.frames
    fixed = [f.name for f in frames if f.type.name in ("FIXED_JOINT", "JOINT")]
    return tuple(n for n in (*fixed, *(m.joint for m in robot.mimics)) if n not in robot.joint_names)
