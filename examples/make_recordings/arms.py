"""The arms that recordings are made of: robot, tip that the person holds, and a posture to begin from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import final

import numpy as np
from jaxtyping import Float

from manip_learn.robot import Frame, Robot, load_robot

LIMIT_MARGIN = 0.1  # [rad]
SPEED_SHARE = 0.9
LOWEST, NARROWEST = 0.03, 0.18  # tip above the floor, and from the column of the base [m]

# robot: tip, posture in front of the base with the elbow up [rad]
ARMS = {
    "panda": ("panda_hand_tcp", (0.0, -0.5, 0.0, -2.0, 0.0, 1.7, 0.8)),
    "xarm7": ("link_eef", (0.0, -0.2, 0.0, 1.3, 0.0, 1.4, 0.0)),
    "ur5": ("tool0", (0.0, -1.3, 1.7, -1.9, -1.4, 0.0)),
    "sawyer": ("right_hand", (0.0, -0.9, 0.0, 1.7, 0.0, 0.8, 3.3161)),
    "ur5e": ("tool0", (0.0, -1.3, 1.7, -1.9, -1.4, 0.0)),
}
ROBOTS = tuple(ARMS)[:4]  # of sets that are drawn over all arms
LOCKED = {"panda": ("panda_finger_joint1", "panda_finger_joint2")}


@final
@dataclass(frozen=True)
class Arm:
    """A robot that is guided by its tip.

    Attributes:
        robot: Its kinematics.
        tip: Frame that the person holds.
        ready: shape (nv,), posture in front of the base [rad].
        offset: shape (3,), where the person holds it, seen from the tip's frame [m].
    """

    robot: Robot
    tip: Frame
    ready: Float[np.ndarray, " nv"]
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def pose(self, q: Float[np.ndarray, " nv"]) -> Float[np.ndarray, "4 4"]:
        """Pose of the held point, turned like the tip's frame, in the base frame."""
        pose = self.robot.pose(q, self.tip)
        if any(self.offset):
            pose[:3, 3] += pose[:3, :3] @ self.offset
        return pose

    def jacobian(self, q: Float[np.ndarray, " nv"]) -> Float[np.ndarray, "6 nv"]:
        """Jacobian of the held point in base axes: v + w x r, with r the offset."""
        J = self.robot.jacobian(q, self.tip)
        if any(self.offset):
            x, y, z = self.robot.pose(q, self.tip)[:3, :3] @ self.offset
            J = J.copy()
            J[:3] -= np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ J[3:]
        return J

    def stays_inside(self, q: Float[np.ndarray, "T nv"], rate: float) -> bool:
        """True if a motion keeps 0.1 rad from the position limits and below 90 % of the velocity limits."""
        robot = self.robot
        speed = np.abs(np.diff(q, axis=0)).max(axis=0, initial=0.0) * rate
        return bool(
            np.all(q > robot.position_lower + LIMIT_MARGIN)
            and np.all(q < robot.position_upper - LIMIT_MARGIN)
            and np.all(speed < SPEED_SHARE * robot.velocity_limit)
        )

    def keeps_clear(self, q: Float[np.ndarray, "T nv"]) -> bool:
        """True if the tip stays above the floor and away from the base's own column."""
        places = np.array([self.pose(row)[:3, 3] for row in q])
        return bool(np.all(places[:, 2] > LOWEST) and np.all(np.hypot(places[:, 0], places[:, 1]) > NARROWEST))


@cache
def load_arm(name: str) -> Arm:
    """The arm of that name; one of `ARMS`.

    Raises:
        ValueError: No arm of that name.
    """
    if name not in ARMS:
        raise ValueError(f"no arm {name!r}; there are {', '.join(ARMS)}")
    tip, ready = ARMS[name]
    robot = load_robot(name, locked=LOCKED.get(name, ()))
    posture = np.array(ready)
    posture.setflags(write=False)
    return Arm(robot, robot.frame(tip), posture)
