"""What anyone writes first: Pinocchio's Jacobian, and NumPy's pseudo-inverse or a damped one."""

import numpy as np
import pinocchio as pin
from driving import TARGET, TIP, URDF, answer, drive, main, report

AXES = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


def step():
    """The plain step, without and with a rest posture."""
    model = pin.buildModelFromUrdf(URDF)
    data, frame = model.createData(), model.getFrameId(TIP)

    def task_only(q):
        """J^+ (target - position), no null space."""
        J = pin.computeFrameJacobian(model, data, q, frame, AXES)[:3]
        return np.linalg.pinv(J) @ (TARGET - data.oMf[frame].translation)

    def with_rest_posture(q):
        """The same with a rest posture in the null space, and mu."""
        J = pin.computeFrameJacobian(model, data, q, frame, AXES)[:3]
        inverse = np.linalg.pinv(J)
        mu = np.sqrt(np.linalg.det(J @ J.T))
        return inverse @ (TARGET - data.oMf[frame].translation) + (np.eye(7) - inverse @ J) @ -q, mu

    report("pin", {"task only": task_only, "with rest posture and mu": with_rest_posture})


def stepper(damping):
    """The pseudo-inverse (A^T A + damping^2)^-1 A^T; without damping NumPy's pinv."""

    def make(arm, case):
        model = pin.buildModelFromUrdf(arm.urdf)
        data, frame = model.createData(), model.getFrameId(arm.tip)
        order = [model.joints[model.getJointId(n)].idx_v for n in arm.names]

        def step(q):
            full = np.empty(model.nq)
            full[order] = q
            A = case.rows @ pin.computeFrameJacobian(model, data, full, frame, AXES)[:3]
            b = arm.task_gain * case.rows @ (case.target - data.oMf[frame].translation)
            if damping == 0.0:
                return (np.linalg.pinv(A) @ b)[order]
            return (A.T @ np.linalg.solve(A @ A.T + damping**2 * np.eye(len(A)), b))[order]

        return step

    return make


def bare(arm, case):
    """What a step is compared with: the Jacobian, the pseudo-inverse and the product with the null space."""
    model = pin.buildModelFromUrdf(arm.urdf)
    data, frame = model.createData(), model.getFrameId(arm.tip)
    b, pi = np.full(len(case.rows), 0.1), np.full(model.nv, 0.1)

    def step(q):
        A = case.rows @ pin.computeFrameJacobian(model, data, q, frame, AXES)[:3]
        inverse = np.linalg.pinv(A)
        return inverse @ b + pi - inverse @ (A @ pi)

    return step


METHODS = {"pseudo-inverse": stepper(0.0), "damped pseudo-inverse": stepper(0.05)}

if __name__ == "__main__":
    main(step=step, control=lambda *files: drive("pin", *files, METHODS), timings=lambda: answer("pin", {"bare": bare}))
