"""Learnt tasks in other solvers and controllers."""
