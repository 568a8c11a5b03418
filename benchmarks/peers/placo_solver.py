"""placo's solver with velocity limits, and a position task along rows of one's own."""

import numpy as np
import placo


class Solver:
    """An arm in placo, whose base stays where it is.

    Attributes:
        robot: placo's robot.
        solver: placo's solver.
        task: The position task of the arm's tip.
    """

    def __init__(self, arm, rows, target):
        """Rows (s, 3) of the tip's place, and where it should be at first (3,)."""
        self._arm = arm
        self.robot = robot = placo.RobotWrapper(arm.urdf, placo.Flags.ignore_collisions)
        self.solver = solver = placo.KinematicsSolver(robot)
        solver.mask_fbase(True)
        solver.dt = arm.dt
        solver.enable_velocity_limits(True)
        for name, limit in zip(arm.names, arm.velocity.tolist(), strict=True):
            robot.set_velocity_limit(name, limit)
        self.task = solver.add_position_task(arm.tip, target)
        self.task.configure("rows", "soft", 1.0)
        s = len(rows)
        if s < 3:
            axes = np.vstack([rows, np.linalg.svd(rows)[2][s:]])
            axes[2] *= np.sign(np.linalg.det(axes))
            self.task.mask.R_custom_world = axes
            self.task.mask.set_axises("xyz"[:s], "custom")
        self._velocities = [robot.get_joint_v_offset(n) for n in arm.names]
        self._fixed = robot.state.q[:7].copy()

    def at(self, q):
        """Take the arm to a posture; the place of its tip [m]."""
        self.robot.state.q[:7] = self._fixed
        for name, x in zip(self._arm.names, q.tolist(), strict=True):
            self.robot.set_joint(name, x)
        self.robot.update_kinematics()
        return self.robot.get_T_world_frame(self._arm.tip)[:3, 3]

    def velocity(self):
        """Joint velocity."""
        return self.solver.solve(False)[self._velocities] / self._arm.dt
