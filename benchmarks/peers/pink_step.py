"""Pink: a quadratic programme a step, with and without its manipulability task."""

import pink
import pinocchio as pin
from common import DT, TARGET, TIP, URDF, report
from pink.tasks import FrameTask, ManipulabilityTask, PostureTask

model = pin.buildModelFromUrdf(URDF)
data = model.createData()
frame = FrameTask(TIP, position_cost=1.0, orientation_cost=0.0)
frame.set_target(pin.SE3(pin.SE3.Identity().rotation, TARGET))
posture = PostureTask(cost=1e-3)
posture.set_target(pin.neutral(model))
manipulability = ManipulabilityTask(TIP, model, cost=1e-3, mask="position")


def stepper(tasks):
    """Q -> joint velocity that serves these tasks."""

    def step(q):
        configuration = pink.Configuration(model, data, q)
        return pink.solve_ik(configuration, tasks, DT, solver="quadprog")

    return step


report(
    "pin-pink",
    {
        "task and rest posture": stepper([frame, posture]),
        "with manipulability": stepper([frame, posture, manipulability]),
    },
    calls=50,
)
