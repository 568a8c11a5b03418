"""Learn which directions a demonstrated task constrains, and keep the arm away from its singularities.

URDF + demonstrations -> Lambda -> controller -> replay. Method: J. Manavalan and M. Howard, "Learning Singularity
Avoidance".
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from manip_learn.batch_manipulability import manipulability_batch
    from manip_learn.compiled_controller import CompiledController
    from manip_learn.constraint import Constraint
    from manip_learn.controller import Command, ResolvedRateController
    from manip_learn.demonstrations import Demonstrations, Trajectory
    from manip_learn.errors import ManipLearnError
    from manip_learn.features import CentreOfMass, CustomFeatures, FeatureMap, FrameJacobian, Stacked
    from manip_learn.io import RecordingSource, iter_demonstrations, load_demonstrations
    from manip_learn.learning import ConstraintLearner
    from manip_learn.manipulability_measure import log_manipulability_gradient, manipulability, manipulability_gradient
    from manip_learn.playback import LiveViewer, replay
    from manip_learn.policies import JointAttractor, ManipulabilityAscent, NullSpacePolicy, ZeroPolicy
    from manip_learn.preparation import resample, thin, trim_standstill
    from manip_learn.robot import Robot, load_robot
    from manip_learn.robot.inspection import inspect_robot
    from manip_learn.robot.tips import likely_tips
    from manip_learn.rollout import Rollout, simulate
    from manip_learn.tasks import Hold, PointAttractor, Task, Track
    from manip_learn.velocities import derive_velocities

__version__ = "0.1.0"

# loaded at first use, so that `import manip_learn` and `manip-learn --help` are quick
_HOMES = {
    "RecordingSource": "io",
    "likely_tips": "robot.tips",
    "inspect_robot": "robot.inspection",
    "manipulability_batch": "batch_manipulability",
    "CompiledController": "compiled_controller",
    "CentreOfMass": "features",
    "Command": "controller",
    "Constraint": "constraint",
    "ConstraintLearner": "learning",
    "CustomFeatures": "features",
    "Demonstrations": "demonstrations",
    "FeatureMap": "features",
    "FrameJacobian": "features",
    "Hold": "tasks",
    "JointAttractor": "policies",
    "LiveViewer": "playback",
    "ManipLearnError": "errors",
    "ManipulabilityAscent": "policies",
    "NullSpacePolicy": "policies",
    "PointAttractor": "tasks",
    "ResolvedRateController": "controller",
    "Robot": "robot",
    "Rollout": "rollout",
    "Stacked": "features",
    "Task": "tasks",
    "Track": "tasks",
    "Trajectory": "demonstrations",
    "ZeroPolicy": "policies",
    "derive_velocities": "velocities",
    "iter_demonstrations": "io",
    "load_demonstrations": "io",
    "load_robot": "robot",
    "log_manipulability_gradient": "manipulability_measure",
    # the file is not called manipulability.py: importing it would put the module where the function belongs
    "manipulability": "manipulability_measure",
    "manipulability_gradient": "manipulability_measure",
    "replay": "playback",
    "resample": "preparation",
    "simulate": "rollout",
    "thin": "preparation",
    "trim_standstill": "preparation",
}
__all__ = [
    "CentreOfMass",
    "Command",
    "CompiledController",
    "Constraint",
    "ConstraintLearner",
    "CustomFeatures",
    "Demonstrations",
    "FeatureMap",
    "FrameJacobian",
    "Hold",
    "JointAttractor",
    "LiveViewer",
    "ManipLearnError",
    "ManipulabilityAscent",
    "NullSpacePolicy",
    "PointAttractor",
    "RecordingSource",
    "ResolvedRateController",
    "Robot",
    "Rollout",
    "Stacked",
    "Task",
    "Track",
    "Trajectory",
    "ZeroPolicy",
    "derive_velocities",
    "inspect_robot",
    "iter_demonstrations",
    "likely_tips",
    "load_demonstrations",
    "load_robot",
    "log_manipulability_gradient",
    "manipulability",
    "manipulability_batch",
    "manipulability_gradient",
    "replay",
    "resample",
    "simulate",
    "thin",
    "trim_standstill",
]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        value = getattr(importlib.import_module(f"manip_learn.{_HOMES[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'manip_learn' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
