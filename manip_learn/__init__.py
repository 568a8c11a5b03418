"""Learn which directions a demonstrated task constrains, and keep the arm away from its singularities.

URDF + demonstrations -> Lambda -> controller -> replay. Method: J. Manavalan and M. Howard, "Learning Singularity
Avoidance".
"""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

from manip_learn.moved import MovedModules

if TYPE_CHECKING:
    from manip_learn.constraint.constraint import Constraint
    from manip_learn.constraint.features import (
        CentreOfMass,
        CustomFeatures,
        FeatureMap,
        FrameJacobian,
        MechanismRows,
        RelativeFrameJacobian,
        Stacked,
    )
    from manip_learn.constraint.manipulability import (
        log_manipulability_gradient,
        log_penalised_manipulability_gradient,
        manipulability,
        manipulability_gradient,
        penalised_manipulability,
        penalised_manipulability_gradient,
    )
    from manip_learn.constraint.manipulability_batch import manipulability_batch
    from manip_learn.constraint.mechanism import Mechanism
    from manip_learn.control.command import Command, Controller, Status
    from manip_learn.control.compiled_controller import CompiledController
    from manip_learn.control.controller import ResolvedRateController
    from manip_learn.control.driver import Driver, RunRecord, run, warm_up
    from manip_learn.control.following import following_error_limit
    from manip_learn.control.limits import Limits
    from manip_learn.control.optimise_path import optimise_path
    from manip_learn.control.planning.approach import GraspCone
    from manip_learn.control.planning.plan import Plan, plan
    from manip_learn.control.policies import (
        JointAttractor,
        JointLimitAvoidance,
        ManipulabilityAscent,
        NullSpacePolicy,
        PenalisedManipulabilityAscent,
        SelfCollisionAvoidance,
        WeightedPolicies,
        ZeroPolicy,
    )
    from manip_learn.control.rollout import Rollout
    from manip_learn.control.servo_loop import ServoLoop
    from manip_learn.control.simulation import simulate
    from manip_learn.control.tasks import FreeDirection, Hold, PointAttractor, Task, Track, motion
    from manip_learn.errors import ManipLearnError, NoPlanError
    from manip_learn.learning import ConstraintLearner
    from manip_learn.learning.audit import audit_episodes
    from manip_learn.learning.mechanisms.find_mechanism import MechanismFit, find_mechanism
    from manip_learn.playback import LiveViewer, replay
    from manip_learn.recordings import RecordingSource, iter_demonstrations, load_demonstrations
    from manip_learn.recordings.demonstrations import Demonstrations
    from manip_learn.recordings.preprocessing import resample, subsample, trim_standstill
    from manip_learn.recordings.trajectory import Trajectory
    from manip_learn.recordings.velocities import derive_velocities
    from manip_learn.robot import Robot, load_robot
    from manip_learn.robot.collision import SelfCollision
    from manip_learn.robot.robot_summary import inspect_robot
    from manip_learn.robot.tips import likely_tips

__version__ = "0.1.0"

sys.meta_path.append(MovedModules())

# loaded at first use, so that `import manip_learn` and `manip-learn --help` are quick
_HOMES = {
    "JointLimitAvoidance": "control.policies",
    "PenalisedManipulabilityAscent": "control.policies",
    "SelfCollisionAvoidance": "control.policies",
    "WeightedPolicies": "control.policies",
    "SelfCollision": "robot.collision",
    "penalised_manipulability": "constraint.manipulability",
    "penalised_manipulability_gradient": "constraint.manipulability",
    "log_penalised_manipulability_gradient": "constraint.manipulability",
    "RecordingSource": "recordings",
    "likely_tips": "robot.tips",
    "inspect_robot": "robot.robot_summary",
    "manipulability_batch": "constraint.manipulability_batch",
    "CompiledController": "control.compiled_controller",
    "CentreOfMass": "constraint.features",
    "Command": "control.command",
    "Controller": "control.command",
    "Constraint": "constraint.constraint",
    "ConstraintLearner": "learning",
    "CustomFeatures": "constraint.features",
    "Demonstrations": "recordings.demonstrations",
    "FeatureMap": "constraint.features",
    "FrameJacobian": "constraint.features",
    "FreeDirection": "control.tasks",
    "GraspCone": "control.planning.approach",
    "Hold": "control.tasks",
    "JointAttractor": "control.policies",
    "LiveViewer": "playback",
    "ManipLearnError": "errors",
    "Mechanism": "constraint.mechanism",
    "MechanismFit": "learning.mechanisms.find_mechanism",
    "MechanismRows": "constraint.features",
    "Driver": "control.driver",
    "RunRecord": "control.driver",
    "following_error_limit": "control.following",
    "run": "control.driver",
    "warm_up": "control.driver",
    "find_mechanism": "learning.mechanisms.find_mechanism",
    "Limits": "control.limits",
    "ManipulabilityAscent": "control.policies",
    "NoPlanError": "errors",
    "NullSpacePolicy": "control.policies",
    "Plan": "control.planning.plan",
    "PointAttractor": "control.tasks",
    "RelativeFrameJacobian": "constraint.features",
    "ResolvedRateController": "control.controller",
    "Robot": "robot",
    "Rollout": "control.rollout",
    "ServoLoop": "control.servo_loop",
    "Status": "control.command",
    "Stacked": "constraint.features",
    "Task": "control.tasks",
    "Track": "control.tasks",
    "Trajectory": "recordings.trajectory",
    "ZeroPolicy": "control.policies",
    "audit_episodes": "learning.audit",
    "derive_velocities": "recordings.velocities",
    "iter_demonstrations": "recordings",
    "load_demonstrations": "recordings",
    "load_robot": "robot",
    "log_manipulability_gradient": "constraint.manipulability",
    "manipulability": "constraint.manipulability",
    "manipulability_gradient": "constraint.manipulability",
    "motion": "control.tasks",
    "optimise_path": "control.optimise_path",
    "plan": "control.planning.plan",
    "replay": "playback",
    "resample": "recordings.preprocessing",
    "simulate": "control.simulation",
    "subsample": "recordings.preprocessing",
    "trim_standstill": "recordings.preprocessing",
}
__all__ = [
    "CentreOfMass",
    "Command",
    "CompiledController",
    "Constraint",
    "ConstraintLearner",
    "Controller",
    "CustomFeatures",
    "Demonstrations",
    "Driver",
    "FeatureMap",
    "FrameJacobian",
    "FreeDirection",
    "GraspCone",
    "Hold",
    "JointAttractor",
    "JointLimitAvoidance",
    "Limits",
    "LiveViewer",
    "ManipLearnError",
    "ManipulabilityAscent",
    "Mechanism",
    "MechanismFit",
    "MechanismRows",
    "NoPlanError",
    "NullSpacePolicy",
    "PenalisedManipulabilityAscent",
    "Plan",
    "PointAttractor",
    "RecordingSource",
    "RelativeFrameJacobian",
    "ResolvedRateController",
    "Robot",
    "Rollout",
    "RunRecord",
    "SelfCollision",
    "SelfCollisionAvoidance",
    "ServoLoop",
    "Stacked",
    "Status",
    "Task",
    "Track",
    "Trajectory",
    "WeightedPolicies",
    "ZeroPolicy",
    "audit_episodes",
    "derive_velocities",
    "find_mechanism",
    "following_error_limit",
    "inspect_robot",
    "iter_demonstrations",
    "likely_tips",
    "load_demonstrations",
    "load_robot",
    "log_manipulability_gradient",
    "log_penalised_manipulability_gradient",
    "manipulability",
    "manipulability_batch",
    "manipulability_gradient",
    "motion",
    "optimise_path",
    "penalised_manipulability",
    "penalised_manipulability_gradient",
    "plan",
    "replay",
    "resample",
    "run",
    "simulate",
    "subsample",
    "trim_standstill",
    "warm_up",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        value = getattr(importlib.import_module(f"manip_learn.{_HOMES[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'manip_learn' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
