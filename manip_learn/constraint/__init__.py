"""Constraints A(q) = Lambda Phi(q), and their manipulability."""

from manip_learn.constraint.constraint import Constraint

__all__ = ["Constraint"]
