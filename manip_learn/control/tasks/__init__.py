"""Tasks: the velocity b that the constrained rows shall have."""

from manip_learn.control.tasks.free_direction import FreeDirection
from manip_learn.control.tasks.motion import motion
from manip_learn.control.tasks.point_attractor import PointAttractor, Track
from manip_learn.control.tasks.task import Hold, Task

__all__ = ["FreeDirection", "Hold", "PointAttractor", "Task", "Track", "motion"]
