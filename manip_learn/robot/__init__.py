"""Robots: read descriptions and compute kinematics."""

from manip_learn.robot.joints import Frame
from manip_learn.robot.loading import load_robot
from manip_learn.robot.robot import Reference, Robot

__all__ = ["Frame", "Reference", "Robot", "load_robot"]
