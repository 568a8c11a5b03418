"""Robotics Toolbox: its Jacobian, and its manipulability Jacobian in the null space."""

import warnings

import numpy as np

warnings.simplefilter("ignore")  # it warns about its own escapes while it is imported

import roboticstoolbox as rtb  # noqa: E402
from common import TARGET, TIP, URDF, report  # noqa: E402

robot = rtb.Robot.URDF(URDF)
end = robot.link_dict[TIP]


def task_only(q):
    """J^+ (target - position)."""
    J = robot.jacob0(q, end=end)[:3]
    return np.linalg.pinv(J) @ (TARGET - robot.fkine(q, end=end).t)


def with_manipulability(q):
    """The same with the gradient of mu in the null space."""
    J = robot.jacob0(q, end=end)[:3]
    inverse = np.linalg.pinv(J)
    climb = robot.jacobm(q, end=end, axes="trans").reshape(-1)
    return inverse @ (TARGET - robot.fkine(q, end=end).t) + (np.eye(7) - inverse @ J) @ climb


report("roboticstoolbox-python", {"task only": task_only, "with manipulability": with_manipulability}, calls=50)
