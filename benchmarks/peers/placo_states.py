"""placo at given postures, with its velocity and joint limits, with and without its manipulability task.

python placo_states.py CASES.json     {"urdf", "tip", "target", "far", "states": {name: [posture, ...]}}
"""

import json
import sys
from pathlib import Path

import numpy as np
import placo
from common import DT
from timing import rounds_of

cases = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))


def runner(target, postures, manipulability):
    """All postures once."""
    robot = placo.RobotWrapper(cases["urdf"], placo.Flags.ignore_collisions)
    solver = placo.KinematicsSolver(robot)
    solver.mask_fbase(True)
    solver.dt = DT
    solver.enable_velocity_limits(True)
    solver.enable_joint_limits(True)
    solver.add_position_task(cases["tip"], np.array(target)).configure("tip", "soft", 1.0)
    solver.add_regularization_task(1e-4)
    if manipulability:
        solver.add_manipulability_task(cases["tip"], "position", 1.0).configure("mu", "soft", 1e-3)
    start = robot.state.q[:7].copy()

    def run():
        for q in postures:
            robot.state.q[7:] = q
            robot.state.q[:7] = start
            robot.update_kinematics()
            try:
                solver.solve(False)
            except RuntimeError:  # no velocity meets its limits
                pass

    return run


candidates = {}
for state, postures in cases["states"].items():
    target, arrays = cases["far" if state in cases["far states"] else "target"], [np.array(q) for q in postures]
    candidates[state, "limits"] = runner(target, arrays, False)
    candidates[state, "limits and manipulability"] = runner(target, arrays, True)
seconds = rounds_of(candidates, 2, 9)
best = {kind: {} for kind in ("limits", "limits and manipulability")}
for (state, kind), times in seconds.items():
    best[kind][state] = 1e6 * min(times) / len(cases["states"][state])
print(json.dumps(best))
