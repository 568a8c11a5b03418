"""Public names and the modules that they are loaded from at first use."""

from .constraint.constraint import Constraint
from .constraint.features.feature_map import FeatureMap
from .constraint.features.frame_jacobian import FrameJacobian, RelativeFrameJacobian
from .constraint.features.mechanism_rows import CurveRows, MechanismRows
from .constraint.features.other_features import CentreOfMass, CustomFeatures, Stacked
from .constraint.manipulability import (
    log_manipulability_gradient,
    manipulability,
    manipulability_batch,
    manipulability_gradient,
)
from .constraint.mechanism import Mechanism
from .constraint.shown import Shown
from .constraint.skill import Skill, Step
from .constraint.task_frame import TaskFrame
from .control.command import Command, Controller, Status
from .control.contact import Contact
from .control.controller import ResolvedRateController
from .control.driver import Driver, RunRecord, run
from .control.joint_motion import FollowMotion
from .control.limits import Limits
from .control.policies import (
    JointAttractor,
    JointLimitAvoidance,
    ManipulabilityAscent,
    NullSpacePolicy,
    WeightedPolicies,
    ZeroPolicy,
)
from .control.rollout import Rollout
from .control.servo_loop import ServoLoop
from .control.simulation import simulate
from .control.tasks import FreeDirection, Hold, PointAttractor, Task, Track, motion
from .drivers.lerobot import LeRobotDriver, LeRobotMotor
from .drivers.mujoco import MuJoCoDriver
from .drivers.record import RecordedFiles, record
from .errors import ManipLearnError, NoPlanError
from .learning import ConstraintLearner
from .learning.audit import audit_episodes
from .planning.plan import Plan, plan
from .planning.repeat import Repetition, repeat
from .planning.scene import Box, Cylinder, Mesh, Scene, Sphere
from .playback import LiveViewer, replay, show
from .recordings import RecordingSource, load_demonstrations
from .recordings.trajectory import Demonstrations, Trajectory, subsample
from .recordings.velocities import derive_velocities
from .robot import Robot, load_robot
from .robot.collision import SelfCollision
from .robot.robot_summary import inspect_robot
from .robot.tips import likely_tips

__all__ = [
    "Box",
    "CentreOfMass",
    "Command",
    "Constraint",
    "ConstraintLearner",
    "Contact",
    "Controller",
    "CurveRows",
    "CustomFeatures",
    "Cylinder",
    "Demonstrations",
    "Driver",
    "FeatureMap",
    "FollowMotion",
    "FrameJacobian",
    "FreeDirection",
    "Hold",
    "JointAttractor",
    "JointLimitAvoidance",
    "LeRobotDriver",
    "LeRobotMotor",
    "Limits",
    "LiveViewer",
    "ManipLearnError",
    "ManipulabilityAscent",
    "Mechanism",
    "MechanismRows",
    "Mesh",
    "MuJoCoDriver",
    "NoPlanError",
    "NullSpacePolicy",
    "Plan",
    "PointAttractor",
    "RecordedFiles",
    "RecordingSource",
    "RelativeFrameJacobian",
    "Repetition",
    "ResolvedRateController",
    "Robot",
    "Rollout",
    "RunRecord",
    "Scene",
    "SelfCollision",
    "ServoLoop",
    "Shown",
    "Skill",
    "Sphere",
    "Stacked",
    "Status",
    "Step",
    "Task",
    "TaskFrame",
    "Track",
    "Trajectory",
    "WeightedPolicies",
    "ZeroPolicy",
    "audit_episodes",
    "derive_velocities",
    "inspect_robot",
    "likely_tips",
    "load_demonstrations",
    "load_robot",
    "log_manipulability_gradient",
    "manipulability",
    "manipulability_batch",
    "manipulability_gradient",
    "motion",
    "plan",
    "record",
    "repeat",
    "replay",
    "run",
    "show",
    "simulate",
    "subsample",
]
__version__: str
