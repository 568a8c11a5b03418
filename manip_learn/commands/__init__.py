"""Commands of the program `manip-learn`."""
