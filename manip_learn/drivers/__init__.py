"""Drivers of arms (LeRobot, MuJoCo), and recording of demonstrations from a driver."""
