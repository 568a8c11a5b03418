"""mink: Pink's sibling over MuJoCo."""

import mink
import mujoco
import numpy as np
from common import DT, TARGET, TIP, URDF, report

model = mujoco.MjModel.from_xml_path(URDF)
configuration = mink.Configuration(model)
frame = mink.FrameTask(TIP, "body", position_cost=1.0, orientation_cost=0.0)
frame.set_target(mink.SE3.from_translation(TARGET))
posture = mink.PostureTask(model, cost=1e-3)
posture.set_target(np.zeros(model.nq))
limits = [mink.ConfigurationLimit(model)]


def stepper(limits):
    """Q -> joint velocity."""

    def step(q):
        configuration.update(q)
        return mink.solve_ik(configuration, [frame, posture], DT, solver="daqp", limits=limits)

    return step


report("mink", {"task and rest posture": stepper([]), "with position limits": stepper(limits)}, calls=50)
