"""A robot of 7 joints loaded, over Pinocchio's own reading of the same file: what validation and names cost."""

from __future__ import annotations

import pinocchio as pin
import pytest
from timing import keep, rounds_of

from manip_learn.robot import load_robot


@pytest.mark.bench
def test_loading_over_pinocchio() -> None:
    """Sawyer, without its meshes: validation, Pinocchio model and fingerprint."""
    text = load_robot("sawyer").description
    assert text is not None
    plain = text.decode()
    candidates = {"pinocchio": lambda: pin.buildModelFromXML(plain), "ours": lambda: load_robot("sawyer")}
    seconds = rounds_of(candidates, calls=5, rounds=9)
    ratio = min(seconds["ours"]) / min(seconds["pinocchio"])
    print(f"\nsawyer: {ratio:.1f} times pin.buildModelFromXML, {1e3 * min(seconds['ours']):.1f} ms")
    keep("loading", {"sawyer": ratio})
