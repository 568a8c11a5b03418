"""Null-space policies pi(q, t)."""

from manip_learn.control.policies.joint_attractor import JointAttractor
from manip_learn.control.policies.manipulability_ascent import ManipulabilityAscent
from manip_learn.control.policies.policy import NullSpacePolicy, ZeroPolicy

__all__ = ["JointAttractor", "ManipulabilityAscent", "NullSpacePolicy", "ZeroPolicy"]
