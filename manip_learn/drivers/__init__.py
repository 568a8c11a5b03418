"""Arms behind the protocol of `run`, and their recording."""
