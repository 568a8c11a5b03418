"""mink along a way: rows of the hand's pose as a task of its own kind, damping, position and velocity limits."""

import mink
import numpy as np
from mink_solver import solver
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
    rows = Rows(arm, case)
    solve = solver(arm, rows)

    def step(q, pose):
        rows.pose = pose
        return solve(q)

    return step


drive("mink", {"mink": make})
