"""Tasks: the velocity b that the constrained rows shall have."""

from manip_learn.control.tasks.motion import FreeDirection, motion
from manip_learn.control.tasks.point_attractor import Hold, PointAttractor, Task, Track

__all__ = ["FreeDirection", "Hold", "PointAttractor", "Task", "Track", "motion"]
