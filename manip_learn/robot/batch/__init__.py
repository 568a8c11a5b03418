"""Kinematics of one frame at many configurations at once."""
