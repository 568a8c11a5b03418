"""RoboPlan's OInK, a quadratic programme in C++: its frame task without orientation, within its limits.

Its tasks are written in C++ and weigh x, y and z alike, so oblique rows are not to be had; it knows no manipulability.
"""

import numpy as np
from driving import TARGET, Case, NoSuchRowsError, answer, drive, main, order, report, sawyer
from roboplan.core import CartesianConfiguration, Scene, loadUrdfSceneDescription
from roboplan.optimal_ik import FrameTask, FrameTaskOptions, Oink, PositionLimit, VelocityLimit

DAMPING = 1e-6  # with the default, 1e-12, a tenth fewer rollouts arrive; more makes no difference


def solver(arm, case, limited=True):
    """Posture -> joint velocity towards a point."""
    if len(case.rows) < 3:
        raise NoSuchRowsError
    scene = Scene("arm", loadUrdfSceneDescription(arm.urdf))
    oink, goal = Oink(scene), np.eye(4, order="F")
    goal[:3, 3] = case.target
    at, n = order(scene.getJointPositionIndices(arm.names)), len(arm.names)
    full, change, fastest = np.empty(n), np.zeros(n), np.empty(n)
    fastest[at] = arm.velocity
    options = FrameTaskOptions(orientation_cost=0.0, task_gain=arm.task_gain * arm.dt)
    tasks = [FrameTask(oink, scene, CartesianConfiguration("", arm.tip, goal), options)]
    limits = [PositionLimit(oink), VelocityLimit(oink, arm.dt, fastest)] if limited else []

    def step(q):
        full[at] = q
        oink.solveIk(full, tasks, limits, [], change, DAMPING)
        return change[at] / arm.dt

    return step


def step():
    """Without and with limits."""
    arm, case = sawyer(), Case(np.eye(3), np.zeros(7), TARGET, 0.0)
    report("roboplan-oink", {"task only": solver(arm, case, False), "with limits": solver(arm, case)})


METHODS = {"OInK": solver}

if __name__ == "__main__":
    main(
        step=step,
        control=lambda *files: drive("roboplan-oink", *files, METHODS),
        timings=lambda: answer("roboplan-oink", METHODS),
    )
