"""Pink, a quadratic programme a step: rows of a place as a task of its own kind, and its manipulability task."""

import numpy as np
import pink
import pinocchio as pin
from driving import DT, TARGET, TIP, URDF, NoSuchRowsError, answer, drive, main, report
from pink.tasks import DampingTask, FrameTask, ManipulabilityTask, PostureTask, Task


def step():
    """Its frame task and a rest posture, with and without its manipulability task."""
    model = pin.buildModelFromUrdf(URDF)
    data = model.createData()
    frame = FrameTask(TIP, position_cost=1.0, orientation_cost=0.0)
    frame.set_target(pin.SE3(pin.SE3.Identity().rotation, TARGET))
    posture = PostureTask(cost=1e-3)
    posture.set_target(pin.neutral(model))
    climb = ManipulabilityTask(TIP, model, cost=1e-3, mask="position")

    def stepper(*tasks):
        return lambda q: pink.solve_ik(pink.Configuration(model, data, q), tasks, DT, solver="quadprog")

    steps = {"task and rest posture": stepper(frame, posture), "with manipulability": stepper(frame, posture, climb)}
    report("pin-pink", steps, calls=50)


class Rows(Task):
    """Rows (s, 3) of a frame's place."""

    def __init__(self, arm, case):
        super().__init__(cost=1.0, gain=arm.task_gain * arm.dt, lm_damping=1.0)  # as in Pink's examples
        self.tip, self.rows, self.target = arm.tip, case.rows, case.target

    def compute_error(self, configuration):
        """Pink's sign: the negative way to the target."""
        here = configuration.get_transform_frame_to_world(self.tip)
        return self.rows @ (here.translation - self.target)

    def compute_jacobian(self, configuration):
        """Rows of the Jacobian along the world's axes."""
        R = configuration.get_transform_frame_to_world(self.tip).rotation
        return self.rows @ R @ configuration.get_frame_jacobian(self.tip)[:3]

    def __repr__(self):
        return "Rows()"


def solver(arm, rows, rate=None):
    """Posture -> joint velocity with damping and Pink's default limits; climbs at a rate [1/s], not at all if None."""
    model = pin.buildModelFromUrdf(arm.urdf)
    data = model.createData()
    order = [model.joints[model.getJointId(n)].idx_v for n in arm.names]
    tasks = [rows, DampingTask(cost=1e-3)]
    if rate is not None:
        # the documented rate is per second, the code takes it per step
        climb = ManipulabilityTask(arm.tip, model, cost=1e-3, mask="position", manipulability_rate=rate * arm.dt)
        tasks.append(climb)

    def solve(q):
        full = np.empty(model.nq)
        full[order] = np.clip(q, arm.lower, arm.upper)
        configuration = pink.Configuration(model, data, full)
        return pink.solve_ik(configuration, tasks, arm.dt, solver="quadprog", safety_break=False)[order]

    return solve


def placing(arm, case):
    """The same with Pink's own frame task, which is written for x, y, z; its orientation has no cost."""
    if len(case.rows) < 3:
        raise NoSuchRowsError
    task = FrameTask(arm.tip, 1.0, 0.0, gain=arm.task_gain * arm.dt, lm_damping=1.0)
    task.set_target(pin.SE3(np.eye(3), case.target))
    return solver(arm, task)


METHODS = {
    "pink": lambda arm, case: solver(arm, Rows(arm, case)),
    "pink, frame task": placing,
    "pink, manipulability": lambda arm, case: solver(arm, Rows(arm, case), case.gain),
}

if __name__ == "__main__":
    main(
        step=step,
        control=lambda *files: drive("pin-pink", *files, METHODS),
        timings=lambda: answer("pin-pink", METHODS),
    )
