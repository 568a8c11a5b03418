"""J-PARSE: its own inverse of the rows near singularities; its controller has no null-space motion of its own."""

import jparse_robotics as jparse
import numpy as np
import pinocchio as pin
from driving import TARGET, TIP, URDF, drive, main, report


def step():
    """Through its robot class."""
    robot = jparse.Robot.from_urdf(URDF, "base", TIP)

    def task_only(q):
        """J-PARSE inverse times (target - position)."""
        return robot.jparse(q, position_only=True) @ (TARGET - robot.forward_kinematics(q)[0])

    def with_null_space(q):
        """The same with a rest posture in the null space, and mu."""
        inverse, N = robot.jparse(q, position_only=True, return_nullspace=True)
        return inverse @ (TARGET - robot.forward_kinematics(q)[0]) + N @ -q, robot.manipulability(q)

    report("jparse-robotics", {"task only": task_only, "with rest posture and mu": with_null_space})


def make(arm, case):
    """Joint velocity by J-PARSE, with its default gamma."""
    model = pin.buildModelFromUrdf(arm.urdf)
    data, frame = model.createData(), model.getFrameId(arm.tip)
    order = [model.joints[model.getJointId(n)].idx_v for n in arm.names]
    core = jparse.JParseCore()

    def step(q):
        full = np.empty(model.nq)
        full[order] = q
        J = pin.computeFrameJacobian(model, data, full, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        b = arm.task_gain * case.rows @ (case.target - data.oMf[frame].translation)
        return (core.compute(case.rows @ J[:3]) @ b)[order]

    return step


if __name__ == "__main__":
    main(step=step, control=lambda *files: drive("jparse-robotics", *files, {"jparse": make}))
