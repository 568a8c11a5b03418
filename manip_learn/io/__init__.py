"""Files: recordings in, results out."""

from manip_learn.io.load_demonstrations import iter_demonstrations, load_demonstrations

__all__ = ["iter_demonstrations", "load_demonstrations"]
