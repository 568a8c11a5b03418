"""Drake's two differential inverse kinematics, quadratic programmes with position and velocity limits.

The function `DoDifferentialInverseKinematics` takes any rows and keeps their direction; the newer
`DifferentialInverseKinematicsSystem` takes axes of a frame, here one whose axes are the rows, and comes as near as it
can. Neither knows manipulability; the rest of the joints' motion is as small as can be.
"""

import numpy as np
from driving import TARGET, Case, answer, drive, main, report, sawyer
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.inverse_kinematics import (
    DifferentialInverseKinematicsParameters,
    DifferentialInverseKinematicsSystem,
    DoDifferentialInverseKinematics,
)
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.tree import FixedOffsetFrame, JacobianWrtVariable
from pydrake.planning import DofMask, JointLimits, RobotDiagramBuilder, SceneGraphCollisionChecker
from pydrake.systems.framework import BusValue

ORIGIN = np.zeros(3)


def checker(arm, axes):
    """The arm on its base, with a frame "task" whose axes are rows of the base's."""
    builder = RobotDiagramBuilder(time_step=0.0)
    plant, (model,) = builder.plant(), builder.parser().AddModels(arm.urdf)
    if arm.base != "world":
        plant.WeldFrames(plant.world_frame(), plant.GetFrameByName(arm.base))
    plant.AddFrame(FixedOffsetFrame("task", plant.world_frame(), RigidTransform(RotationMatrix(axes.T))))
    return SceneGraphCollisionChecker(model=builder.Build(), robot_model_instances=[model], edge_step_size=0.1)


def order_of(plant, arm):
    """Where Drake keeps the joints."""
    return [plant.GetJointByName(n).position_start() for n in arm.names]


def function(arm, case):
    """Joint velocity by `DoDifferentialInverseKinematics`."""
    plant = checker(arm, np.eye(3)).plant()
    order, n = order_of(plant, arm), plant.num_positions()
    context, tip, world = plant.CreateDefaultContext(), plant.GetFrameByName(arm.tip), plant.world_frame()
    parameters = DifferentialInverseKinematicsParameters(n, n)
    parameters.set_time_step(arm.dt)
    parameters.set_joint_position_limits((plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()))
    parameters.set_joint_velocity_limits((plant.GetVelocityLowerLimits(), plant.GetVelocityUpperLimits()))
    full, still = np.empty(n), np.zeros(n)

    def step(q):
        full[order] = q
        plant.SetPositions(context, full)
        J = plant.CalcJacobianTranslationalVelocity(context, JacobianWrtVariable.kV, tip, ORIGIN, world, world)
        here = plant.CalcPointsPositions(context, tip, ORIGIN, world)[:, 0]
        b = arm.task_gain * case.rows @ (case.target - here)
        found = DoDifferentialInverseKinematics(full, still, b, case.rows @ J, parameters)
        if found.joint_velocities is None:
            raise RuntimeError(str(found.status))
        return found.joint_velocities[order]

    return step


def system(arm, case):
    """Joint velocity by `DifferentialInverseKinematicsSystem`."""
    s, kind = len(case.rows), DifferentialInverseKinematicsSystem
    axes = np.vstack([case.rows, np.linalg.svd(case.rows)[2][s:]])
    axes[2] *= np.sign(np.linalg.det(axes))  # of three rows it is the cost that has no sign
    robot = checker(arm, axes)
    plant = robot.plant()
    order, n = order_of(plant, arm), plant.num_positions()
    tip, task = (plant.GetFrameByName(name).scoped_name().get_full() for name in (arm.tip, "task"))
    masks = {tip: np.array([0.0] * 3 + [1.0] * s + [0.0] * (3 - s))}
    limits = kind.JointVelocityLimitConstraint.Config()
    recipe = kind.Recipe()
    # its documentation wants the first a hundred times the second
    weighted = kind.LeastSquaresCost.Config(cartesian_qp_weight=100.0, cartesian_axis_masks=masks)
    recipe.AddIngredient(kind.LeastSquaresCost(weighted))
    centring = kind.JointCenteringCost.Config(posture_gain=0.0, cartesian_axis_masks=masks)
    recipe.AddIngredient(kind.JointCenteringCost(centring))
    recipe.AddIngredient(kind.JointVelocityLimitConstraint(limits, JointLimits(plant)))
    unbounded = SpatialVelocity(np.full(6, 1e3))
    mask = DofMask(np.ones(n, dtype=bool))
    solver = kind(recipe, task, robot, mask, arm.dt, arm.task_gain * arm.dt, unbounded)
    context, goal, full = solver.CreateDefaultContext(), BusValue(), np.empty(n)
    goal.Set(tip, Value(RigidTransform(axes @ case.target)))
    solver.get_input_port_desired_cartesian_poses().FixValue(context, Value(goal))
    solver.get_input_port_nominal_posture().FixValue(context, np.zeros(n))
    posture, velocity = solver.get_input_port_position(), solver.get_output_port_commanded_velocity()

    def step(q):
        full[order] = q
        posture.FixValue(context, full)
        return velocity.Eval(context)[order]

    return step


METHODS = {"Drake, function": function, "Drake, system": system}


def step():
    """Both, with limits."""
    arm, case = sawyer(), Case(np.eye(3), np.zeros(7), TARGET, 0.0)
    report("drake", {name: make(arm, case) for name, make in METHODS.items()}, calls=50)


if __name__ == "__main__":
    main(step=step, control=lambda *files: drive("drake", *files, METHODS), timings=lambda: answer("drake", METHODS))
