"""Stretches of whole recordings in which a constraint holds."""
