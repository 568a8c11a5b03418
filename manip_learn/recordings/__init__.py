"""Files: recordings in, results out."""

from manip_learn.recordings.load_demonstrations import load_demonstrations
from manip_learn.recordings.trajectory_source import RecordingSource

__all__ = ["RecordingSource", "load_demonstrations"]
