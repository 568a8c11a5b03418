"""A teleoperator of LeRobot whose actions come from a learnt constraint: `--teleop.type=manip_learn`."""

from .config_manip_learn import ManipLearnConfig
from .manip_learn import ManipLearn

__all__ = ["ManipLearn", "ManipLearnConfig"]
