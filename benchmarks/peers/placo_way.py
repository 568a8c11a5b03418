"""placo along a way: its position task along rotated axes, its orientation task and its manipulability task."""

import numpy as np
from placo_solver import Solver
from way_driving import drive


def make(arm, case):
    """Joint velocity by placo, with its velocity and joint limits."""
    linear = case.rows[np.linalg.norm(case.rows[:, 3:], axis=1) < 0.5, :3]
    placed = Solver(arm, linear, case.poses[0][:3, 3])
    placed.solver.enable_joint_limits(True)
    turning = None
    if len(linear) < len(case.rows):
        turning = placed.solver.add_orientation_task(arm.tip, case.poses[0][:3, :3])
        turning.configure("orientation", "soft", 1.0)
    placed.solver.add_regularization_task(1e-6)
    kind = "both" if case.whole else "position"
    placed.solver.add_manipulability_task(arm.tip, kind, 1.0).configure("mu", "soft", 1e-3)

    def step(q, pose):
        here = placed.at(q)
        # placo's tasks have no gain: the target is set where the task's velocity leads within dt
        placed.task.target_world = here + case.gain * (pose[:3, 3] - here)
        if turning is not None:
            turning.R_world_frame = pose[:3, :3]
        return placed.velocity()

    return step


drive("placo", {"placo": make})
