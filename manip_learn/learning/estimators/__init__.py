"""Estimators of Lambda, and the number of its rows."""
