"""mink: the rows as a task of its own kind, damping, position and velocity limits."""

import mink
import mujoco
import numpy as np
from driving import drive


class Rows(mink.Task):
    """Oblique rows of a body's position."""

    def __init__(self, arm, case):
        super().__init__(cost=np.ones(len(case.rows)), gain=arm.task_gain * arm.dt, lm_damping=1.0)
        self.arm, self.case = arm, case

    def compute_error(self, configuration):
        """The negative way to the target, as in Pink."""
        place = configuration.get_transform_frame_to_world(self.arm.tip, "body").translation()
        return self.case.rows @ (place - self.case.target)

    def compute_jacobian(self, configuration):
        """Rows of the Jacobian along the world's axes."""
        R = configuration.get_transform_frame_to_world(self.arm.tip, "body").rotation().as_matrix()
        return self.case.rows @ R @ configuration.get_frame_jacobian(self.arm.tip, "body")[:3]


def make(arm, case):
    """Joint velocity by mink."""
    model = mujoco.MjModel.from_xml_path(arm.urdf)
    configuration = mink.Configuration(model)
    tasks = [Rows(arm, case), mink.DampingTask(model, cost=1e-3)]
    speeds = dict(zip(arm.names, arm.velocity.tolist(), strict=True))
    limits = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, speeds)]
    order = [int(model.joint(n).qposadr[0]) for n in arm.names]

    def step(q):
        full = np.empty(model.nq)
        full[order] = q
        configuration.update(full)
        return mink.solve_ik(configuration, tasks, arm.dt, solver="daqp", limits=limits)[order]

    return step


drive("mink", {"mink": make})
