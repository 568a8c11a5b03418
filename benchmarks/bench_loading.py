"""Promise: a robot is loaded within 50 ms once the library is imported."""

from __future__ import annotations

import pytest
from timing import rounds_of, summary

from manip_learn.robot import load_robot

PROMISED = 0.050  # [s]


@pytest.mark.bench
def test_a_robot_is_loaded_within_fifty_milliseconds() -> None:
    """Sawyer, without its meshes: validation, Pinocchio model and fingerprint."""
    timing = summary(rounds_of({"sawyer": lambda: load_robot("sawyer")}, calls=5, rounds=5)["sawyer"])
    print(f"\nsawyer: {timing.median * 1e3:.1f} ms, {timing.best * 1e3:.1f} in the best round")
    assert timing.best <= PROMISED
