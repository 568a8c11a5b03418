"""Learnt tasks in other people's solvers."""
