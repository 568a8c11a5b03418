"""placo, a quadratic programme in C++: a position task along rotated axes, and its manipulability task."""

import numpy as np
import placo
from driving import DT, TARGET, TIP, URDF, answer, drive, drive_ways, main, order, report


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


class Solver:
    """An arm in placo, whose base stays where it is, with velocity limits and a position task along rows of one's own.

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
        self._positions = order([robot.get_joint_offset(n) for n in arm.names])
        self._velocities = order([robot.get_joint_v_offset(n) for n in arm.names])

    def at(self, q):
        """Take the arm to a posture; the place of its tip [m]."""
        self.robot.state.q[self._positions] = q
        self.robot.update_kinematics()
        return self.robot.get_T_world_frame(self._arm.tip)[:3, 3]

    def velocity(self):
        """Joint velocity."""
        return self.solver.solve(False)[self._velocities] / self._arm.dt


def reaching(manipulability):
    """Joint velocity by placo towards a point."""

    def make(arm, case):
        placed = Solver(arm, case.rows, case.target)
        placed.solver.add_regularization_task(1e-6)
        if manipulability:
            placed.solver.add_manipulability_task(arm.tip, "position", case.gain).configure("mu", "soft", 1e-3)
        share = arm.task_gain * arm.dt

        def step(q):
            here = placed.at(q)
            # placo's tasks have no gain: the target is set where the task's velocity leads within dt
            placed.task.target_world = here + share * (case.target - here)
            return placed.velocity()

        return step

    return make


def following(arm, way):
    """Joint velocity by placo along a way, with its joint limits too."""
    linear = way.rows[np.linalg.norm(way.rows[:, 3:], axis=1) < 0.5, :3]
    placed = Solver(arm, linear, way.poses[0][:3, 3])
    placed.solver.enable_joint_limits(True)
    turning = None
    if len(linear) < len(way.rows):
        turning = placed.solver.add_orientation_task(arm.tip, way.poses[0][:3, :3])
        turning.configure("orientation", "soft", 1.0)
    placed.solver.add_regularization_task(1e-6)
    kind = "both" if way.whole else "position"
    placed.solver.add_manipulability_task(arm.tip, kind, 1.0).configure("mu", "soft", 1e-3)

    def step(q, pose):
        here = placed.at(q)
        # placo's tasks have no gain: the target is set where the task's velocity leads within dt
        placed.task.target_world = here + way.gain * (pose[:3, 3] - here)
        if turning is not None:
            turning.R_world_frame = pose[:3, :3]
        return placed.velocity()

    return step


METHODS = {"placo": reaching(False), "placo, manipulability": reaching(True)}

if __name__ == "__main__":
    main(
        step=step,
        control=lambda *files: drive("placo", *files, METHODS),
        timings=lambda: answer("placo", METHODS),
        way=lambda *files: drive_ways("placo", *files, {"placo": following}),
    )
