"""Learn the selection matrix Lambda of a constraint A(q) = Lambda Phi(q) from demonstrations."""

from manip_learn.learning.learner import ConstraintLearner
from manip_learn.learning.report import LearningReport

__all__ = ["ConstraintLearner", "LearningReport"]
