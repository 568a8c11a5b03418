"""What the commands of `manip-learn` do; `cli.py` parses and prints."""
