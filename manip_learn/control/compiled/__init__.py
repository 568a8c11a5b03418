"""The control step as compiled code."""
