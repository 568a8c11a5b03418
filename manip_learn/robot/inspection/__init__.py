"""What is worth knowing about a loaded robot, with an independent check of its kinematics."""
