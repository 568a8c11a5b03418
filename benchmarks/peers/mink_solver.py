"""mink's solver with position and velocity limits, for an arm whose joints it keeps in an order of its own."""

import mink
import mujoco
import numpy as np


def solver(arm, task):
    """Posture -> joint velocity for a task, with damping."""
    model = mujoco.MjModel.from_xml_path(arm.urdf)
    configuration = mink.Configuration(model)
    tasks = [task, mink.DampingTask(model, cost=1e-3)]
    speeds = dict(zip(arm.names, arm.velocity.tolist(), strict=True))
    limits = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, speeds)]
    order = [int(model.joint(n).qposadr[0]) for n in arm.names]

    def step(q):
        full = np.empty(model.nq)
        full[order] = q
        configuration.update(full)
        return mink.solve_ik(configuration, tasks, arm.dt, solver="daqp", limits=limits)[order]

    return step
