"""Solve recorded steps with PlaCo, in PlaCo's own environment: rows.npz and a URDF in, velocities out, as JSON."""

import json
import sys

import numpy as np
import placo

from manip_learn.control.interop.placo_task import PlacoTask
from manip_learn.errors import TargetError

rows, urdf = np.load(sys.argv[1]), sys.argv[2]
names = [str(n) for n in rows["names"]]
robot = placo.RobotWrapper(urdf, placo.Flags.ignore_collisions)
solver = placo.KinematicsSolver(robot)
solver.mask_fbase(True)
solver.dt = 0.01
solver.enable_joint_limits(False)
solver.enable_velocity_limits(False)
solver.problem.regularization = 0.0
task = PlacoTask(solver, names)
velocities = []
for q, A, b, pi in zip(rows["q"], rows["A"], rows["b"], rows["pi"], strict=True):
    for name, x in zip(names, q, strict=True):
        robot.set_joint(name, x)
    robot.update_kinematics()
    task.update(A, b, pi)
    velocities.append(task.velocity(solver.solve(False)).tolist())
try:
    task.update(rows["A"][0], rows["b"][0][:1])
    refused = ""
except TargetError as error:
    refused = str(error)
print(json.dumps({"velocities": velocities, "refused": refused}))
