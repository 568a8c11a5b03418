"""Tasks: the velocity b that the constrained rows shall have."""

from manip_learn.tasks.hold import Hold
from manip_learn.tasks.point_attractor import PointAttractor
from manip_learn.tasks.task import Task
from manip_learn.tasks.track import Track

__all__ = ["Hold", "PointAttractor", "Task", "Track"]
