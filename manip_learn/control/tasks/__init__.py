"""Tasks: the velocity b that the constrained rows shall have."""

from manip_learn.control.tasks.hold import Hold
from manip_learn.control.tasks.point_attractor import PointAttractor
from manip_learn.control.tasks.task import Task
from manip_learn.control.tasks.track import Track

__all__ = ["Hold", "PointAttractor", "Task", "Track"]
