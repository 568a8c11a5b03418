"""mink along a way: rows of the hand's pose as a task of its own kind, damping, position and velocity limits."""

import mink
import mujoco
import numpy as np
from way_driving import drive, pose_error


class Rows(mink.Task):
    """Rows of a body's pose."""

    def __init__(self, arm, case):
        super().__init__(cost=np.ones(len(case.rows)), gain=case.gain, lm_damping=1.0)
        self.tip, self.rows, self.pose = arm.tip, case.rows, case.poses[0]

    def compute_error(self, configuration):
        """The negative way to the target, as in Pink."""
        here = configuration.get_transform_frame_to_world(self.tip, "body")
        return -self.rows @ pose_error(here.rotation().as_matrix(), here.translation(), self.pose)

    def compute_jacobian(self, configuration):
        """Rows of the Jacobian along the world's axes."""
        R = configuration.get_transform_frame_to_world(self.tip, "body").rotation().as_matrix()
        return self.rows @ np.kron(np.eye(2), R) @ configuration.get_frame_jacobian(self.tip, "body")


def make(arm, case):
    """Joint velocity by mink."""
    model = mujoco.MjModel.from_xml_path(arm.urdf)
    configuration = mink.Configuration(model)
    rows = Rows(arm, case)
    tasks = [rows, mink.DampingTask(model, cost=1e-3)]
    speeds = dict(zip(arm.names, arm.velocity.tolist(), strict=True))
    limits = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, speeds)]
    order = [int(model.joint(n).qposadr[0]) for n in arm.names]

    def step(q, pose):
        rows.pose = pose
        full = np.empty(model.nq)
        full[order] = q
        configuration.update(full)
        return mink.solve_ik(configuration, tasks, arm.dt, solver="daqp", limits=limits)[order]

    return step


drive("mink", {"mink": make})
