"""Arms behind the protocol of `run`, and what records them."""
