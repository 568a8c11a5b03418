"""Errors carry facts, travel between processes, and their sentences help."""

from __future__ import annotations

import inspect
import pickle
from pathlib import Path

import pytest

from manip_learn import errors
from manip_learn.errors import (
    ManipLearnError,
    MissingExtraError,
    NotIdentifiableError,
    NumberOfConstraintsError,
    RecordingError,
    RobotError,
    UnknownNameError,
    closest_names,
)

ALL = [c for _, c in inspect.getmembers(errors, inspect.isclass) if c.__module__ == errors.__name__]
EXAMPLES = [
    RobotError("no", code="not-xml", path=Path("a.urdf"), line=3),
    UnknownNameError("frame", "panda_hnd", ["panda_hand", "panda_link1"], "robot 'panda'"),
    RecordingError("no", code="missing-joint", path=Path("a.csv"), line=7, column="j1"),
    NotIdentifiableError("no", code="weak-gap"),
    MissingExtraError("reading ROS bags", "ros"),
    NumberOfConstraintsError(7, 3, "FrameJacobian(...)"),
    *(c("a sentence") for c in ALL if c not in (UnknownNameError, MissingExtraError, NumberOfConstraintsError)),
]


@pytest.mark.parametrize("error_class", ALL, ids=lambda c: c.__name__)
def test_one_base(error_class):
    """Every error is a ManipLearnError, so that one except clause is enough, and its name says that it is one."""
    assert issubclass(error_class, ManipLearnError)
    assert error_class.__name__.endswith("Error")


@pytest.mark.parametrize("error", EXAMPLES, ids=lambda e: type(e).__name__)
def test_errors_travel(error):
    """Pickling (workers, dask) keeps type, sentence and facts."""
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert str(copy) == str(error)
    assert vars(copy) == vars(error)


def test_unknown_name_offers_near_ones():
    """The near matches stand in the sentence and in the attribute; the place is named."""
    error = UnknownNameError("frame", "panda_hnd", ["panda_hand", "panda_link1", "other"], "robot 'panda'")
    assert error.near[0] == "panda_hand"
    assert str(error).startswith("unknown frame 'panda_hnd' in robot 'panda': did you mean 'panda_hand'")


def test_unknown_name_without_near_ones_lists_what_there_is():
    """Nothing near: at most twelve names are listed and the others counted; nothing at all is said to be nothing."""
    error = UnknownNameError("joint", "zzz", [f"joint{i}" for i in range(20)])
    assert "and 8 more" in str(error)
    assert error.near == ()
    assert "there are no joints" in str(UnknownNameError("joint", "a", []))


def test_closest_names():
    """Similar names come first, then those that contain the word; upper case does not matter there."""
    known = ["right_hand", "right_gripper_tip", "left_hand"]
    assert closest_names("right_hnd", known)[0] == "right_hand"
    assert "right_gripper_tip" in closest_names("TIP", known)
    assert closest_names("", known) == []


def test_missing_extra_says_how_to_get_it():
    """The command that installs the extra stands in the sentence."""
    error = MissingExtraError("reading ROS bags", "ros")
    assert error.extra == "ros"
    assert "pip install 'manip_learn[ros]'" in str(error)
