"""Which controllers are compiled, and the table of their constants."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from manip_learn.constraint.features.frame_jacobian import AXES, FrameJacobian
from manip_learn.constraint.features.pose_error import goal_rotation
from manip_learn.constraint.features.weighed_velocity import WeighedVelocity, compiled_form
from manip_learn.control.compiled import step_table as table
from manip_learn.control.compiled_limits import packed_limits, tips_are_compiled, with_tips
from manip_learn.control.controller import ResolvedRateController
from manip_learn.control.policies import JointAttractor, ManipulabilityAscent, ZeroPolicy
from manip_learn.control.resolved_rate_law import ESCAPE_WIDTH
from manip_learn.control.tasks import FreeDirection, Hold, PointAttractor, Track
from manip_learn.robot.batch.batch_kinematics import batch_kinematics
from manip_learn.robot.rotations import rotation_matrix


def why_not(controller: ResolvedRateController) -> str | None:
    """Why a controller cannot be compiled; None if it can where numba is installed.

    Children of the classes that are compiled are not: what they change would be lost.
    """
    constraint, task, policy = controller.constraint, controller.task, controller.null_policy
    features = constraint.features
    if type(features) is not FrameJacobian and not isinstance(features, WeighedVelocity):
        return f"the features are {type(features).__name__}, not rows of one frame seen from the base or from itself"
    kinematics = batch_kinematics(features.robot, features.frame)
    if not kinematics.fast or kinematics.public_columns is None:
        return (
            "not all joints between the base and the frame are revolute, continuous or prismatic ones that move freely"
        )
    if controller.robot is not features.robot:
        return "its limits are those of another robot"
    if not tips_are_compiled(controller.limits):
        return "the speed or the place of a frame is limited that other joints than revolute or prismatic ones move"
    if any(b.kind in ("floating", "planar", "other") for b in features.robot.blocks):
        return "the robot's base moves"
    if constraint.n_constraints > len(kinematics.public_columns):
        return "it has more rows than joints"
    known = type(task) is Hold
    if type(task) is PointAttractor and isinstance(features, FrameJacobian):
        known = _is_packed(features, constraint.n_constraints, task.target)
    if type(task) is FreeDirection:
        known = task.along_rows
    if type(task) is Track:  # elsewhere the rows of the error are others than those held
        known = isinstance(features, FrameJacobian) and features.only_linear
    if not known:
        reference = getattr(features, "reference", type(features).__name__)
        return f"the task is {task!r} with rows {' '.join(features.row_names)} ({reference})"
    if type(policy) is ManipulabilityAscent:
        return None if policy.constraint is constraint else "the policy climbs another constraint's mu"
    if type(policy) is JointAttractor:
        known = policy.robot is features.robot or (policy.robot is None and policy.rest.shape == (features.nv,))
        return None if known else "the rest posture belongs to another robot"
    return None if type(policy) is ZeroPolicy else f"the policy is {type(policy).__name__}"


def packed(controller: ResolvedRateController) -> Float[np.ndarray, "rows 12"]:
    """All constants of the step in one table: one argument costs less than thirty."""
    from manip_learn.robot.batch.compiled_kinematics import JOINTS  # and with it numba

    constraint, task = controller.constraint, controller.task
    features: FrameJacobian = constraint.features  # type: ignore[assignment]  # or rows weighed by the place
    rows, form, reference = compiled_form(features, constraint.selection)  # type: ignore[misc]  # `why_not` has asked
    chain = batch_kinematics(features.robot, features.frame).chain_table(reference)
    chain[1, table.FORM] = form
    header, dofs = packed_limits(controller.limits, constraint.nv, controller.inverse, controller.threshold)
    header[0, table.N_JOINTS] = chain.shape[0] - JOINTS
    header[0, table.NV], header[0, table.N_CONSTRAINTS] = constraint.nv, constraint.n_constraints
    header[1, table.DAMPING], header[1, table.ESCAPE_WIDTH] = controller.damping, ESCAPE_WIDTH * controller.threshold
    if isinstance(task, PointAttractor):
        header[0, table.GAIN] = task.gain
        header[0, table.MAX_SPEED] = np.inf if task.max_speed is None else task.max_speed
        _pack_target(features, constraint.selection, task.target, header, chain)
    elif isinstance(task, FreeDirection | Track):
        header[0, table.TASK] = table.GIVEN
    _pack_policy(controller, header, dofs)
    return with_tips(np.concatenate([header, chain, dofs, rows]), controller.limits)


def _is_packed(features: FrameJacobian, n_constraints: int, target: np.ndarray) -> bool:
    """Whether a target is fixed in the base by numbers or by a pose, all of whose rotation is given or none."""
    if target.shape == (4, 4) or (features.only_linear and target.shape == (n_constraints,)):
        return True
    whole = (0, 3)  # of x y z, and of rx ry rz
    linear = sum(name in "xyz" for name in features.row_names)
    turns = features.n_rows - linear in whole
    return target.shape == (features.n_rows,) and turns and (features.reference == "world" or linear in whole)


def _pack_target(
    features: FrameJacobian, selection: np.ndarray, target: np.ndarray, header: np.ndarray, chain: np.ndarray
) -> None:
    """Place and rotation of the target as `free_step` takes them, in the frame in which the chain is walked.

    What a target of numbers leaves open is taken as 0: no row of Lambda sees it.
    """
    if target.shape == (4, 4):
        place, rotation = target[:3, 3], goal_rotation(target[:3, :3])
    else:
        numbers = target if target.shape == (features.n_rows,) else selection.T.dot(target)
        given = dict(zip(features.row_names, numbers.tolist(), strict=True))
        place, turn = (np.array([given.get(name, 0.0) for name in names]) for names in (AXES[:3], AXES[3:]))
        rotation = rotation_matrix(turn)
    header[0, table.TASK] = table.POINT
    if not features.only_linear:
        header[0, table.TASK] = table.POSE
        walked = batch_kinematics(features.robot, features.frame).walked(features.reference)
        if features.reference == "local":
            place = walked.tool_position + walked.tool_rotation.dot(place)
            rotation = walked.tool_rotation.dot(rotation)
        else:
            rotation = rotation.dot(walked.tool_rotation.T)
        header[1, table.GOAL :] = rotation.reshape(-1)
    chain[1, table.TARGET_POINT : table.TARGET_POINT + 3] = place


def _pack_policy(controller: ResolvedRateController, header: np.ndarray, dofs: np.ndarray) -> None:
    policy = controller.null_policy
    header[0, table.POLICY] = table.NO_POLICY
    if isinstance(policy, ManipulabilityAscent):
        header[0, table.POLICY] = table.LOG_ASCENT if policy.logarithmic else table.ASCENT
        header[0, table.POLICY_GAIN] = policy.gain
        header[0, table.LONGEST] = np.inf if policy.max_speed is None else policy.max_speed
        header[1, table.ESCAPES] = controller.inverse == "damped" and policy.max_speed is not None
    elif isinstance(policy, JointAttractor):
        header[0, table.POLICY], header[0, table.POLICY_GAIN] = table.REST, policy.gain
        dofs[:, table.REST_AT] = controller.robot.positions(policy.rest)  # type: ignore[union-attr]
        for block in policy.robot.blocks if policy.robot is not None else ():
            dofs[block.v, table.WRAPS] = block.kind == "continuous"
