"""Paths: null-space motion chosen over a whole horizon, where the greedy law looks at one instant."""
