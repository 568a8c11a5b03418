"""placo: its position task along rotated axes, with and without its manipulability task."""

import numpy as np
import placo
from driving import drive


def stepper(manipulability):
    """Joint velocity by placo, with its velocity and joint limits."""

    def make(arm, case):
        robot = placo.RobotWrapper(arm.urdf, placo.Flags.ignore_collisions)
        solver = placo.KinematicsSolver(robot)
        solver.mask_fbase(True)
        solver.dt = arm.dt
        solver.enable_velocity_limits(True)
        for name, limit in zip(arm.names, arm.velocity.tolist(), strict=True):
            robot.set_velocity_limit(name, limit)
        task = solver.add_position_task(arm.tip, case.target)
        task.configure("rows", "soft", 1.0)
        s = len(case.rows)
        axes = np.vstack([case.rows, np.linalg.svd(case.rows)[2][s:]])
        if s < 3:
            if np.linalg.det(axes) < 0.0:
                axes[2] *= -1.0
            task.mask.R_custom_world = axes
            task.mask.set_axises("xyz"[:s], "custom")
        solver.add_regularization_task(1e-6)
        if manipulability:
            solver.add_manipulability_task(arm.tip, "position", case.gain).configure("mu", "soft", 1e-3)
        velocities = [robot.get_joint_v_offset(n) for n in arm.names]
        fixed = robot.state.q[:7].copy()

        def step(q):
            robot.state.q[:7] = fixed
            for name, x in zip(arm.names, q.tolist(), strict=True):
                robot.set_joint(name, x)
            robot.update_kinematics()
            # placo's tasks have no gain: the target is set where the task's velocity leads within dt
            here = robot.get_T_world_frame(arm.tip)[:3, 3]
            task.target_world = here + arm.task_gain * arm.dt * (case.target - here)
            return solver.solve(False)[velocities] / arm.dt

        return step

    return make


drive("placo", {"placo": stepper(False), "placo, manipulability": stepper(True)})
