"""Plain and damped pseudo-inverse over Pinocchio's Jacobian."""

import numpy as np
import pinocchio as pin
from driving import drive


def stepper(damping):
    """The pseudo-inverse (A^T A + damping^2)^-1 A^T; without damping NumPy's pinv."""

    def make(arm, case):
        model = pin.buildModelFromUrdf(arm.urdf)
        data, frame = model.createData(), model.getFrameId(arm.tip)
        order = [model.joints[model.getJointId(n)].idx_v for n in arm.names]

        def step(q):
            full = np.empty(model.nq)
            full[order] = q
            J = pin.computeFrameJacobian(model, data, full, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
            A = case.rows @ J[:3]
            b = arm.task_gain * case.rows @ (case.target - data.oMf[frame].translation)
            if damping == 0.0:
                return (np.linalg.pinv(A) @ b)[order]
            return (A.T @ np.linalg.solve(A @ A.T + damping**2 * np.eye(len(A)), b))[order]

        return step

    return make


drive("pin", {"pseudo-inverse": stepper(0.0), "damped pseudo-inverse": stepper(0.05)})
