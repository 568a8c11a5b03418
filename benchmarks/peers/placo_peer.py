"""placo, a quadratic programme in C++: a position task along rotated axes, and its manipulability task."""

import numpy as np
import placo
from driving import DT, TARGET, TIP, URDF, answer, drive, main, order, report


def plain_solver(manipulability):
    """Sets the posture of an arm in placo and solves for a point, within velocity limits."""
    robot = placo.RobotWrapper(URDF, placo.Flags.ignore_collisions)
    solver = placo.KinematicsSolver(robot)
    solver.mask_fbase(True)
    solver.dt = DT
    solver.enable_velocity_limits(True)
    solver.enable_joint_limits(False)
    solver.add_position_task(TIP, TARGET).configure("tip", "soft", 1.0)
    solver.add_regularization_task(1e-4)
    if manipulability:
        solver.add_manipulability_task(TIP, "position", 1.0).configure("mu", "soft", 1e-3)
    start = robot.state.q[:7].copy()

    def solve(q):
        robot.state.q[7:] = q
        robot.state.q[:7] = start
        robot.update_kinematics()
        return solver.solve(False)

    return solve


def step():
    """With and without its manipulability task; only velocities are limited."""
    names = {"task with velocity limits": False, "with manipulability": True}
    report("placo", {name: plain_solver(climbs) for name, climbs in names.items()})


def reaching(manipulability):
    """Joint velocity by placo towards a point, within velocity limits, the base where it is."""

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
        if s < 3:
            axes = np.vstack([case.rows, np.linalg.svd(case.rows)[2][s:]])
            axes[2] *= np.sign(np.linalg.det(axes))
            task.mask.R_custom_world = axes
            task.mask.set_axises("xyz"[:s], "custom")
        solver.add_regularization_task(1e-6)
        if manipulability:
            solver.add_manipulability_task(arm.tip, "position", case.gain).configure("mu", "soft", 1e-3)
        positions = order([robot.get_joint_offset(n) for n in arm.names])
        velocities = order([robot.get_joint_v_offset(n) for n in arm.names])
        share = arm.task_gain * arm.dt

        def step(q):
            robot.state.q[positions] = q
            robot.update_kinematics()
            here = robot.get_T_world_frame(arm.tip)[:3, 3]
            # placo's tasks have no gain: the target is set where the task's velocity leads within dt
            task.target_world = here + share * (case.target - here)
            return solver.solve(False)[velocities] / arm.dt

        return step

    return make


METHODS = {"placo": reaching(False), "placo, manipulability": reaching(True)}

if __name__ == "__main__":
    main(
        step=step,
        control=lambda *files: drive("placo", *files, METHODS),
        timings=lambda: answer("placo", METHODS),
    )
