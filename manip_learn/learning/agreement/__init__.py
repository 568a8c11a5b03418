"""Which trajectories obey one constraint, and which do not."""
