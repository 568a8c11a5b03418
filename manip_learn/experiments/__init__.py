"""Experiments of the paper: one file for each table and figure; `reproduce` runs them."""

from manip_learn.experiments.reproduce import EXPERIMENTS, reproduce

__all__ = ["EXPERIMENTS", "reproduce"]
