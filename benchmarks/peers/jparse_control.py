"""J-PARSE: its inverse of the rows; it has no null-space motion of its own."""

import jparse_robotics as jparse
import numpy as np
import pinocchio as pin
from driving import drive


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


drive("jparse-robotics", {"jparse": make})
