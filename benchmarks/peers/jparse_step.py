"""J-PARSE: its own inverse near singularities, through its robot class."""

import jparse_robotics as jparse
from common import TARGET, TIP, URDF, report

robot = jparse.Robot.from_urdf(URDF, "base", TIP)


def task_only(q):
    """J-PARSE inverse times (target - position)."""
    return robot.jparse(q, position_only=True) @ (TARGET - robot.forward_kinematics(q)[0])


def with_null_space(q):
    """The same with a rest posture in the null space, and mu."""
    inverse, N = robot.jparse(q, position_only=True, return_nullspace=True)
    return inverse @ (TARGET - robot.forward_kinematics(q)[0]) + N @ -q, robot.manipulability(q)


report("jparse-robotics", {"task only": task_only, "with rest posture and mu": with_null_space})
