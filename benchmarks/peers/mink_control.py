"""mink: the rows as a task of its own kind, damping, position and velocity limits."""

import mink
import numpy as np
from driving import drive
from mink_solver import solver


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
    return solver(arm, Rows(arm, case))


drive("mink", {"mink": make})
