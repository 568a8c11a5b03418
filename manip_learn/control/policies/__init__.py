"""Null-space policies pi(q, t)."""

from manip_learn.control.policies.joint_attractor import JointAttractor
from manip_learn.control.policies.joint_limit_avoidance import JointLimitAvoidance
from manip_learn.control.policies.manipulability_ascent import ManipulabilityAscent
from manip_learn.control.policies.penalised_ascent import PenalisedManipulabilityAscent
from manip_learn.control.policies.policy import NullSpacePolicy, SampledPolicy, ZeroPolicy
from manip_learn.control.policies.self_collision_avoidance import SelfCollisionAvoidance
from manip_learn.control.policies.weighted_policies import WeightedPolicies, climbing

__all__ = [
    "JointAttractor",
    "JointLimitAvoidance",
    "ManipulabilityAscent",
    "NullSpacePolicy",
    "PenalisedManipulabilityAscent",
    "SampledPolicy",
    "SelfCollisionAvoidance",
    "WeightedPolicies",
    "ZeroPolicy",
    "climbing",
]
