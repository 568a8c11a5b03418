"""Distances between the links of a robot, and their gradients."""

from manip_learn.robot.collision.self_collision import Proximity, SelfCollision

__all__ = ["Proximity", "SelfCollision"]
