"""`python -m manip_learn` is `manip-learn`."""

from manip_learn.cli import main

main()
