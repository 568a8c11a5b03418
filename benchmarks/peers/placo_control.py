"""placo: its position task along rotated axes, with and without its manipulability task."""

from driving import drive
from placo_solver import Solver


def stepper(manipulability):
    """Joint velocity by placo, with its velocity limits."""

    def make(arm, case):
        placed = Solver(arm, case.rows, case.target)
        placed.solver.add_regularization_task(1e-6)
        if manipulability:
            placed.solver.add_manipulability_task(arm.tip, "position", case.gain).configure("mu", "soft", 1e-3)

        def step(q):
            here = placed.at(q)
            # placo's tasks have no gain: the target is set where the task's velocity leads within dt
            placed.task.target_world = here + arm.task_gain * arm.dt * (case.target - here)
            return placed.velocity()

        return step

    return make


drive("placo", {"placo": stepper(False), "placo, manipulability": stepper(True)})
