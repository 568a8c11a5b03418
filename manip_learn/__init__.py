"""Learn task constraints from demonstrations, and keep the arm away from singularities."""
