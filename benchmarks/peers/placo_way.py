"""placo along a way: its position task along rotated axes, its orientation task and its manipulability task."""

import numpy as np
import placo
from way_driving import drive


def make(arm, case):
    """Joint velocity by placo, with its velocity and joint limits."""
    robot = placo.RobotWrapper(arm.urdf, placo.Flags.ignore_collisions)
    solver = placo.KinematicsSolver(robot)
    solver.mask_fbase(True)
    solver.dt = arm.dt
    solver.enable_velocity_limits(True)
    solver.enable_joint_limits(True)
    for name, limit in zip(arm.names, arm.velocity.tolist(), strict=True):
        robot.set_velocity_limit(name, limit)
    task = solver.add_position_task(arm.tip, case.poses[0][:3, 3])
    task.configure("rows", "soft", 1.0)
    linear = case.rows[np.linalg.norm(case.rows[:, 3:], axis=1) < 0.5, :3]
    s = len(linear)
    if s < 3:
        axes = np.vstack([linear, np.linalg.svd(linear)[2][s:]])
        axes[2] *= np.sign(np.linalg.det(axes))
        task.mask.R_custom_world = axes
        task.mask.set_axises("xyz"[:s], "custom")
    turning = None
    if s < len(case.rows):
        turning = solver.add_orientation_task(arm.tip, case.poses[0][:3, :3])
        turning.configure("orientation", "soft", 1.0)
    solver.add_regularization_task(1e-6)
    kind = "both" if case.whole else "position"
    solver.add_manipulability_task(arm.tip, kind, 1.0).configure("mu", "soft", 1e-3)
    velocities = [robot.get_joint_v_offset(n) for n in arm.names]
    fixed = robot.state.q[:7].copy()

    def step(q, pose):
        robot.state.q[:7] = fixed
        for name, x in zip(arm.names, q.tolist(), strict=True):
            robot.set_joint(name, x)
        robot.update_kinematics()
        # placo's tasks have no gain: the target is set where the task's velocity leads within dt
        here = robot.get_T_world_frame(arm.tip)[:3, 3]
        task.target_world = here + case.gain * (pose[:3, 3] - here)
        if turning is not None:
            turning.R_world_frame = pose[:3, :3]
        return solver.solve(False)[velocities] / arm.dt

    return step


drive("placo", {"placo": make})
