"""Pink along a way: rows of the hand's pose as a task of its own kind, with its manipulability task and its limits."""

import numpy as np
import pink
import pinocchio as pin
from pink.tasks import DampingTask, ManipulabilityTask, Task
from way_driving import drive, pose_error


class Rows(Task):
    """Rows of a frame's pose."""

    def __init__(self, arm, case):
        super().__init__(cost=1.0, gain=case.gain, lm_damping=1.0)  # as in Pink's examples
        self.tip, self.rows, self.pose = arm.tip, case.rows, case.poses[0]

    def compute_error(self, configuration):
        """Pink's sign: the negative way to the target."""
        here = configuration.get_transform_frame_to_world(self.tip)
        return -self.rows @ pose_error(here.rotation, here.translation, self.pose)

    def compute_jacobian(self, configuration):
        """Rows of the Jacobian along the world's axes."""
        R = configuration.get_transform_frame_to_world(self.tip).rotation
        return self.rows @ np.kron(np.eye(2), R) @ configuration.get_frame_jacobian(self.tip)

    def __repr__(self):
        return "Rows()"


def make(arm, case):
    """Joint velocity by Pink, with its default limits."""
    model = pin.buildModelFromUrdf(arm.urdf)
    data = model.createData()
    order = [model.joints[model.getJointId(n)].idx_v for n in arm.names]
    rows = Rows(arm, case)
    # the documented rate is per second, the code takes it per step; 3 /s as that of our ascent
    climb = ManipulabilityTask(
        arm.tip, model, cost=1e-3, mask=None if case.whole else "position", manipulability_rate=3.0 * arm.dt
    )
    tasks = [rows, DampingTask(cost=1e-3), climb]

    def step(q, pose):
        rows.pose = pose
        full = np.empty(model.nq)
        full[order] = np.clip(q, arm.lower, arm.upper)
        configuration = pink.Configuration(model, data, full)
        return pink.solve_ik(configuration, tasks, arm.dt, solver="quadprog", safety_break=False)[order]

    return step


drive("pin-pink", {"pink": make})
