"""placo: a quadratic programme in C++, with and without its manipulability task."""

import placo
from common import DT, TARGET, TIP, URDF, report


def stepper(manipulability):
    """Q -> joint velocity."""
    robot = placo.RobotWrapper(URDF, placo.Flags.ignore_collisions)
    solver = placo.KinematicsSolver(robot)
    solver.mask_fbase(True)
    solver.dt = DT
    solver.enable_velocity_limits(True)
    solver.add_position_task(TIP, TARGET).configure("tip", "soft", 1.0)
    solver.add_regularization_task(1e-4)
    if manipulability:
        solver.add_manipulability_task(TIP, "position", 1.0).configure("mu", "soft", 1e-3)
    start = robot.state.q[:7].copy()

    def step(q):
        robot.state.q[7:] = q
        robot.state.q[:7] = start
        robot.update_kinematics()
        return solver.solve(False)

    return step


report("placo", {"task with velocity limits": stepper(False), "with manipulability": stepper(True)})
