"""mink, Pink's sibling over MuJoCo: rows of a place as a task of its own, damping, limits of position and speed."""

import mink
import mujoco
import numpy as np
from driving import DT, TARGET, TIP, URDF, NoSuchRowsError, answer, drive, main, report


def step():
    """Its frame task and a rest posture, with and without position limits."""
    model = mujoco.MjModel.from_xml_path(URDF)
    configuration = mink.Configuration(model)
    frame = mink.FrameTask(TIP, "body", position_cost=1.0, orientation_cost=0.0)
    frame.set_target(mink.SE3.from_translation(TARGET))
    posture = mink.PostureTask(model, cost=1e-3)
    posture.set_target(np.zeros(model.nq))

    def stepper(limits):
        def step(q):
            configuration.update(q)
            return mink.solve_ik(configuration, [frame, posture], DT, solver="daqp", limits=limits)

        return step

    limited = stepper([mink.ConfigurationLimit(model)])
    report("mink", {"task and rest posture": stepper([]), "with position limits": limited}, calls=50)


class Rows(mink.Task):
    """Rows (s, 3) of a body's place."""

    def __init__(self, arm, case):
        super().__init__(cost=np.ones(len(case.rows)), gain=arm.task_gain * arm.dt, lm_damping=1.0)
        self.tip, self.rows, self.target = arm.tip, case.rows, case.target

    def compute_error(self, configuration):
        """The negative way to the target, as in Pink."""
        here = configuration.get_transform_frame_to_world(self.tip, "body")
        return self.rows @ (here.translation() - self.target)

    def compute_jacobian(self, configuration):
        """Rows of the Jacobian along the world's axes."""
        R = configuration.get_transform_frame_to_world(self.tip, "body").rotation().as_matrix()
        return self.rows @ R @ configuration.get_frame_jacobian(self.tip, "body")[:3]


def solver(arm, task):
    """Posture -> joint velocity for a task, with damping and limits; mink keeps the joints in an order of its own."""
    model = mujoco.MjModel.from_xml_path(arm.urdf)
    configuration = mink.Configuration(model)
    tasks = [task, mink.DampingTask(model, cost=1e-3)]
    speeds = dict(zip(arm.names, arm.velocity.tolist(), strict=True))
    limits = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, speeds)]
    order = [int(model.joint(n).qposadr[0]) for n in arm.names]

    def solve(q):
        full = np.empty(model.nq)
        full[order] = q
        configuration.update(full)
        return mink.solve_ik(configuration, tasks, arm.dt, solver="daqp", limits=limits)[order]

    return solve


def reaching(arm, case):
    """Joint velocity by mink towards a point."""
    return solver(arm, Rows(arm, case))


def placing(arm, case):
    """The same with mink's own frame task, which is written for x, y, z; its orientation has no cost."""
    if len(case.rows) < 3:
        raise NoSuchRowsError
    task = mink.FrameTask(arm.tip, "body", 1.0, 0.0, gain=arm.task_gain * arm.dt, lm_damping=1.0)
    task.set_target(mink.SE3.from_translation(case.target))
    return solver(arm, task)


METHODS = {"mink": reaching, "mink, frame task": placing}

if __name__ == "__main__":
    main(
        step=step,
        control=lambda *files: drive("mink", *files, METHODS),
        timings=lambda: answer("mink", METHODS),
    )
