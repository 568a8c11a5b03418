"""The plain step that anyone writes first: Pinocchio's Jacobian and NumPy's pseudo-inverse."""

import numpy as np
import pinocchio as pin
from common import TARGET, TIP, URDF, report

model = pin.buildModelFromUrdf(URDF)
data = model.createData()
frame = model.getFrameId(TIP)
reference = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


def task_only(q):
    """J^+ (target - position), no null space."""
    J = pin.computeFrameJacobian(model, data, q, frame, reference)[:3]
    return np.linalg.pinv(J) @ (TARGET - data.oMf[frame].translation)


def with_rest_posture(q):
    """The same with a rest posture in the null space, and mu."""
    J = pin.computeFrameJacobian(model, data, q, frame, reference)[:3]
    inverse = np.linalg.pinv(J)
    mu = np.sqrt(np.linalg.det(J @ J.T))
    return inverse @ (TARGET - data.oMf[frame].translation) + (np.eye(7) - inverse @ J) @ -q, mu


report("pin", {"task only": task_only, "with rest posture and mu": with_rest_posture})
