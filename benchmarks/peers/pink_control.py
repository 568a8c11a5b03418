"""Pink: the rows as a task of its own kind, with and without its manipulability task."""

import numpy as np
import pink
import pinocchio as pin
from driving import drive
from pink.tasks import DampingTask, ManipulabilityTask, Task


class Rows(Task):
    """Oblique rows of a frame's position."""

    def __init__(self, arm, case):
        super().__init__(cost=1.0, gain=arm.task_gain * arm.dt, lm_damping=1.0)  # as in Pink's examples
        self.arm, self.case = arm, case

    def compute_error(self, configuration):
        """Pink's sign: the negative way to the target."""
        return self.case.rows @ (
            configuration.get_transform_frame_to_world(self.arm.tip).translation - self.case.target
        )

    def compute_jacobian(self, configuration):
        """Rows of the Jacobian along the world's axes."""
        R = configuration.get_transform_frame_to_world(self.arm.tip).rotation
        return self.case.rows @ R @ configuration.get_frame_jacobian(self.arm.tip)[:3]

    def __repr__(self):
        return "Rows()"


def stepper(manipulability):
    """Joint velocity by Pink, with its default limits."""

    def make(arm, case):
        model = pin.buildModelFromUrdf(arm.urdf)
        data = model.createData()
        order = [model.joints[model.getJointId(n)].idx_v for n in arm.names]
        tasks = [Rows(arm, case), DampingTask(cost=1e-3)]
        if manipulability:
            # the documented rate is per second, the code takes it per step
            rate = case.gain * arm.dt
            tasks.append(ManipulabilityTask(arm.tip, model, cost=1e-3, mask="position", manipulability_rate=rate))

        def step(q):
            full = np.empty(model.nq)
            full[order] = np.clip(q, arm.lower, arm.upper)
            configuration = pink.Configuration(model, data, full)
            return pink.solve_ik(configuration, tasks, arm.dt, solver="quadprog", safety_break=False)[order]

        return step

    return make


drive("pin-pink", {"pink": stepper(False), "pink, manipulability": stepper(True)})
