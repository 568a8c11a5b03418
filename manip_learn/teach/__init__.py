"""A simulated arm that a person guides by hand, that learns the demonstrated task and reproduces it."""
