"""Resolved-rate control of a constraint, and rollouts."""
