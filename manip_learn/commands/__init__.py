"""Commands of `manip-learn`; `cli.py` parses and prints."""
