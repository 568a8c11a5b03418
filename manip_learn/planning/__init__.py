"""Planning of grasp configurations, approaches and whole tasks."""
