"""Learn which directions a demonstrated task constrains, and keep the arm away from its singularities.

URDF + demonstrations -> Lambda -> controller -> replay. Method: J. Manavalan and M. Howard, "Learning Singularity
Avoidance".
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from manip_learn.constraint.constraint import Constraint
    from manip_learn.constraint.features import (
        CentreOfMass,
        CurveRows,
        CustomFeatures,
        FeatureMap,
        FrameJacobian,
        MechanismRows,
        RelativeFrameJacobian,
        Stacked,
    )
    from manip_learn.constraint.manipulability import (
        log_manipulability_gradient,
        manipulability,
        manipulability_batch,
        manipulability_gradient,
    )
    from manip_learn.constraint.mechanism import Mechanism
    from manip_learn.constraint.shown import Shown
    from manip_learn.constraint.skill import Skill, Step
    from manip_learn.constraint.task_frame import TaskFrame
    from manip_learn.control.command import Command, Controller, Status
    from manip_learn.control.contact import Contact
    from manip_learn.control.controller import ResolvedRateController
    from manip_learn.control.driver import Driver, RunRecord, run
    from manip_learn.control.joint_motion import FollowMotion
    from manip_learn.control.limits import Limits
    from manip_learn.control.policies import (
        JointAttractor,
        JointLimitAvoidance,
        ManipulabilityAscent,
        NullSpacePolicy,
        WeightedPolicies,
        ZeroPolicy,
    )
    from manip_learn.control.rollout import Rollout
    from manip_learn.control.servo_loop import ServoLoop
    from manip_learn.control.simulation import simulate
    from manip_learn.control.tasks import FreeDirection, Hold, PointAttractor, Task, Track, motion
    from manip_learn.drivers.lerobot import LeRobotDriver, LeRobotMotor
    from manip_learn.drivers.mujoco import MuJoCoDriver
    from manip_learn.drivers.record import RecordedFiles, record
    from manip_learn.errors import ManipLearnError, NoPlanError
    from manip_learn.learning import ConstraintLearner
    from manip_learn.learning.audit import audit_episodes
    from manip_learn.planning.plan import Plan, plan
    from manip_learn.planning.repeat import Repetition, repeat
    from manip_learn.planning.scene import Box, Cylinder, Mesh, Scene, Sphere
    from manip_learn.playback import LiveViewer, replay, show
    from manip_learn.recordings import RecordingSource, load_demonstrations
    from manip_learn.recordings.trajectory import Demonstrations, Trajectory, subsample
    from manip_learn.recordings.velocities import derive_velocities
    from manip_learn.robot import Robot, load_robot
    from manip_learn.robot.collision import SelfCollision
    from manip_learn.robot.robot_summary import inspect_robot
    from manip_learn.robot.tips import likely_tips

__version__ = "0.1.0"

# loaded at first use, so that `import manip_learn` and `manip-learn --help` are quick: module -> names
_NAMES = {
    "robot": "Robot load_robot",
    "robot.robot_summary": "inspect_robot",
    "robot.tips": "likely_tips",
    "robot.collision": "SelfCollision",
    "recordings": "RecordingSource load_demonstrations",
    "recordings.trajectory": "Demonstrations Trajectory subsample",
    "recordings.velocities": "derive_velocities",
    "constraint.constraint": "Constraint",
    "constraint.mechanism": "Mechanism",
    "constraint.shown": "Shown",
    "constraint.skill": "Skill Step",
    "constraint.task_frame": "TaskFrame",
    "constraint.features": "CentreOfMass CurveRows CustomFeatures FeatureMap "
    "FrameJacobian MechanismRows RelativeFrameJacobian Stacked",
    "constraint.manipulability": "log_manipulability_gradient manipulability manipulability_batch "
    "manipulability_gradient",
    "learning": "ConstraintLearner",
    "learning.audit": "audit_episodes",
    "control.command": "Command Controller Status",
    "control.controller": "ResolvedRateController",
    "control.limits": "Limits",
    "control.contact": "Contact",
    "control.joint_motion": "FollowMotion",
    "control.policies": "JointAttractor JointLimitAvoidance ManipulabilityAscent NullSpacePolicy "
    "WeightedPolicies ZeroPolicy",
    "control.tasks": "FreeDirection Hold PointAttractor Task Track motion",
    "planning.plan": "Plan plan",
    "planning.repeat": "Repetition repeat",
    "planning.scene": "Box Cylinder Mesh Scene Sphere",
    "control.servo_loop": "ServoLoop",
    "control.driver": "Driver RunRecord run",
    "control.simulation": "simulate",
    "control.rollout": "Rollout",
    "drivers.lerobot": "LeRobotDriver LeRobotMotor",
    "drivers.mujoco": "MuJoCoDriver",
    "drivers.record": "RecordedFiles record",
    "playback": "LiveViewer replay show",
    "errors": "ManipLearnError NoPlanError",
}
# names that are gone, and what to use instead: of 0.1 until 0.3, of 0.2 until 0.4
_REMOVED = {
    "following_error_limit": "give ServoLoop contact=Contact(stiffness=...): forces on the hand stop the arm",
    "GraspCone": "leave it out: a loose grip turns freely, a firm one is held as it was shown",
    "SelfCollisionAvoidance": "Limits(robot, clear_of=SelfCollision(robot)) keeps the links apart",
    "PenalisedManipulabilityAscent": "task.ascent() climbs the room that is left, of joint ranges too",
    **dict.fromkeys(
        ("penalised_manipulability", "penalised_manipulability_gradient", "log_penalised_manipulability_gradient"),
        "manipulability(constraint, q) says how near a singularity is, robot.position_lower and _upper the limits",
    ),
    "resample": "time stamps need not be even: leave the call out, or interpolate with numpy.interp",
    "trim_standstill": "cut a trajectory by time, demo[2.0:5.5]; the learner itself leaves out what rests",
    "CompiledController": "nothing is compiled any more: use the ResolvedRateController itself",
    "warm_up": "nothing is compiled any more: leave the call out",
    "PlacoTask": "hand PlaCo the rows A(q), b and pi yourself: A(q + dq) = A q + dt b as two joint-space half-spaces",
    "iter_demonstrations": "RecordingSource(paths, robot).part(i) reads part by part, load_demonstrations all at once",
    **dict.fromkeys(
        ("find_mechanism", "MechanismFit"),
        "ConstraintLearner(features).fit(demos).report_.mechanism has the mechanism with its uncertainty",
    ),
    "optimise_path": "ml.plan chooses posture and motion of a whole way; ManipulabilityAscent climbs on the spot",
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names.split()}
__all__ = ["Box", "CentreOfMass", "Command", "Constraint", "ConstraintLearner", "Contact", "Controller", "CurveRows"]
__all__ += ["CustomFeatures", "Cylinder", "Demonstrations", "Driver", "FeatureMap", "FollowMotion", "FrameJacobian"]
__all__ += ["FreeDirection", "Hold", "JointAttractor", "JointLimitAvoidance", "LeRobotDriver"]
__all__ += ["LeRobotMotor", "Limits", "LiveViewer", "ManipLearnError", "ManipulabilityAscent", "Mechanism"]
__all__ += ["MechanismRows", "Mesh", "MuJoCoDriver", "NoPlanError", "NullSpacePolicy", "Plan"]
__all__ += ["PointAttractor", "RecordedFiles", "RecordingSource", "RelativeFrameJacobian", "Repetition"]
__all__ += ["ResolvedRateController", "Robot", "Rollout", "RunRecord", "Scene", "SelfCollision", "ServoLoop", "Shown"]
__all__ += ["Skill", "Sphere", "Stacked", "Status", "Step", "Task", "TaskFrame", "Track", "Trajectory"]
__all__ += ["WeightedPolicies", "ZeroPolicy", "audit_episodes", "derive_velocities"]
__all__ += ["inspect_robot", "likely_tips", "load_demonstrations", "load_robot"]
__all__ += ["log_manipulability_gradient", "manipulability", "manipulability_batch", "manipulability_gradient"]
__all__ += ["motion", "plan", "record", "repeat", "replay", "run", "show", "simulate", "subsample"]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        value = getattr(importlib.import_module(f"manip_learn.{_HOMES[name]}"), name)
        globals()[name] = value
        return value
    if name in _REMOVED:
        raise AttributeError(f"{name} has been removed from manip_learn: {_REMOVED[name]}")
    raise AttributeError(f"module 'manip_learn' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
