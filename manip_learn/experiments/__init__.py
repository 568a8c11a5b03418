"""One file for each table and figure of the paper; `reproduce` runs them."""

from manip_learn.experiments.reproduce import EXPERIMENTS, reproduce

__all__ = ["EXPERIMENTS", "reproduce"]
