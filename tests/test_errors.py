"""Errors carry facts, travel between processes, and their sentences help."""

from __future__ import annotations

import inspect
import logging
import pickle
import unicodedata
from pathlib import Path

import numpy as np
from hypothesis import given, strategies

from manip_learn import errors
from manip_learn.errors import ManipLearnError, MissingExtraError, NumberOfConstraintsError, UnknownNameError

ALL = [c for _, c in inspect.getmembers(errors, inspect.isclass) if c.__module__ == errors.__name__]
SPECIAL = (UnknownNameError, MissingExtraError, NumberOfConstraintsError)
EXAMPLES = [
    UnknownNameError("frame", "panda_hnd", ["panda_hand", "panda_link1"], "robot 'panda'"),
    errors.RecordingError("no", code="missing-joint", path=Path("a.csv"), line=7, column="j1"),
    MissingExtraError("reading ROS bags", "ros"),
    NumberOfConstraintsError(7, 3, "FrameJacobian(...)"),
    *(c("a sentence") for c in ALL if c not in SPECIAL),
]


def test_one_base_and_one_way_to_travel():
    """One except clause is enough; names end in Error; pickling (workers, dask) keeps type, sentence and facts."""
    assert {type(error) for error in EXAMPLES} == set(ALL)
    for error in EXAMPLES:
        copy = pickle.loads(pickle.dumps(error))
        assert isinstance(error, ManipLearnError) and type(error).__name__.endswith("Error")
        assert (type(copy), str(copy), vars(copy)) == (type(error), str(error), vars(error))
        assert getattr(copy, "name", None) == getattr(error, "name", None)


def test_unknown_names_help():
    """Near names are offered, else at most twelve are listed; nothing at all is said; an extra says how to get it."""
    error = UnknownNameError("frame", "panda_hnd", ["panda_hand", "panda_link1", "other"], "robot 'panda'")
    assert error.near[0] == "panda_hand"
    assert str(error).startswith("unknown frame 'panda_hnd' in robot 'panda': did you mean 'panda_hand'")
    error = UnknownNameError("joint", "zzz", [f"joint{i}" for i in range(20)])
    assert error.near == () and str(error).endswith(" and 8 more") and str(error).count("'joint") == 12
    assert "there are no joints" in str(UnknownNameError("joint", "a", []))
    assert errors.closest_names("TIP", ["right_hand", "right_gripper_tip"]) == ["right_gripper_tip"]
    error = MissingExtraError("reading ROS bags", "ros")
    assert error.extra == "ros" and "pip install 'manip_learn[ros]'" in str(error)
    facts = errors.NoPlanError("no", largest=0.2, posture=np.zeros(2), stopped_by="a limit").facts()
    assert facts == {"largest": 0.2, "posture": [0.0, 0.0], "stopped_by": "a limit", "helps": ()}


def test_numbers_come_with_their_noun():
    """Counts have singular or plural nouns; errors are rounded to the digits that count."""
    assert (errors.counted(1, "trajectory"), errors.counted(1200, "stretch")) == ("1 trajectory", "1,200 stretches")
    words = {(8.4e-4, "degrees"): "0.0008 degrees", (7.43, "mm"): "7.4 mm", (3e-6, "m"): "better than 0.0001 m"}
    words |= {(0.0949, "mm"): "0.09 mm", (0.095, "mm"): "0.095 mm", (0.0001, "mm"): "0.0001 mm"}
    assert {pair: errors.error_in_words(*pair) for pair in words} == words


@given(strategies.text())
def test_no_character_of_a_name_controls_the_terminal(name):
    """Control characters and marks of direction are written as escapes, in a sentence and in a log; text stays."""
    for said in (errors.printable(name), str(ManipLearnError(name)).translate({10: None, 9: None})):
        assert not any(unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp") for c in said)
    if all(c.isalnum() or c == " " for c in name):
        assert errors.printable(name) == name


def test_logs_and_facts(caplog):
    """A record of the library's logger is printable; what is cut out of a sentence stays readable, and facts exact."""
    logging.getLogger("manip_learn").warning("frame %s\nis new", "a\x1b[31m\u202e\x9bé")
    assert caplog.messages == ["frame a\\x1b[31m\\u202e\\x9bé\nis new"]
    error = UnknownNameError("frame", "\x1b", ["a"])
    assert "\\x1b" in str(error) and error.facts()["name"] == "\x1b"


def test_advice_is_what_the_caller_can_write():
    """The advice names an argument in Python and a flag in a command, or no flag if the command does not have it."""
    known = ", or give the number of rows if you know it"
    assert errors.number_if_known(2) == f"{known} (n_constraints=2)"
    for flags, advice in (({"--constraints", "--lock"}, f"{known} (--constraints 2)"), ({"--lock"}, known)):
        with errors.advice_for_command(flags):
            assert errors.number_if_known(2) == advice
