"""What explains the recordings: a few constraints and free motion, each sample by one of them."""
