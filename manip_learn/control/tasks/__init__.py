"""Tasks: the desired velocity b of the constrained rows."""

from manip_learn.control.tasks.motion import FreeDirection, motion
from manip_learn.control.tasks.point_attractor import Hold, PointAttractor, Task, Track

__all__ = ["FreeDirection", "Hold", "PointAttractor", "Task", "Track", "motion"]
