"""Ours: the controller with its default settings, with and without the ascent of the manipulability."""

import sys
import time

import numpy as np
from driving import read, save

import manip_learn as ml

arm, cases = read(sys.argv[1])
robot = ml.load_robot(arm.urdf)
features = ml.FrameJacobian(robot, arm.tip, "xyz")
out = {"version": np.array(f"manip_learn {ml.__version__}")}
for name in ("ours, ascent", "ours, no null-space motion"):
    runs = []
    for case in cases:
        constraint = ml.Constraint(case.rows, features)
        ascent = ml.ManipulabilityAscent(constraint, case.gain) if name == "ours, ascent" else None
        task = ml.PointAttractor(case.target, gain=arm.task_gain)
        controller = ml.ResolvedRateController(constraint, task, ascent, dt=arm.dt)
        began = time.perf_counter()
        rollout = ml.simulate(robot, controller, case.start, arm.duration, arm.dt)
        runs.append((rollout.q, rollout.u, (time.perf_counter() - began) / len(rollout), 0))
    save(out, name, runs)
np.savez(sys.argv[2], **out)
